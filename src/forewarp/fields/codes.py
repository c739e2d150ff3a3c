"""Learned codes, one for each training time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import torch
from torch import Tensor, nn


class FrameCodes(nn.Module):
    """A code for each distinct time, and for a time between two of them their mix, linear in time.

    A training time has exactly its own code; a time outside of all has the nearest one's.

    Args:
        times: of the training frames, in any order; equal ones share a code.
        width: channels of a code.
        spread: codes start uniformly in ``[0, spread)``, on one side of 0.

    >>> codes = FrameCodes([0.0, 1.0, 0.5, 0.5], 8)
    >>> codes.codes.shape, torch.equal(codes(0.5), codes.codes[1])
    (torch.Size([3, 8]), True)
    """

    def __init__(self, times: Sequence[float], width: int, *, spread: float = 0.05) -> None:
        super().__init__()
        self.times = tuple(sorted({float(time) for time in times}))
        if not self.times or width < 1:
            raise ValueError(
                f"frame codes: expected a time and width >= 1, but got {len(times)} times, {width=}"
            )
        self.codes = nn.Parameter(spread * torch.rand(len(self.times), width))

    def forward(self, time: float) -> Tensor:
        """Give the code (width,) of a time. Differentiable in the codes."""
        right = bisect_right(self.times, time)
        if right == 0 or right == len(self.times):
            return self.codes[min(right, len(self.times) - 1)]
        before, after = self.times[right - 1], self.times[right]
        if time == before:  # not a mix of weight 0, which would let a broken neighbour in
            return self.codes[right - 1]
        return torch.lerp(self.codes[right - 1], self.codes[right], (time - before) / (after - before))
