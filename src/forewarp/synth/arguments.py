"""Arguments of the generators, checked: one line that names the key."""

from __future__ import annotations

import operator
from collections.abc import Sequence

from forewarp.scene.errors import SceneError
from forewarp.synth.motions import MOTIONS


def check_whole(name: str, value, least: int, multiple: int = 1) -> int:
    """A whole number of at least ``least`` that ``multiple`` divides; SceneError otherwise.

    >>> check_whole("size", 16, 8)
    16
    """
    try:
        good = operator.index(value) >= least and value % multiple == 0 and not isinstance(value, bool)
    except TypeError:
        good = False
    if not good:
        kind = "a whole number" if multiple == 1 else f"a multiple of {multiple}"
        raise SceneError(f"{name}: expected {kind} of at least {least}, but got {value!r}; set {name}")
    return value


def check_numbers(**numbers: tuple[int, int]) -> None:
    """Refuse what is no whole number or too small; ``numbers`` are (value, least) by name."""
    for name, (value, least) in numbers.items():
        check_whole(name, value, least)


def check_workers(workers: int | None) -> None:
    """Refuse a number of processes that is neither None nor a whole number of at least 1."""
    if workers is not None:
        check_whole("workers", workers, 1)


def check_motion(motion: str, name: str = "motion") -> None:
    """Refuse a motion that ``motions.MOTIONS`` does not have."""
    if not isinstance(motion, str) or motion not in MOTIONS:
        raise SceneError(f"{name}: expected one of {', '.join(MOTIONS)}, but got {motion!r}; set {name}")


def check_counts(name: str, counts: Sequence[int], meaning: str) -> None:
    """Refuse what is not three whole numbers, some of them above 0; ``meaning`` says what they count."""
    try:
        good = [check_whole(name, n, 0) for n in counts]
    except TypeError:
        good = []
    if len(good) != 3 or not any(good):
        raise SceneError(
            f"{name}: expected three numbers ({meaning}), not all 0, but got {counts!r}; set {name}"
        )
