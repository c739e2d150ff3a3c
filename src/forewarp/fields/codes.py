"""Learned codes of instants and of cameras."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

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
        after = bisect.bisect_left(self.times, time)
        if after == len(self.times) or after == 0 or self.times[after] == time:
            return self.table[min(after, len(self.times) - 1)]
        low, high = self.times[after - 1], self.times[after]
        return torch.lerp(self.table[after - 1], self.table[after], (time - low) / (high - low))


class CameraCodes(nn.Module):
    """A code (D,) for each camera that took training pictures; others see by the mean of them.

    Args:
        count: number of cameras.
        size: D.
        spread: the first values are uniform in [0, spread).
    """

    def __init__(self, count: int, size: int, spread: float = 0.05) -> None:
        super().__init__()
        self.table = nn.Parameter(spread * torch.rand(count, size))

    def forward(self, camera: int | None) -> Tensor:
        """Return the code (D,) of a camera's number."""
        known = camera is not None and 0 <= camera < len(self.table)
        return self.table[camera] if known else self.table.mean(0)
