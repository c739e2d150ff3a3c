"""D-NeRF scenes (Blender style): one folder with ``transforms_<split>.json`` and RGBA images.

A pose on disk is camera-to-world with OpenGL's axes (x right, y up, looking along -z); reading and writing
negate its y and z columns. Beside the stock ``transforms_test.json`` a scene may bring one file per
ability (``transforms_test_space.json``, ``..._time.json``, ``..._canonical.json``), exact ray depth
(``depth_file_path``: float32 .npy, or 16-bit PNG times the file's ``depth_scale``, 0 = background) and
``trajectories.npz`` (``points`` (N, T, 3), ``times`` (T,)). ``test_space/transforms.json`` serves as well.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch
from torch import Tensor

from forewarp.data.arrays import StoredDepth, read_truth, write_array, write_truth
from forewarp.data.cameras import FLIP, box_of, check_range, frustum_box, pose_of
from forewarp.data.files import MARKERS, SceneError, frames_of, inside, number, read_json, scene_folder
from forewarp.data.images import CachedImage, common_header, write_png
from forewarp.files import write_json
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene, Truth

ABILITIES = ("space", "time", "canonical")
_PUBLISHED_WIDTH = 400


@dataclass(frozen=True)
class Shot:
    """An image to write: ``pose`` (4, 4) camera-to-world with OpenCV's axes, ``rgba`` uint8 (H, W, 4)
    straight alpha, ``depth`` (H, W) ray depth in world units (0 = background), ``time`` in [0, 1].
    """

    name: str
    time: float
    pose: Tensor | np.ndarray
    rgba: Tensor | np.ndarray
    depth: Tensor | np.ndarray | None = None
    ability: str = "all"


@dataclass(frozen=True)
class _Record:
    """A checked entry of a transforms file; the pose has OpenCV's axes, ``angle`` is the field of view."""

    name: str
    time: float
    pose: np.ndarray
    angle: float
    image: Path
    depth: tuple[Path, float | None] | None  # file and world units a step, where it says so
    ability: str


def read_scene(
    root: str | Path,
    scene: str,
    *,
    half_resolution: bool | str = "auto",
    box: Sequence[float] | None = None,
    near: float = 2.0,
    far: float = 6.0,
) -> Scene:
    """Read ``root/scene``; pixels are decoded when a frame is first loaded.

    Args:
        half_resolution: average 2 x 2 pixels; "auto" does so where images are wider than 400, as published.
        box: x0 y0 z0 x1 y1 z1 in world units; None takes the bounds of all training rays from near to far.
        near, far: along the unit ray, world units.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and key.
    """
    check_range(near, far)
    folder = scene_folder(root, scene, MARKERS["dnerf"])
    records = {split: _read_split(folder, split) for split in ("train", "val", "test")}
    header = common_header(r.image for split in records.values() for r in split)
    size, halve = header.size, _is_halved(header.size, half_resolution, folder)
    train, val, test = (
        tuple(_frame(r, size, halve, near, far) for r in records[split]) for split in ("train", "val", "test")
    )
    camera, canonical = train[0].camera, min(f.time for f in train)
    protocol = {
        "dataset": "dnerf",
        "resolution": [camera.width, camera.height],
        "half_resolution": halve,
        "test_frames": len(test),
    }
    bounds = frustum_box(f.camera for f in train) if box is None else box_of(box)
    truth = read_truth(folder / "trajectories.npz", canonical)
    return Scene(scene, train, val, test, bounds, canonical, header.has_alpha, truth, protocol)


def write_scene(
    folder: str | Path,
    splits: Mapping[str, Iterable[Shot]],
    *,
    camera_angle_x: float,
    trajectories: Truth | None = None,
) -> None:
    """Write a scene that ``read_scene`` reads; each file appears whole or not at all.

    A scene already in ``folder`` is replaced: its transforms are removed first and written last, so that an
    interrupted call leaves nothing that could be read by mistake.

    Args:
        splits: ``train``, ``test`` and perhaps ``val``, any iterables of shots, consumed one by one. Test
            shots go to one transforms file per ability, or to the stock file where it is "all".
        camera_angle_x: horizontal field of view, radians.
        trajectories: exact point trajectories, the canonical time first.
    """
    folder = Path(folder)
    if unknown := set(splits) - {"train", "val", "test"}:
        raise ValueError(f"splits: expected train, val and test, but got {sorted(unknown)}")
    for pattern in ("transforms_*.json", "test_*/transforms.json", "trajectories.npz"):
        for stale in folder.glob(pattern):
            stale.unlink()
    files: dict[str, dict[str, dict]] = {}  # transforms file -> image path -> entry
    size = None
    for split, shots in splits.items():
        for shot in shots:
            size = size or tuple(shot.rgba.shape)
            _write_shot(folder, split, shot, files, size)
    if trajectories is not None:
        write_truth(folder / "trajectories.npz", trajectories)
    for part, frames in files.items():
        content = {"camera_angle_x": float(camera_angle_x), "frames": list(frames.values())}
        write_json(folder / f"transforms_{part}.json", content)


