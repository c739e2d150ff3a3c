"""What all commands share: one line for a mistake, and the help."""

from __future__ import annotations

import errno
import logging
import os
import re
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from forewarp.cli.misspelt import unknown_key, with_keys
from forewarp.runs.folders import configurations, project_root
from forewarp.runs.renamed import refuse_renamed

TRACEBACK_VARIABLE = "FOREWARP_TRACEBACK"
MISTAKE, INTERRUPTED = 2, 130


def command(name: str, task: Callable, text: str, *, config: str | None = None) -> None:
    """Run a console script: compose ``conf/<name>.yaml`` with the command line and hand it to ``task``.

    Never returns: exits with 0; with 2 and one line for a mistake of the user's; with 130 on Ctrl-C.
    ``FOREWARP_TRACEBACK=1`` shows the whole story.

    Args:
        name: of the config file and of the command after ``forewarp-``.
        task: takes the composed config.
        text: what ``--help`` says first.
        config: the name of the config file where it is another.
    """
    quiet()
    try:
        if {"-h", "--help"} & set(sys.argv[1:]):
            print(text.strip() + "\n\n" + choices(project_root() / "conf", config or name), flush=True)
            sys.exit(0)
        sys.argv[1:] = _words(name)
        if (config or name) == "train":
            refuse_renamed(sys.argv[1:])
        failures = _run(name, task, configurations(), config or name)
    except KeyboardInterrupt:
        _interrupted(name)
    except BrokenPipeError:  # whoever read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except SystemExit as leaving:
        # Lightning turns Ctrl-C into an exit of its own.
        if isinstance(leaving.__context__, KeyboardInterrupt):
            _interrupted(name)
        raise
    except Exception as error:
        failures = [_tell(name, error, config or name)]
    sys.exit(max(failures, default=0))


def _words(name: str) -> list[str]:
    """The words of the command line as Hydra takes them."""
    words = with_keys(name, sys.argv[1:])
    if any(word.startswith("plan=") for word in words):
        from forewarp.planning.plan_file import with_plan

        return with_plan(name, words)
    return words


def quiet() -> None:
    """Settings that must stand before torch is imported, and silence for Lightning's small talk."""
    # On a busy machine threads that spin while they wait are many times slower.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Touching new pages takes a fifth to two fifths of a U-Net's step on a CPU; of large ones there are few.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it would report to its makers
    # Hydra then raises what it would print.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    logging.disable(logging.INFO)
    logging.getLogger("forewarp.metrics").setLevel(logging.ERROR)  # the table says it
    if TRACEBACK_VARIABLE not in os.environ:
        warnings.filterwarnings("ignore", module=r"(lightning|torch|tensorboard|numba)(\..*)?$")
        warnings.filterwarnings("ignore", message=".*LeafSpec.*", category=FutureWarning)


def _run(name: str, task: Callable, conf: Path, config_name: str) -> list[int]:
    """Exit statuses of the jobs that failed; with ``--multirun`` the others still run."""
    import hydra
    from hydra.core.hydra_config import HydraConfig

    from forewarp.runs.trust import TRUST_VARIABLE

    # Goes along with the job, whatever of its environment a launcher hands on.
    trust = {TRUST_VARIABLE: os.environ[TRUST_VARIABLE]} if TRUST_VARIABLE in os.environ else {}

    def job(config) -> object:
        # Caught here, as Hydra would add a line of its own.
        status, result = 0, None
        try:
            quiet()  # a launcher's process begins here
            os.environ.update(trust)
            result = task(config)
        except Exception as error:
            status = _tell(name, error, config_name)
        with suppress(OSError), open(ended, "a") as file:
            file.write(f"{status} {' '.join(HydraConfig.get().overrides.task)}\n")
        return result

    # A file, as jobs may be other processes; those of another machine do not reach it.
    with tempfile.TemporaryDirectory(prefix="forewarp-") as folder:
        ended = os.path.join(folder, "ended")
        try:
            hydra.main(version_base="1.3", config_path=str(conf), config_name=config_name)(job)()
        finally:  # a sweeper may end with an error of its own
            lines = Path(ended).read_text().splitlines() if os.path.exists(ended) else []
            jobs = [line.split(" ", 1) for line in lines]
            failed = [words for status, words in jobs if int(status)]
            if failed and len(jobs) > 1:
                listed = "".join(f"\n  {words}" for words in failed)
                print(f"forewarp-{name}: {len(failed)} of {len(jobs)} jobs failed:{listed}", file=sys.stderr)
    return [int(status) for status, _ in jobs]


def _tell(name: str, error: Exception, config_name: str) -> int:
    """Say what went wrong and return the exit status."""
    line = unknown_key(error, config_name, sys.argv[1:]) or one_line(error)
    if line is None or os.environ.get(TRACEBACK_VARIABLE) == "1":
        traceback.print_exception(error)
    print(f"forewarp-{name}: error: {line or _bug(error)}", file=sys.stderr)
    return 1 if line is None else MISTAKE


def _interrupted(name: str) -> None:
    say = "run the same command again" + (" to go on from the last checkpoint" if name == "train" else "")
    print(f"\nforewarp-{name}: interrupted; {say}", file=sys.stderr)
    sys.exit(INTERRUPTED)


