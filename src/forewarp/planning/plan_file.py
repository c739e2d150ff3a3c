"""A plan as a file, as words of a command line, and on a screen."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import yaml
from rich import box
from rich.console import Console
from rich.table import Table

from forewarp.files import MOST_CONFIG, read_text, replace_file
from forewarp.progress import time_text
from forewarp.runs.overrides import as_typed, key_of, merged, of_what_is_on
from forewarp.runs.trust import check_target, without_trust

PATHS = ("lpips_weights",)  # keys of the first level that hold paths


def write_plan(file: Path, made: dict) -> None:
    """Write a plan with the command that made it, whole or not at all."""
    about = f"# {as_typed('plan', made.get('asked', made['typed']))}\n"
    about += "# Fit it: forewarp-train plan=<this file>; any word typed beside that wins.\n"
    replace_file(file, about + yaml.safe_dump(made, sort_keys=False, width=110, allow_unicode=True))


def read_plan(file: Path, trust: Sequence[str] = (), typed: Sequence[str] = ()) -> dict:
    """What a ``plan.yaml`` holds; words of trust are left out, as a file has no say in that.

    Args:
        file: to read.
        trust: packages beside forewarp whose code its words may name.
        typed: words that were typed now, so that they may be in it whatever they name.

    Raises:
        ValueError: where it is none, or has words that no plan has.
    """
    try:
        made = yaml.safe_load(read_text(file, MOST_CONFIG))
        words = [*made["typed"], *made["words"], f"of={made['of']}"]
        others = [word for word in words if word not in typed]
        allowed = all(isinstance(word, str) and _is_harmless(word) for word in others)
    except (OSError, ValueError, yaml.YAMLError, TypeError, KeyError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise ValueError(
            f"plan: expected a file that forewarp-plan wrote, but got {file} ({reason}); "
            "use plan=<folder of a plan>/plan.yaml"
        ) from error
    if not allowed:
        raise ValueError(f"plan: expected words that a plan has, but got others in {file}; make it anew")
    for word in others:
        if (key := key_of(word)).endswith("._target_"):
            where = f"plan: expected words that a plan has, but got others in {file}"
            check_target(word.partition("=")[2], where, key, trust)
    kept = {name: [word for word in made[name] if key_of(word) != "trust"] for name in ("typed", "words")}
    return made | kept


def _is_harmless(word: str) -> bool:
    """Whether a word may come from a file: none that hides code, or says how jobs are run, and no option."""
    sets = re.match(r"\+{0,2}[A-Za-z][\w./@]*=", word) is not None
    key, _, value = word.lstrip("+").partition("=")
    hides = "_target_" in word and not (key.endswith("._target_") and word.count("_target_") == 1)
    # A choice names a file below conf/, and none elsewhere.
    chooses = "/" in key or "." not in key
    climbs = chooses and key not in PATHS and re.fullmatch(r"[\w ,.+\-\[\]]*", value) is None
    return sets and not hides and not climbs and ".." not in key and not key_of(word).startswith("hydra")


def with_plan(name: str, words: list[str]) -> list[str]:
    """The words, with ``plan=FILE`` (of ``train``) replaced by what it says; those typed beside it win."""
    files = [word.partition("=")[2] for word in words if word.startswith("plan=")]
    if name != "train" or not files:
        return words
    made = read_plan(Path(files[-1]).expanduser(), without_trust(words)[1])
    typed = [word for word in words if not word.startswith("plan=")]
    planned = [word for word in planned_words(made) if word.startswith("model=")] or ["model=forward"]
    for word in typed:
        if word.startswith("resume=") or (word.startswith("model=") and word != planned[-1]):
            raise ValueError(f"{word}: expected no such word beside plan={files[-1]}; leave one of them out")
    file = files[-1].replace("\\", "\\\\").replace("'", "\\'")
    kept = [*planned_words(made), f"planned='{file}'", "effects=given"]
    return of_what_is_on(merged([*kept, *own_folder(typed)], typed))


def own_folder(typed: Sequence[str]) -> list[str]:
    """The word that gives a planned run a folder of its own, where neither a word nor a sweep names one."""
    named = any(key_of(word) in ("run", "sweeps") for word in typed)
    return [] if named else ["run='${paths.runs}/${data.scene}/planned-{hash}'"]


def planned_words(made: dict) -> list[str]:
    """All words of the run that a plan says; those that were typed for it win."""
    return merged(made["words"], made["typed"])


def tell(made: dict, *, to_fit: bool = True) -> None:
    """A plan on one screen; ``to_fit`` says how it is fitted."""
    title = f"planned {'before, ' if made.get('found') else ''}in {time_text(made['seconds'])}"
    caption = "± is two standard errors" if made["evidence"]["trials"] else "without trials: less sure"
    table = Table(box=box.SIMPLE, title=title, caption=caption, title_justify="left", caption_justify="left")
    for name in ("effect", "choice", "because"):
        table.add_column(name, overflow="fold")
    for effect, decision in made["effects"].items():
        table.add_row(effect, decision["choice"], decision["because"])
    console = Console()
    console.print(table)
    if to_fit:
        console.print(f"fit it: forewarp-train plan={made['file']}", soft_wrap=True, highlight=False)
