"""Learned codes of instants and of cameras."""

from __future__ import annotations

import bisect
from collections.abc import Sequence, Set

import torch
from torch import Tensor, nn


class TimeCodes(nn.Module):
    """A code (D,) for each training time; between two of them, the codes beside it in proportion (linear).

    Args:
        times: the distinct training times, ascending.
        size: D.
        spread: the first values are uniform in [0, spread).
    """

    def __init__(self, times: Sequence[float], size: int, spread: float = 0.05) -> None:
        super().__init__()
        self.times = tuple(times)
        self.table = nn.Parameter(spread * torch.rand(len(self.times), size))

    def forward(self, time: float) -> Tensor:
        """Return the code (D,) of a time; before the first and after the last it stays the same."""
        before, after, share = beside(self.times, time)
        return self.table[before] if before == after else self.table[before].lerp(self.table[after], share)


def beside(times: Sequence[float], time: float) -> tuple[int, int, float]:
    """Return the numbers of the ascending times before and after a time, and how far it is on the way.

    Both are the same at one of the times, before the first and after the last.

    >>> beside((0.0, 0.5, 1.0), 0.625), beside((0.0, 0.5), 0.5)
    ((1, 2, 0.25), (1, 1, 0.0))
    """
    after = bisect.bisect_left(times, time)
    if after == len(times) or after == 0 or times[after] == time:
        after = min(after, len(times) - 1)
        return after, after, 0.0
    return after - 1, after, (time - times[after - 1]) / (times[after] - times[after - 1])


class CameraCodes(nn.Module):
    """A code (D,) for each camera that took training pictures; others see by the mean of them.

    Args:
        cameras: their ids; None: pictures whose camera is not known.
        size: D.
        spread: the first values are uniform in [0, spread).
    """

    def __init__(self, cameras: Set[int | None], size: int, spread: float = 0.05) -> None:
        super().__init__()
        ordered = sorted(cameras, key=lambda camera: (camera is None, camera))
        self.rows = {camera: row for row, camera in enumerate(ordered)}
        self.table = nn.Parameter(spread * torch.rand(len(self.rows), size))

    def forward(self, camera: int | None) -> Tensor:
        """Return the code (D,) of a camera's id."""
        return self.table[self.rows[camera]] if camera in self.rows else self.table.mean(0)
