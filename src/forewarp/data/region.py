"""Where a capture of unknown scale happens: its middle, its size, how near and how far one sees."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forewarp.data.views import frustum_box
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.errors import SceneError
from forewarp.scene.paths import focus_point

# Shares of the cameras' distance from what they look at, where nothing else is known. Two real captures whose
# ends were given had the near one at 0.01 and 0.55 and the far one at 2.4 and 2.2.
_NEAR, _FAR = 0.2, 2.5
_LEAST, _MOST = 1e-3, 50.0  # of how far ahead is supposed: nearer or farther the axes do not say it
_STILL = 1e-9
_AHEAD = 4.0  # of the cameras' spread: how far ahead they look where their axes do not say

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Region:
    """``X_scene = (X - center) * scale``; ``near``, ``far`` and ``box`` are the scene's."""

    center: tuple[float, float, float]
    scale: float
    near: float
    far: float
    box: Box

    def placed(self, camera: Camera) -> Camera:
        """A camera of the file in the scene."""
        pose = camera.camera_to_world.clone()
        pose[:3, 3] = (pose[:3, 3] - torch.tensor(self.center, dtype=torch.float64)) * self.scale
        return replace(camera, camera_to_world=pose, near=self.near, far=self.far)

    def moved(self, box: Box) -> Box:
        """A box of the file in the scene."""
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
    """The region that cameras look at.

    Args:
        cameras: of all frames; their near and far are not looked at.
        where: the file, for errors.
        near, far, box: what is known, in the file's units; None is derived. ``near`` and ``far`` are shares
            of the distance to the point that is looked at; the box holds all rays between them.
        cut_out: the subject is; then the box holds no more than the pictures show about that point.
        normalise: put that point at the origin and the farthest camera at distance 1.

    Raises:
        SceneError: where something is to be derived and the cameras do not say it.
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
    """The point looked at (3,) and its distances along those optical axes that it lies before, float64."""
    centers = torch.stack([camera.center for camera in cameras])
    axes = torch.stack([camera.camera_to_world[:3, 2] for camera in cameras])
    spread = float((centers - centers.mean(0)).norm(dim=-1).max())
    ahead = _AHEAD * spread if near is None or far is None else 0.5 * (near + far)
    if spread <= _STILL * (1 + float(centers.abs().max())) and (near is None or far is None):
        raise SceneError(
            f"{where}: expected cameras that move, but got one place; set data.near and data.far"
        )
    focus = focus_point([replace(camera, near=0.0, far=2 * ahead) for camera in cameras])
    distances = ((focus - centers) * axes).sum(-1)
    if not _LEAST * ahead < float(distances.median()) < _MOST * ahead:
        # The axes are nearly parallel or part: they say no more than whither the cameras look.
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
    """Near and far in the file's units; what is derived is said."""
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
    """The cube about the focus point that holds what all pictures show of it."""
    width = max(max(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras)
    half = 0.5 * float(distances.max()) * width
    low, high = ([v + sign * half for v in focus.tolist()] for sign in (-1, 1))
    return Box(tuple(low), tuple(high))
