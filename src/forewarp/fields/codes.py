"""A learned code for each training time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import torch
from torch import Tensor, nn


class FrameCodes(nn.Module):
    """A code for each distinct training time, interpolated linearly between them.

    Times before the first or after the last training time have the nearest code.

    Args:
        times: times of the training frames, in any order; equal times share a code.
        width: channels of a code.
        init_scale: codes start uniformly in ``[0, init_scale)``.

    Raises:
        ValueError: if there is no time, or ``width`` is below 1.

    >>> codes = FrameCodes([0.0, 1.0, 0.5, 0.5], 8)
    >>> codes.codes.shape, torch.equal(codes(0.5), codes.codes[1])
    (torch.Size([3, 8]), True)
    """

    def __init__(self, times: Sequence[float], width: int, *, init_scale: float = 0.05) -> None:
        super().__init__()
        self.times = tuple(sorted({float(time) for time in times}))
        if not self.times or width < 1:
            raise ValueError(
                f"frame codes: expected a time and width >= 1, but got {len(times)} times, {width=}"
            )
        self.codes = nn.Parameter(init_scale * torch.rand(len(self.times), width))

    def forward(self, time: float) -> Tensor:
        """Return the code (width,) of a time. Differentiable in the codes."""
        right = bisect_right(self.times, time)
        if right == 0 or right == len(self.times):
            return self.codes[min(right, len(self.times) - 1)]
        before, after = self.times[right - 1], self.times[right]
        if time == before:  # not a mix: 0 times a NaN of the neighbour is NaN
            return self.codes[right - 1]
        return torch.lerp(self.codes[right - 1], self.codes[right], (time - before) / (after - before))
