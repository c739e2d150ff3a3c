"""Find the region that cameras of unknown scale look at: its middle, its size, near and far."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from forewarp.data.geometry import frustum_box
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.errors import SceneError
from forewarp.scene.paths import focus_point

# Near and far as shares of the cameras' distance from what they look at, where nothing else is known. Two
# real captures that gave them had near at 0.01 and 0.55 and far at 2.4 and 2.2.
_NEAR, _FAR = 0.2, 2.5
_LEAST, _MOST = 1e-3, 50.0  # a focus outside these shares of the assumed distance is not trusted
_SAME_PLACE = 1e-9
_AHEAD = 4.0  # assumed distance of what is looked at, in radii of the cameras' places

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Region:
    """The part of the file's world that becomes the scene, and the map ``X_scene = (X - center) * scale``.

    ``near``, ``far`` and ``box`` are in scene units.
    """

    center: tuple[float, float, float]
    scale: float
    near: float
    far: float
    box: Box

    def placed(self, camera: Camera) -> Camera:
        """Move a camera from the file's units to the scene's."""
        pose = camera.camera_to_world.clone()
        pose[:3, 3] = (pose[:3, 3] - torch.tensor(self.center, dtype=torch.float64)) * self.scale
        return replace(camera, camera_to_world=pose, near=self.near, far=self.far)

    def points(self, points: np.ndarray) -> Tensor:
        """Move points (N, 3) from the file's units to the scene's: float32."""
        return ((torch.from_numpy(points).double() - torch.tensor(self.center)) * self.scale).float()

    def moved(self, box: Box) -> Box:
        """Move a box from the file's units to the scene's."""
        low, high = (
            tuple((v - c) * self.scale for v, c in zip(end, self.center)) for end in (box.low, box.high)
        )
        return Box(low, high)


def region_of(
    cameras: Sequence[Camera],
    where: str,
    *,
    near: float | None = None,
    far: float | None = None,
    box: Box | None = None,
    normalise: bool = True,
    cut_out: bool = False,
) -> Region:
    """Find the region that cameras look at.

    Args:
        cameras: cameras of all frames; their near and far are not used.
        where: the file, for errors.
        near, far, box: what is known, in the file's units; None is derived: ``near`` and ``far`` from the
            distance to the focus, the point looked at; the box holds all rays between them.
        cut_out: the images are cut out; then the box holds only what they show around the focus.
        normalise: put the focus at the origin and the farthest camera at distance 1.

    Raises:
        SceneError: where something cannot be derived from the cameras.
    """
    focus, distances = _focus(cameras, near, far, where)
    near, far = _range(distances, near, far, where)
    size = max(float((camera.center - focus).norm()) for camera in cameras) if normalise else 1.0
    center = tuple(focus.tolist()) if normalise else (0.0, 0.0, 0.0)
    region = Region(center, 1 / size, near / size, far / size, Box((0, 0, 0), (1, 1, 1)))
    try:
        if box is not None:
            return replace(region, box=region.moved(box))
        seen = frustum_box(region.placed(camera) for camera in cameras)
        if cut_out:
            seen = seen.intersection(region.moved(_shown(focus, distances, cameras)))
        return replace(region, box=seen)
    except ValueError as error:
        raise SceneError(f"{where}: {error}; set data.near, data.far and data.box") from error


def _focus(
    cameras: Sequence[Camera], near: float | None, far: float | None, where: str
) -> tuple[Tensor, Tensor]:
    """Find the focus (3,) and its distances along the optical axes of the cameras that face it, float64."""
    centers = torch.stack([camera.center for camera in cameras])
    axes = torch.stack([camera.camera_to_world[:3, 2] for camera in cameras])
    radius = float((centers - centers.mean(0)).norm(dim=-1).max())
    ahead = _AHEAD * radius if near is None or far is None else 0.5 * (near + far)
    if radius <= _SAME_PLACE * (1 + float(centers.abs().max())) and (near is None or far is None):
        raise SceneError(
            f"{where}: expected cameras that move, but got one place; set data.near and data.far"
        )
    focus = focus_point([replace(camera, near=0.0, far=2 * ahead) for camera in cameras])
    distances = ((focus - centers) * axes).sum(-1)
    if not _LEAST * ahead < float(distances.median()) < _MOST * ahead:
        # The axes are nearly parallel or diverge: only the direction of view can be trusted.
        axis = axes.mean(0)
        focus = centers.mean(0) + ahead * axis / axis.norm().clamp(min=0.1)
        distances = ((focus - centers) * axes).sum(-1)
    distances = distances[distances > _LEAST * ahead]
    if not len(distances):
        raise SceneError(
            f"{where}: expected cameras that look at something in common, but got views in all directions; "
            "remove those that look away"
        )
    return focus, distances


def _range(distances: Tensor, near: float | None, far: float | None, where: str) -> tuple[float, float]:
    """Choose near and far in the file's units; log what is derived."""
    derived = [name for name, value in (("near", near), ("far", far)) if value is None]
    low, high = _NEAR * float(distances.min()), _FAR * float(distances.max())
    near, far = (
        (low if far is None else min(low, far / 2)) if near is None else near,
        (high if near is None else max(high, 2 * near)) if far is None else far,
    )
    if not near < far:
        raise SceneError(
            f"{where}: expected near < far, but got {near:g} and {far:g}; set data.near, data.far"
        )
    if derived:
        log.warning(
            "%s: %s derived from the cameras: near %.4g, far %.4g in the file's units; where something is "
            "cut off or blurred set data.near and data.far",
            where,
            " and ".join(derived),
            near,
            far,
        )
    return near, far


def _shown(focus: Tensor, distances: Tensor, cameras: Sequence[Camera]) -> Box:
    """Make the cube around the focus that holds what all pictures show of it."""
    width = max(max(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras)
    half = 0.5 * float(distances.max()) * width
    low, high = ([v + sign * half for v in focus.tolist()] for sign in (-1, 1))
    return Box(tuple(low), tuple(high))
