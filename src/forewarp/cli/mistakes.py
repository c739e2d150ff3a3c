"""Answer mistakes in one line: a command line that is nearly right, or an exception raised by a run."""

from __future__ import annotations

import difflib
import errno
import inspect
import mimetypes
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from shlex import quote

from forewarp.data.files import LAYOUTS, layout_of
from forewarp.runs.config_files import configurations, installed
from forewarp.runs.overrides import key_of

OF_METHODS = ("model", "modules", "objective", "preset", "stage")  # what methods have keys of their own in
# Hydra's own, which begin with dashes; after those of ``VALUED`` a word follows.
VALUED = ("cfg", "package", "config-path", "config-name", "config-dir", "experimental-rerun")
OPTIONS = (*VALUED, "help", "hydra-help", "version", "resolve", "run", "multirun", "shell-completion", "info")
VALUED = {*(f"--{option}" for option in VALUED), "-c", "-p", "-cp", "-cn", "-cd"}
# Commands that take a file or a folder alone, and the key that it is the value of.
KEYS = {
    "evaluate": "run",
    "render": "run",
    "view": "run",
    "export": "run",
    "report": "run",
    "train": "resume",
}
KEYS |= {"capture": "video", "open": "video"}
RESULTS = ("runs", "opened")  # where runs lie by default: those in runs/hand are meant by hand, too
_OF_RUN = ("config.yaml", "*/config.yaml", "*/*/config.yaml")  # of its folder, and of those above


def with_keys(name: str, arguments: list[str]) -> list[str]:
    """Put the key before a file or folder that is typed alone: ``run=`` before that of a run, also of one
    that holds a single run; ``resume=`` for ``train``; ``video=``, ``images=`` or ``videos=`` for
    ``capture``. A folder whose name reads as an override, as Hydra names those of a sweep, needs its path:
    ``./seed=0``.

    Args:
        name: name of the command.
        arguments: arguments of the command line.

    Raises:
        ValueError: for what the command cannot take, with what to type.
    """
    found = []
    for word, before in zip(arguments, ["", *arguments]):
        is_other = re.match("$|[-~+]|[^/]*=", word) is not None  # nothing, an option or an override
        is_alone = name in KEYS and not is_other and before[:1] != "-"
        found += _with_key(name, word) if is_alone else [word]
    if name == "report" and any(one.startswith("run=") for one in found):
        found += [] if any(one.startswith("kind=") for one in found) else ["kind=run"]
    return found


def _with_key(name: str, word: str) -> list[str]:
    """Return the override that a word typed alone stands for, or itself, if it is no file and no folder."""
    path, key = Path(word), KEYS[name]
    if key == "video":
        if path.is_dir() and name == "capture":
            inner = [one for one in path.iterdir() if not one.name.startswith(".")]
            of_cameras = any(map(_is_film, inner)) or (inner and all(map(Path.is_dir, inner)))
            return [f"{'videos' if of_cameras else 'images'}={word}"]
        return [f"video={word}"] if path.exists() or _is_film(path) else [word]
    if _is_film(path):
        expected = f"{word}: expected the folder of a run, but got a film"
        raise ValueError(f"{expected}; type forewarp-open {quote(word)}")
    places = [path, *(Path(root) / path for root in RESULTS if key == "run" and not path.is_absolute())]
    if (place := next((one for one in places if one.is_dir()), None)) is None:
        return [word]
    runs = next((made for mark in _OF_RUN if (made := sorted(place.glob(mark)))), [])
    if not runs and (layout := layout_of(place)) is not None:
        scene, way = place.resolve(), LAYOUTS[layout][1]
        if way.startswith("experiment="):
            way = f"forewarp-train {way} data.root={quote(str(scene.parent))} data.scene={quote(scene.name)}"
        raise ValueError(f"{word}: expected the folder of a run, but got a scene; type {way}")
    if len(runs) > 1 and name not in ("export", "report"):  # which take those of a film's windows, and tables
        names = ", ".join(str(run.parent) for run in runs[:3]) + ", ..." * (len(runs) > 3)
        raise ValueError(f"{word}: expected one run, but got {len(runs)}; type {key}= and one of {names}")
    key = "runs" if name == "report" and len(runs) != 1 else key
    return [f"{key}={runs[0].parent if len(runs) == 1 and runs[0].parent != path else word}"]


def _is_film(path: Path) -> bool:
    kind = mimetypes.guess_type(path.name)[0] or ""
    return not path.is_dir() and (kind.startswith("video/") or path.suffix.lower() == ".r3d")


