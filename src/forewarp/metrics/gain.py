"""Measure the gain of an effect: compare runs with and without the effect, pair by pair."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

FACTORS = ("step", "frame", "memory", "parameters", "steps")  # measures that change by a factor

Numbers = Mapping[str, float]


@dataclass(frozen=True)
class Estimate:
    """A mean over repetitions, and the sample's standard deviation; None for a single repetition."""

    mean: float
    deviation: float | None = None

    @classmethod
    def of(cls, values: Sequence[float]) -> Estimate | None:
        """Estimate from values; None if there are none.

        >>> Estimate.of([1.0, 3.0])
        Estimate(mean=2.0, deviation=1.4142135623730951)
        """
        if not values:
            return None
        return cls(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None)


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


@dataclass(frozen=True)
class Gain:
    """The gain of an effect in trials.

    Attributes:
        psnr: mean change of PSNR, dB.
        noise: two standard errors of ``psnr``, over all pairs or over the seeds' means, whichever is larger.
        times: factor by which a step takes longer.
        steps: steps of each trial; None if the trials had equal time.
        seconds: seconds of the trials with and without the effect.
    """

    psnr: float
    noise: float
    times: float
    steps: int | None
    seconds: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(
        cls,
        pairs: Sequence[Sequence[tuple[Numbers, Numbers]]],
        steps: int | None,
        seconds: tuple[float, float] = (0.0, 0.0),
    ) -> Gain:
        """Compute the gain; ``pairs`` has for each seed a (with, without) pair for each held-out view.

        Raises:
            ValueError: for a single pair, as its noise is unknown.
        """
        every = [pair for of_seed in pairs for pair in of_seed]
        if len(every) < 2:
            raise ValueError(f"effect: expected at least 2 pairs, but got {len(every)}; hold more views out")
        change = measure_effect(every, "psnr")
        means = Estimate.of([measure_effect(of_seed, "psnr").mean for of_seed in pairs])
        errors = [
            (change.deviation or 0.0) / math.sqrt(len(every)),
            (means.deviation or 0.0) / math.sqrt(len(pairs)),
        ]
        return cls(change.mean, 2 * max(errors), measure_effect(every, "step").mean, steps, seconds)

    def __str__(self) -> str:
        own, other = self.seconds
        cost = (
            f"for {self.times:.1f} times the time" if self.steps else f"in {own:.0f} s against {other:.0f} s"
        )
        return f"trial {self.psnr:+.2f} ± {self.noise:.2f} dB {cost}"
