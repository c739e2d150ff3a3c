"""Run any of the commands: compose its config, print its help, end mistakes in one line."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import re
import secrets
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import forewarp
from forewarp.cli.mistakes import flat, one_line, options_last, refuse_dashes, unknown_key, with_keys
from forewarp.interrupts import listening, signal_of
from forewarp.progress import printable_output
from forewarp.provenance import drop_missing_backend, import_nothing_from_here
from forewarp.runs import overrides
from forewarp.runs.config_files import configurations, installed, project_root
from forewarp.runs.overrides import as_text, command_of_job, is_sweep, key_of
from forewarp.runs.windows import commands_of, scores_of

TRACEBACK_VARIABLE = "FOREWARP_TRACEBACK"
MISTAKE = 2
INTERRUPTED = 128  # and the number of the signal
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # of mallopt, in glibc's malloc.h


@printable_output()
def command(name: str, task: Callable, text: str, *, config: str | None = None) -> None:
    """Run a console script: compose ``conf/<config>.yaml`` with the command line and call ``task`` with it.

    Never returns. The exit status is 0; 2 after a mistake of the user's, which is told in one line; 1 after a
    bug, with its traceback; 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP. ``FOREWARP_TRACEBACK=1``
    always shows the traceback.

    Args:
        name: the command's name after ``forewarp-``.
        task: takes the composed config.
        text: the beginning of ``--help``.
        config: the config file's name if it is another.
    """
    config = config or name
    quiet()
    try:
        if {"-h", "--help"} & set(sys.argv[1:]):
            print(text.strip() + "\n\n" + choices(project_root() / "conf", config), flush=True)
            sys.exit(0)
        if "--version" in sys.argv[1:]:
            print(f"forewarp {forewarp.__version__}", flush=True)
            sys.exit(0)
        if any(argument.partition("=")[0] in ("--info", "-i") for argument in sys.argv[1:]):
            logging.disable(logging.NOTSET)  # Hydra logs what it prints
        failures: list[int] = []
        words = arguments_of(name, sys.argv[1:])
        with listening():
            for sys.argv[1:] in commands_of(words) if name == "train" else [words]:
                failures += _run(name, task, configurations(), config)
                if any(failures):
                    break
    except KeyboardInterrupt as interruption:
        sys.exit(interrupted(name, interruption))
    except SystemExit as leaving:
        # Lightning turns Ctrl-C into its own exit.
        if isinstance(leaving.__context__, KeyboardInterrupt):
            sys.exit(interrupted(name, leaving.__context__))
        raise
    except Exception as error:
        failures = [_tell(name, error, config)]
    sys.exit(max(failures, default=0))


def run_part(name: str, task: Callable, typed: Sequence[str]) -> None:
    """Run another command within this one, as if these words were typed after its name; where it fails, which
    it has told, leave with its status.
    """
    from hydra.core.global_hydra import GlobalHydra

    of_this, words = GlobalHydra.instance().hydra, sys.argv
    GlobalHydra.instance().clear()
    try:
        sys.argv = [str(Path(words[0]).with_name(f"forewarp-{name}")), *arguments_of(name, typed)]
        failures = _run(name, task, configurations(), name)
    finally:
        sys.argv, GlobalHydra.instance().hydra = words, of_this
    if any(failures):
        sys.exit(max(failures))


def arguments_of(name: str, typed: Sequence[str]) -> list[str]:
    """Return a command line as Hydra takes it: a bare file or folder has its key, a plan is its overrides,
    options come last.

    ``dataset=NAME`` is ``experiment=NAME`` where scenes are trained on, and a group where they are written.
    """
    _refuse_half_decoded(typed)
    arguments = as_text(with_keys(name, typed))
    if name in ("train", "plan"):
        arguments = [re.sub(r"^dataset=", "experiment=", argument) for argument in arguments]
        for seeds in (argument[6:] for argument in arguments if argument.startswith("seeds=")):
            if not re.fullmatch("[1-9][0-9]*", seeds):  # of none Hydra would run nothing, and say nothing
                raise ValueError(f"seeds: expected a whole number of at least 1, but got {seeds}")
    arguments += ["~hydra.callbacks.cost"] * (name == "plan")  # its jobs train nothing
    refuse_dashes(arguments)
    if any(argument.startswith("plan=") for argument in arguments):
        from forewarp.planning.plan_file import with_plan

        arguments = with_plan(name, arguments)
    return options_last(arguments)


def _refuse_half_decoded(words: Sequence[str]) -> None:
    """Refuse words that no file in UTF-8 can hold, which a run, its trackers and its page write."""
    for word in words:
        if word.encode(errors="replace").decode() == word:
            continue
        if (encoding := sys.getfilesystemencoding()) == "utf-8":
            raise ValueError(f"expected words in UTF-8, but got {ascii(word)}; rename the file or folder")
        raise ValueError(f"{ascii(word)}: Python reads names as {encoding} here; set PYTHONUTF8=1")


def quiet() -> None:
    """Set what must be set before torch is imported, and silence the notices of other packages."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError):  # of a test's, or none
            stream.reconfigure(errors="backslashreplace")  # of a terminal that knows ASCII only
    wait_briefly()
    # Large pages: first touches of small ones take 20 to 40 % of a U-Net's step on a CPU.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    _keep_memory()
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report usage to its makers
    drop_launchers()
    import_nothing_from_here()
    drop_missing_backend()
    # Lets Hydra raise errors instead of printing them.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    logging.disable(logging.INFO)
    logging.getLogger("forewarp.metrics").setLevel(logging.ERROR)  # the table says the same
    logging.getLogger("lightning.pytorch.loggers.mlflow").setLevel(logging.ERROR)  # of its first run
    if TRACEBACK_VARIABLE not in os.environ:
        warnings.filterwarnings("ignore", module=r"(lightning|torch|tensorboard|numba)(\..*)?$")
        warnings.filterwarnings("ignore", message=".*LeafSpec.*", category=FutureWarning)


