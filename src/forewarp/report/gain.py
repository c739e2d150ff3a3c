"""Measure what an effect is worth: compare runs with it and without, pair by pair."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from forewarp.report.tables import Estimate

DIFFERENCES = ("psnr", "ssim", "epe")  # other measures change by a factor

Numbers = Mapping[str, float]


def measure_effect(pairs: Sequence[tuple[Numbers, Numbers]], measure: str) -> Estimate | None:
    """Return the change of a measure over pairs of (with, without) that are equal in all else.

    Args:
        pairs: numbers by name; a pair that lacks the measure is left out.
        measure: its change is a difference if it is in ``DIFFERENCES``, else a quotient.

    >>> measure_effect([({"psnr": 31.0, "step": 0.2}, {"psnr": 30.0, "step": 0.1})], "step")
    Estimate(mean=2.0, deviation=None)
    """
    both = [(now.get(measure), before.get(measure)) for now, before in pairs]
    both = [(now, before) for now, before in both if None not in (now, before)]
    if measure in DIFFERENCES:
        return Estimate.of([now - before for now, before in both])
    return Estimate.of([now / before for now, before in both if before])


@dataclass(frozen=True)
class Gain:
    """What an effect gained in trials.

    Attributes:
        psnr: dB, the mean change.
        noise: dB, two standard errors of it, over all pairs or over the seeds' means, whichever is larger.
        times: the factor by which a step takes longer.
        steps: of each trial; None if the trials were of equal time.
        seconds: of the trials with the effect and without.
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
            raise ValueError(f"effect: expected at least 2 pairs, but got {len(every)}; set more views aside")
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
