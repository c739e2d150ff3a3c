"""Refuse numbers that a method cannot use, in a line that names the key to change."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

FRACTION = "a fraction in [0, 1]", lambda part: 0 <= part <= 1


def check_number(key: str, given: Any, wanted: str, good: Callable[[float], bool]) -> None:
    """Refuse what is no number, or no good one.

    Raises:
        ValueError: naming the key, and in words what it takes.
    """
    if isinstance(given, bool) or not isinstance(given, int | float) or not good(given):
        raise ValueError(f"{key}: expected {wanted}, but got {given}")


def check_least(least: int = 0, *, of: str = "model", **given: Any) -> None:
    """Refuse what is no whole number of at least ``least``; ``given`` by their keys in ``of``.

    Raises:
        ValueError: naming the key.
    """
    for name, count in given.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < least:
            raise ValueError(f"{of}.{name}: expected a whole number >= {least}, but got {count}")


def check_pair(key: str, given: Any) -> None:
    """Refuse what is not two whole numbers >= 1.

    Raises:
        ValueError: naming the key.
    """
    whole = isinstance(given, list | tuple) and [n for n in given if type(n) is int and n >= 1]
    if not whole or len(given) != 2 or len(whole) != 2:
        raise ValueError(f"{key}: expected two whole numbers >= 1, but got {given}")


def steps_of(
    key: str, given: Any, least: float = 1.0, *, from_start: bool = False
) -> list[tuple[float, float]]:
    """Return a schedule ``[[fraction, count], ...]`` as pairs: ``count`` from ``fraction`` of a stage on.

    Args:
        key: of the schedule.
        given: what is set there.
        least: the least count.
        from_start: whether the first fraction must be 0.

    Raises:
        ValueError: for something else, for nothing, or for fractions that do not ascend.
    """
    try:
        pairs = [(float(begin), float(count)) for begin, count in given]
    except (TypeError, ValueError):
        pairs = []
    good = pairs and all(0 <= begin <= 1 and count >= least for begin, count in pairs)
    good = good and all(one[0] <= other[0] for one, other in pairwise(pairs))
    if not good or (from_start and pairs[0][0] != 0):
        form = "[[0, count], [fraction, count], ...]" if from_start else "[[fraction, count], ...]"
        raise ValueError(
            f"{key}: expected {form} with ascending fractions and counts >= {least:g}, but got {given}"
        )
    return pairs