def _read_split(folder: Path, split: str) -> list[_Record]:
    """Read the records of a split; ``val`` may be absent, ``test`` may be one file per ability."""
    stock = folder / f"transforms_{split}.json"
    files = {stock: "all"} if stock.is_file() else {}
    if split == "test":
        parts = {path: ability for ability in ABILITIES for path in _ability_files(folder, ability)}
        if files and parts:
            raise SceneError(f"{stock}: expected it or one file per ability, but got both; remove one kind")
        files = files or parts
        if not files:
            raise SceneError(
                f"{stock}: expected this file or transforms_test_<ability>.json, but got neither"
            )
    return [record for path, ability in files.items() for record in _read_records(folder, path, ability)]


def _ability_files(folder: Path, ability: str) -> list[Path]:
    """Find the transforms file of an ability, beside the others or in its folder, if there is one."""
    places = folder / f"transforms_test_{ability}.json", folder / f"test_{ability}" / "transforms.json"
    return [path for path in places if path.is_file()][:1]


def _read_records(folder: Path, path: Path, ability: str) -> list[_Record]:
    content = read_json(path)
    angle = number(content.get("camera_angle_x"), f"{path}: camera_angle_x", 0, math.pi)
    if angle in (0, math.pi):
        raise SceneError(f"{path}: camera_angle_x: expected radians inside (0, pi), but got {angle}")
    frames = frames_of(content, path)
    records, common = [], {"ability": ability, "depth_scale": content.get("depth_scale")}
    for i, entry in enumerate(frames):
        where = f"{path}: frames[{i}]"
        if not isinstance(entry, dict):
            raise SceneError(f"{where}: expected an object, but got {short(entry)}")
        default = i / max(len(frames) - 1, 1)
        records.append(_record(folder, path.parent, {"time": default, **common, **entry}, angle, where))
    return records


def _record(folder: Path, base: Path, entry: dict, angle: float, where: str) -> _Record:
    image = inside(base, entry.get("file_path"), f"{where}.file_path")
    if image.suffix != ".png":
        image = image.with_name(image.name + ".png")
    depth = None
    if "depth_file_path" in entry:
        file, scale = inside(base, entry["depth_file_path"], f"{where}.depth_file_path"), entry["depth_scale"]
        if not os.path.isfile(file):
            raise SceneError(f"{where}.depth_file_path: expected an existing file, but got {file}")
        depth = file, None if scale is None else number(scale, f"{where}.depth_scale", 1e-12, 1e6)
    if entry["ability"] not in (*ABILITIES, "all"):
        expected = ", ".join(ABILITIES)
        raise SceneError(f"{where}.ability: expected one of {expected}, but got {short(entry['ability'])}")
    return _Record(
        name=image.relative_to(folder).with_suffix("").as_posix(),
        time=number(entry["time"], f"{where}.time", 0, 1),
        pose=pose_of(entry.get("transform_matrix"), f"{where}.transform_matrix") @ FLIP,
        angle=angle,
        image=image,
        depth=depth,
        ability=entry["ability"],
    )


def _is_halved(size: tuple[int, int], half_resolution: bool | str, folder: Path) -> bool:
    if half_resolution not in (True, False, "auto"):
        raise SceneError(f"data.half_resolution: expected true, false or auto, but got {half_resolution!r}")
    halve = size[0] > _PUBLISHED_WIDTH if half_resolution == "auto" else bool(half_resolution)
    if halve and (size[0] % 2 or size[1] % 2):
        got = f"{size[0]} x {size[1]}"
        raise SceneError(
            f"{folder}: expected even sides to halve, but got {got}; set data.half_resolution=false"
        )
    return halve


