"""A user's own capture: ``transforms.json`` as nerfstudio and instant-ngp write it, and images, PNG or JPEG.

A pose on disk is camera-to-world with OpenGL's axes (x right, y up, looking along -z). The camera
(``w h fl_x fl_y cx cy k1 k2 k3 p1 p2 camera_model``) stands at the top or, where it differs, in a frame. All
lengths (``near``, ``far``, ``aabb``; ``data.near``, ``data.far``, ``data.box``) are in the file's units,
which may be any: the scene is normalised. The optional ``points.npy`` (N, 3) holds points that never move.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch
from torch import Tensor

from forewarp.data.arrays import read_cloud, write_array
from forewarp.data.cameras import (
    FLIP,
    MOST_UNITS,
    SPLITS,
    SUFFIXES,
    ImageEntry,
    box_of,
    frustum_box,
    name_of,
    pose_of,
    read_entries,
    split_entries,
    with_even_times,
)
from forewarp.data.files import MARKERS, SceneError, number, read_json, scene_folder, whole
from forewarp.data.images import CachedImage, MaskedImage, write_jpeg, write_png
from forewarp.files import write_json
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene, middle_of
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


FILE, POINTS = MARKERS["posed_video"], "points.npy"
SCALES = (1, 2, 4, 8)
_OF_CAMERA = {"w", "h", "fl_x", "fl_y", "cx", "cy", "camera_model", "k1", "k2", "k3", "p1", "p2"}


@dataclass(frozen=True)
class PosedShot:
    """An image to write: ``name`` its file, .png or .jpg; ``pixels`` uint8 (H, W, 3), or (H, W, 4) of
    straight alpha; ``camera`` of that size, its near and far are not written; ``time`` in [0, 1] or None;
    ``split`` train, val or test, or "" where the reader is to choose.
    """

    name: str
    camera: Camera
    pixels: Tensor | np.ndarray
    time: float | None = None
    split: str = ""


def read_scene(
    root: str | Path,
    scene: str,
    *,
    scale: int = 1,
    near: float | None = None,
    far: float | None = None,
    box: Sequence[float] | None = None,
    normalise: bool = True,
    canonical: str = "middle",
    test_every: int = 8,
) -> Scene:
    """Read ``root/scene``; pixels are decoded when a frame is first loaded.

    The subject is cut out where there are masks, or where some image has a pixel that is not opaque: images
    with an alpha channel are decoded until one such is found.

    Without ``time`` in the file the frames are evenly spaced over [0, 1] in the order of their names.

    Args:
        scale: 1, 2, 4 or 8: take the smaller images in ``images_<scale>`` beside ``images``.
        near, far: along the unit ray, the file's units; None takes the file's or derives them.
        box: x0 y0 z0 x1 y1 z1 in the file's units; None takes the file's ``aabb``, or all that is seen.
        normalise: put what is looked at into the origin and the farthest camera at distance 1.
        canonical: the training time nearest to the ``middle``, or the ``first``.
        test_every: every n-th frame is a test frame, the first and the last never, where the file does not
            list ``<split>_filenames``.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and key.
    """
    _check(scale, canonical, test_every, normalise)
    file = scene_folder(root, scene, FILE) / FILE
    content = read_json(file)
    entries = read_entries(file, content, scale)
    timeless = entries[0].time is None
    entries = with_even_times(entries) if timeless else sorted(entries, key=lambda e: e.time)
    parts, how = split_entries(file, content, entries, test_every)
    near, far, bounds = _limits(file, content, near, far, box)
    has_alpha = any(e.mask is not None or _is_transparent(e) for e in entries)
    options = {"near": near, "far": far, "box": bounds, "normalise": normalise, "cut_out": has_alpha}
    region = region_of([e.camera for e in entries], str(file), **options)
    train, val, test = (
        tuple(Frame(e.name, e.time, region.placed(e.camera), _load(e)) for e in parts[split])
        for split in SPLITS
    )
    start = (min if canonical == "first" else middle_of)([frame.time for frame in train])
    protocol = {
        "dataset": "video_with_poses",
        "resolution": [train[0].camera.width, train[0].camera.height],
        "times": "spread in the order of the files' names" if timeless else "as given",
        "split": how,
        "test_frames": len(test),
        "normalisation": {"center": list(region.center), "scale": region.scale},
        "near": region.near,
        "far": region.far,
        "derived": [n for n, v in (("near", near), ("far", far), ("box", bounds)) if v is None],
    }
    cloud = file.parent / POINTS
    still = region.points(read_cloud(cloud, 3)) if cloud.exists() else None
    return Scene(scene, train, val, test, region.box, start, has_alpha, protocol=protocol, still=still)


def write_scene(
    folder: str | Path,
    shots: Iterable[PosedShot],
    *,
    near: float | None = None,
    far: float | None = None,
    aabb: Box | None = None,
    points: np.ndarray | None = None,
) -> None:
    """Write a scene that ``read_scene`` reads; ``transforms.json`` is removed first and written last.

    Args:
        shots: consumed one by one; all or none have a split.
        near, far, aabb, points: where known, in the units of the cameras' places; ``points`` (N, 3) never
            move.

    Raises:
        ValueError: for a shot that ``read_scene`` would refuse.
    """
    folder = Path(folder)
    for name in (FILE, POINTS):
        (folder / name).unlink(missing_ok=True)
    entries, lists, taken = [], {split: [] for split in SPLITS}, set()
    for shot in shots:
        _check_shot(folder, shot, taken)
        entries.append(_write_shot(folder, shot))
        if shot.split:
            lists[shot.split].append(entries[-1]["file_path"])
    common = {key: value for key, value in (entries[0] if entries else {}).items() if key in _OF_CAMERA}
    for entry in entries:
        common = {key: value for key, value in common.items() if entry.get(key) == value}
    content = {**common, **{f"{split}_filenames": names for split, names in lists.items() if names}}
    content |= {key: value for key, value in (("near", near), ("far", far)) if value is not None}
    content |= {} if aabb is None else {"aabb": [aabb.low, aabb.high]}
    content["frames"] = [{k: v for k, v in entry.items() if k not in common} for entry in entries]
    if points is not None and len(points):
        write_array(folder / POINTS, np.asarray(points, dtype=np.float32))
    write_json(folder / FILE, content)


def _check_shot(folder: Path, shot: PosedShot, taken: set[str]) -> None:
    """Refuse what ``read_scene`` would; ``taken`` are the names so far, to which this one's is added."""
    camera, pixels = shot.camera, np.asarray(shot.pixels)
    suffix, name = Path(shot.name).suffix, name_of(folder, f"images/{shot.name}", f"shots: {shot.name!r}")
    if suffix not in SUFFIXES:
        raise ValueError(f"{shot.name}: expected a name in {', '.join(SUFFIXES)}, but got {suffix!r}")
    if name in taken:
        raise ValueError(f"{shot.name}: expected names that differ without their suffix, but got two alike")
    taken.add(name)
    if shot.split not in ("", *SPLITS):
        raise ValueError(f"{shot.name}: expected a split of {', '.join(SPLITS)}, but got {shot.split!r}")
    if pixels.shape[2:] == (4,) and not _is_png(shot.name):
        raise ValueError(f"{shot.name}: expected 3 channels, as a JPEG has no alpha, but got 4; name it .png")
    shapes = [(camera.height, camera.width, channels) for channels in (3, 4)]
    if pixels.dtype != np.uint8 or pixels.shape not in shapes or camera.skew:
        raise ValueError(
            f"{shot.name}: expected uint8 pixels of shape {shapes[0]} or {shapes[1]} and no skew, but got "
            f"{pixels.dtype} of {pixels.shape} and a skew of {camera.skew:g}"
        )


