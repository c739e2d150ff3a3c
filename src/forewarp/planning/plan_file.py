"""Write a plan to ``plan.yaml``, read it, turn it into overrides, and print it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from reprlib import repr as short

import yaml

from forewarp.files import load_yaml, replace_file
from forewarp.runs.config import check_target, without_trust
from forewarp.runs.overrides import command_line, key_of, merged, without_switched_off

PATHS = ("lpips_weights",)  # top-level keys that hold paths


def write_plan(file: Path, made: dict) -> None:
    """Write a plan, with the command that made the plan on top."""
    about = f"# {command_line('plan', made.get('asked', made['typed']))}\n"
    about += "# Fit it: forewarp-train plan=<this file>; an override typed beside that wins.\n"
    replace_file(file, about + yaml.safe_dump(made, sort_keys=False, width=110, allow_unicode=True))


def read_plan(file: Path, trust: Sequence[str] = (), typed: Sequence[str] = ()) -> dict:
    """Read a ``plan.yaml``; drop overrides of ``trust``, as a file may not say what is trusted.

    Args:
        file: the file to read.
        trust: packages beside forewarp whose code the overrides may name.
        typed: overrides on this command line; the same ones in the file are accepted unchecked.

    Raises:
        ValueError: if the file is no plan, or has overrides no plan may have.
    """
    try:
        made = load_yaml(file)
        overrides = [*made["typed"], *made["overrides"], f"of={made['of']}"]
        others = [override for override in overrides if override not in typed]
        allowed = all(isinstance(override, str) and _is_harmless(override) for override in others)
    except (OSError, ValueError, TypeError, KeyError) as error:
        reason = getattr(error, "strerror", None) or (
            str(error) if isinstance(error, ValueError) else type(error).__name__
        )
        told = f"plan: expected a file that forewarp-plan wrote, but got {file} ({reason})"
        raise ValueError(f"{told}; use plan=<folder of a plan>/plan.yaml") from error
    where = f"plan: expected overrides that a plan has, but got others in {file}"
    if not allowed:
        raise ValueError(f"{where}; make it anew")
    for override in others:
        # What is typed may use the environment and write anywhere, what a file says may not.
        if "${" in override.replace("\\", ""):
            raise ValueError(f"{where}: {short(override)}; write the value, or type it beside plan=")
        if key_of(override) == "paths.runs" and not _holds(override.partition("=")[2], file):
            raise ValueError(f"{where}: {short(override)}, where the plan does not lie; type it beside plan=")
        if (key := key_of(override)).endswith("._target_"):
            check_target(override.partition("=")[2], where, key, trust)
    names = ("typed", "overrides")
    return made | {name: [word for word in made[name] if key_of(word) != "trust"] for name in names}


def _holds(folder: str, file: Path) -> bool:
    """Tell whether a file lies below a folder, which may be in quotes."""
    return file.resolve().is_relative_to(Path(folder.strip("'\"")).expanduser().resolve())


def _is_harmless(override: str) -> bool:
    """Tell whether an override only sets a key, names no code and does not change how jobs run."""
    sets = re.match(r"\+{0,2}[A-Za-z][\w./@]*=", override) is not None
    key, _, value = override.lstrip("+").partition("=")
    hides = "_target_" in override and not (key.endswith("._target_") and override.count("_target_") == 1)
    # A choice names a file below conf/, never elsewhere.
    chooses = "/" in key or "." not in key
    climbs = chooses and key not in PATHS and re.fullmatch(r"[\w ,.+\-\[\]]*", value) is None
    return sets and not hides and not climbs and ".." not in key and not key_of(override).startswith("hydra")


def with_plan(name: str, arguments: list[str]) -> list[str]:
    """Replace ``plan=FILE`` on the command line of ``forewarp-train`` by the plan's overrides.

    Args:
        name: the command; for other commands the arguments are returned unchanged.
        arguments: the command line's arguments; those typed beside ``plan=`` win over the plan.

    Raises:
        ValueError: if the file is no plan, or ``model=`` or ``resume=`` beside it contradicts it.
    """
    files = [argument.partition("=")[2] for argument in arguments if argument.startswith("plan=")]
    if name != "train" or not files:
        return arguments
    made = read_plan(Path(files[-1]).expanduser(), without_trust(arguments)[1])
    typed = [argument for argument in arguments if not argument.startswith("plan=")]
    planned = merged(made["overrides"], made["typed"])
    for override in typed:
        other_model = override.startswith("model=") and override not in planned
        if override.startswith("resume=") or other_model:
            raise ValueError(f"{override}: expected none beside plan={files[-1]}; leave one of them out")
    file = files[-1].replace("\\", "\\\\").replace("'", "\\'")
    kept = [*planned, f"planned='{file}'", "effects=given"]
    return without_switched_off(merged([*kept, *own_folder(typed)], typed))


def own_folder(typed: Sequence[str]) -> list[str]:
    """Return the override that gives a planned run its own folder; none if ``run`` or a sweep names one."""
    named = any(key_of(override) in ("run", "sweeps") for override in typed)
    return [] if named else ["run='${paths.runs}/${data.scene}/planned-{hash}'"]


def show_plan(made: dict, *, to_fit: bool = True) -> None:
    """Print a plan as a table; ``to_fit`` adds the command that fits it."""
    from rich import box
    from rich.table import Table

    from forewarp.progress import TextConsole, time_text

    title = f"planned {'before, ' if made.get('found') else ''}in {time_text(made['seconds'])}"
    if fit := made.get("fit"):
        title += f"; {fit['seconds']:g} s of it for {fit['steps']} steps of a still fit"
        title += f": {fit['share']:.0%} of the budget, on top of it"
    table = Table(box=box.SIMPLE, title=title, title_justify="left")
    for name in ("effect", "choice", "because"):
        table.add_column(name, overflow="fold")
    for effect, decision in made["effects"].items():
        table.add_row(effect, decision["choice"], decision["because"])
    console = TextConsole()
    console.print(table)
    if to_fit:
        console.print(f"fit it: forewarp-train plan={made['file']}", soft_wrap=True, highlight=False)