def wait_briefly() -> None:
    """Say how threads wait for work, before torch is imported.

    Those that wait spinning are many times slower on a busy machine; those that sleep at once wake so late
    that a second thread brings nothing. Spinning for a fraction of a millisecond first avoids both.
    """
    if os.environ.setdefault("OMP_WAIT_POLICY", "passive").lower() == "passive":
        os.environ.setdefault("GOMP_SPINCOUNT", "10000")


def drop_launchers() -> None:
    """Leave out variables that would decide in a command's place: Lightning takes arguments of its trainer
    from some, and cannot be imported beside a rank that is no number.
    """
    for name, value in list(os.environ.items()):
        is_rank = name in ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
        if name.startswith("PL_TRAINER_") or (is_rank and not value.isdecimal()):
            del os.environ[name]


def _keep_memory() -> None:
    """Let freed memory stay with the process, where the C library can be told so.

    A step takes again what the step before has freed; every page that went back to the system in between is
    fetched and cleared anew, which took more of a particles' step than its arithmetic on a busy machine.
    """
    with suppress(OSError, AttributeError, TypeError):
        limit = ctypes.CDLL(None).mallopt
        for option, size in ((_MMAP_THRESHOLD, 32 << 20), (_TRIM_THRESHOLD, 1 << 30)):
            limit(option, size)


def _run(name: str, task: Callable, conf: Path, config_name: str) -> list[int]:
    """Return the exit status of each job; with ``--multirun`` a failed job does not stop the others."""
    import hydra

    from forewarp.runs.config import TRUST_VARIABLE
    from forewarp.runs.jobs import PlanOnly

    # Travels with the job, as a launcher may not pass the environment on.
    trust = {TRUST_VARIABLE: os.environ[TRUST_VARIABLE]} if TRUST_VARIABLE in os.environ else {}
    typed_once = {key_of(word) for word in sys.argv[1:] if not word.startswith("-") and not is_sweep(word)}
    overrides.constant.clear()  # of an earlier sweep of this process
    overrides.constant.update(typed_once)

    @printable_output()
    def job(config) -> object:
        status, result = 0, None
        try:
            quiet()  # again, as a launcher may start another process
            os.environ.update(trust)
            overrides.constant.update(typed_once)  # it may be another process
            result = task(config)
        except Exception as error:  # caught here, as Hydra would print a message of its own
            status = _tell(name, error, config_name)
        score = result if isinstance(result, int | float) else None
        found = [None, None] if status else [str(config.get("run")), config.get("score")]
        row = [status, command_of_job(name), *found, score]
        if os.getpid() == launched_by:
            jobs.append(row)
            return result
        with suppress(OSError), open(ended, "a") as file:
            file.write(json.dumps(row) + "\n")
        return result

    # Jobs of other processes tell in a file, which they make, so that a killed command leaves none; those of
    # other machines do not reach it.
    jobs, launched_by = [], os.getpid()
    ended = Path(tempfile.gettempdir()) / f"forewarp-{secrets.token_hex(16)}"
    try:
        hydra.main(version_base="1.3", config_path=str(conf), config_name=config_name)(job)()
    except PlanOnly as ended_by:
        if (error := ended_by.error) is not None:  # no job began, so none says what is wrong
            error = error if one_line(error) else ValueError(f"{type(error).__name__}: {error}")
            return [_tell(name, error, config_name)]
    finally:  # a sweeper may fail, too
        with suppress(FileNotFoundError):
            jobs += [json.loads(line) for line in ended.read_text().splitlines()]
            ended.unlink()
        if len(jobs) > 1:
            _tell_jobs(name, jobs)
    return [status for status, *_ in jobs]


