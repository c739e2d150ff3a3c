"""HyperNeRF and Nerfies captures: one or more phones around a scene that moves, images without alpha.

``dataset.json`` names the items and the split, ``metadata.json`` each item's time, ``scene.json`` the world's
``center`` and ``scale``, ``camera/<id>.json`` the camera, ``rgb/<s>x/<id>.png`` the image, s times smaller.
The optional ``points.npy`` (N, 3) holds points that never move, the optional ``trajectories.npz`` true
trajectories (see ``data.arrays``). Scene coordinates are ``(X - center) * scale`` of those in the files.

A camera file's ``orientation`` is world-to-camera with OpenCV's axes, ``position`` the camera's centre in the
unscaled world; all else is in pixels of the full-size image. Old files say ``tangential`` for
``tangential_distortion``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch
from torch import Tensor

from forewarp.data.arrays import read_cloud, read_truth, write_array, write_truth
from forewarp.data.cameras import MOST_UNITS, box_of, check_lens, frustum_box, pose_of
from forewarp.data.files import (
    MARKERS,
    MOST_FRAMES,
    SceneError,
    inside,
    number,
    numbers,
    read_json,
    scene_folder,
    whole,
)
from forewarp.data.images import CachedImage, inspect_image, write_png
from forewarp.files import write_json
from forewarp.scene.camera import Camera, Lens
from forewarp.scene.frame import Frame, Scene, Truth, middle_of

_SCALES, _ASPECTS = (1e-6, 1e6), (1e-2, 1e2)
_MOST_PIXELS, _MOST_PIXELS_OFF, _MOST_BENT = 1e5, 1e7, 1e3  # beyond them a camera file is wrong
_MOST_MOMENTS = 1e9
_EVERY = 4  # the published interpolation protocol: train on every fourth, test midway between


@dataclass(frozen=True)
class RigShot:
    """An item to write: ``camera`` of the full-size image in the unscaled world, ``rgb`` uint8 (H, W, 3),
    ``split`` train, val or "" for neither. Items of one ``time_id`` were taken at the same moment.
    """

    name: str
    time_id: int
    camera_id: int
    split: str
    camera: Camera
    rgb: Tensor | np.ndarray


@dataclass(frozen=True)
class _World:
    """What ``scene.json`` says; ``near`` and ``far`` are in normalised units."""

    center: Tensor
    scale: float
    near: float
    far: float

    def normalised(self, points: Tensor) -> Tensor:
        """Normalise points (..., 3) of the unscaled world, float64."""
        return (points.double() - self.center) * self.scale

    def camera(self, path: Path) -> Camera:
        """Read a camera file in normalised units."""
        camera = read_camera(path, self.near, self.far)
        pose = camera.camera_to_world.clone()
        pose[:3, 3] = self.normalised(pose[:3, 3])
        return replace(camera, camera_to_world=pose)


def read_scene(root: str | Path, scene: str, *, scale: int = 2, box: Sequence[float] | None = None) -> Scene:
    """Read ``root/scene``; pixels are decoded when a frame is first loaded.

    With ``val_ids`` these are tested and ``train_ids`` trained on (split "vrig"). Without, every fourth item
    from the first is trained on and those midway between are tested (split "interpolation"). The canonical
    time is the training time nearest to the middle of them.

    Args:
        scale: which of the stored sizes, sides ``scale`` times smaller than the full-size image.
        box: x0 y0 z0 x1 y1 z1 in normalised units; None takes the bounds of all training rays.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and key.
    """
    folder = scene_folder(root, scene, MARKERS["hypernerf"])
    images, world = _image_folder(folder, scale), _read_world(folder / "scene.json")
    how, ids, train_ids, test_ids = _read_split(folder / "dataset.json")
    times, camera_ids = _read_items(folder / "metadata.json", ids)

    def frame(item: str) -> Frame:
        where = f"{folder / 'dataset.json'}: ids"
        path = inside(images, f"{item}.png", where)
        camera = reduced(world.camera(inside(folder / "camera", f"{item}.json", where)), scale)
        size = camera.width, camera.height
        if (found := inspect_image(path).size) != size:
            raise SceneError(
                f"{path}: expected {size[0]} x {size[1]} pixels, the camera's image_size / {scale}, but got "
                f"{found[0]} x {found[1]}"
            )
        return Frame(item, times[item], camera, CachedImage(path, size), camera_id=camera_ids[item])

    train, test = (tuple(map(frame, items)) for items in (train_ids, test_ids))
    canonical = middle_of(f.time for f in train)
    protocol = {
        "dataset": "hypernerf",
        "scale": scale,
        "split": how,
        "resolution": [train[0].camera.width, train[0].camera.height],
        "train_frames": len(train),
        "test_frames": len(test),
    }
    bounds = frustum_box(f.camera for f in train) if box is None else box_of(box)
    truth = read_truth(folder / "trajectories.npz", canonical)
    if truth is not None:
        truth = replace(truth, points=world.normalised(truth.points).float())
    cloud = folder / "points.npy"
    still = world.normalised(torch.from_numpy(read_cloud(cloud, 3))).float() if cloud.exists() else None
    return Scene(scene, train, (), test, bounds, canonical, False, truth, protocol, still)


def write_scene(
    folder: str | Path,
    shots: Iterable[RigShot],
    *,
    center: Sequence[float],
    scale: float,
    near: float,
    far: float,
    points: np.ndarray | Tensor | None = None,
    scales: Sequence[int] = (1, 2),
    trajectories: Truth | None = None,
) -> None:
    """Write a capture that ``read_scene`` reads; each file appears whole or not at all.

    A capture already in ``folder`` is replaced: ``dataset.json`` is removed first and written last, so that
    an interrupted call leaves nothing that could be read by mistake.

    Args:
        shots: consumed one by one, in the order of ``ids``. Where none is val the reader takes every fourth.
        center, scale: the normalised world is ``(X - center) * scale``.
        near, far: along the unit ray, normalised units.
        points: (N, 3) that never move, unscaled world.
        scales: scales of the images to write; every side is a multiple of all of them.
        trajectories: unscaled world, the canonical time first.
    """
    folder = Path(folder)
    _remove(folder)
    metadata: dict[str, dict[str, int]] = {}
    parts: dict[str, list[str]] = {"train": [], "val": [], "": []}
    for shot in shots:
        if shot.name in metadata or shot.split not in parts:
            got = f"{shot.name!r} of split {shot.split!r}"
            raise ValueError(f"shots: expected different names, each of train, val or '', but got {got}")
        _write_shot(folder, shot, scales)
        parts[shot.split].append(shot.name)
        times = dict.fromkeys(("time_id", "warp_id", "appearance_id"), int(shot.time_id))
        metadata[shot.name] = times | {"camera_id": shot.camera_id}
    if points is not None:
        write_array(folder / "points.npy", points)
    if trajectories is not None:
        write_truth(folder / "trajectories.npz", trajectories)
    world = {"scale": float(scale), "center": [float(v) for v in center]}
    world |= {"near": float(near), "far": float(far)}
    dataset = {"count": len(metadata), "num_exemplars": len(parts["train"]), "ids": list(metadata)}
    dataset |= {"train_ids": parts["train"], "val_ids": parts["val"]}
    for name, content in (("scene", world), ("metadata", metadata), ("dataset", dataset)):
        write_json(folder / f"{name}.json", content)


def read_camera(path: Path, near: float, far: float) -> Camera:
    """Read a camera in the file's units: the unscaled world and the full-size image.

    Raises:
        SceneError: for a key that is missing or has a wrong number of values, for no rotation, and for a lens
            that cannot be undone.
    """
    content = read_json(path)
    width, height = numbers(content, "image_size", 2, path, 1, _MOST_PIXELS)
    if width % 1 or height % 1:
        raise SceneError(f"{path}: image_size: expected whole numbers, but got {width:g} x {height:g}")
    focal = number(content.get("focal_length"), f"{path}: focal_length", 1e-3, _MOST_PIXELS_OFF)
    aspect = number(content.get("pixel_aspect_ratio", 1.0), f"{path}: pixel_aspect_ratio", *_ASPECTS)
    skew = number(content.get("skew", 0.0), f"{path}: skew", -_MOST_PIXELS_OFF, _MOST_PIXELS_OFF)
    cx, cy = numbers(content, "principal_point", 2, path, -_MOST_PIXELS_OFF, _MOST_PIXELS_OFF)
    pose = torch.from_numpy(_pose(content, path))
    size = int(width), int(height)
    camera = Camera(*size, focal, focal * aspect, cx, cy, pose, near, far, skew, _lens(content, path))
    check_lens(camera, f"{path}: radial_distortion")
    return camera


def write_camera(path: Path, camera: Camera) -> None:
    """Write a camera for ``read_camera``, every digit of it but near and far, whole or not at all."""
    lens = camera.lens or Lens()
    content = {
        "orientation": camera.camera_to_world[:3, :3].double().T.tolist(),
        "position": camera.center.double().tolist(),
        "focal_length": float(camera.fx),
        "principal_point": [float(camera.cx), float(camera.cy)],
        "skew": float(camera.skew),
        "pixel_aspect_ratio": float(camera.fy / camera.fx),
        "radial_distortion": list(lens.k),
        "tangential_distortion": list(lens.p),
        "image_size": [camera.width, camera.height],
    }
    write_json(path, content)


def reduced(camera: Camera, scale: int) -> Camera:
    """Scale a camera to an image whose sides are ``scale`` times smaller; sizes are rounded, all else exact.

    The skew shrinks too. Public loaders leave it as it is, which slants the picture wherever it is not 0.
    """
    size = {"width": round(camera.width / scale), "height": round(camera.height / scale)}
    pixels = {key: getattr(camera, key) / scale for key in ("fx", "fy", "cx", "cy", "skew")}
    return replace(camera, **size, **pixels)


def _image_folder(folder: Path, scale: int) -> Path:
    images = folder / "rgb" / f"{whole(scale, 'data.scale', 1)}x"
    if not images.is_dir():
        there = sorted((p.name for p in folder.glob("rgb/*x") if p.is_dir()), key=lambda n: (len(n), n))
        raise SceneError(
            f"{images}: expected a folder of images, but got none; set data.scale to one of those there: "
            f"{', '.join(there) or 'none'}"
        )
    return images


def _read_world(path: Path) -> _World:
    content = read_json(path)
    center = numbers(content, "center", 3, path, -MOST_UNITS, MOST_UNITS)
    scale = number(content.get("scale"), f"{path}: scale", *_SCALES)
    near, far = (number(content.get(key), f"{path}: {key}", 0, MOST_UNITS) for key in ("near", "far"))
    if near >= far:
        raise SceneError(f"{path}: near, far: expected near < far, but got {near:g} and {far:g}")
    return _World(torch.tensor(center, dtype=torch.float64), scale, near, far)


def _read_split(path: Path) -> tuple[str, list[str], list[str], list[str]]:
    """Read how a ``dataset.json`` is split: vrig or interpolation, all items, those to train and to test on.

    Raises:
        SceneError: for lists that are none, name an item twice, an unknown one or one in both parts.
    """
    content = read_json(path)
    lists = {key: content.get(key, []) for key in ("ids", "train_ids", "val_ids")}
    for key, ids in lists.items():
        if not isinstance(ids, list) or not all(isinstance(i, str) for i in ids) or len({*ids}) < len(ids):
            raise SceneError(f"{path}: {key}: expected a list of different names, but got {short(ids)}")
    ids, train, val = lists.values()
    if len(ids) > MOST_FRAMES:
        raise SceneError(f"{path}: ids: expected at most {MOST_FRAMES} items, but got {len(ids)}")
    for key in ("train_ids", "val_ids"):
        if unknown := [i for i in lists[key] if i not in {*ids}]:
            raise SceneError(
                f"{path}: {key}: expected items of ids, but got {short(unknown[0])}; list it in ids"
            )
    if both := {*train} & {*val}:
        raise SceneError(f"{path}: val_ids: expected none of train_ids, but got {short(min(both))}")
    if val and not train:
        raise SceneError(f"{path}: train_ids: expected at least one beside val_ids, but got none")
    if val:
        return "vrig", ids, train, val
    if len(ids) <= _EVERY:
        raise SceneError(
            f"{path}: ids: expected more than {_EVERY} items to test between where val_ids is empty, but got "
            f"{len(ids)}"
        )
    chosen = range(0, len(ids), _EVERY)
    test = [ids[i + _EVERY // 2] for i in chosen[:-1]]
    return "interpolation", ids, [ids[i] for i in chosen], test


def _read_items(path: Path, ids: list[str]) -> tuple[dict[str, float], dict[str, int | None]]:
    """Read the time in [0, 1] of each item of a ``metadata.json`` and its camera's number, where it has one.

    The time is ``time_id``, or where none of ``ids`` has one ``warp_id``, over the greatest of them. Entries
    of other items are not looked at.

    Raises:
        SceneError: for an item that is missing or has no time, and for a number that is not whole.
    """
    content, numbered, cameras = read_json(path), {}, {}
    entries = [content.get(item) for item in ids]
    key = "time_id" if any(isinstance(e, dict) and "time_id" in e for e in entries) else "warp_id"

    def count(value: object, where: str) -> int:
        if number(value, where, 0, _MOST_MOMENTS) % 1:
            raise SceneError(f"{where}: expected a whole number, but got {value:g}")
        return int(value)

    for item, entry in zip(ids, entries):
        where = f"{path}: {item!r}"
        if not isinstance(entry, dict):
            raise SceneError(f"{where}: expected an object for this item, but got {short(entry)}")
        numbered[item] = count(entry.get(key), f"{where}.{key}")
        camera = entry.get("camera_id")
        cameras[item] = None if camera is None else count(camera, f"{where}.camera_id")
    last = max(numbered.values()) or 1
    return {item: value / last for item, value in numbered.items()}, cameras


def _pose(content: dict, path: Path) -> np.ndarray:
    """Camera-to-world (4, 4) float64."""
    rows = content.get("orientation")
    fits = isinstance(rows, list) and [len(r) if isinstance(r, list) else 0 for r in rows] == [3, 3, 3]
    if not fits:
        raise SceneError(f"{path}: orientation: expected 3 x 3 numbers, but got {short(rows)}")
    where = f"{path}: orientation"
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[number(v, where) for v in row] for row in rows]).T
    matrix[:3, 3] = numbers(content, "position", 3, path)
    return pose_of(matrix, where)


def _lens(content: dict, path: Path) -> Lens | None:
    """Read the lens; return None if it does not distort."""
    name = "tangential" if "tangential" in content else "tangential_distortion"
    bent = {"radial_distortion": [0.0] * 3, name: [0.0] * 2} | content
    radial = numbers(bent, "radial_distortion", 3, path, -_MOST_BENT, _MOST_BENT)
    tangential = numbers(bent, name, 2, path, -_MOST_BENT, _MOST_BENT)
    return Lens(tuple(radial), tuple(tangential)) if any(radial + tangential) else None


def _write_shot(folder: Path, shot: RigShot, scales: Sequence[int]) -> None:
    rgb, size = np.asarray(shot.rgb), (shot.camera.height, shot.camera.width)
    if rgb.shape != (*size, 3) or rgb.dtype != np.uint8 or any(n % s for n in size for s in scales):
        expected = f"uint8 {(*size, 3)} with sides that are multiples of {tuple(scales)}"
        raise ValueError(f"{shot.name}: expected {expected}, but got {rgb.dtype} {rgb.shape}")
    for s in scales:
        means = rgb.reshape(size[0] // s, s, size[1] // s, s, 3).mean((1, 3))
        write_png(folder / "rgb" / f"{s}x" / f"{shot.name}.png", np.rint(means).astype(np.uint8))
    write_camera(folder / "camera" / f"{shot.name}.json", shot.camera)


def _remove(folder: Path) -> None:
    """Remove the capture that is there, the list of its items first; other files stay."""
    for name in ("dataset.json", "metadata.json", "scene.json", "points.npy", "trajectories.npz"):
        (folder / name).unlink(missing_ok=True)
    for pattern in ("camera/*.json", "rgb/*x/*.png"):
        for stale in folder.glob(pattern):
            stale.unlink()
