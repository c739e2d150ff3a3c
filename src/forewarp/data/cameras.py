"""Check poses, lenses and boxes, and read what the frames of ``transforms*.json`` files share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch

from forewarp.data.files import Entry, mismatch
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, Lens

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes of a camera to OpenCV's, and back
MOST_UNITS = 1e9  # largest coordinate: farther from the origin single precision is long lost
SPLITS = ("train", "val", "test")
MODELS = ("OPENCV", "PINHOLE", "RADIAL", "SIMPLE_RADIAL", "SIMPLE_PINHOLE")
_SAME_PIXEL = 0.01
# Poses are stored with six digits or more; a scale or a shear in a pose is never this small.
_ROTATION_TOLERANCE = 1e-3


def pose_of(value: object, where: str) -> np.ndarray:
    """Check a camera-to-world matrix, whose upper left part must be a rotation: (4, 4) float64.

    Raises:
        SceneError: for another shape, entries that are no finite numbers, or no rotation.
    """
    try:
        matrix = np.array(value)
    except ValueError:  # rows of different lengths
        matrix = np.array(None)
    if matrix.shape != (4, 4) or matrix.dtype.kind not in "if" or not np.isfinite(matrix).all():
        raise mismatch(where, "4 x 4 finite numbers", short(value), "check the export")
    matrix = matrix.astype(np.float64)
    rotation, largest = matrix[:3, :3], np.abs(matrix).max()
    if largest > MOST_UNITS:
        raise mismatch(where, f"a place within {MOST_UNITS:g} units", f"{largest:g}")
    error, determinant = np.abs(rotation @ rotation.T - np.eye(3)).max(), np.linalg.det(rotation)
    if error > _ROTATION_TOLERANCE or determinant < 0:
        got = f"determinant {determinant:.4g} and columns that are off orthonormal by {error:.2g}"
        raise mismatch(where, "a rotation", got, "remove scale and mirroring from the camera")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_TOLERANCE:
        raise mismatch(where, "the last row 0 0 0 1", matrix[3].tolist())
    return matrix


def opengl_pose(entry: Entry) -> torch.Tensor:
    """Read a frame's ``transform_matrix``, whose axes are OpenGL's: (4, 4) float64 with OpenCV's axes."""
    return torch.from_numpy(
        pose_of(entry.own.get("transform_matrix"), entry.where("transform_matrix")) @ FLIP
    )


def opengl_rows(pose: np.ndarray | torch.Tensor, where: str) -> list[list[float]]:
    """Make the ``transform_matrix`` of a pose (4, 4) with OpenCV's axes, to be written."""
    return (pose_of(np.asarray(pose, np.float64), where) @ FLIP).tolist()


def box_of(values: Sequence[float]) -> Box:
    """Make the box that a config gives as x0 y0 z0 x1 y1 z1 in world units.

    >>> box_of([-1, -1, -1, 1, 1, 2]).high
    (1.0, 1.0, 2.0)
    """
    try:
        return Box(tuple(values[:3]), tuple(values[3:]))
    except (TypeError, ValueError) as error:
        expected = "six numbers x0 y0 z0 x1 y1 z1, each low end below its high end"
        raise mismatch("data.box", expected, short(values)) from error


def frustum_box(cameras: Iterable[Camera]) -> Box:
    """Bound all rays between near and far, by those of 3 x 3 pixels of each camera."""
    points = []
    for camera in cameras:
        # Corners are not enough: at equal length a ray through the middle of an edge reaches further.
        rays = camera.rays(_nine_pixels(camera), dtype=torch.float64)
        points += [rays.origins + distance * rays.directions for distance in (camera.near, camera.far)]
    cloud = torch.cat(points)
    return Box(tuple(cloud.amin(0).tolist()), tuple(cloud.amax(0).tolist()))


