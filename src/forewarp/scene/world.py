"""The similarity between a scene's world, which may be normalised, and that of its data."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from forewarp.scene.camera import Camera

_FAR = 30.0  # sizes of a scene from the origin, from which on float32 loses digits that its files need


@dataclass(frozen=True)
class World:
    """The map ``X_scene = (X_data - center) * scale`` from the world of the data to the scene's.

    Attributes:
        center: in the data's world, its unit of length.
        scale: scene units for one unit of the data.
    """

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    @property
    def is_same(self) -> bool:
        """Whether both worlds are the same."""
        return self.scale == 1 and not any(self.center)

    def to_scene(self, points: np.ndarray | Tensor) -> Tensor:
        """Move points (..., 3), or poses ``camera_to_world`` (4, 4), from the data's world to the scene's:
        float64.
        """
        return self._placed(points, lambda places: (places - places.new_tensor(self.center)) * self.scale)

    def to_data(self, points: np.ndarray | Tensor) -> Tensor:
        """Move points (..., 3), or poses (4, 4), from the scene's world back to the data's: float64."""
        return self._placed(points, lambda places: places / self.scale + places.new_tensor(self.center))

    @staticmethod
    def _placed(points: np.ndarray | Tensor, move) -> Tensor:
        points = torch.as_tensor(points).double()
        if points.shape != (4, 4):
            return move(points)
        pose = points.clone()
        pose[:3, 3] = move(pose[:3, 3])
        return pose

    def camera_to_data(self, camera: Camera) -> Camera:
        """Move a camera from the scene's world to the data's."""
        if self.is_same:
            return camera
        near, far = camera.near / self.scale, camera.far / self.scale
        return replace(camera, camera_to_world=self.to_data(camera.camera_to_world), near=near, far=far)

    def shift(self, size: float) -> tuple[float, float, float]:
        """Return what files leave out of the data's coordinates, so that float32 holds the rest: 0 where they
        are not large, else the center, rounded to a power of ten.

        Args:
            size: of the scene, scene units.

        >>> World((456012.25, 4650123.5, 80.0), 0.5).shift(1.0)
        (456012.0, 4650124.0, 80.0)
        >>> World((3.0, 4.0, 0.0), 0.5).shift(1.0)
        (0.0, 0.0, 0.0)
        """
        extent = size / self.scale
        if max(map(abs, self.center)) <= _FAR * extent:
            return 0.0, 0.0, 0.0
        digits = -math.floor(math.log10(extent))
        return tuple(round(value, digits) for value in self.center)

    def without(self, shift: tuple[float, float, float]) -> World:
        """Return the world whose data's coordinates are smaller by a shift."""
        return replace(self, center=tuple(c - s for c, s in zip(self.center, shift)))


SAME = World()