def refuse_dashes(arguments: list[str]) -> None:
    """Refuse what is typed as other programs have it, ``--experiment dnerf`` or ``experiment dnerf``; Hydra's
    own options pass.

    Raises:
        ValueError: with the way to type it.
    """
    for at, argument in enumerate(arguments):
        key, _, value = argument.removeprefix("--").partition("=")
        if argument.startswith("--") and key not in OPTIONS:
            follows = arguments[at + 1] if not value and at + 1 < len(arguments) else ""
            value = value or ("" if "=" in follows or follows[:1] == "-" else follows)
            says = f"expected options without dashes; type {key}={value or 'VALUE'}"
            if not value and (near := difflib.get_close_matches(key, OPTIONS, 1, cutoff=0.75)):
                says = f"expected an option of Hydra's, but got none of this name; did you mean --{near[0]}?"
            raise ValueError(f"{argument}: {says}")
        if re.fullmatch(r"[\w.@/]+", argument) and (at == 0 or arguments[at - 1][:1] != "-"):
            follows = arguments[at + 1] if at + 1 < len(arguments) else "VALUE"
            value = "VALUE" if "=" in follows or follows[:1] == "-" else follows
            advice = "" if "/" in argument else f"; type {argument}={value}"
            raise ValueError(f"{argument}: expected KEY=VALUE or an existing folder, but got neither{advice}")


def options_last(arguments: list[str]) -> list[str]:
    """Put options that begin with dashes behind the overrides, as Hydra refuses them in between.

    >>> options_last(["model=nerf", "--cfg", "job", "--multirun", "seed=0,1", "--info", "~stage.fine"])
    ['model=nerf', 'seed=0,1', '~stage.fine', '--cfg', 'job', '--multirun', '--info']
    """
    overrides, options = [], []
    for word, before in zip(arguments, ["", *arguments]):
        follows = before in VALUED or (before in ("--info", "-i") and re.fullmatch("[a-z-]+", word))
        (options if follows or word.startswith("-") else overrides).append(word)
    return overrides + options


def unknown_key(error: Exception, name: str, arguments: list[str]) -> str | None:
    """Return the line for an unknown key, with the nearest known one; None for any other error.

    Args:
        error: raised by Hydra.
        name: name of the config file.
        arguments: arguments of the command line.
    """
    from hydra.errors import HydraException

    from forewarp.runs.sections import option_groups

    unknown = re.match(r"Could not override '([^'@]+)'", str(error))
    if unknown is None or not isinstance(error, HydraException):
        return None
    typed = unknown[1]
    inner = re.search(r"full_key: (\S+)", str(error.__cause__))  # where the value is a dictionary, its key
    key = inner[1] if inner else typed
    others = [argument for argument in arguments if key_of(argument) != typed]
    config = _composed(name, others)
    keys = list(_every_key(config))
    if key in keys and {"--multirun", "-m"} & set(arguments):
        return f"{key}: expected an option of every job, but got one that not all have; leave it out"
    of_own = [*(one for one in others if key_of(one) != "start_motion"), "start_motion=own"]
    if name == "train" and key in _every_key(_composed(name, of_own)):
        expected = "expected a key of a run that begins with the motion of particles, but got one of its own"
        return f"{key}: {expected}; add start_motion=own"
    if key in _every_key(_composed(name, [one for one in others if key_of(one) in ("model", "preset")])):
        removed = "expected an option, but got one that another one typed here removes"
        return f"{key}: {removed}; leave one of them out"
    if plus := _needs_plus(config, key, keys):
        value = next((one.partition("=")[2] for one in arguments if key_of(one) == key), "VALUE")
        expected = "expected + before a key that is not in this configuration, but got none"
        return f"{key}: {expected}; type {plus}={value}"
    if name == "train" and key.startswith(OF_METHODS):
        for model in ("forward", "particles"):
            of_model = [*(one for one in others if key_of(one) != "model"), f"model={model}"]
            if key.replace("/", ".") in _every_key(_composed(name, of_model)):
                return of_another(key, config.model.name, model)
    groups = option_groups(configurations(), *installed().values())
    # The last part of a key, as minutes of budget.minutes, of which the shortest is meant.
    inner = sorted(
        (one for one in keys if one.endswith(f".{key}")), key=lambda one: (one.count("."), len(one))
    )
    near = difflib.get_close_matches(key, [*keys, *groups], 1, cutoff=0.8) or inner
    advice = f"did you mean {near[0]}?" if near else f"forewarp-{name} --cfg job prints all keys"
    return f"{key}: expected a key of the configuration, but got none of this name; {advice}"