def check_lens(camera: Camera, where: str) -> None:
    """Refuse a lens whose distortion cannot be undone all over the image: its rays would be wrong.

    Cost: nine points of Newton's method, once for all cameras of the same lens and size.
    """
    shape = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.skew
    if camera.lens is not None and not _can_be_undone(camera.lens, *shape):
        got = f"k={camera.lens.k} and p={camera.lens.p}"
        raise mismatch(where, "a lens that can be undone all over the picture", got, "undistort the images")


@lru_cache(1024)
def _can_be_undone(lens: Lens, width: int, height: int, *pinhole: float) -> bool:
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera(width, height, *pinhole[:4], pose, 0.0, 0.0, pinhole[4], lens)
    pixels = _nine_pixels(camera)
    u, v = pixels % width + 0.5, torch.div(pixels, width, rounding_mode="floor") + 0.5
    again, _ = camera.project(camera.directions(u, v))
    return bool(((again - torch.stack([u, v], -1)).abs() < _SAME_PIXEL).all())


def _nine_pixels(camera: Camera) -> torch.Tensor:
    """Flat indices (9,) of the corners, the middles of the edges and the centre."""
    columns = torch.tensor([0, camera.width // 2, camera.width - 1])
    rows = torch.tensor([0, camera.height // 2, camera.height - 1])
    return (rows[:, None] * camera.width + columns).flatten()


@dataclass(frozen=True)
class Normalisation:
    """The map ``X_scene = (X - center) * scale`` of a file's world; near and far are in the scene's units."""

    center: tuple[float, float, float]
    scale: float
    near: float
    far: float

    def points(self, points: np.ndarray | torch.Tensor) -> torch.Tensor:
        """Move points (..., 3) from the file's world to the scene's: float64."""
        return (
            torch.as_tensor(points).double() - torch.tensor(self.center, dtype=torch.float64)
        ) * self.scale

    def camera(self, camera: Camera) -> Camera:
        """Move a camera from the file's world to the scene's."""
        pose = camera.camera_to_world.clone()
        pose[:3, 3] = self.points(pose[:3, 3])
        return replace(camera, camera_to_world=pose, near=self.near, far=self.far)


def camera_of(entry: Entry, stored: tuple[int, int], scale: int, image: Path) -> Camera:
    """Read a nerfstudio-style camera: that of an image of ``stored`` pixels, whose entry is of one ``scale``
    times as large.
    """
    model = entry.get("camera_model", "OPENCV")
    if model not in MODELS:
        expected = f"one of {', '.join(MODELS)}"
        raise mismatch(entry.where("camera_model"), expected, short(model), "undistort the images")
    sizes = [entry.number(key, 1, 1e6, n * scale) for key, n in zip("wh", stored)]
    if any(abs(n - size / scale) >= 1 for n, size in zip(stored, sizes)):
        expected = " x ".join(f"{size / scale:g}" for size in sizes)
        got = f"{stored[0]} x {stored[1]}"
        raise mismatch(image, f"{expected} pixels as {entry.where('w')} and h say", got)
    width, height = map(round, sizes)
    fx = entry.number("fl_x", 0.01 * width, 100 * width)
    fy = entry.number("fl_y", 0.01 * height, 100 * height, fx)
    cx, cy = (entry.number(key, -n, 2 * n, n / 2) for key, n in (("cx", width), ("cy", height)))
    k = tuple(entry.number(key, -1e6, 1e6, 0.0) for key in ("k1", "k2", "k3"))
    p = tuple(entry.number(key, -1e6, 1e6, 0.0) for key in ("p1", "p2"))
    if entry.number("k4", default=0.0) != 0:
        raise mismatch(entry.where("k4"), "0", entry.get("k4"), "undistort the images")
    lens = Lens(k, p) if any(k + p) else None
    camera = Camera(width, height, fx, fy, cx, cy, opengl_pose(entry), 0.0, 0.0, lens=lens).resized(*stored)
    check_lens(camera, entry.where("k1"))
    return camera
