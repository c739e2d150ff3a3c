"""The cosine basis of smooth trajectories."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def dct_basis(
    time: Tensor | float, bases: int, frames: int, canonical_time: float, padding: float = 0.0
) -> Tensor:
    """Return ``b_k(t) - b_k(canonical)`` for k = 1..K, exactly 0 at the canonical time.

    ``b_k(t) = sqrt(2/T) cos(pi/(2T) (2 t (T-1) + 1) k)``; a trajectory is
    ``flow_t = sum_k c_k (b_k(t) - b_k(can))`` (the paper's flow equation with TrajectoryNeRF's inverse DCT).

    Args:
        time: in [0, 1], a float or a tensor (...,).
        bases: K in [1, T - 1].
        frames: T >= 2, the number of distinct training times.
        canonical_time: in [0, 1].
        padding: extend the sequence at both ends by this share of its length. Every cosine has slope 0 at
            both ends of its period, so without padding (as printed) nothing moves at the first and last
            frame.

    Returns:
        (..., K), float32 (or ``time``'s floating dtype). Differentiable in ``time``.

    Raises:
        ValueError: for K or T out of range, or a time outside [0, 1], where the cosine would mirror.

    Cost: K cosines per time.

    >>> dct_basis(0.0, 3, 50, canonical_time=0.0)
    tensor([0., 0., 0.])
    """
    if frames < 2 or not 1 <= bases <= frames - 1:
        raise ValueError(f"dct: expected 1 <= bases <= frames - 1, but got bases={bases}, frames={frames}")
    t = torch.as_tensor(time)
    t = t if t.is_floating_point() else t.float()
    # Round both alike, or the difference at the canonical time is not 0.
    both = torch.stack([t, torch.full_like(t, canonical_time)]).double()
    if not bool(((both >= 0) & (both <= 1)).all()):
        low, high = float(both.min()), float(both.max())
        raise ValueError(f"dct: expected times in [0, 1], but got {low:.4g} to {high:.4g}; scale the times")
    both = (both + padding) / (1 + 2 * padding)
    k = torch.arange(1, bases + 1, dtype=torch.float64, device=t.device)
    phase = math.pi / (2 * frames) * (2 * both[..., None] * (frames - 1) + 1) * k
    basis = math.sqrt(2 / frames) * torch.cos(phase)
    return (basis[0] - basis[1]).to(t.dtype)
