"""D-NeRF scenes (Blender style): one folder with ``transforms_<split>.json`` and RGBA images.

A pose on disk is camera-to-world with OpenGL's axes (x right, y up, looking along -z); reading and writing
negate its y and z columns. Beside the stock ``transforms_test.json`` a scene may bring one file per
ability (``transforms_test_space.json``, ``..._time.json``, ``..._canonical.json``), exact ray depth
(``depth_file_path``: float32 .npy, or 16-bit PNG times the file's ``depth_scale``, 0 = background) and
``trajectories.npz`` (``points`` (N, T, 3), ``times`` (T,)). ``test_space/transforms.json`` serves as well.

Lego Complete scenes have this layout with three kinds of test view, each with exact ray depth. Numbers are
comparable with 50 training times and test views at training times (``space``), at all times (``time``) and at
the canonical time (``canonical``).
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
from torch import Tensor

from forewarp.data.arrays import StoredDepth, read_truth, write_array, write_truth
from forewarp.data.cameras import MOST_UNITS, SPLITS, box_of, frustum_box, opengl_pose, opengl_rows
from forewarp.data.files import frames_of, mismatch, number, read_json, remove, scene_folder
from forewarp.data.images import StoredImage, by, check_pixels, common_header, write_image
from forewarp.files import write_json
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene, Truth

ABILITIES = ("space", "time", "canonical")
TRAINING_TIMES = 50  # of the published Lego Complete data, as are the counts of test views
TEST_VIEWS = {"space": 200, "time": 197, "canonical": 50}
_SAME_TIME = 1e-4  # times are stored with four digits or more; neighbours are 1/196 apart
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

    time: float
    pose: Tensor
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
    if not number(near, "data.near", 0, MOST_UNITS) < number(far, "data.far", 0, MOST_UNITS):
        raise mismatch("data.near, data.far", "near < far", f"{near} and {far}")
    folder = scene_folder(root, scene, "dnerf")
    records = {split: _read_split(folder, split) for split in SPLITS}
    header = common_header(record.image for split in records.values() for record in split)
    if half_resolution not in (True, False, "auto"):
        raise mismatch("data.half_resolution", "true, false or auto", repr(half_resolution))
    size = header.size
    halve = size[0] > _PUBLISHED_WIDTH if half_resolution == "auto" else bool(half_resolution)
    if halve and (size[0] % 2 or size[1] % 2):
        raise mismatch(folder, "even sides to halve", by(size), "set data.half_resolution=false")
    width, height = (n // 2 if halve else n for n in size)

    def frame(record: _Record) -> Frame:
        focal = 0.5 * width / math.tan(0.5 * record.angle)
        camera = Camera(width, height, focal, focal, width / 2, height / 2, record.pose, near, far)
        name = record.image.relative_to(folder).with_suffix("").as_posix()
        depth = StoredDepth(record.depth[0], size, halve, record.depth[1]) if record.depth else None
        return Frame(name, record.time, camera, StoredImage(record.image, size, halve), depth, record.ability)

    train, val, test = (tuple(map(frame, records[split])) for split in SPLITS)
    canonical = min(f.time for f in train)
    protocol = {
        "dataset": "dnerf",
        "resolution": [width, height],
        "half_resolution": halve,
        "test_frames": len(test),
    }
    bounds = frustum_box(f.camera for f in train) if box is None else box_of(box)
    truth = read_truth(folder / "trajectories.npz", canonical)
    return Scene(scene, train, val, test, bounds, canonical, header.has_alpha, truth, protocol)


def _read_split(folder: Path, split: str) -> list[_Record]:
    """Read the records of a split; ``val`` may be absent, ``test`` may be one file per ability."""
    stock = folder / f"transforms_{split}.json"
    files = {stock: "all"} if stock.is_file() else {}
    if split == "test":
        parts = {}
        for ability in ABILITIES:
            places = (
                folder / f"transforms_test_{ability}.json",
                folder / f"test_{ability}" / "transforms.json",
            )
            parts |= dict.fromkeys([path for path in places if path.is_file()][:1], ability)
        if files and parts:
            raise mismatch(stock, "it or one file per ability", "both", "remove one kind")
        files = files or parts
        if not files:
            raise mismatch(stock, "this file or transforms_test_<ability>.json", "neither")
    return [record for path, ability in files.items() for record in _read_records(path, ability)]


def _read_records(path: Path, ability: str) -> list[_Record]:
    content, records = read_json(path), []
    angle = number(content.get("camera_angle_x"), f"{path}: camera_angle_x", 0, math.pi)
    if angle in (0, math.pi):
        raise mismatch(f"{path}: camera_angle_x", "radians inside (0, pi)", angle)
    entries = frames_of(path, content, {"ability": ability, "depth_scale": content.get("depth_scale")})
    for i, entry in enumerate(entries):
        image, depth, ability = entry.path("file_path"), None, entry.get("ability")
        if image.suffix != ".png":
            image = image.with_name(image.name + ".png")
        if "depth_file_path" in entry.own:
            file, scale = entry.path("depth_file_path"), entry.get("depth_scale")
            if not os.path.isfile(file):
                raise mismatch(entry.where("depth_file_path"), "an existing file", file)
            depth = file, None if scale is None else entry.number("depth_scale", 1e-12, 1e6)
        if ability not in (*ABILITIES, "all"):
            raise mismatch(entry.where("ability"), f"one of {', '.join(ABILITIES)}", short(ability))
        time = entry.number("time", 0, 1, i / max(len(entries) - 1, 1))
        records.append(_Record(time, opengl_pose(entry), angle, image, depth, ability))
    return records


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

    Raises:
        ValueError: for another split, and for a shot that ``read_scene`` would refuse.
    """
    folder = Path(folder)
    if unknown := sorted(splits.keys() - set(SPLITS)):
        raise mismatch("splits", "train, val and test", unknown)
    remove(folder, "transforms_*.json", "test_*/transforms.json", "trajectories.npz")
    files: dict[str, dict[str, dict]] = {}  # transforms file -> image path -> entry
    shape = None
    for split, shots in splits.items():
        for shot in shots:
            shape = shape or (*shot.rgba.shape[:2], 4)
            part = split if shot.ability == "all" else f"{split}_{shot.ability}"
            path, entry = _write_shot(folder, part, shot, shape)
            if path in files.setdefault(part, {}):
                raise mismatch(path, "shots of different names", "this one twice")
            files[part][path] = entry
    write_truth(folder / "trajectories.npz", trajectories)
    for part, frames in files.items():
        content = {"camera_angle_x": float(camera_angle_x), "frames": list(frames.values())}
        write_json(folder / f"transforms_{part}.json", content)


