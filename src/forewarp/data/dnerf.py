"""D-NeRF scenes (Blender style): one folder with ``transforms_<split>.json`` and RGBA images.

A pose on disk is camera-to-world with OpenGL's axes (x right, y up, looking along -z); reading and writing
negate its y and z columns. Beside the stock ``transforms_test.json`` a scene may bring one file per
ability (``transforms_test_space.json``, ``..._time.json``, ``..._canonical.json``), exact ray depth
(``depth_file_path``: .npy, or 16-bit PNG, times the file's ``depth_scale``, 0 = background) and
``trajectories.npz`` (``points`` (N, T, 3), ``times`` (T,)). ``test_space/transforms.json`` serves as well.
A frame's ``mask_path`` cuts its image out.

Lego Complete scenes have this layout with three kinds of test view, each with exact ray depth. Numbers are
comparable with 50 training times and test views at training times (``space``), at all times (``time``) and at
the canonical time (``canonical``).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from torch import Tensor

from forewarp.data.arrays import read_truth, write_array, write_truth
from forewarp.data.cameras import (
    SPLITS,
    Normalisation,
    box_of,
    frustum_box,
    number_or_none,
    opengl_rows,
    space_of,
)
from forewarp.data.depth import METRIC, SensedDepth, StoredDepth, doubt_depths
from forewarp.data.directions import check_directions, common_point
from forewarp.data.files import (
    RECORD,
    mismatch,
    nearly,
    number,
    one_of,
    read_json,
    remove,
    scene_folder,
    whole,
)
from forewarp.data.images import (
    StoredImage,
    alpha_of,
    by,
    check_pixels,
    inspect_image,
    mixed_linear,
    write_image,
    wrong_size,
)
from forewarp.data.transforms import (
    ListedImage,
    check_times,
    hold_out_every,
    image_of,
    read_frames,
    times_of,
    unread_beside,
)
from forewarp.files import write_json
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene, Truth

ABILITIES = ("space", "time", "canonical")
TRAINING_TIMES = 50  # of the published Lego Complete data, as are the counts of test views
TEST_VIEWS = {"space": 200, "time": 197, "canonical": 50}
_SAME_TIME = 1e-4  # times are stored with four digits or more; neighbours are 1/196 apart
_PUBLISHED_WIDTH = 400
# The published scenes: cameras 4.03 from the origin, and what is taken for them by all who report numbers.
_RADIUS, _LEAST_DISTANCE, _MOST_DISTANCE = 4.0, 3.5, 4.6
_NEAR, _FAR, _BOX = 2.0, 6.0, (-1.5, -1.5, -1.5, 1.5, 1.5, 1.5)


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
class _Record(ListedImage):
    """A checked frame: the ``mask`` that cuts it out, and the file of its ``depth`` with the world units of a
    step, where it says so.
    """

    mask: Path | None
    depth: tuple[Path, float | None] | None
    ability: str

    @property
    def has_alpha(self) -> bool:
        return self.header.has_alpha or self.mask is not None


def read_scene(
    root: str | Path,
    scene: str,
    *,
    half_resolution: bool | str = "auto",
    box: Sequence[float] | str | None = None,
    near: float | None = None,
    far: float | None = None,
    axes: str | None = None,
    inverse: bool = False,
    angle: str = "width",
    test_every: int = 8,
    name_pattern: str | None = None,
    alpha: str | None = None,
    depth_kind: str | None = None,
) -> Scene:
    """Read ``root/scene``; pixels are decoded when a frame is first loaded.

    Where all cameras are about 4 from the origin, as in the published scenes, the world stays as it is. Else
    what the cameras look at is moved to the origin and the farthest camera to distance 4; where depth or
    trajectories come with the scene, the unit stays, and the origin, too, unless it is far away. Frames
    without an image are left out and counted; without test images training images are held out.

    Args:
        half_resolution: average 2 x 2 pixels; "auto" does so where images are wider than 400, as published.
        box: x0 y0 z0 x1 y1 z1 in the file's units; "auto": +-1.5 where cameras are as published, else what
            the images show; None takes the bounds of all training rays from near to far.
        near, far: along the unit ray, the file's units; None: 2 and 6 where cameras are as published, else
            derived from the cameras.
        axes, inverse: of the poses in the files, see ``posed_video.read_scene``.
        angle: ``camera_angle_x`` is that of the ``width`` or of the ``longer`` side.
        test_every: every n-th training image is tested on where there are no test images.
        name_pattern: see ``posed_video.read_scene``.
        alpha: colours are ``straight`` or ``premultiplied``; None: as the edges of some images show.
        depth_kind: of ``depth_file_path``, along the optical ``axis`` or each pixel's ``ray``; None: ray,
            unless views agree much better along the axis, which is refused.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and key.
    """
    one_of(depth_kind, "data.depth_kind", *METRIC, None)
    near, far = number_or_none(near, "data.near"), number_or_none(far, "data.far")
    one_of(angle, "data.angle", "width", "longer")
    one_of(half_resolution, "data.half_resolution", True, False, "auto")
    folder = scene_folder(root, scene, "D-NeRF")
    every = whole(test_every, "data.test_every", 2)
    records, assumed = _read_records(folder, axes, inverse, angle == "longer", every, name_pattern)
    everything = [record for split in records.values() for record in split]
    size, has_alpha = _common(everything)
    halve = size[0] > _PUBLISHED_WIDTH if half_resolution == "auto" else bool(half_resolution)
    if halve and (size[0] % 2 or size[1] % 2):
        raise mismatch(folder, "even sides to halve", by(size), "set data.half_resolution=false")
    width, height = (n // 2 if halve else n for n in size)
    cut_out = {
        split: [record.path for record in records[split] if record.has_alpha and record.mask is None]
        for split in SPLITS
    }
    premultiplied, told = alpha_of(alpha, cut_out, folder)
    assumed += told

    cameras = [record.camera for record in records["train"]]
    is_metric = any(record.depth for record in everything) or (folder / "trajectories.npz").exists()
    space, bounds = _space(cameras, str(folder), near, far, box, has_alpha, is_metric)

    def frame(record: _Record, split: str) -> Frame:
        whole = space.camera(record.camera)
        camera = whole.resized(width, height) if halve else whole
        load = StoredImage(record.path, size, 1 + halve, record.mask, premultiplied=premultiplied[split])
        depth = None
        if record.depth:
            depth = StoredDepth(record.depth[0], whole, halve, record.depth[1], depth_kind or "ray")
        return Frame(_name(folder, record), record.time, camera, load, depth, record.ability)

    train, val, test = (tuple(frame(record, split) for record in records[split]) for split in SPLITS)
    deep = sorted((f for f in (*train, *val, *test) if f.load_depth), key=lambda f: f.time)
    advice = "write depth_scale: {} beside the frames"
    sensed = [*map(_sensed, deep)]
    assumed += doubt_depths(sensed, space.scale, depth_kind, folder, advice, usual="ray")
    for frame, measured in zip(deep, sensed):
        frame.load_depth.ends = measured.load_sensed.ends
    if deep and depth_kind is None and not any((place / RECORD).is_file() for place in (folder, Path(root))):
        line = "depth_file_path is taken for depth along the pixels' rays"
        assumed.append(f"{folder}: {line}; if it is along the optical axis, set data.depth_kind=axis")
    canonical = min(f.time for f in train)
    protocol = {"dataset": "dnerf", "resolution": [width, height], "half_resolution": halve}
    is_moved = space.scale != 1 or any(space.center)
    protocol |= {"test_frames": len(test), "normalisation": space.told if is_moved else None}
    protocol["assumed"] = [*dict.fromkeys(assumed)] or None
    truth = read_truth(folder / "trajectories.npz", canonical, space)
    return Scene(scene, train, val, test, bounds, canonical, has_alpha, truth, protocol, world=space)


def _sensed(frame: Frame) -> Frame:
    """Give a frame its exact depth as measured, to doubt it."""
    depth = frame.load_depth
    return replace(frame, load_sensed=SensedDepth(depth.path, frame.camera, depth.scale, kind=depth.kind))


def _space(
    cameras: Sequence[Camera],
    where: str,
    near: float | None,
    far: float | None,
    box: Sequence[float] | str | None,
    cut_out: bool,
    is_metric: bool,
) -> tuple[Normalisation, Box]:
    """Find near, far and the box, and where a world of other units is moved to: see ``read_scene``."""
    distances = [float(camera.center.norm()) for camera in cameras]
    as_published = all(_LEAST_DISTANCE < distance < _MOST_DISTANCE for distance in distances)
    given = None if box == "auto" else box_of(box)
    if not as_published:
        options = {"near": near, "far": far, "box": given, "metric": is_metric, "cut_out": cut_out}
        return space_of(cameras, where, **options, radius=_RADIUS)
    near, far = _NEAR if near is None else near, _FAR if far is None else far
    if not near < far:
        raise mismatch("data.near, data.far", "near < far", f"{near:g} and {far:g}")
    space = Normalisation((0.0, 0.0, 0.0), 1.0, near, far)
    if box == "auto":
        return space, box_of(_BOX)
    return space, frustum_box(map(space.camera, cameras)) if given is None else given


def _common(records: Sequence[_Record]) -> tuple[tuple[int, int], bool]:
    """Return the size of all images and whether they have alpha.

    Raises:
        SceneError: naming an image that differs from the first in either.
    """
    first, sizes = records[0], [(record.camera.width, record.camera.height) for record in records]
    for record, size in zip(records, sizes):
        if size != sizes[0]:
            advice = f"remove it from {record.entry.file.name}"
            raise wrong_size(record.path, sizes[0], size, " as the first", advice)
    bare = [record for record in records if not record.has_alpha]
    if 0 < len(bare) < len(records):
        got = f"{len(bare)} of {len(records)} without, as {bare[0].path}"
        raise mismatch(first.path.parent, "an alpha channel in all images or in none", got)
    return sizes[0], not bare


def _read_records(
    folder: Path,
    axes: str | None,
    inverse: bool,
    longer: bool,
    test_every: int,
    name_pattern: str | None,
) -> tuple[dict[str, list[_Record]], list[str]]:
    """Read the records of all splits, each with a time; also say in lines what was assumed."""
    records, assumed = {}, []
    for split in SPLITS:
        files = _files(folder, split)
        options = {"axes": axes, "inverse": inverse, "longer": longer}
        parts = [_read_file(path, ability, **options) for path, ability in files.items()]
        records[split] = [record for part, _ in parts for record in part]
        assumed += [line for _, lines in parts for line in lines]
    everything = [record for split in SPLITS for record in records[split]]
    assumed += mixed_linear({record.path: record.header for record in everything}, folder)
    names = [_name(folder, record) for record in everything]
    cameras = [record.camera for record in everything]
    times, told = times_of(names, [record.time for record in everything], str(folder), name_pattern, cameras)
    assumed += [told] if told else []
    given = {split: {_name(folder, record): record.time for record in records[split]} for split in SPLITS}
    if name_pattern is None:
        assumed += check_times(given, str(folder), dict(zip(names, cameras)))
    each = iter(times)
    records = {split: [replace(record, time=next(each)) for record in records[split]] for split in SPLITS}
    if not records["test"]:
        ordered = sorted(records["train"], key=lambda record: record.time)
        records["train"], records["test"] = hold_out_every(ordered, test_every)
        line = f"{folder}: no test images: every {test_every}th training image is tested on instead"
        assumed.append(f"{line} ({len(records['test'])}; data.test_every)")
        if not records["test"]:
            raise mismatch(folder, "images to test on, or at least 3 to train on", f"{len(ordered)} in all")
    trained = {record.path for record in records["train"]}
    agree = [s for s in SPLITS if common_point([r.camera.camera_to_world for r in records[s]]) is not None]
    for split in SPLITS:
        for path, count in Counter(record.path for record in records[split]).most_common(1):
            if count > 1:
                raise mismatch(f"{folder}: {split}", "each image once", f"{path.name} twice", "remove one")
        poses = [record.camera.camera_to_world for record in records[split]]
        advice, other = "", next((s for s in agree if s != split), None)
        if other or split != "train":
            wanted = f"as in transforms_{other}.json" if other else "all in OpenGL's axes (docs/own-data.md)"
            advice = f"write them {wanted}, or set data.axes=opengl if they are right"
        if axes is None:
            where = f"{folder}: {split} images"
            assumed += check_directions(poses, where, inverse=inverse, advice=advice)
        if split != "train" and (both := sum(record.path in trained for record in records[split])):
            assumed.append(f"{folder}: {both} {split} images are trained on, too; their scores say little")
    upright = [record.entry for record in everything if record.camera.height > record.camera.width]
    keys = ("camera_angle_x", "fl_x", "fl_y")
    by_angle = any([entry.get(key) is None for key in keys] == [False, True, True] for entry in upright)
    if by_angle and not longer:
        line = f"{folder}: camera_angle_x taken as the angle of the width of these upright images"
        assumed.append(f"{line}; if it is that of the height, as of Blender's, set data.angle=longer")
    return records, assumed


def _files(folder: Path, split: str) -> dict[Path, str]:
    """List the transforms files of a split with their abilities: all in one, or one file per ability."""
    stock = folder / f"transforms_{split}.json"
    files = {stock: "all"} if stock.is_file() else {}
    if split != "test":
        return files
    parts = {}
    for ability in ABILITIES:
        places = (folder / f"transforms_test_{ability}.json", folder / f"test_{ability}" / "transforms.json")
        parts |= dict.fromkeys([path for path in places if path.is_file()][:1], ability)
    if files and parts:
        raise mismatch(stock, "it or one file per ability", "both", "remove one kind")
    return files or parts


def _name(folder: Path, record: _Record) -> str:
    return record.path.relative_to(folder).with_suffix("").as_posix()


def _read_file(path: Path, ability: str, **options) -> tuple[list[_Record], list[str]]:
    """Read a transforms file; without its images where it is of a test split that was never rendered.

    Args:
        path: of the file.
        ability: of its frames that name none.
        options: axes, inverse and longer, as of ``read_frames``.
    """
    content, records = read_json(path), []
    optional = ability == "all" and path.stem != "transforms_train"
    images, assumed = read_frames(path, content, **options, optional=optional)
    if ours := [key for key in ("near", "far", "aabb") if content.get(key) is not None]:
        keys = "data.near, data.far and data.box"
        assumed.append(f"{path}: {', '.join(ours)} left aside, as this layout has none; set {keys}")
    assumed += unread_beside(path, content, [image.path for image in images])
    for image in images:
        entry, depth, mask = image.entry, None, None
        if "depth_file_path" in entry.own:
            file, scale = entry.path("depth_file_path"), entry.get("depth_scale")
            if not os.path.isfile(file):
                raise mismatch(entry.where("depth_file_path"), "an existing file", file, nearly(file))
            depth = file, None if scale is None else entry.number("depth_scale", 1e-12, 1e6)
        own = entry.own.get("ability", ability)
        one_of(own, entry.where("ability"), *ABILITIES, "all")
        if entry.get("mask_path") is not None:
            mask = image_of(entry, "mask_path")
            inspect_image(mask, image.header.size, f" as {image.path.name}")
        records.append(_Record(**vars(image), mask=mask, depth=depth, ability=own))
    return records, assumed


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
