"""Measure the gain of an effect: compare runs with and without the effect, pair by pair."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

FACTORS = ("step", "frame", "memory", "parameters", "steps")  # measures that change by a factor

Numbers = Mapping[str, float]


@dataclass(frozen=True)
class Estimate:
    """A mean over repetitions, and the sample's standard deviation; None for a single repetition."""

    mean: float
    deviation: float | None = None

    @classmethod
    def of(cls, values: Iterable[float | None]) -> Estimate | None:
        """Estimate from the values that are not None; None if there are none.

        >>> Estimate.of([1.0, None, 3.0])
        Estimate(mean=2.0, deviation=1.4142135623730951)
        """
        known = [value for value in values if value is not None]
        if not known:
            return None
        return cls(statistics.fmean(known), statistics.stdev(known) if len(known) > 1 else None)


def pooled_deviation(groups: Sequence[Sequence[float]]) -> float | None:
    """Pool the standard deviation within groups that may have different means; None without repetitions.

    >>> pooled_deviation([[1.0, 3.0], [10.0, 10.0], [5.0]])
    1.0
    """
    within = [value - statistics.fmean(group) for group in groups if group for value in group]
    free = sum(len(group) - 1 for group in groups if group)
    return math.sqrt(sum(value**2 for value in within) / free) if free else None


def measure_effect(pairs: Sequence[tuple[Numbers, Numbers]], measure: str) -> Estimate | None:
    """Return the change of a measure over pairs of (with, without) that are equal in all else.

    Args:
        pairs: pairs of numbers by name; pairs without the measure are left out.
        measure: name; if in ``FACTORS`` the change is a quotient, else a difference.

    >>> measure_effect([({"psnr": 31.0, "step": 0.2}, {"psnr": 30.0, "step": 0.1})], "step")
    Estimate(mean=2.0, deviation=None)
    """
    both = [(now.get(measure), before.get(measure)) for now, before in pairs]
    both = [(now, before) for now, before in both if None not in (now, before)]
    if measure in FACTORS:
        return Estimate.of([now / before for now, before in both if before])
    return Estimate.of([now - before for now, before in both])
