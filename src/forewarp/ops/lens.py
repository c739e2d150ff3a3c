"""Lens distortion, radial and tangential (Brown-Conrady), and its inverse."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.backend import check_shapes

Radial = tuple[float, float, float]
Tangential = tuple[float, float]

_STEPS = 40  # at most; a mild lens needs five
_CLOSE_ENOUGH = 1e-14
_CHECKS, _RATIO = 16, 0.75  # points checked between the axis and a point, at 1, 0.75, 0.75^2, ... of it


def distort(points: Tensor, radial: Radial, tangential: Tangential) -> Tensor:
    """Distort points on the plane at distance 1 in front of the camera (Brown-Conrady).

    With ``s = 1 + k1 r^2 + k2 r^4 + k3 r^6`` a point (x, y) moves to ``x s + 2 p1 x y + p2 (r^2 + 2 x^2)``,
    ``y s + 2 p2 x y + p1 (r^2 + 2 y^2)``.

    Args:
        points: (..., 2), x to the right and y down, divided by the distance.
        radial: k1, k2, k3.
        tangential: p1, p2.

    Returns:
        (..., 2). Differentiable in ``points``.

    Raises:
        ValueError: for points of another shape.

    Cost: about 20 operations per point.

    >>> distort(torch.tensor([0.5, 0.0]), (0.4, 0.0, 0.0), (0.0, 0.1))
    tensor([0.6250, 0.0000])
    """
    check_shapes("points (..., 2)", points)
    return distort_with_jacobian(points, radial, tangential)[0]


def distort_with_jacobian(
    points: Tensor, radial: Radial, tangential: Tangential
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """``distort``, and its Jacobian: dx/dx, dx/dy = dy/dx and dy/dy, each (...,)."""
    (k1, k2, k3), (p1, p2) = radial, tangential
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    scale = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d scale / dx is slope * x
    distorted_x = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    distorted_y = y * scale + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    xx = scale + slope * x * x + 2 * p1 * y + 6 * p2 * x
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    yy = scale + slope * y * y + 2 * p2 * x + 6 * p1 * y
    return torch.stack([distorted_x, distorted_y], -1), (xx, xy, yy)


def unfolded(points: Tensor, radial: Radial, tangential: Tangential) -> Tensor:
    """Return whether the distortion is invertible all the way from the axis to a point.

    The Jacobian of ``distort`` is symmetric, and positive definite on the axis. Where it first is not, the
    image folds: points further out are mapped back onto points further in.

    Args:
        points: (..., 2), as for ``distort``.
        radial, tangential: as for ``distort``.

    Returns:
        (...,) bool; not differentiable.

    Raises:
        ValueError: for points of another shape.

    Cost: 16 evaluations of ``distort``, at the point and ever closer to the axis.

    >>> unfolded(torch.tensor([[1.0, 0.0], [1.2, 0.0]]), (-0.25, 0.0, 0.0), (0.0, 0.0))  # until 2 / sqrt(3)
    tensor([ True, False])
    """
    check_shapes("points (..., 2)", points)
    place = points.detach().double()
    regular = torch.ones_like(place[..., 0], dtype=torch.bool)
    for k in range(_CHECKS):
        regular &= _is_regular(distort_with_jacobian(_RATIO**k * place, radial, tangential)[1])
    return regular


def undistort(points: Tensor, radial: Radial, tangential: Tangential) -> Tensor:
    """Invert ``distort`` by Newton's method with the exact 2 x 2 Jacobian, in float64.

    A step that does not reduce the error, or enters the fold (see ``unfolded``), is halved and repeated. A
    point beyond the fold has no inverse: the result is then finite, but ``distort`` of it is another point.

    Args:
        points: (..., 2) distorted.
        radial, tangential: as for ``distort``.

    Returns:
        (..., 2) float64, exact to 1e-10, mostly to 1e-14. Not differentiable.

    Raises:
        ValueError: for points of another shape.

    Cost: a few evaluations of ``distort``; up to 40 if a point has no inverse.
    """
    check_shapes("points (..., 2)", points)
    goal = points.detach().double()
    damping = torch.ones_like(goal[..., :1])
    ahead = _is_regular(distort_with_jacobian(goal, radial, tangential)[1])[..., None]
    place = torch.where(ahead, goal, 0.0)  # start on the near side of a fold
    distorted, jacobian = distort_with_jacobian(place, radial, tangential)
    error = (distorted - goal).norm(dim=-1, keepdim=True)
    for _ in range(_STEPS):
        if not bool((error > _CLOSE_ENOUGH).any()):
            break
        (xx, xy, yy), (a, b) = jacobian, (distorted - goal).unbind(-1)
        step = torch.stack([yy * a - xy * b, xx * b - xy * a], -1) / (xx * yy - xy * xy)[..., None]
        tried = place - damping * step.nan_to_num(0.0, 0.0, 0.0)  # no step where the Jacobian is singular
        distorted_there, jacobian_there = distort_with_jacobian(tried, radial, tangential)
        error_there = (distorted_there - goal).norm(dim=-1, keepdim=True)
        closer = (error_there < error) & _is_regular(jacobian_there)[..., None]  # False for NaN
        place, distorted = torch.where(closer, tried, place), torch.where(closer, distorted_there, distorted)
        error = torch.where(closer, error_there, error)
        jacobian = tuple(torch.where(closer[..., 0], b, a) for a, b in zip(jacobian, jacobian_there))
        damping = torch.where(closer, (2 * damping).clamp(max=1), damping / 2)
    return place


def _is_regular(jacobian: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Return whether the Jacobian is positive definite, (...,) bool; False if it is not finite."""
    xx, xy, yy = jacobian
    return (xx > 0) & (xx * yy - xy * xy > 0)