def _frame(record: _Record, size: tuple[int, int], halve: bool, near: float, far: float) -> Frame:
    w, h = (n // 2 if halve else n for n in size)
    focal = 0.5 * w / math.tan(0.5 * record.angle)
    camera = Camera(w, h, focal, focal, w / 2, h / 2, torch.from_numpy(record.pose), near, far)
    depth = StoredDepth(record.depth[0], size, halve, record.depth[1]) if record.depth else None
    return Frame(
        record.name, record.time, camera, CachedImage(record.image, size, halve), depth, record.ability
    )


def _write_shot(folder: Path, split: str, shot: Shot, files: dict, size: tuple[int, ...]) -> None:
    """Write one shot's image and depth and note its entry in ``files``."""
    part = split if shot.ability == "all" else f"{split}_{shot.ability}"
    path = f"./{part}/{shot.name}"
    if shot.ability not in ((*ABILITIES, "all") if split == "test" else ("all",)):
        raise ValueError(
            f"{path}: expected {', '.join(ABILITIES)} or all, in test only, but got {shot.ability!r}"
        )
    stock = {p == "test" for p in files if p.startswith("test")}
    if split == "test" and stock and (part == "test") not in stock:
        raise ValueError(f"{path}: expected all test shots or none to have an ability, but got both kinds")
    if path in files.setdefault(part, {}):
        raise ValueError(f"{path}: expected shots of different names, but got this one twice")
    if tuple(shot.rgba.shape) != size or len(size) != 3 or size[-1] != 4:
        raise ValueError(f"{path}: expected rgba {size[:2]} + (4,), but got {tuple(shot.rgba.shape)}")
    if np.asarray(shot.rgba).dtype != np.uint8:
        raise ValueError(f"{path}: expected uint8 pixels, but got {shot.rgba.dtype}")
    pose = pose_of(np.asarray(shot.pose, np.float64), f"{path}: pose") @ FLIP
    entry = {"file_path": path, "rotation": 0.0, "time": number(shot.time, f"{path}: time", 0, 1)}
    entry["transform_matrix"] = pose.tolist()
    write_png(folder / f"{path}.png", shot.rgba)
    if shot.depth is not None:
        write_array(folder / f"{path}_depth.npy", shot.depth)
        entry["depth_file_path"] = f"{path}_depth.npy"
    files[part][path] = entry


TRAINING_TIMES = 50
TEST_VIEWS = {"space": 200, "time": 197, "canonical": 50}
_SAME_TIME = 1e-4  # times are stored with four digits or more; neighbours are 1/196 apart


def read_lego_complete(root: str | Path, scene: str, **options) -> Scene:
    """Read the Lego Complete scene ``root/scene``; ``options`` as in ``read_scene``.

    A scene with other numbers of images or other times is read too; ``protocol["note"]`` says what differs.

    Raises:
        SceneError: as ``read_scene``, and for a test view without an ability.
    """
    found = read_scene(root, scene, **options)
    for frame in found.test:
        if frame.ability == "all":
            raise SceneError(
                f"{Path(root) / scene}: expected transforms_test_<ability>.json for {', '.join(ABILITIES)}, "
                f"but got {frame.name} without an ability; use data=dnerf"
            )
    counts = Counter(frame.ability for frame in found.test)
    protocol = {
        **found.protocol,
        "dataset": "lego_complete",
        "training_times": len(found.times),
        "test_views": {ability: counts[ability] for ability in ABILITIES},
        "depth": "along the ray, foreground pixels",
    }
    if differences := _differences(found, protocol):
        protocol["note"] = f"not the published protocol: {'; '.join(differences)}"
    return replace(found, protocol=protocol)


def _differences(scene: Scene, protocol: dict) -> list[str]:
    """Say how a scene differs from the published protocol."""
    said = []
    if protocol["training_times"] != TRAINING_TIMES:
        said.append(f"{protocol['training_times']} training times instead of {TRAINING_TIMES}")
    if len(scene.train) != protocol["training_times"]:
        said.append(f"{len(scene.train)} training images at {protocol['training_times']} times")
    for ability, expected in TEST_VIEWS.items():
        if (count := protocol["test_views"][ability]) != expected:
            said.append(f"{count} {ability} views instead of {expected}")
    for ability, allowed in (("space", scene.times), ("canonical", (scene.canonical_time,))):
        views = [frame for frame in scene.test if frame.ability == ability]
        if away := sum(min(abs(frame.time - time) for time in allowed) > _SAME_TIME for frame in views):
            place = "a training time" if ability == "space" else "the canonical time"
            said.append(f"{away} {ability} views not at {place}")
    if bare := sum(frame.load_depth is None for frame in scene.test):
        said.append(f"{bare} of {len(scene.test)} test views without a depth")
    return said
