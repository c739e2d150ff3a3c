"""How a lens bends the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.ops.lens import distort, undistort, unfolded

# Of the plane at distance 1: outside every picture, and in pixels still a whole number of 64 bits.
_OUTSIDE, _ON_AXIS = 1e9, 1e-9


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

        A point that lies beyond the lens's fold appears nowhere, though the polynomial would carry it back
        into the picture. It is put far outside, in its own direction, and so is what appears farther off.
        """
        # Float64, as points beside the camera lie so far off that their sixth power needs its range.
        plane = points.double()
        bent = distort(plane, self.k, self.p)
        seen = unfolded(plane, self.k, self.p) & (bent.detach().norm(dim=-1) < _OUTSIDE)
        away = plane * (_OUTSIDE / plane.detach().norm(dim=-1, keepdim=True).clamp(min=_ON_AXIS))
        return torch.where(seen[..., None], bent, away).to(points.dtype)

    def straighten(self, points: Tensor) -> Tensor:
        """The inverse of ``bend`` (..., 2), float64: of what a picture can show."""
        return undistort(points, self.k, self.p)
