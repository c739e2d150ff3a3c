"""Check poses, lenses, boxes and ranges, and read the cameras of a nerfstudio-style ``transforms.json``."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch

from forewarp.data.files import SceneError, frames_of, inside, number
from forewarp.data.images import inspect_image
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, Lens

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


SPLITS = ("train", "val", "test")
MODELS = ("OPENCV", "PINHOLE", "RADIAL", "SIMPLE_RADIAL", "SIMPLE_PINHOLE")
SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


@dataclass(frozen=True)
class ImageEntry:
    """A checked entry: ``camera`` in the file's units, at the size of the image; its near and far are 0.

    ``name`` is the image's path without its suffix; ``has_alpha`` says what the image's header does.
    """

    name: str
    time: float | None
    camera: Camera
    image: Path
    mask: Path | None
    has_alpha: bool


@dataclass(frozen=True)
class _Entry:
    """A frame's own keys, then those at the top of the file."""

    file: Path
    index: int
    own: dict
    common: dict

    def where(self, key: str) -> str:
        shared = key in self.common and key not in self.own
        return f"{self.file}: {key}" if shared else f"{self.file}: frames[{self.index}].{key}"

    def get(self, key: str, default: object = None) -> object:
        return self.own.get(key, self.common.get(key, default))

    def number(self, key: str, default: object, low: float = -math.inf, high: float = math.inf) -> float:
        return number(self.get(key, default), self.where(key), low, high)


def read_entries(file: Path, content: dict, scale: int = 1) -> list[ImageEntry]:
    """Read all entries of a file in its order.

    Args:
        file: for errors and as the place that paths start from.
        content: content of the file.
        scale: take images that are ``scale`` times smaller, from ``images_4`` in place of ``images``.

    Raises:
        SceneError: for every key or image that is missing or wrong.

    Cost: one read of each PNG, of a JPEG's beginning and end.
    """
    frames, entries = frames_of(content, file), []
    for i, own in enumerate(frames):
        if not isinstance(own, dict):
            raise SceneError(f"{file}: frames[{i}]: expected an object, but got {short(own)}")
        entries.append(_image_entry(_Entry(file, i, own, content), scale))
    for key, given in (
        ("time", [e.time is not None for e in entries]),
        ("mask_path", [e.mask is not None for e in entries]),
        ("file_path: alpha", [e.has_alpha or e.mask is not None for e in entries]),
    ):
        if any(given) and not all(given):
            got = f"{sum(given)} of {len(given)} and none in frames[{given.index(False)}]"
            raise SceneError(f"{file}: frames: {key}: expected one in all frames or in none, but got {got}")
    if len({e.name for e in entries}) < len(entries):
        twice = next(e.name for i, e in enumerate(entries) if e.name in {w.name for w in entries[:i]})
        raise SceneError(f"{file}: frames: expected each image once, but got {twice} twice; remove one")
    return entries


def name_of(folder: Path, value: object, where: str) -> str:
    """Name an image by its path without the suffix."""
    path = inside(folder, value, where)
    return path.relative_to(folder).as_posix().removesuffix(path.suffix if path.suffix in SUFFIXES else "")


def with_even_times(entries: list[ImageEntry]) -> list[ImageEntry]:
    """Sort entries by name, as ``in_order``, and space their times evenly over [0, 1]."""
    entries = in_order(entries, lambda entry: entry.name)
    return [replace(entry, time=i / max(len(entries) - 1, 1)) for i, entry in enumerate(entries)]


def in_order(things: Iterable, name: Callable[..., str] = str) -> list:
    """Sort things by their names, numbers within them by value.

    >>> in_order(["b2", "b10", "a"])
    ['a', 'b2', 'b10']
    """

    def parts(thing) -> list:
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name(thing))]

    return sorted(things, key=parts)


