"""Check the poses, boxes, ranges and lenses that files and configs give."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from reprlib import repr as short

import numpy as np
import torch

from forewarp.data.files import number
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.errors import SceneError
from forewarp.scene.lens import Lens

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes of a camera to OpenCV's, and back
MOST_UNITS = 1e9  # largest coordinate: farther from the origin single precision is long lost
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
        raise SceneError(f"{where}: expected 4 x 4 finite numbers, but got {short(value)}; check the export")
    matrix = matrix.astype(np.float64)
    rotation = matrix[:3, :3]
    if np.abs(matrix).max() > MOST_UNITS:
        largest = np.abs(matrix).max()
        raise SceneError(f"{where}: expected a place within {MOST_UNITS:g} units, but got {largest:g}")
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    determinant = np.linalg.det(rotation)
    if error > _ROTATION_TOLERANCE or determinant < 0:
        raise SceneError(
            f"{where}: expected a rotation, but got determinant {determinant:.4g} and columns that are off "
            f"orthonormal by {error:.2g}; remove scale and mirroring from the camera"
        )
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_TOLERANCE:
        raise SceneError(f"{where}: expected the last row 0 0 0 1, but got {matrix[3].tolist()}")
    return matrix


def box_of(values: Sequence[float]) -> Box:
    """Make the box that a config gives as x0 y0 z0 x1 y1 z1 in world units.

    >>> box_of([-1, -1, -1, 1, 1, 2]).high
    (1.0, 1.0, 2.0)
    """
    expected = "data.box: expected six numbers x0 y0 z0 x1 y1 z1, each low end below its high end"
    try:
        low, high = tuple(float(v) for v in values[:3]), tuple(float(v) for v in values[3:])
        return Box(low, high)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{expected}, but got {short(values)}") from error


def frustum_box(cameras: Iterable[Camera]) -> Box:
    """Bound all rays between near and far, by those of 3 x 3 pixels of each camera."""
    points = []
    for camera in cameras:
        # Corners are not enough: at equal length a ray through the middle of an edge reaches further.
        pixels = _nine_pixels(camera)
        rays = camera.rays(pixels, dtype=torch.float64)
        points += [rays.origins + distance * rays.directions for distance in (camera.near, camera.far)]
    cloud = torch.cat(points)
    return Box(tuple(cloud.amin(0).tolist()), tuple(cloud.amax(0).tolist()))


def check_range(near: float, far: float) -> None:
    """Refuse a range of distances that is empty, negative or infinite."""
    if not number(near, "data.near", 0, MOST_UNITS) < number(far, "data.far", 0, MOST_UNITS):
        raise SceneError(f"data.near, data.far: expected near < far, but got {near} and {far}")


def check_lens(camera: Camera, where: str) -> None:
    """Refuse a lens whose distortion cannot be undone all over the picture: its rays would be wrong.

    Cost: nine points of Newton's method, once for all cameras of the same lens and size.
    """
    if camera.lens is not None and not _can_be_undone(
        camera.lens, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.skew
    ):
        raise SceneError(
            f"{where}: expected a lens that can be undone all over the picture, but got k={camera.lens.k} "
            f"and p={camera.lens.p}; undistort the images"
        )


@lru_cache(1024)
def _can_be_undone(
    lens: Lens, width: int, height: int, fx: float, fy: float, cx: float, cy: float, skew: float
) -> bool:
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera(width, height, fx, fy, cx, cy, pose, 0.0, 0.0, skew, lens)
    pixels = _nine_pixels(camera)
    u, v = pixels % width + 0.5, torch.div(pixels, width, rounding_mode="floor") + 0.5
    again, _ = camera.project(camera.directions(u, v))
    return bool(((again - torch.stack([u, v], -1)).abs() < _SAME_PIXEL).all())


def _nine_pixels(camera: Camera) -> torch.Tensor:
    """Flat indices (9,) of the corners, the middles of the edges and the centre."""
    columns = torch.tensor([0, camera.width // 2, camera.width - 1])
    rows = torch.tensor([0, camera.height // 2, camera.height - 1])
    return (rows[:, None] * camera.width + columns).flatten()
