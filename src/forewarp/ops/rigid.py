"""Rigid motions of points by screws, and how far a map is from rigid."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.checks import check_shape

_SMALL = 0.05  # radian; below, series in the squared angle are exact to single precision


def move_by_screw(points: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    """Move points by the exponential of a screw (se(3)): ``x' = R x + V v``.

    With ``theta = |w|`` and ``W`` the matrix of ``w x``: ``R = I + a W + b W^2`` and ``V = I + b W + c W^2``,
    where ``a = sin(theta) / theta``, ``b = (1 - cos(theta)) / theta^2``, ``c = (1 - a) / theta^2``. Small
    angles take the series, so that value and gradient are finite at 0, where ``x' = x + v`` (Nerfies, with
    its axis ``(w, v) / theta`` written out).

    Args:
        points: x (..., 3).
        turn: w (..., 3), radian about the origin.
        shift: v (..., 3), in the unit of the points.

    Returns:
        (..., 3). Differentiable in all three.

    >>> move_by_screw(torch.tensor([1.0, 0.0, 0.0]), torch.zeros(3), torch.tensor([0.0, 2.0, 0.0]))
    tensor([1., 2., 0.])
    """
    check_shape("points", points, (*points.shape[:-1], 3))
    check_shape("turn", turn, tuple(points.shape))
    check_shape("shift", shift, tuple(points.shape))
    a, b, c = _coefficients(turn.square().sum(-1, keepdim=True))
    about = torch.linalg.cross(turn, points)
    along = torch.linalg.cross(turn, shift)
    turned = points + a * about + b * torch.linalg.cross(turn, about)
    return turned + shift + b * along + c * torch.linalg.cross(turn, along)


def _coefficients(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``sin(t)/t``, ``(1 - cos t)/t^2`` and ``(t - sin t)/t^3`` of squared angles."""
    small = squared < _SMALL**2
    q = torch.where(small, squared, 0.0)
    series = (
        1 - q / 6 * (1 - q / 20 * (1 - q / 42)),
        (1 - q / 12 * (1 - q / 30 * (1 - q / 56))) / 2,
        (1 - q / 20 * (1 - q / 42 * (1 - q / 72))) / 6,
    )
    safe = torch.where(small, 1.0, squared)
    angle = safe.sqrt()
    exact = angle.sin() / angle, (1 - angle.cos()) / safe, (angle - angle.sin()) / (angle * safe)
    return tuple(torch.where(small, near, far) for near, far in zip(series, exact))


def stretch(jacobian: Tensor, floor: float = 1e-6) -> Tensor:
    """Sum the squared logarithms of a map's singular values: 0 where it is locally rigid (Nerfies' elastic
    energy).

    Args:
        jacobian: (..., 3, 3).
        floor: of a singular value.

    Returns:
        (...,) >= 0. Differentiable also where singular values are equal, as at the identity.

    >>> float(stretch(2 * torch.eye(3)) / torch.tensor(2.0).log() ** 2)
    3.0
    """
    check_shape("jacobian", jacobian, (*jacobian.shape[:-2], 3, 3))
    return torch.linalg.svdvals(jacobian).clamp(min=floor).log().square().sum(-1)


def geman_mcclure(squared: Tensor) -> Tensor:
    """``rho = 2 q / (q + 4)`` of squared residuals q over squared scales: half of q near 0, at most 2.

    >>> geman_mcclure(torch.tensor([0.0, 4.0, torch.inf]))
    tensor([0., 1., 2.])
    """
    return 2 / (1 + 4 / squared.clamp(min=torch.finfo(squared.dtype).tiny))
