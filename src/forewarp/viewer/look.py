"""What one page looks at, and the camera of that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.browser import vertical_fov
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Scene
from forewarp.scene.paths import focus_point, mean_up

SPLATS = "splats"  # drawn by the browser; all other names are pictures that the method renders
_CLOSEST = 0.01  # of the box's diagonal: nothing nearer to the camera is drawn

Point = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Look:
    """Where a page stands, and what it wants to see from there.

    Attributes:
        pose: ``camera_to_world`` (4, 4), float64.
        fov: vertical, radians.
        time: in [0, 1].
        show: one of ``Subject.shows``.
        tails: draw trajectories of points all over the moving surface.
        followed: points, each with the time at which it is there, whose trajectories are drawn.
        stand: the training view that is compared with its image; None: none.
    """

    pose: Tensor
    fov: float
    time: float = 0.0
    show: str = "colour"
    tails: bool = False
    followed: tuple[tuple[Point, float], ...] = ()
    stand: int | None = None

    @property
    def by_browser(self) -> bool:
        """Whether the browser draws it by itself; a training view is always compared in a picture."""
        return self.show == SPLATS and self.stand is None


def first_look(scene: Scene) -> Look:
    """Stand where the first test image was taken, at its time; without one, the first training image."""
    frame = (scene.test or scene.train)[0]
    return Look(frame.camera.camera_to_world, vertical_fov(frame.camera), frame.time)


def camera_of(look: Look, width: int, height: int, scene: Scene) -> Camera:
    """Make the pinhole camera of a look, ``width`` x ``height`` pixels, which sees all of the scene's box."""
    focal = 0.5 * height / math.tan(0.5 * look.fov)
    near, far = reach(look.pose[:3, 3], scene.box, [frame.camera for frame in scene.train])
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, look.pose, near, far)


def reach(center: Tensor, box: Box, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Return near and far of a camera at ``center`` (3,): those of the training cameras, and wider where the
    box begins nearer or ends farther.
    """
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (box.low, box.high))
    outside = float(torch.maximum(low - center, center - high).clamp(min=0).norm())
    farthest = float(torch.maximum((center - low).abs(), (center - high).abs()).norm())
    near = min(*(camera.near for camera in cameras), max(outside, _CLOSEST * box.diagonal))
    return near, max(farthest, *(camera.far for camera in cameras))


def pivot(scene: Scene) -> tuple[Tensor, Tensor]:
    """Return the point that the page's camera turns about, and the upward direction, both (3,)."""
    cameras = [frame.camera for frame in scene.train]
    return focus_point(cameras), mean_up(cameras)


def axis_of(pose: Tensor, up: Tensor) -> Tensor:
    """Return the axis (3,) about which a page turns that stands at ``pose`` (4, 4): the upward direction
    ``up``, bent just so much that the picture has the pose's roll.
    """
    right, above = pose[:3, 0], -pose[:3, 1]
    axis = up - (up @ right) * right
    axis = axis if float(axis @ above) > 0 else -axis
    return axis / axis.norm() if float(axis @ above) > 0.05 else above
