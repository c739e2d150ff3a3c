"""A pinhole camera.

Axes are OpenCV's: x right, y down, z forward. Pixel centres lie at +0.5. Distances are along the unit ray.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forewarp.scene.rays import Rays


@dataclass(frozen=True)
class Camera:
    """``width`` x ``height`` pixels, focal lengths ``fx fy`` and principal point ``cx cy`` in pixels,
    ``camera_to_world`` (4, 4) float64 tensor, ``near`` and ``far`` along the unit ray in world units.
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

    @property
    def center(self) -> Tensor:
        """Camera centre (3,), float64, world units."""
        return self.camera_to_world[:3, 3]

    def rays(self, pixels: Tensor | None = None, dtype: torch.dtype = torch.float32) -> Rays:
        """Rays through pixel centres.

        Args:
            pixels: flat indices (R,) into the row-major image, or None for all H*W.
            dtype: of the result.
        """
        if pixels is None:
            pixels = torch.arange(self.width * self.height)
        u = (pixels % self.width).double() + 0.5
        v = torch.div(pixels, self.width, rounding_mode="floor").double() + 0.5
        local = torch.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, torch.ones_like(u)], -1)
        directions = torch.nn.functional.normalize(local @ self.camera_to_world[:3, :3].T, dim=-1)
        return Rays(self.center.expand_as(directions).to(dtype), directions.to(dtype), self.near, self.far)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) -> pixel coordinates (..., 2), top-left corner the origin, and the
        depth along the optical axis (...,); a point is visible only where that depth is positive.
        """
        pose = self.camera_to_world.to(points)
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        z = local[..., 2]
        scale = torch.tensor([self.fx, self.fy]).to(points)
        shift = torch.tensor([self.cx, self.cy]).to(points)
        safe = torch.where(z.abs() > 1e-12, z, torch.full_like(z, 1e-12))
        return local[..., :2] / safe[..., None] * scale + shift, z

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another image size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )


def look_at(center: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """The pose (4, 4) of a camera at ``center`` that looks at ``target`` with ``up`` upwards in the picture.

    All are (3,). Where the view runs along ``up`` any horizontal axis serves.
    """
    forward = torch.nn.functional.normalize(target.double() - center.double(), dim=0)
    right = torch.linalg.cross(forward, up.double())
    if right.norm() < 1e-6:
        other = torch.eye(3, dtype=torch.float64)[int(forward.abs().argmin())]
        right = torch.linalg.cross(forward, other)
    right = torch.nn.functional.normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
    pose[:3, 3] = center.double()
    return pose
