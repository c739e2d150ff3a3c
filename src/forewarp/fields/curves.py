"""Smooth curves over time by a few coefficients: which basis, and how many."""

from __future__ import annotations

from collections.abc import Sequence
from operator import mul

import torch
from torch import Tensor

from forewarp.ops.curves import dct_basis, spline_basis, spline_shares

KINDS = ("spline", "cosines")
_PADDING = 0.2  # of the sequence, imagined before and after it: a cosine stands still at both ends


class Curve:
    """``sum_k c_k b_k(t)``. Cosines are exactly 0 at the canonical time; a spline is not: pictures of that
    time bend their own knots, and not what all others share.

    Args:
        kind: ``spline``, whose knots bend their neighbourhood in time alone, or ``cosines``, the paper's DCT.
        count: of coefficients; a spline has at least 4, cosines at most one less than there are times. Of a
            ``straight`` spline two follow from the others, and it has two less, but no fewer than 4 of four
            times or more, and as many as there are times of fewer.
        times: how many distinct training times there are.
        canonical_time: in [0, 1].
        straight: whether a spline ends without acceleration: what the first and the last picture leave open
            is then told by those beside them.

    Raises:
        ValueError: for another kind, or a single time, over which nothing moves.
    """

    def __init__(
        self, kind: str, count: int, times: int, canonical_time: float, *, straight: bool = False
    ) -> None:
        if kind not in KINDS:
            raise ValueError(f"model.motion: expected {', '.join(KINDS)} or none, but got {kind!r}")
        if times < 2:
            raise ValueError(
                f"model.motion: expected at least 2 distinct training times, but got {times}; "
                "use model.motion=none"
            )
        self.kind, self.times, self.canonical_time = kind, times, canonical_time
        self.straight = straight and kind == "spline"
        if kind == "cosines":
            self.count = max(1, min(count, times - 1))
        else:
            self.count = max(min(times, 4), count - 2) if straight else max(4, count)
        self.pieces = self.count - (1 if self.straight else 3)  # cubics of a spline, each between two knots

    def __call__(self, time: float | Tensor, beyond: float = 0.0) -> Tensor:
        """The basis (..., K) at a time in [0, 1]; a spline also takes times up to ``beyond`` outside."""
        if self.kind == "spline":
            return spline_basis(time, self.count, beyond=beyond, straight=self.straight)
        return dct_basis(time, self.count, self.times, self.canonical_time, _PADDING)

    def summed(self, parts: Sequence[tuple[float, float]], beyond: float = 0.0) -> Tensor:
        """``sum_i f_i b(t_i)`` (K,) of times and factors: a difference of bases, say, at one go."""
        if self.kind == "spline":
            shares = [spline_shares(t, self.count, beyond=beyond, straight=self.straight) for t, _ in parts]
            factors = [factor for _, factor in parts]
            return torch.tensor([sum(map(mul, factors, of_one)) for of_one in zip(*shares)])
        return sum(factor * self(time) for time, factor in parts)

    def reach(self) -> Tensor | None:
        """From when to when (K, 2) each coefficient bends the curve; None where all do so at all times."""
        if self.kind == "cosines":
            return None
        knots = torch.arange(self.count, dtype=torch.float32) + self.straight
        return torch.stack([knots - 3, knots + 1], -1) / self.pieces
