"""Bases of curves over time: cosines, and splines that a knot bends in its own neighbourhood alone."""

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
        padding: extend the sequence at both ends by this share of its length. Every cosine has derivative 0
            at both ends of its period, so without padding (as printed) nothing moves at the first and last
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


def spline_basis(time: Tensor | float, knots: int, *, beyond: float = 0.0, straight: bool = False) -> Tensor:
    """Uniform cubic B-splines over [0, 1]: a curve is ``sum_k c_k B_k(t)``.

    With ``s = t (K - 3)``, ``i`` its whole part and ``u`` the rest, knots i to i + 3 have the shares
    ``(1 - u)^3, 3 u^3 - 6 u^2 + 4, -3 u^3 + 3 u^2 + 3 u + 1, u^3`` over 6, and all others none.

    A natural spline (``straight``) has no acceleration at 0 and 1: of K + 2 such knots the outer two follow
    from those beside them, ``c_0 = 2 c_1 - c_2``, and it passes through its first and last coefficient.

    Args:
        time: in [0, 1], a float or a tensor (...,).
        knots: K >= 4; if ``straight``, >= 2.
        beyond: how far beyond [0, 1] a time may be; the first and the last piece are continued there.
        straight: whether the curve ends without acceleration.

    Returns:
        (..., K), float32 (or ``time``'s floating dtype). Not differentiable in ``time``.

    Raises:
        ValueError: for fewer knots, or a time farther outside [0, 1].

    Cost: K numbers a time, which Python makes one by one.

    >>> spline_basis(1.0, 3, straight=True)
    tensor([0., 0., 1.])
    """
    if isinstance(time, float):
        return torch.tensor(spline_shares(time, knots, beyond=beyond, straight=straight))
    shares = [spline_shares(t, knots, beyond=beyond, straight=straight) for t in time.flatten().tolist()]
    return torch.tensor(shares, dtype=time.dtype, device=time.device).reshape(*time.shape, knots)


def spline_shares(time: float, knots: int, *, beyond: float = 0.0, straight: bool = False) -> list[float]:
    """``B_k`` at a time as numbers, without what it takes to make a tensor; see ``spline_basis``."""
    least = 2 if straight else 4
    if knots < least:
        raise ValueError(f"spline: expected at least {least} knots, but got {knots}")
    if not -beyond <= time <= 1 + beyond:
        span = f"[{0.0 - beyond:g}, {1 + beyond:g}]"
        raise ValueError(f"spline: expected times in {span}, but got {time:.4g}; scale the times")
    count = knots + 2 if straight else knots  # with those that follow from others
    place = time * (count - 3)
    first = min(max(int(place), 0), count - 4)
    u = place - first
    shares = [0.0] * count
    shares[first : first + 4] = (
        (1 - u) ** 3 / 6,
        (3 * u**3 - 6 * u**2 + 4) / 6,
        (-3 * u**3 + 3 * u**2 + 3 * u + 1) / 6,
        u**3 / 6,
    )
    if straight:  # the outer two knots' shares go to those inside, of which they are continuations
        first, *shares, last = shares
        shares[0], shares[1] = shares[0] + 2 * first, shares[1] - first
        shares[-1], shares[-2] = shares[-1] + 2 * last, shares[-2] - last
    return shares