def _tell_jobs(name: str, jobs: list[tuple[int, str, str | None, str | None, float | None]]) -> None:
    """Print the folder and the score of each job of a sweep, and the commands of those that failed."""
    failed = [words for status, words, *_ in jobs if status]
    done = [job for job in jobs if not job[0]]
    if name == "train" and done:
        scored = {metric for *_, metric, score in done if score is not None}
        about = f", {' and '.join(sorted(scored))} of held-out or validation views" if scored else ""
        print(f"{len(done)} jobs{about}:")
        for _, _, run, _, score in done:
            print(f"  {'' if score is None else f'{score:.4f}':>9}  {run}")
        for line in scores_of(job[2] for job in done):
            print(line)
        sys.stdout.flush()
    if failed:
        about = f"forewarp-{name}: {len(failed)} of {len(jobs)} jobs failed:"
        print(about, *failed, sep="\n  ", file=sys.stderr)


def _tell(name: str, error: Exception, config_name: str) -> int:
    """Print what went wrong and return the exit status."""
    line = unknown_key(error, config_name, sys.argv[1:]) or one_line(error)
    if line is None or os.environ.get(TRACEBACK_VARIABLE) == "1":
        traceback.print_exception(error)
    bug = f"{type(error).__name__}: {flat(str(error))}; this is a bug, please report it"
    print(f"forewarp-{name}: error: {line or bug}", file=sys.stderr)
    return 1 if line is None else MISTAKE


def interrupted(name: str, interruption: KeyboardInterrupt) -> int:
    """Say what ended a command and how to go on; return the exit status, 128 and the number of the signal."""
    number = signal_of(interruption)
    ended = "interrupted" if number == signal.SIGINT else f"ended by {number.name}"
    ways = dict.fromkeys(("reproduce", "open"), " to go on")
    way = {"train": " to go on from the last checkpoint", **ways}.get(name, "")
    print(f"\nforewarp-{name}: {ended}; run the same command again{way}", file=sys.stderr)
    return INTERRUPTED + number


def choices(conf: Path, name: str) -> str:
    """List the options of every group that ``<name>.yaml`` uses, for the help, those of packages too."""
    from forewarp.runs.sections import option_groups

    groups = option_groups(conf, *installed().values())
    if name == "train":
        # Chosen by other choices, or by nobody.
        groups = {g: groups[g] for g in groups.keys() - {"dataset", "hydra", "numbers", "paths", "stage/one"}}
        sweeps = sorted((conf.parent / "sweeps").glob("*.yaml"))
        sweeps = [*(path.stem for path in sweeps), *groups.get("sweeps", ())]
        groups["sweeps"] = [f"{sweep} (with --multirun)" for sweep in sweeps]
    else:
        text = (conf / f"{name}.yaml").read_text()
        groups = {group: groups[group] for group in ("dataset", "trainer") if f"- {group}:" in text}
    lines = [f"  {group:<17} {' | '.join(groups[group])}" for group in sorted(groups) if groups[group]]
    more = ["Every other key: --cfg job prints them all; key=value sets one."]
    more.append("Where options come from: --info defaults-tree or searchpath. Hydra's own: --hydra-help.")
    return "\n".join((["Choices (group=option):", *lines, ""] if lines else []) + more)