def _write_shot(folder: Path, shot: PosedShot) -> dict:
    """Write an image and make its entry."""
    camera = shot.camera
    entry = {"file_path": f"images/{shot.name}", "w": camera.width, "h": camera.height}
    entry |= {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "camera_model": "OPENCV",
    }
    if camera.lens is not None:
        entry |= dict(zip(("k1", "k2", "k3", "p1", "p2"), camera.lens.k + camera.lens.p))
    if shot.time is not None:
        entry["time"] = number(shot.time, f"{shot.name}: time", 0, 1)
    entry["transform_matrix"] = (pose_of(camera.camera_to_world.tolist(), shot.name) @ FLIP).tolist()
    write = write_png if _is_png(shot.name) else write_jpeg
    write(folder / entry["file_path"], np.asarray(shot.pixels))
    return entry


def _is_png(name: str) -> bool:
    return name.lower().endswith(".png")


def _check(scale: int, canonical: str, test_every: int, normalise: bool) -> None:
    """Refuse options that have no meaning."""
    if type(scale) is not int or scale not in SCALES:
        raise SceneError(f"data.scale: expected one of {SCALES}, but got {scale!r}")
    if canonical not in ("middle", "first"):
        raise SceneError(f"data.canonical: expected middle or first, but got {canonical!r}")
    whole(test_every, "data.test_every", 2)
    if not isinstance(normalise, bool):
        raise SceneError(f"data.normalise: expected true or false, but got {normalise!r}")


def _load(entry: ImageEntry) -> CachedImage | MaskedImage:
    size = (entry.camera.width, entry.camera.height)
    return (
        CachedImage(entry.image, size) if entry.mask is None else MaskedImage(entry.image, entry.mask, size)
    )


def _is_transparent(entry: ImageEntry) -> bool:
    """Tell whether any pixel is not opaque; decode the image only where its header says it has alpha."""
    return entry.has_alpha and bool((_load(entry)()[..., 3] < 255).any())


def _limits(
    file: Path, content: dict, near: float | None, far: float | None, box: Sequence[float] | None
) -> tuple[float | None, float | None, Box | None]:
    """Take near, far and box, in the file's units, from the config, else from the file, else None."""
    least = {"near": 0.0, "far": 1 / MOST_UNITS}
    found = []
    for key, value in (("near", near), ("far", far)):
        where = f"data.{key}" if value is not None else f"{file}: {key}"
        value = content.get(key) if value is None else value
        found.append(None if value is None else number(value, where, least[key], MOST_UNITS))
    if box is not None or content.get("aabb") is None:
        return *found, None if box is None else box_of(box)
    try:
        low, high = (tuple(number(v, "aabb", -MOST_UNITS, MOST_UNITS) for v in c) for c in content["aabb"])
        return *found, Box(low, high)
    except (TypeError, ValueError) as error:
        expected = "[[x0, y0, z0], [x1, y1, z1]], each low end below its high end"
        raise SceneError(f"{file}: aabb: expected {expected}, but got {short(content['aabb'])}") from error
