"""Lens distortion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.ops.lens import distort, undistort, unfolded

# In the plane at distance 1: outside every picture, but small enough for 64-bit integers in pixels.
_OUTSIDE, _ON_AXIS = 1e9, 1e-9


@dataclass(frozen=True)
class Lens:
    """Radial distortion ``k`` (k1, k2, k3) and tangential distortion ``p`` (p1, p2), as in ``ops.lens``.

    Independent of the image size.

    Raises:
        ValueError: for other numbers of coefficients, or coefficients that are not finite.
    """

    k: tuple[float, float, float] = (0.0, 0.0, 0.0)
    p: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, count in (("k", 3), ("p", 2)):
            values = tuple(float(v) for v in getattr(self, name))
            if len(values) != count or not all(math.isfinite(v) for v in values):
                raise ValueError(f"lens.{name}: expected {count} finite numbers, but got {values}")
            object.__setattr__(self, name, values)

    def bend(self, points: Tensor) -> Tensor:
        """Distort points (..., 2) of the plane at distance 1; keeps the dtype.

        Beyond the lens's fold points are invisible, though the polynomial would map them back into the
        picture; such points, and points mapped still farther, are put far outside in their own direction.
        """
        # Float64, as the sixth power of points beside the camera exceeds the range of float32.
        plane = points.double()
        bent = distort(plane, self.k, self.p)
        seen = unfolded(plane, self.k, self.p) & (bent.detach().norm(dim=-1) < _OUTSIDE)
        away = plane * (_OUTSIDE / plane.detach().norm(dim=-1, keepdim=True).clamp(min=_ON_AXIS))
        return torch.where(seen[..., None], bent, away).to(points.dtype)

    def straighten(self, points: Tensor) -> Tensor:
        """Invert ``bend`` for points (..., 2) inside a picture, float64."""
        return undistort(points, self.k, self.p)
