"""Check poses, lenses and boxes; find the part of space that cameras look at."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from reprlib import repr as short

import numpy as np
import torch
from torch import Tensor

from forewarp.data.files import mismatch, number
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, Lens, focus_point
from forewarp.scene.world import World

log = logging.getLogger(__name__)

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes of a camera to OpenCV's, and back
MOST_UNITS = 1e9  # largest coordinate: farther from the origin single precision is long lost
_LARGER, _SAME_FACTOR = 1.5, 0.1  # of a middle beyond the image's own, which tells a larger image's
_LEAST_FACTOR, _EXCHANGED = 0.1, 0.05  # of a smaller image's middle; by which exchanged sides may be off
_SHARES = 0.2  # of the sides, below which no principal point lies
_FEW_PIXELS = 8  # of a side, which is no image
WIDEST = 110  # degrees of a pinhole camera, of which phones' widest have 108
IN_PIXELS = "if fl_x is in millimetres, multiply it by w and divide it by the sensor's width"
IN_PIXELS += "; if it is a share of the width, multiply it by w"
SPLITS = ("train", "val", "test")
_SAME_PIXEL = 0.01
# Near and far as shares of the cameras' distance from what they look at, where nothing else is known. Two
# real captures that gave them had near at 0.01 and 0.55 and far at 2.4 and 2.2.
_NEAR, _FAR = 0.2, 2.5
_LEAST, _MOST = 1e-3, 50.0  # a focus outside these shares of the assumed distance is not trusted
_SAME_PLACE = 1e-9
_FAR_AWAY = 1e4  # far planes from the origin: there single precision moves things by about a pixel
_AHEAD = 4.0  # assumed distance of what is looked at, in radii of the cameras' places
# Poses are stored with six digits or more; a scale or a shear in a pose is never this small.
_ROTATION_TOLERANCE = 1e-3


def pose_of(value: object, where: str) -> np.ndarray:
    """Check a camera-to-world matrix, whose upper left part must be a rotation: (4, 4) float64.

    The last row may be left out.

    Raises:
        SceneError: for another shape, entries that are no finite numbers, or no rotation.
    """
    try:
        matrix = np.array(value)
    except ValueError:  # rows of different lengths
        matrix = np.array(None)
    if matrix.shape == (3, 4) and matrix.dtype.kind in "if":
        matrix = np.concatenate([matrix, [[0, 0, 0, 1]]])
    if matrix.shape != (4, 4) or matrix.dtype.kind not in "if" or not np.isfinite(matrix).all():
        advice = "write its numbers without quotes" if matrix.dtype.kind == "U" else "check the export"
        rows = {(16,): "four", (12,): "three"}.get(matrix.shape)
        advice = f"write it as {rows} rows of four numbers" if rows else advice
        raise mismatch(where, "4 x 4 or 3 x 4 finite numbers", short(value), advice)
    matrix = matrix.astype(np.float64)
    rotation, largest = matrix[:3, :3], np.abs(matrix).max()
    if largest > MOST_UNITS:
        raise mismatch(where, f"a place within {MOST_UNITS:g} units", f"{largest:g}")
    error, determinant = np.abs(rotation @ rotation.T - np.eye(3)).max(), np.linalg.det(rotation)
    if error > _ROTATION_TOLERANCE or determinant < 0:
        got = f"determinant {determinant:.4g} and columns that are off orthonormal by {error:.2g}"
        raise mismatch(where, "a rotation", got, "remove scale and mirroring from the camera")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_TOLERANCE:
        advice = "transpose it" if not matrix[:3, 3].any() else ""
        raise mismatch(where, "the last row 0 0 0 1", matrix[3].tolist(), advice)
    return matrix


def opengl_rows(pose: np.ndarray | torch.Tensor, where: str) -> list[list[float]]:
    """Make the ``transform_matrix`` of a pose (4, 4) with OpenCV's axes, to be written."""
    return (pose_of(np.asarray(pose, np.float64), where) @ FLIP).tolist()


def number_or_none(value: object, where: str, least: float = 0, most: float = MOST_UNITS) -> float | None:
    """Check a number, such as a length in world units, that may be unknown, None."""
    return None if value is None else number(value, where, least, most)


def box_of(values: Sequence[float] | None) -> Box | None:
    """Make the box that a config gives as x0 y0 z0 x1 y1 z1 in world units; None of None.

    >>> box_of([-1, -1, -1, 1, 1, 2]).high
    (1.0, 1.0, 2.0)
    """
    try:
        return None if values is None else Box(tuple(values[:3]), tuple(values[3:]))
    except (TypeError, ValueError) as error:
        expected = "six numbers x0 y0 z0 x1 y1 z1, each low end below its high end"
        raise mismatch("data.box", expected, short(values)) from error


