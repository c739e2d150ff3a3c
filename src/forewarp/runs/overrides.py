"""List, quote and merge the overrides of a command line."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

# Keys that hold a path, a name, or a regular expression, which is always one value;
# those in which a list of paths may stand.
PATTERN = re.compile(r"(data\.)?name_pattern")
TEXTS = re.compile(
    r"data\.(root|scene)|paths\.\w+|plan\.folder|run2?|runs|resume|start|out|videos?|images|colmap|masks|curves|"
    "renders|name|device|"
    f"published|lpips_weights|rows|columns|metric|{PATTERN.pattern}"
)
LISTS = ("runs", "published", "lpips_weights", "rows", "columns", "metric")
constant: set[str] = set()  # keys that were typed with one value, which tell no jobs of a sweep apart
OF_A_SWEEP = ("sweeps=", "seeds=", "launcher=")  # these say how jobs are run, not what a job computes


def typed_overrides(*, of_sweep: bool = False) -> list[str]:
    """List the overrides of this job's command line; ``of_sweep`` keeps those that only say how jobs run.

    Outside of a job there are none.
    """
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    if not HydraConfig.initialized():
        return []
    typed = OmegaConf.to_container(HydraConfig.get().overrides.task)  # ${..} as typed
    return typed if of_sweep else [override for override in typed if not override.startswith(OF_A_SWEEP)]


def typed_folders() -> list[str]:
    """List the words of this job's command line that name folders of options, beside those of packages."""
    from hydra.core.hydra_config import HydraConfig

    hydra = HydraConfig.get()
    typed = [source.path for source in hydra.runtime.config_sources if source.provider == "command-line"]
    searched = [one for one in hydra.overrides.hydra if key_of(one) == "hydra.searchpath"]
    return [*(f"--config-dir={path}" for path in typed), *searched]


def next_command(name: str, overrides: Sequence[str]) -> str:
    """Quote a command to be typed next: its program by the path of this one's, ``.venv/bin/forewarp-view``,
    or by its name where that is found.
    """
    program = Path(sys.argv[0])
    found = shutil.which(f"forewarp-{name}")
    beside = program.absolute().with_name(f"forewarp-{name}")
    if not program.name.startswith("forewarp-") or len(program.parts) == 1 or found == str(beside):
        return command_line(name, overrides)
    near = beside.relative_to(Path.cwd()) if beside.is_relative_to(Path.cwd()) else beside
    return shlex.join([str(near), *overrides])


def command_line(name: str, overrides: Sequence[str]) -> str:
    """Quote a command so that it can be pasted into a shell.

    >>> command_line("train", ["data.scene=hook", "stage.fine.num_voxels=[[0,4000]]"])
    "forewarp-train data.scene=hook 'stage.fine.num_voxels=[[0,4000]]'"
    """
    return shlex.join([f"forewarp-{name}", *overrides])


def command_of_job(name: str) -> str:
    """Return the command that runs this job of a sweep alone, quoted."""
    typed = [one for one in typed_overrides(of_sweep=True) if not one.startswith(("seeds=", "launcher="))]
    # A sweep's file sets the mode.
    alone = ["hydra.mode=RUN"] if any(one.startswith("sweeps=") for one in typed) else []
    return command_line(name, [*typed_folders(), *alone, *map(bare, typed)])


def bare(override: str) -> str:
    r"""Write a path or a name of a scene as it was typed, which Hydra's sweepers escape; others as they are.

    >>> bare(r"run=runs/$\{data.scene\}"), bare(r"data.scene='it\'s'"), bare("seed=1")
    ('run=runs/${data.scene}', "data.scene=it's", 'seed=1')
    """
    read = parsed(override) if TEXTS.fullmatch(key_of(override)) else None
    is_text = read is not None and isinstance(read.value(), str)
    return f"{key_of(override)}={read.value()}" if is_text else override