def _write_shot(folder: Path, part: str, shot: Shot, shape: tuple[int, ...]) -> tuple[str, dict]:
    """Write one shot's image and depth; return its path and entry."""
    path = f"./{part}/{shot.name}"
    rgba = check_pixels(path, shot.rgba, shape)
    entry = {"file_path": path, "rotation": 0.0, "time": number(shot.time, f"{path}: time", 0, 1)}
    entry["transform_matrix"] = opengl_rows(shot.pose, f"{path}: pose")
    write_image(folder / f"{path}.png", rgba)
    if shot.depth is not None:
        write_array(folder / f"{path}_depth.npy", shot.depth)
        entry["depth_file_path"] = f"{path}_depth.npy"
    return path, entry


def read_lego_complete(root: str | Path, scene: str, **options) -> Scene:
    """Read the Lego Complete scene ``root/scene``; ``options`` as in ``read_scene``.

    A scene with other numbers of images or other times is read too; ``protocol["note"]`` says what differs.

    Raises:
        SceneError: as ``read_scene``, and for a test view without an ability.
    """
    name, scene = scene, read_scene(root, scene, **options)
    for frame in scene.test:
        if frame.ability == "all":
            expected = f"transforms_test_<ability>.json for {', '.join(ABILITIES)}"
            raise mismatch(Path(root) / name, expected, f"{frame.name} without an ability", "use data=dnerf")
    views = Counter(frame.ability for frame in scene.test)
    protocol = {
        **scene.protocol,
        "dataset": "lego_complete",
        "training_times": len(scene.times),
        "test_views": {ability: views[ability] for ability in ABILITIES},
        "depth": "along the ray, foreground pixels",
    }
    if differences := _differences(scene, views):
        protocol["note"] = f"not the published protocol: {'; '.join(differences)}"
    return replace(scene, protocol=protocol)


def _differences(scene: Scene, views: Mapping[str, int]) -> list[str]:
    """Say how a Lego Complete scene differs from the published protocol."""
    differences, times = [], len(scene.times)
    if times != TRAINING_TIMES:
        differences.append(f"{times} training times instead of {TRAINING_TIMES}")
    if len(scene.train) != times:
        differences.append(f"{len(scene.train)} training images at {times} times")
    for ability, expected in TEST_VIEWS.items():
        if views[ability] != expected:
            differences.append(f"{views[ability]} {ability} views instead of {expected}")
    for ability, place in (("space", "a training time"), ("canonical", "the canonical time")):
        times = scene.times if ability == "space" else (scene.canonical_time,)
        views = [frame.time for frame in scene.test if frame.ability == ability]
        if away := sum(min(abs(view - time) for time in times) > _SAME_TIME for view in views):
            differences.append(f"{away} {ability} views not at {place}")
    if bare := sum(frame.load_depth is None for frame in scene.test):
        differences.append(f"{bare} of {len(scene.test)} test views without a depth")
    return differences
