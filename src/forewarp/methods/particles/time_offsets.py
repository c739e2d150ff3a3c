"""Learned corrections of the times that are written beside pictures."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import torch
from torch import Tensor, nn

FARTHEST = 0.2  # of all time
_FEWEST = 8  # times: neighbours must tell how things move
_PULL = 0.1  # of the rate: how much a step draws towards 0


class TimeOffsets(nn.Module):
    """From the time written beside a picture to the time of the motion that it shows: T training times are
    each ``off`` (T, 1), in units of their mean distance; times in between, on a line.

    Published sequences hold their first picture twice, leave one out before the last, or round their times.
    A smooth motion cannot fit such times; the error then shows as a wrong depth, which one picture cannot
    tell.

    Args:
        times: distinct, two or more.
        most: bound of ``off``; of few times less, so that none is off by more than a fifth of all time.
    """

    def __init__(self, times: Sequence[float], most: float) -> None:
        super().__init__()
        self.times = sorted(times)
        self.step = (self.times[-1] - self.times[0]) / (len(times) - 1)
        self.most = min(most, FARTHEST / self.step)
        self.learns = True
        self.off = nn.Parameter(torch.zeros(len(times), 1))

    @classmethod
    def of(cls, motion: str, times: Sequence[float], most: float) -> TimeOffsets | None:
        """Make the offsets of a motion; None if ``most`` is 0, of fewer than 8 times, and of cosines, which
        are exactly 0 at the canonical time.
        """
        return cls(times, most) if most and motion == "spline" and len(times) >= _FEWEST else None

    def weights(self, time: float) -> dict[int, float]:
        """The rows of the one or two training times around a time, and how much each counts.

        >>> TimeOffsets([0.0, 0.5, 1.0], 1.5).weights(0.625)
        {1: 0.75, 2: 0.25}
        """
        after = bisect_left(self.times, time)
        if after in (0, len(self.times)):
            return {min(after, len(self.times) - 1): 1.0}
        low, high = self.times[after - 1 : after + 1]
        share = (time - low) / (high - low)
        return {row: part for row, part in ((after - 1, 1 - share), (after, share)) if part > 0}

    def __call__(self, time: float) -> float:
        """The time of the motion, up to ``most`` steps beyond [0, 1]."""
        off = sum(part * self.off.detach()[row].item() for row, part in self.weights(time).items())
        return time + self.step * min(max(off, -self.most), self.most)

    def slopes(self, time: float, by_motion: float) -> Tensor:
        """From the slope by the time of the motion to those by ``off``."""
        found = torch.zeros_like(self.off)
        for row, part in self.weights(time).items():
            found[row] = part * self.step * by_motion
        return found

    @torch.no_grad()
    def settle(self, rate: float) -> None:
        """Draw towards 0 what pictures do not hold, and keep to the bound.

        A time's pictures count once in about T steps, so that a step draws by a T-th of a share of the rate.
        """
        size = (self.off.abs() - _PULL * rate / len(self.times)).clamp(0.0, self.most)
        self.off.copy_(size * self.off.sign())