def frustum_box(cameras: Iterable[Camera]) -> Box:
    """Bound all rays between near and far, by those of 3 x 3 pixels of each camera."""
    points = []
    for camera in cameras:
        # Corners are not enough: at equal length a ray through the middle of an edge reaches further.
        directions = camera.turned(_nine_points(*camera.inner))
        points += [camera.center + distance * directions for distance in (camera.near, camera.far)]
    cloud = torch.cat(points)
    return Box(tuple(cloud.amin(0).tolist()), tuple(cloud.amax(0).tolist()))


def check_lens(camera: Camera, where: str) -> None:
    """Refuse a lens whose distortion cannot be undone all over the image: its rays would be wrong.

    Cost: nine points of Newton's method, once for all cameras of the same lens and size.
    """
    if camera.lens is not None and not _can_be_undone(*camera.inner):
        got = f"k={camera.lens.k} and p={camera.lens.p}"
        advice = "undistort the images"
        if (degrees := degrees_of(camera)) > WIDEST:
            got += f" of images {degrees:.0f} degrees wide"
            advice = f"{IN_PIXELS}; else {advice}"
        raise mismatch(where, "a lens that can be undone all over the picture", got, advice)


def degrees_of(camera: Camera) -> float:
    """Return the angle in degrees that the wider side of a camera's image has without its lens."""
    return math.degrees(2 * math.atan(max(camera.width / camera.fx, camera.height / camera.fy) / 2))


def check_camera(camera: Camera, middle: str, lens: str) -> None:
    """Refuse intrinsics of a larger or smaller image, whose middle is off by one factor on both sides, of one
    with width and height exchanged, and shares of the size in place of pixels; also as ``check_lens``.

    Args:
        camera: at the size of the stored image.
        middle, lens: the keys of principal point and distortion, for errors.
    """
    across, down = 2 * camera.cx / camera.width, 2 * camera.cy / camera.height
    of_one_factor = min(across, down) > _LEAST_FACTOR and abs(across / down - 1) < _SAME_FACTOR
    exchanged = 2 * camera.cx / camera.height, 2 * camera.cy / camera.width
    aside, advice = min(abs(across - 1), abs(down - 1)), None
    factor = math.sqrt(across * down) if of_one_factor else 1.0
    shares = min(camera.cx, camera.cy) > _SHARES and max(camera.cx, camera.cy) <= 1
    if shares and min(camera.width, camera.height) > _FEW_PIXELS:
        advice = "they are shares of the size: multiply cx and fl_x by the width, cy and fl_y by the height"
    elif not 1 / _LARGER < factor < _LARGER:
        size, way = (factor, "down") if factor > 1 else (1 / factor, "up")
        larger = "large" if factor > 1 else "small"
        advice = f"the intrinsics are of images {size:.3g} times as {larger}: scale them {way}"
    elif aside > _SAME_FACTOR and all(abs(share - 1) < _EXCHANGED for share in exchanged):
        advice = "width and height seem exchanged: exchange cx and cy, fl_x and fl_y"
    if advice is not None:
        got = f"({camera.cx:g}, {camera.cy:g}) of {camera.width} x {camera.height} pixels"
        raise mismatch(middle, "a principal point near the middle", got, advice)
    check_lens(camera, lens)


@lru_cache(1024)
def _can_be_undone(*inner: float | Lens) -> bool:
    again, _ = Camera.at_origin(*inner).project(_nine_points(*inner))
    return bool(((again - _nine_places(*inner[:2])).abs() < _SAME_PIXEL).all())


@lru_cache(1024)
def _nine_points(*inner: float | Lens) -> Tensor:
    """Points (9, 3) of the camera's axes that ``nine_pixels`` show, once for all cameras of a film."""
    return Camera.at_origin(*inner).straight(*_nine_places(*inner[:2]).unbind(-1))