def _needs_plus(config, key: str, keys: Sequence[str]) -> str | None:
    """Return ``+key`` if the class that is configured there, or the method's terms, have it, else None."""
    from hydra.utils import get_object
    from omegaconf import OmegaConf

    parent, _, argument = key.rpartition(".")
    is_term = re.fullmatch(r"objective\.\w+\.(weights|every)", parent) is not None
    target = (
        OmegaConf.select(config, f"{'model' if is_term else parent}._target_") if parent in keys else None
    )
    siblings = [one[len(parent) + 1 :] for one in keys if one.startswith(f"{parent}.")]
    # Of what is nearly another key, the class is not imported: that may take seconds.
    if target is None or difflib.get_close_matches(argument, siblings, 1, cutoff=0.85):
        return None
    with suppress(Exception):  # an import may raise anything
        made = get_object(target)
        return f"+{key}" if argument in (made.terms if is_term else _arguments_of(made)) else None
    return None


def _arguments_of(made: Callable) -> Iterator[str]:
    """Yield the arguments with a default of a class, and of bases and a reader that it hands others to."""
    for part in (getattr(made, "_described_by", None), *getattr(made, "__mro__", [made])):
        call = vars(part).get("__init__") if inspect.isclass(part) else part
        parameters = inspect.signature(call).parameters.values() if call else ()
        yield from (one.name for one in parameters if one.default is not one.empty)
        if (
            parameters
            and inspect.isclass(part)
            and all(one.kind is not one.VAR_KEYWORD for one in parameters)
        ):
            return


def of_another(option: str, model: str, owner: str) -> str:
    """Return the line for an option that the chosen method has not, but ``owner`` has."""
    expected = f"expected an option of model={model}, but got one of model={owner}"
    return f"{option}: {expected}; add model={owner}, or leave it out"


def _composed(name: str, arguments: list[str]):
    """Compose the config with the other arguments, less those of a sweep; alone, if they are wrong."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser

    of_sweep = GlobalHydra.instance().hydra  # the other jobs need it
    GlobalHydra.instance().clear()
    dirs = [one.partition("=")[2] for one in arguments if one.startswith("--config-dir=")]
    dirs += [after for before, after in zip(arguments, arguments[1:]) if before == "--config-dir"]
    more = [f"hydra.searchpath=[{','.join(f'file://{Path(d).resolve()}' for d in dirs)}]"] if dirs else []
    try:
        with hydra.initialize_config_dir(str(configurations()), version_base="1.3"):
            with suppress(Exception):
                typed = [one for one in arguments if one[:1] == "~" or ("=" in one and one[:1] != "-")]
                parsed = OverridesParser.create().parse_overrides(typed)
                one_job = [override.input_line for override in parsed if not override.is_sweep_override()]
                return hydra.compose(name, [*more, *one_job])
            return hydra.compose(name)
    finally:
        GlobalHydra.instance().hydra = of_sweep


def _every_key(node, prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of a config, each before those within it."""
    from omegaconf import DictConfig

    for key in (key for key in node if not str(key).startswith("_")):
        yield f"{prefix}{key}"
        inner = node._get_node(key)
        if isinstance(inner, DictConfig) and not (inner._is_none() or inner._is_missing()):
            yield from _every_key(inner, f"{prefix}{key}.")


