"""Lens distortion, radial and tangential (Brown-Conrady), and its inverse."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.checks import check_shape

Radial = tuple[float, float, float]
Tangential = tuple[float, float]

_STEPS = 40  # at most; where the lens is mild five do
_CLOSE_ENOUGH = 1e-14
_LOOKS, _APART = 16, 0.75  # along the way from the axis: where, as shares of what is left


def distort(points: Tensor, radial: Radial, tangential: Tangential) -> Tensor:
    """Where a lens puts a point of the plane at distance 1 before the camera.

    With ``s = 1 + k1 r^2 + k2 r^4 + k3 r^6`` a point goes to ``x s + 2 p1 x y + p2 (r^2 + 2 x^2)``,
    ``y s + 2 p2 x y + p1 (r^2 + 2 y^2)``.

    Args:
        points: (..., 2), x to the right and y down, in units of the distance.
        radial: k1, k2, k3.
        tangential: p1, p2.

    Returns:
        (..., 2). Differentiable in ``points``.

    Raises:
        ValueError: for points of another shape.

    **Cost** about 20 operations a point.

    >>> distort(torch.tensor([0.5, 0.0]), (0.4, 0.0, 0.0), (0.0, 0.1))
    tensor([0.6250, 0.0000])
    """
    check_shape("points", points, ("...", 2))
    return _bent(points, radial, tangential)[0]


def unfolded(points: Tensor, radial: Radial, tangential: Tangential) -> Tensor:
    """Whether a lens still spreads the picture all the way from its axis to a point.

    The Jacobian of ``distort`` is symmetric, and positive definite on the axis. Where it first is not, the
    picture folds: what lies beyond, the polynomial carries back over what lies before.

    Args:
        points: (..., 2), as for ``distort``.
        radial, tangential: as for ``distort``.

    Returns:
        (...,) bool; not differentiable.

    Raises:
        ValueError: for points of another shape.

    **Cost** 16 evaluations of ``distort``: at the point and at shares of the way that shrink by a quarter.

    >>> unfolded(torch.tensor([[1.0, 0.0], [1.2, 0.0]]), (-0.25, 0.0, 0.0), (0.0, 0.0))  # until 2 / sqrt(3)
    tensor([ True, False])
    """
    check_shape("points", points, ("...", 2))
    place = points.detach().double()
    spread = torch.ones_like(place[..., 0], dtype=torch.bool)
    for look in range(_LOOKS):
        spread &= _spreads(_bent(_APART**look * place, radial, tangential)[1])
    return spread


def undistort(points: Tensor, radial: Radial, tangential: Tangential) -> Tensor:
    """The inverse of ``distort`` by Newton's method with the exact 2 x 2 Jacobian, in float64.

    A step that does not come closer, or leads where the picture is folded (see ``unfolded``), is halved and
    tried again. Where the lens puts no point at all (beyond its fold) the result is the nearest that was
    met: finite, but ``distort`` of it is not the point.

    Args:
        points: (..., 2) distorted.
        radial, tangential: as for ``distort``.

    Returns:
        (..., 2) float64, to 1e-10 and mostly to 1e-14. Not differentiable.

    Raises:
        ValueError: for points of another shape.

    **Cost** a few evaluations of ``distort``; up to 40 where some point has no inverse.
    """
    check_shape("points", points, ("...", 2))
    goal = points.detach().double()
    rate = torch.ones_like(goal[..., :1])
    ahead = _spreads(_bent(goal, radial, tangential)[1])[..., None]
    place = torch.where(ahead, goal, 0.0)  # from the far side of a fold one would find what lies there
    bent, jacobian = _bent(place, radial, tangential)
    error = (bent - goal).norm(dim=-1, keepdim=True)
    for _ in range(_STEPS):
        if not bool((error > _CLOSE_ENOUGH).any()):
            break
        tried = place - rate * _solved(jacobian, bent - goal)
        bent_there, jacobian_there = _bent(tried, radial, tangential)
        error_there = (bent_there - goal).norm(dim=-1, keepdim=True)
        closer = (error_there < error) & _spreads(jacobian_there)[..., None]  # and not NaN
        place, bent = torch.where(closer, tried, place), torch.where(closer, bent_there, bent)
        error = torch.where(closer, error_there, error)
        jacobian = tuple(torch.where(closer[..., 0], b, a) for a, b in zip(jacobian, jacobian_there))
        rate = torch.where(closer, (2 * rate).clamp(max=1), rate / 2)
    return place


def _bent(
    points: Tensor, radial: Radial, tangential: Tangential
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """The distorted points and the Jacobian's three entries dx/dx, dx/dy = dy/dx and dy/dy, each (...,)."""
    (k1, k2, k3), (p1, p2) = radial, tangential
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    scale = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d scale / dx is slope * x
    bent_x = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * scale + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    xx = scale + slope * x * x + 2 * p1 * y + 6 * p2 * x
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    yy = scale + slope * y * y + 2 * p2 * x + 6 * p1 * y
    return torch.stack([bent_x, bent_y], -1), (xx, xy, yy)


def _spreads(jacobian: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Whether the Jacobian is positive definite, (...,) bool; what is not finite is not."""
    xx, xy, yy = jacobian
    return (xx > 0) & (xx * yy - xy * xy > 0)


def _solved(jacobian: tuple[Tensor, Tensor, Tensor], offset: Tensor) -> Tensor:
    """The Newton step (..., 2); none where the Jacobian is singular, and never an endless one."""
    (xx, xy, yy), (a, b) = jacobian, offset.unbind(-1)
    determinant = xx * yy - xy * xy
    step = torch.stack([yy * a - xy * b, xx * b - xy * a], -1) / determinant[..., None]
    return step.nan_to_num(0.0, 0.0, 0.0)
