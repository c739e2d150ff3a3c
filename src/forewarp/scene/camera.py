"""A pinhole camera, optionally with a distorting lens, and its rays.

Axes are OpenCV's: x right, y down, z forward. Pixel centres lie at +0.5. Distances are along the unit ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forewarp.ops.lens import distort, undistort, unfolded

# In the plane at distance 1: outside every image, but small enough for 64-bit integers in pixels.
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
        image; such points, and points mapped still farther, are put far outside in their own direction.
        """
        # Float64, as the sixth power of points beside the camera exceeds the range of float32.
        plane = points.double()
        bent = distort(plane, self.k, self.p)
        seen = unfolded(plane, self.k, self.p) & (bent.detach().norm(dim=-1) < _OUTSIDE)
        away = plane * (_OUTSIDE / plane.detach().norm(dim=-1, keepdim=True).clamp(min=_ON_AXIS))
        return torch.where(seen[..., None], bent, away).to(points.dtype)

    def straighten(self, points: Tensor) -> Tensor:
        """Invert ``bend`` for points (..., 2) inside a image, float64."""
        return undistort(points, self.k, self.p)


@dataclass(frozen=True)
class Rays:
    """R rays: ``origins`` (R, 3) and unit ``directions`` (R, 3) in world units; ``near`` and ``far``
    are distances along the unit direction, shared by all.
    """

    origins: Tensor
    directions: Tensor
    near: float
    far: float

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, rows) -> Rays:
        return Rays(self.origins[rows], self.directions[rows], self.near, self.far)

    def to(self, device) -> Rays:
        """Move the rays to another device."""
        return Rays(self.origins.to(device), self.directions.to(device), self.near, self.far)


def joined(parts: Sequence[Rays]) -> Rays:
    """Concatenate rays; take the least near and the greatest far."""
    origins, directions = torch.cat([p.origins for p in parts]), torch.cat([p.directions for p in parts])
    return Rays(origins, directions, min(p.near for p in parts), max(p.far for p in parts))


@dataclass(frozen=True)
class Camera:
    """``width`` x ``height`` pixels, focal lengths ``fx fy`` and principal point ``cx cy`` in pixels,
    ``camera_to_world`` (4, 4) float64 tensor, ``near`` and ``far`` along the unit ray in world units.

    The plane's point (x, y), bent by the ``lens``, lies at pixel ``u = fx x + skew y + cx, v = fy y + cy``.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_world: Tensor
    near: float
    far: float
    skew: float = 0.0
    lens: Lens | None = None

    @property
    def center(self) -> Tensor:
        """Camera centre (3,), float64, world units."""
        return self.camera_to_world[:3, 3]

    def rays(self, pixels: Tensor | None = None, dtype: torch.dtype = torch.float32) -> Rays:
        """Make rays through pixel centres.

        Args:
            pixels: flat indices (R,) into the row-major image, or None for all H*W.
            dtype: dtype of the result.
        """
        if pixels is None:
            pixels = torch.arange(self.width * self.height)
        u = (pixels % self.width).double() + 0.5
        v = torch.div(pixels, self.width, rounding_mode="floor").double() + 0.5
        directions = self.directions(u, v)
        return Rays(self.center.expand_as(directions).to(dtype), directions.to(dtype), self.near, self.far)

    def directions(self, u: Tensor, v: Tensor) -> Tensor:
        """Make unit world directions (..., 3) float64 through pixel coordinates ``u v`` (...,), measured from
        the image's top-left corner; lens and skew are undone.
        """
        y = (v.double() - self.cy) / self.fy
        x = (u.double() - self.cx - self.skew * y) / self.fx
        if self.lens is not None:
            x, y = self.lens.straighten(torch.stack([x, y], -1)).unbind(-1)
        local = torch.stack([x, y, torch.ones_like(x)], -1)
        return torch.nn.functional.normalize(local @ self.camera_to_world[:3, :3].T, dim=-1)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project world points (..., 3): pixel coordinates (..., 2) from the top-left corner, and depth along
        the optical axis (...,); a point is visible only if this depth is positive.
        """
        pose = self.camera_to_world.to(points)
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        z = local[..., 2]
        scale, shift = points.new_tensor([self.fx, self.fy]), points.new_tensor([self.cx, self.cy])
        # A point beside the camera projects very far off; the bound is relative, so any unit of length works.
        least = torch.finfo(z.dtype).eps * local.detach().abs().amax(-1)
        safe = torch.where(z.abs() > least, z, torch.where(least > 0, least, 1.0))
        plane = local[..., :2] / safe[..., None]
        plane = plane if self.lens is None else self.lens.bend(plane)
        pixel = plane * scale + shift
        if self.skew:
            pixel = pixel + self.skew * torch.stack([plane[..., 1], torch.zeros_like(z)], -1)
        return pixel, z

    def resized(self, width: int, height: int) -> Camera:
        """Change the image size, keeping the view."""
        sx, sy = width / self.width, height / self.height
        pixels = {"fx": self.fx * sx, "fy": self.fy * sy, "cx": self.cx * sx, "cy": self.cy * sy}
        return replace(self, width=width, height=height, **pixels, skew=self.skew * sx)


def look_at(center: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Make the pose (4, 4) of a camera at ``center`` that looks at ``target``, with ``up`` upwards.

    All are (3,). A camera that looks along ``up`` gets any horizontal axis.
    """
    forward = torch.nn.functional.normalize(target.double() - center.double(), dim=0)
    right = torch.linalg.cross(forward, up.double())
    if right.norm() < 1e-6:
        right = torch.linalg.cross(forward, torch.eye(3, dtype=torch.float64)[int(forward.abs().argmin())])
    right = torch.nn.functional.normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
    pose[:3, 3] = center.double()
    return pose
