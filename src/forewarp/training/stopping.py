"""Enough is enough: say from the curve of views not trained on when more training is not worth its time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from forewarp.methods.method import check_number


@dataclass(frozen=True)
class StopRule:
    """What ends a run's last stage before its budget does; each of the two may be None, for no such end.

    Args:
        psnr: dB that the views reach.
        plateau: dB; training ends once its last doubling gained less.

    Raises:
        ValueError: for what is not a number above 0.
    """

    psnr: float | None = None
    plateau: float | None = None

    def __post_init__(self) -> None:
        for key in ("psnr", "plateau"):
            if (value := getattr(self, key)) is not None:
                check_number(f"target.{key}", value, "a number of dB above 0, or null", lambda dB: dB > 0)

    @property
    def is_set(self) -> bool:
        """Whether there is any such end."""
        return (self.psnr, self.plateau) != (None, None)

    def reached(self, curve: Sequence[tuple[float, float]], *, all_in: bool) -> str | None:
        """Return the key that ends training; None: none does.

        A single evaluation may be luck, so the last two must agree.

        Args:
            curve: (time, PSNR in dB) of the stage so far, in order; times count from the run's beginning.
            all_in: whether all training images are in use; before, a flat curve says nothing.

        >>> StopRule(psnr=30).reached([(1, 29), (2, 30), (4, 31)], all_in=False)
        'target.psnr'
        >>> StopRule(plateau=1.0).reached([(1, 20), (2, 25), (4, 25.5), (8, 25.6)], all_in=True)
        'target.plateau'
        >>> StopRule(psnr=26, plateau=0.5).reached([(1, 20), (2, 25), (4, 25.5), (8, 25.6)], all_in=True)
        """
        if len(curve) < 2:
            return None
        if self.psnr is not None and all(psnr >= self.psnr for _, psnr in curve[-2:]):
            return "target.psnr"
        if self.plateau is not None and all_in:
            gains = [gain_of_doubling(curve[: len(curve) - left]) for left in (0, 1)]
            if None not in gains and max(gains) < self.plateau:
                return "target.plateau"
        return None


def gain_of_doubling(curve: Sequence[tuple[float, float]]) -> float | None:
    """Return how many dB the last doubling of time gained; None where the curve begins after half its time.

    Between two evaluations PSNR is taken to grow with the logarithm of time.

    >>> gain_of_doubling([(1, 20), (4, 24), (8, 25)]), gain_of_doubling([(2, 20), (8, 24)])
    (1, 2.0)
    >>> gain_of_doubling([(3, 20), (5, 24)])
    """
    end, psnr = curve[-1]
    for (before, low), (after, high) in zip(curve, curve[1:]):
        if before <= end / 2 <= after:
            share = 1 if end / 2 == after else math.log(end / 2 / before) / math.log(after / before)
            return psnr - (high if share == 1 else low + share * (high - low))
    return None
