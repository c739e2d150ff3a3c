"""The basis of smooth curves that a knot bends in its own neighbourhood alone."""

from __future__ import annotations

import torch
from torch import Tensor


def spline_basis(
    time: Tensor | float, knots: int, canonical_time: float | None = None, *, beyond: float = 0.0
) -> Tensor:
    """Uniform cubic B-splines over [0, 1], less their values at the canonical time, where one is given.

    With ``s = t (K - 3)``, ``i`` its whole part and ``u`` the rest, knots i to i + 3 have the shares
    ``(1 - u)^3, 3 u^3 - 6 u^2 + 4, -3 u^3 + 3 u^2 + 3 u + 1, u^3`` over 6, and all others none. A curve is
    ``sum_k c_k B_k(t)``, or ``sum_k c_k (B_k(t) - B_k(canonical))``: exactly zero at the canonical time.

    Args:
        time: in [0, 1], a float or a tensor (...,).
        knots: K >= 4.
        canonical_time: in [0, 1], or None.
        beyond: how far beyond [0, 1] a time may be; the first and the last piece are continued there.

    Returns:
        (..., K), float32 (or ``time``'s floating dtype). Not differentiable in ``time``.

    Raises:
        ValueError: for fewer knots, or a time farther outside [0, 1].

    Cost: K numbers a time.

    >>> spline_basis(1.0, 4, canonical_time=1.0)
    tensor([0., 0., 0., 0.])
    """
    if knots < 4:
        raise ValueError(f"spline: expected at least 4 knots, but got {knots}")
    origin = 0.0 if canonical_time is None else canonical_time
    if isinstance(time, float) and -beyond <= time <= 1 + beyond and 0 <= origin <= 1:
        now = _shares(time, knots)
        then = [0.0] * knots if canonical_time is None else _shares(origin, knots)
        return torch.tensor([a - b for a, b in zip(now, then)])
    t = torch.as_tensor(time)
    t = t if t.is_floating_point() else t.float()
    both = torch.stack([t, torch.full_like(t, origin)]).double()
    if not bool(((both >= -beyond) & (both <= 1 + beyond)).all()):
        low, high = float(both.min()), float(both.max())
        raise ValueError(
            f"spline: expected times in [{0.0 - beyond:g}, {1 + beyond:g}], but got {low:.4g} to {high:.4g}; "
            "scale the times"
        )
    place = both * (knots - 3)
    first = place.floor().clamp(0, knots - 4)
    u = place - first
    shares = [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]
    basis = both.new_zeros(*both.shape, knots)
    basis.scatter_(
        -1, first.long()[..., None] + torch.arange(4, device=t.device), torch.stack(shares, -1) / 6
    )
    return (basis[0] if canonical_time is None else basis[0] - basis[1]).to(t.dtype)


def _shares(time: float, knots: int) -> list[float]:
    """``B_k`` at a time."""
    place = time * (knots - 3)
    first = min(max(int(place), 0), knots - 4)
    u = place - first
    found = [0.0] * knots
    found[first : first + 4] = (
        (1 - u) ** 3 / 6,
        (3 * u**3 - 6 * u**2 + 4) / 6,
        (-3 * u**3 + 3 * u**2 + 3 * u + 1) / 6,
        u**3 / 6,
    )
    return found