def split_entries(file: Path, content: dict, entries: list[ImageEntry], test_every: int) -> tuple[dict, str]:
    """Split the entries; also say in words how.

    Args:
        file, content: where ``<split>_filenames`` may list frames; what no list names trains, or tests where
            the training frames are listed.
        entries: in the order of time.
        test_every: every n-th is a test frame where nothing is listed, the first and the last never; of three
            frames or more at least one.

    Raises:
        SceneError: for a list that names no frame or one of another list, and where a split is empty.
    """
    lists = {
        s: _listed(file, content, f"{s}_filenames", entries) for s in SPLITS if f"{s}_filenames" in content
    }
    if lists:
        home = next((split for split in ("train", "test") if split not in lists), None)
        parts = {split: [e for e in entries if e.name in lists.get(split, ())] for split in SPLITS}
        free = [e for e in entries if all(e.name not in names for names in lists.values())]
        parts |= {home: free} if home else {}
        how = "as listed in the file"
    else:
        held = slice(max(1, min(test_every // 2, len(entries) - 2)), -1, test_every)
        parts = {"train": entries.copy(), "val": [], "test": entries[held]}
        del parts["train"][held]
        how = f"every {test_every}th frame held out"
    if sum(map(len, parts.values())) > len({e.name for part in parts.values() for e in part}):
        raise SceneError(f"{file}: expected lists of filenames that share none, but got one in two of them")
    for split in ("train", "test"):
        if not parts[split]:
            raise SceneError(
                f"{file}: expected a frame to {split} on, but got none of {len(entries)}; name some in "
                f"{split}_filenames"
            )
    return parts, how


def _listed(file: Path, content: dict, key: str, entries: list[ImageEntry]) -> set[str]:
    """Read the frame names in the list of paths ``content[key]``; refuse names that are no frame."""
    value = content[key]
    if not isinstance(value, list):
        raise SceneError(f"{file}: {key}: expected a list of paths, but got {short(value)}")
    names = {name_of(file.parent, path, f"{file}: {key}[{i}]") for i, path in enumerate(value)}
    if unknown := sorted(names - {entry.name for entry in entries}):
        raise SceneError(f"{file}: {key}: expected paths of frames, but got {short(unknown[0])}")
    return names


def _image_entry(entry: _Entry, scale: int) -> ImageEntry:
    image, name = _file(entry, "file_path", scale)
    header = inspect_image(image)
    mask = None
    if "mask_path" in entry.own:
        mask, _ = _file(entry, "mask_path", scale)
        if (size := inspect_image(mask).size) != header.size:
            got = f"{size[0]} x {size[1]}"
            raise SceneError(
                f"{mask}: expected {header.size[0]} x {header.size[1]} pixels as {image.name}, but got {got}"
            )
    time = number(entry.own["time"], entry.where("time"), 0, 1) if "time" in entry.own else None
    camera = _camera(entry, header.size, scale, image)
    return ImageEntry(name, time, camera, image, mask, header.has_alpha)


def _file(entry: _Entry, key: str, scale: int) -> tuple[Path, str]:
    """Find the image that a key names, with or without its suffix, and its name."""
    folder, where = entry.file.parent, entry.where(key)
    path, name = inside(folder, entry.own.get(key), where), name_of(folder, entry.own.get(key), where)
    if scale > 1 and path.parent == folder:
        raise SceneError(f"{where}: expected images in a folder, but got {name}; set data.scale=1")
    if scale > 1:
        path = path.parent.with_name(f"{path.parent.name}_{scale}") / path.name
    if path.suffix in SUFFIXES:
        return path, name
    found = [p for p in (path.with_name(path.name + s) for s in SUFFIXES) if os.path.isfile(p)]
    if not found:
        raise SceneError(f"{where}: expected an image, PNG or JPEG, but got no {path}.png or .jpg")
    return found[0], name


def _camera(entry: _Entry, stored: tuple[int, int], scale: int, image: Path) -> Camera:
    """Make the camera of an image of ``stored`` pixels; its entry is of one ``scale`` times as large."""
    model = entry.get("camera_model", "OPENCV")
    if model not in MODELS:
        raise SceneError(
            f"{entry.where('camera_model')}: expected one of {', '.join(MODELS)}, but got {short(model)}; "
            "undistort the images"
        )
    sizes = [entry.number(key, n * scale, 1, 1e6) for key, n in zip("wh", stored)]
    if any(abs(n - size / scale) >= 1 for n, size in zip(stored, sizes)):
        expected = " x ".join(f"{size / scale:g}" for size in sizes)
        raise SceneError(
            f"{image}: expected {expected} pixels as {entry.where('w')} and h say, but got "
            f"{stored[0]} x {stored[1]}"
        )
    width, height = (round(size) for size in sizes)
    fx = entry.number("fl_x", None, 0.01 * width, 100 * width)
    fy = entry.number("fl_y", fx, 0.01 * height, 100 * height)
    cx, cy = (entry.number(key, n / 2, -n, 2 * n) for key, n in (("cx", width), ("cy", height)))
    k = [entry.number(key, 0.0, -1e6, 1e6) for key in ("k1", "k2", "k3")]
    p = [entry.number(key, 0.0, -1e6, 1e6) for key in ("p1", "p2")]
    if entry.number("k4", 0.0) != 0:
        raise SceneError(f"{entry.where('k4')}: expected 0, but got {entry.get('k4')}; undistort the images")
    lens = Lens(tuple(k), tuple(p)) if any(k + p) else None
    where = f"{entry.file}: frames[{entry.index}].transform_matrix"
    pose = torch.from_numpy(pose_of(entry.own.get("transform_matrix"), where) @ FLIP)
    camera = Camera(width, height, fx, fy, cx, cy, pose, 0.0, 0.0, lens=lens).resized(*stored)
    check_lens(camera, entry.where("k1"))
    return camera
