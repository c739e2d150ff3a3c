"""How a lens bends the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.ops.lens import distort, undistort

# Of the plane at distance 1 before the camera: far below a thousandth of a pixel.
_SAME_PLACE = 1e-6


@dataclass(frozen=True)
class Lens:
    """Radial distortion ``k`` (k1, k2, k3) and tangential distortion ``p`` (p1, p2), as in ``ops.lens``.

    They know no pixels: the same numbers hold at every image size.

    Raises:
        ValueError: for other counts or numbers that are not finite.
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
        """Where points (..., 2) of the plane at distance 1 appear, the dtype of ``points``.

        A point that lies beyond the lens's fold appears nowhere. It keeps its place, which is outside the
        picture, where the polynomial would carry it back inside.
        """
        # Float64, as points beside the camera lie so far off that their sixth power needs its range.
        bent = distort(points.double(), self.k, self.p)
        error = (undistort(bent, self.k, self.p) - points.detach()).norm(dim=-1, keepdim=True)
        return torch.where(error < _SAME_PLACE, bent, points.double()).to(points.dtype)

    def straighten(self, points: Tensor) -> Tensor:
        """The inverse of ``bend`` (..., 2), float64."""
        return undistort(points, self.k, self.p)