def _nine_places(width: int, height: int) -> Tensor:
    columns = torch.tensor([0, width // 2, width - 1])
    rows = torch.tensor([0, height // 2, height - 1])
    return torch.cartesian_prod(rows, columns).flip(-1).double() + 0.5


def nine_pixels(camera: Camera) -> Tensor:
    """Flat indices (9,) of the corners, the middles of the edges and the centre."""
    columns, rows = _nine_places(camera.width, camera.height).long().unbind(-1)
    return rows * camera.width + columns


@dataclass(frozen=True)
class Normalisation(World):
    """A file's world, and near and far in the scene's units."""

    near: float = 0.0
    far: float = 1.0

    @property
    def told(self) -> dict:
        """What a scene's protocol says of it."""
        return {"center": list(self.center), "scale": self.scale}

    def camera(self, camera: Camera) -> Camera:
        """Move a camera from the file's world to the scene's."""
        pose = self.to_scene(camera.camera_to_world)
        return replace(camera, camera_to_world=pose, near=self.near, far=self.far)


def space_of(
    cameras: Sequence[Camera],
    where: str,
    *,
    near: float | None = None,
    far: float | None = None,
    box: Box | None = None,
    normalise: bool = True,
    cut_out: bool = False,
    radius: float = 1.0,
    metric: bool = False,
) -> tuple[Normalisation, Box]:
    """Find the part of the world that cameras of unknown scale look at: how to normalise it, and its box.

    Args:
        cameras: cameras of all frames; their near and far are not used.
        where: the file, for errors.
        near, far, box: what is known, in the file's units; None is derived: ``near`` and ``far`` from the
            distance to the focus, the point looked at; the box holds all rays between them.
        cut_out: the images are cut out; then the box holds only what they show around the focus.
        normalise: put the focus at the origin and the farthest camera at distance ``radius``.
        radius: see ``normalise``.
        metric: normalise as ``near_origin`` alone: the unit of length stays.

    Raises:
        SceneError: where something cannot be derived from the cameras.
    """
    focus, distances = _focus(cameras, near, far, where)
    near, far = _range(distances, near, far, where)
    if not normalise and float(focus.norm()) > _FAR_AWAY * far:
        expected = f"cameras within {_FAR_AWAY * far:.3g} units of the origin with data.normalise=false"
        advice = "set data.normalise=true (exports are in the file's world), or move the origin"
        raise mismatch(where, expected, f"{float(focus.norm()):.4g}, too far for single precision", advice)
    size, center = 1.0, near_origin(focus.tolist(), far).center
    if normalise and not metric:
        size = max(float((camera.center - focus).norm()) for camera in cameras) / radius
        center = tuple(focus.tolist())
    space = Normalisation(center, 1 / size, near / size, far / size)

    def moved(box: Box) -> Box:
        return Box(*space.to_scene(np.array([box.low, box.high])).tolist())

    try:
        if box is not None:
            return space, moved(box)
        seen = frustum_box(map(space.camera, cameras))
        if cut_out:  # the cube around the focus that holds what all images show of it
            width = max(max(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras)
            half = 0.5 * float(distances.max()) * width
            seen = seen.intersection(moved(Box((focus - half).tolist(), (focus + half).tolist())))
        return space, seen
    except ValueError as error:
        advice = "set data.near, data.far and data.box"
        raise mismatch(where, "cameras that see a part of space", f"none ({error})", advice) from error


def near_origin(place: Sequence[float], far: float) -> World:
    """Return the world whose origin is at a place, in whole units of the data's, if that is too far from the
    data's origin for single precision, which moves what is seen there; else the data's world.

    >>> near_origin((456012.3, 4650123.7, 81.2), 10.0).center, near_origin((30.0, 4.0, 0.5), 10.0).is_same
    ((456012.0, 4650124.0, 81.0), True)
    """
    is_far = math.dist(place, (0.0, 0.0, 0.0)) > _FAR_AWAY * far
    return World(tuple(float(round(value)) for value in place)) if is_far else World()


def _focus(cameras: list[Camera], near: float | None, far: float | None, where: str) -> tuple[Tensor, Tensor]:
    """Find the focus (3,) and its distances along the optical axes of the cameras that face it, float64."""
    centers = torch.stack([camera.center for camera in cameras])
    axes = torch.stack([camera.camera_to_world[:3, 2] for camera in cameras])
    radius, is_open = float((centers - centers.mean(0)).norm(dim=-1).max()), near is None or far is None
    ahead = _AHEAD * radius if is_open else 0.5 * (near + far)
    if is_open and radius <= _SAME_PLACE * (1 + float(centers.abs().max())):
        raise mismatch(where, "cameras that move", "one place", "set data.near and data.far")
    focus = focus_point([replace(camera, near=0.0, far=2 * ahead) for camera in cameras])
    distances = ((focus - centers) * axes).sum(-1)
    if not _LEAST * ahead < float(distances.median()) < _MOST * ahead:
        # The axes are nearly parallel or diverge: only the direction of view can be trusted.
        axis = axes.mean(0)
        focus = centers.mean(0) + ahead * axis / axis.norm().clamp(min=0.1)
        distances = ((focus - centers) * axes).sum(-1)
    distances = distances[distances > _LEAST * ahead]
    if not len(distances):
        expected, advice = "cameras that look at something in common", "remove those that look away"
        raise mismatch(where, expected, "views in all directions", advice)
    return focus, distances


def _range(distances: Tensor, near: float | None, far: float | None, where: str) -> tuple[float, float]:
    """Choose near and far in the file's units; log what is derived."""
    derived = " and ".join(name for name, value in (("near", near), ("far", far)) if value is None)
    low, high = _NEAR * float(distances.min()), _FAR * float(distances.max())
    near = min(low, math.inf if far is None else far / 2) if near is None else near
    far = max(high, 2 * near) if far is None else far
    if not near < far:
        raise mismatch(where, "near < far", f"{near:g} and {far:g}", "set data.near, data.far")
    if derived:
        line = f"{derived} derived from the cameras: near {near:.4g}, far {far:.4g} in the file's units"
        log.warning(f"{where}: {line}; where something is cut off or blurred set data.near and data.far")
    return near, far