def _bug(error: Exception) -> str:
    return f"{type(error).__name__}: {_flat(str(error))}; this is a bug, please report it"


def one_line(error: BaseException) -> str | None:
    """What a user should read of an error that is his to mend; None where it is ours."""
    from hydra.errors import HydraException, InstantiationException
    from omegaconf.errors import OmegaConfBaseException

    if isinstance(error, InstantiationException):
        where = _after(str(error), "full_key:")
        if isinstance(error.__cause__, ValueError | OSError | ImportError):
            return one_line(error.__cause__)
        return f"{where or 'config'}: {_flat(str(error.__cause__ or error))}"
    missing = re.search(r"Missing mandatory value: ([\w.]+)", str(error))
    if missing and isinstance(error, OmegaConfBaseException):
        return f"{missing[1]}: expected a value, but got none; set {missing[1]}=..."
    if getattr(error, "override", None):  # what Hydra could not parse
        return f"{error.override}: {_flat(str(error))}"
    if isinstance(error, HydraException) and (found := _absent_plugin(str(error))):
        kind, plugin = found
        otherwise = ", or use launcher=local" if kind == "launcher" else ""
        expected = f"{kind}: expected the package of hydra/{kind}={plugin}, but got none"
        return f"{expected}; install forewarp[sweeps]{otherwise}"
    if isinstance(error, HydraException | OmegaConfBaseException):
        cause = error.__cause__
        detail = f" ({_flat(str(cause))})" if isinstance(cause, OmegaConfBaseException) else ""
        return _flat(str(error).split("Config search path")[0]) + detail
    if isinstance(error, OSError):
        return _of_system(error)
    if (
        isinstance(error, MemoryError)
        or "can't allocate memory" in str(error)
        or "out of memory" in str(error)
    ):
        wanted = re.search(r"allocate (\d+ bytes|[\d.]+ .iB)", str(error))
        return (
            f"memory: expected room for {wanted[1] if wanted else 'more'}, but got none; lower data.rays or "
            "stage.*.num_voxels, and run the same command again"
        )
    if isinstance(error, TypeError) and "unexpected keyword argument" in str(error):
        return f"config: {error}; leave that key out"
    if isinstance(error, ImportError):
        return _flat(str(error)) + ("" if "forewarp[" in str(error) else _to_install(error))
    return _flat(str(error)) if isinstance(error, ValueError) else None


def _to_install(error: ImportError) -> str:
    """What to do about a package that is not there: of our own extras, or somebody else's."""
    ours = ("numba", "trimesh", "embreex", "scipy", "matplotlib", "tensorboard", "imageio")
    if error.name is None or error.name.partition(".")[0] in ours:
        return "; install it with make install"
    return f"; install {error.name.partition('.')[0]}, or put its folder on PYTHONPATH"


def _absent_plugin(text: str) -> tuple[str, ...] | None:
    found = re.search(r"hydra/(launcher|sweeper)[/'=:\s]+(joblib|ray|submitit_\w+|optuna)", text)
    return found and found.groups()


def _of_system(error: OSError) -> str:
    reason, file = error.strerror or str(error), error.filename
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    advice = (
        "free some room and run the same command again" if full else "check that it exists and may be written"
    )
    expected = "room to write" if full else "a usable file or folder"
    return f"{file or 'a file'}: expected {expected}, but got {reason}; {advice}"


def _after(text: str, mark: str) -> str:
    """The rest of the line after ``mark``; empty where it does not occur."""
    return text.split(mark, 1)[1].strip().splitlines()[0] if mark in text else ""


def _flat(text: str) -> str:
    lines = [line.strip() for line in text.splitlines()]
    kept = [line for line in lines if line and not line.startswith(("full_key:", "object_type="))]
    return "; ".join(kept).replace(":; ", ": ").replace(".; ", "; ")


def choices(conf: Path, name: str) -> str:
    """The options of every group that ``<name>.yaml`` uses, for the help."""
    if name != "train":
        text = (conf / f"{name}.yaml").read_text()
        groups = [group for group in ("dataset", "trainer") if f"- {group}:" in text]
    else:
        silent = {"hydra", "paths", "callbacks", "dataset"}
        folders = [path for path in sorted(conf.rglob("*")) if path.is_dir() and path.name != "one"]
        groups = [p.relative_to(conf).as_posix() for p in folders]
        # model_preset and its like follow from what is chosen.
        groups = [g for g in groups if g.split("/")[0] not in silent and not g.startswith("model_")]
    found = {group: sorted(path.stem for path in (conf / group).glob("*.yaml")) for group in groups}
    if name == "train":
        found["sweeps"] = [
            f"{path.stem} (with --multirun)" for path in sorted((conf.parent / "sweeps").glob("*.yaml"))
        ]
    lines = [f"  {group:<17} {' | '.join(options)}" for group, options in found.items() if options]
    more = [
        "Every other key: --cfg job prints them all; key=value sets one.",
        "Hydra's own options: --hydra-help.",
    ]
    return "\n".join((["Choices (group=option):", *lines, ""] if lines else []) + more)
