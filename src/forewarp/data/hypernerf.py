"""HyperNeRF and Nerfies captures: one or more phones around a scene that moves, images without alpha.

``dataset.json`` names the items and the split, ``metadata.json`` each item's time, ``scene.json`` the world's
``center`` and ``scale``, ``camera/<id>.json`` the camera, ``rgb/<s>x/<id>.png`` the image, s times smaller.
``points.npy`` (N, 3), where there is one, holds points that never move, and ``trajectories.npz`` what
``data.truth`` reads. A scene's world units are normalised, ``(X - center) * scale``; the files' are not.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.data.clouds import read_cloud, write_cloud
from forewarp.data.files import MARKERS, inside, number, read_json, scene_folder, whole
from forewarp.data.images import CachedImage, inspect_png, write_png
from forewarp.data.nerfies_camera import numbers, read_camera, reduced, write_camera
from forewarp.data.nerfies_items import read_camera_ids, read_split, read_times
from forewarp.data.truth import read_truth, write_truth
from forewarp.data.views import MOST_UNITS, box_of, frustum_box, middle_of
from forewarp.files import replace_file
from forewarp.scene.camera import Camera
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Frame, Scene, Truth

_SCALES = 1e-6, 1e6


@dataclass(frozen=True)
class RigShot:
    """One item to write: ``camera`` of the full-size image in the unscaled world, ``rgb`` uint8 (H, W, 3),
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
        """Unscaled world (..., 3) to normalised, float64."""
        return (points.double() - self.center) * self.scale

    def camera(self, path: Path) -> Camera:
        """The camera of a file in normalised units."""
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
    split = read_split(folder / "dataset.json")
    times = read_times(folder / "metadata.json", split.ids)
    camera_ids = read_camera_ids(folder / "metadata.json", split.ids)

    def frame(item: str) -> Frame:
        where = f"{folder / 'dataset.json'}: ids"
        path = inside(images, f"{item}.png", where)
        camera = reduced(world.camera(inside(folder / "camera", f"{item}.json", where)), scale)
        size = camera.width, camera.height
        if (found := inspect_png(path).size) != size:
            raise SceneError(
                f"{path}: expected {size[0]} x {size[1]} pixels, the camera's image_size / {scale}, but got "
                f"{found[0]} x {found[1]}"
            )
        return Frame(item, times[item], camera, CachedImage(path, size), camera_id=camera_ids[item])

    train, test = (tuple(map(frame, items)) for items in (split.train, split.test))
    canonical = middle_of(f.time for f in train)
    protocol = {
        "dataset": "hypernerf",
        "scale": scale,
        "split": split.name,
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
    write_time_id: bool = True,
) -> None:
    """Write a capture that ``read_scene`` reads; each file appears whole or not at all.

    A capture already in ``folder`` is replaced: ``dataset.json`` goes first and the new one comes last, so
    that a run cut short leaves nothing that reads well and is wrong.

    Args:
        shots: consumed one by one, in the order of ``ids``. Where none is val the reader takes every fourth.
        center, scale: the normalised world is ``(X - center) * scale``.
        near, far: along the unit ray, normalised units.
        points: (N, 3) that never move, unscaled world.
        scales: of the images to write; every side is a multiple of all of them.
        trajectories: unscaled world, the canonical time first.
        write_time_id: also the key ``time_id`` beside ``warp_id``.
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
        entry = dict.fromkeys(("warp_id", "appearance_id"), int(shot.time_id)) | {"camera_id": shot.camera_id}
        metadata[shot.name] = entry | ({"time_id": int(shot.time_id)} if write_time_id else {})
    if points is not None:
        write_cloud(folder / "points.npy", np.asarray(points))
    if trajectories is not None:
        write_truth(folder / "trajectories.npz", trajectories)
    world = {"scale": float(scale), "center": [float(v) for v in center]}
    world |= {"near": float(near), "far": float(far)}
    dataset = {"count": len(metadata), "num_exemplars": len(parts["train"]), "ids": list(metadata)}
    dataset |= {"train_ids": parts["train"], "val_ids": parts["val"]}
    for name, content in (("scene", world), ("metadata", metadata), ("dataset", dataset)):
        replace_file(folder / f"{name}.json", json.dumps(content, indent=1).encode())


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
    """Take away the capture that is there, the list of its items first; files that are none of its stay."""
    for name in ("dataset.json", "metadata.json", "scene.json", "points.npy", "trajectories.npz"):
        (folder / name).unlink(missing_ok=True)
    for pattern in ("camera/*.json", "rgb/*x/*.png"):
        for stale in folder.glob(pattern):
            stale.unlink()