def as_text(arguments: Sequence[str]) -> list[str]:
    r"""Quote paths, names of scenes and patterns so that Hydra keeps them as they are typed: ``VID (1).mp4``.

    What is typed in quotes, an interpolation, null where a key may be null, and a list of paths where there
    may be several are left as they are; a leading ``~/`` is the home folder.

    >>> as_text(["data.root=/data/josé", "data.scene=hand (1)", "out=null", "run='a b'", "seed=1"])
    ["data.root='/data/josé'", "data.scene='hand (1)'", 'out=null', "run='a b'", 'seed=1']
    >>> as_text(["data.scene=null", "data.scene={a}", "run=[a]", "runs=[a]"])
    ["data.scene='null'", "data.scene='{a}'", "run='[a]'", 'runs=[a]']
    >>> as_text(["runs=[my [old] runs,b]", "runs=[1] old"])
    ["runs=['my [old] runs',b]", "runs='[1] old'"]
    >>> as_text([r"data.name_pattern=(?P<frame>\d+)", "name_pattern=_(?P<frame>[0-9]+)$"])
    ["data.name_pattern='(?P<frame>\\d+)'", "name_pattern='_(?P<frame>[0-9]+)$'"]
    """
    swept, found = bool({"-m", "--multirun"} & set(arguments)), []
    for argument in arguments:
        key, _, value = argument.partition("=")
        name = key_of(argument)
        typed = TEXTS.fullmatch(name) and value and not _is_of_hydra(name, value)
        is_pattern = PATTERN.fullmatch(name)
        several = typed and not is_pattern and (swept or name == "data.scene") and is_sweep(argument)
        if typed and name != "data.scene" and value.startswith("~/"):
            value = os.path.expanduser(value)
        if name in LISTS and _is_list(value) and parsed(argument) is None:  # names with brackets
            parts = (text_override("", part.strip()).removeprefix("=") for part in value[1:-1].split(","))
            argument = f"{key}=[{','.join(parts)}]"
        found.append(text_override(key, value) if typed and not several else argument)
    return found


def _is_list(value: str) -> bool:
    """Tell whether a path or name was typed as a list of them; a folder may be called ``[1]``."""
    return value[:1] == "[" and value[-1:] == "]" and not os.path.isdir(value)


def _is_of_hydra(key: str, value: str) -> bool:
    """Tell whether a path or name was typed as Hydra's grammar has it."""
    is_quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "'\""
    is_null, is_list = value == "null" and key != "data.scene", key in LISTS and _is_list(value)
    return is_quoted or is_null or is_list or value.startswith("${")


def parsed(override: str):
    """Return an override as Hydra reads it; None where its grammar has no such thing."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    with suppress(HydraException):
        return OverridesParser.create().parse_override(override)
    return None


def is_sweep(override: str) -> bool:
    """Tell whether Hydra takes an override for several values, as ``data.scene=hook,lego``."""
    read = parsed(override)
    return read is not None and read.is_sweep_override()


def text_override(key: str, text: str) -> str:
    """Write an override whose value Hydra keeps as text, in quotes only where it needs them.

    >>> text_override("data.scene", "hand"), text_override("data.scene", "2024_11")
    ('data.scene=hand', "data.scene='2024_11'")
    """
    read = parsed(f"{key}={text}")
    if read is not None and not read.is_sweep_override() and read.value() == text:
        return f"{key}={text}"
    # In Hydra's quotes a backslash is one unless a quote follows.
    inner = re.sub(r"(\\+)(?='|$)", r"\1\1", text).replace("'", r"\'")
    return f"{key}='{inner}'"


def key_of(override: str) -> str:
    """Return the key that an override sets.

    >>> key_of("+trainer.precision=bf16-mixed"), key_of("~stage.fine")
    ('trainer.precision', 'stage.fine')
    """
    return override.split("=")[0].lstrip("+~")


def merged(overrides: Sequence[str], later: Sequence[str]) -> list[str]:
    """Join two lists of overrides; a later one replaces an earlier one of the same key.

    >>> merged(["model/view_dependence=sh", "preset.bases=12"], ["model/view_dependence=none"])
    ['preset.bases=12', 'model/view_dependence=none']
    """
    known = {key_of(override) for override in later}
    return [override for override in overrides if key_of(override) not in known] + list(later)


def without_switched_off(overrides: Sequence[str]) -> list[str]:
    """Drop settings of effects that the same overrides switch off, which Hydra would refuse.

    >>> without_switched_off(["model/motion=none", "model.trajectory.features=12", "model.renderer.step=1"])
    ['model/motion=none', 'model.renderer.step=1']
    """
    choices = [re.fullmatch("model/(.*)=none", override) for override in overrides]
    off = [f"model.{choice[1]}" for choice in choices if choice]
    off += ["model.trajectory"] if "model.motion" in off else []
    return [override for override in overrides if ".".join(key_of(override).split(".")[:2]) not in off]