def one_line(error: BaseException) -> str | None:
    """Return the line for an error that the user can mend; None for a bug of forewarp."""
    from hydra.errors import HydraException, InstantiationException
    from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

    if isinstance(error, InterpolationKeyError):
        key = re.sub(r".*key '(.*)' not found", r"${\1}", flat(str(error)))
        return f"{key}: expected a key of the configuration, but got none of this name; no name may hold ${{"
    if isinstance(error, InstantiationException):
        if isinstance(error.__cause__, ValueError | OSError | ImportError):
            return one_line(error.__cause__)
        where = re.search(r"full_key: *(.+)", str(error))
        return f"{where[1].strip() if where else 'config'}: {flat(str(error.__cause__ or error))}"
    missing = re.search(r"Missing mandatory value: ([\w.]+)", str(error))
    if missing and isinstance(error, OmegaConfBaseException):
        return f"{missing[1]}: expected a value, but got none; set {missing[1]}=..."
    absent = re.match(r"Missing key .*?\n *full_key: *(\S+)", str(error), re.DOTALL)
    if absent and isinstance(error, OmegaConfBaseException):  # a stored config, from which it was taken
        return f"{absent[1]}: expected a value in the run's config.yaml, but got no such key; add {absent[1]}"
    if getattr(error, "override", None):  # Hydra could not parse it
        return f"{error.override}: {flat(str(error))}"
    if isinstance(error, HydraException) and (line := _of_hydra(str(error))):
        return line
    if isinstance(error, HydraException | OmegaConfBaseException):
        cause = error.__cause__
        detail = f" ({flat(str(cause))})" if isinstance(cause, OmegaConfBaseException) else ""
        return flat(str(error).split("Config search path")[0]) + detail
    if isinstance(error, RuntimeError) and re.search("disk is full|no space left", str(error), re.IGNORECASE):
        error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # of a library that writes by itself
    if isinstance(error, OSError):
        expected, advice = "a usable file or folder", "check that it exists and may be written"
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            expected, advice = "room to write", "free some room and run the same command again"
        got = error.strerror or str(error)
        return f"{error.filename or 'a file'}: expected {expected}, but got {got}; {advice}"
    if isinstance(error, MemoryError) or re.search("can't allocate memory|out of memory", str(error)):
        wanted = re.search(r"allocate (\d+ bytes|[\d.]+ .iB)", str(error))
        advice = "lower stage.*.density, or with model=forward data.rays or stage.*.num_voxels, and run the "
        advice += "same command again"
        return f"memory: expected room for {wanted[1] if wanted else 'more'}, but got none; {advice}"
    if type(error).__module__.partition(".")[0] == "jinja2":
        got = f"others, which a page cannot show ({flat(str(error))}); leave that run's folder out"
        return f"runs: expected files as forewarp-train and forewarp-evaluate write them, but got {got}"
    if isinstance(error, RuntimeError) and "home directory" in str(error):  # pathlib's
        return "~: expected a user with a home folder, but got none; write the whole path"
    if isinstance(error, TypeError) and "unexpected keyword argument" in str(error):
        return f"config: {error}; leave that key out"
    if isinstance(error, ImportError):
        return flat(str(error)) + ("" if "forewarp[" in str(error) else _to_install(error))
    return flat(str(error)) if isinstance(error, ValueError) else None


def _of_hydra(said: str) -> str | None:
    """Return the line for what Hydra says of an option that there is not, or of several values; else None."""
    if absent := re.search(r"hydra/(launcher|sweeper)[/'=:\s]+(joblib|ray|submitit_\w+|optuna)", said):
        kind, plugin = absent.groups()
        otherwise = ", or use launcher=local" if kind == "launcher" else ""
        expected = f"{kind}: expected the package of hydra/{kind}={plugin}, but got none"
        return f"{expected}; install forewarp[sweeps]{otherwise}"
    if several := re.match(r"Ambiguous value for argument '([^=]+)=(.*)'", said):
        key, value = several.groups()
        advice = f"add --multirun for a job of each, or type a name that has a comma as \"{key}='{value}'\""
        return f"{key}: expected one value, but got {value}, which reads as several; {advice}"
    if not (absent := re.search(r"Could not (?:find|load) '([\w/]+)/([^'/]+)'", said)):
        return None
    group, word = absent.groups()
    if group.partition("/")[0] == "trainer":
        word = f"{group}/{word}".partition("/")[2]
        from forewarp.runs.devices import instead_of

        return f"trainer: expected auto, cpu or gpu, but got {word}; {instead_of(word)}"
    from forewarp.runs.sections import option_groups

    said = flat(text := said.split("Config search path")[0])
    known = option_groups(configurations(), *installed().values()).get(group, [])
    if known and "Available" not in said:
        said += f" Available options in '{group}': {'; '.join(known)}"
    options = [*known, *re.findall(r"^\t(\S+)$", text, re.M)]
    near = [one for one in options if one.startswith(word)] or difflib.get_close_matches(word, options, 1)
    return said + (f"; did you mean {near[0]}?" if near else "")


def _to_install(error: ImportError) -> str:
    """Say how to get a missing package: one of forewarp's extras, or another."""
    ours = ("numba", "trimesh", "embreex", "scipy", "matplotlib", "tensorboard", "imageio")
    if error.name is None or error.name.partition(".")[0] in ours:
        return "; install it with make install"
    return f"; install {error.name.partition('.')[0]}, or put its folder on PYTHONPATH"


def flat(text: str) -> str:
    """Join the lines of a message into one, without Hydra's own details."""
    lines = [line.strip() for line in text.splitlines()]
    kept = [line for line in lines if line and not line.startswith(("full_key:", "object_type="))]
    return "; ".join(kept).replace(":; ", ": ").replace(".; ", "; ")
