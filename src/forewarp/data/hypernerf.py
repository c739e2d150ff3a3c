"""HyperNeRF and Nerfies captures: one or more phones around a scene that moves, images without alpha.

``dataset.json`` names the items and the split, ``metadata.json`` each item's time, ``scene.json`` the world's
``center`` and ``scale``, ``camera/<id>.json`` the camera, ``rgb/<s>x/<id>.png`` the image, s times smaller.
The optional ``points.npy`` (N, 3) holds points that never move, the optional ``trajectories.npz`` true
trajectories (see ``data.arrays``). Scene coordinates are ``(X - center) * scale`` of those in the files.

Beyond these, dycheck's captures may have ``depth/<s>x/<id>.npy`` of the unscaled world, along the optical
axis, 0 where there is none, and ``confidence/`` likewise; ``covisible/<s>x/<split>/<id>.png``, bright where
training images show a pixel of a held-out image too; ``keypoint/<s>x/<split>/<id>.json``, rows of x, y and
whether it is seen; ``splits/<split>.json``, whose ``frame_names`` take the place of ``dataset.json``'s lists;
and ``extra.json``, of which ``fps`` is read. An alpha of 0 says that a pixel is unknown.

A camera file's ``orientation`` is world-to-camera with OpenCV's axes, ``position`` the camera's centre in the
unscaled world; all else is in pixels of the full-size image. Old files say ``tangential`` for
``tangential_distortion``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from reprlib import repr as short
from statistics import median

import numpy as np
import torch
from torch import Tensor

from forewarp.data import files
from forewarp.data.arrays import read_cloud, read_truth, write_array, write_truth
from forewarp.data.cameras import (
    MOST_UNITS,
    Normalisation,
    box_of,
    check_camera,
    frustum_box,
    near_origin,
    pose_of,
)
from forewarp.data.depth import METRIC, SensedDepth, depths_beside, doubt_depths, unit_of
from forewarp.data.directions import (
    by_translation,
    common_point,
    doubt_readings,
    opposite,
    transposed,
)
from forewarp.data.files import (
    Entry,
    SceneError,
    inside,
    mismatch,
    number,
    one_of,
    read_json,
    remove,
    scene_folder,
    side_files,
    whole,
)
from forewarp.data.images import (
    MovingMask,
    StoredImage,
    StoredMask,
    check_pixels,
    exif_turned,
    inspect_image,
    mixed_linear,
    refuse_other_sizes,
    write_image,
)
from forewarp.data.names import in_order, read_names
from forewarp.data.rigs import refuse_copied_poses
from forewarp.data.transforms import (
    LIKE_LENS,
    beside_images,
    check_pinhole,
    check_times,
    with_images,
    with_suffix,
)
from forewarp.files import write_json
from forewarp.ops.backend import is_number
from forewarp.scene.camera import Camera, Lens
from forewarp.scene.frame import Frame, Scene, Truth, middle_of

_SCALES, _ASPECTS = (1e-6, 1e6), (1e-2, 1e2)
_MOST_PIXELS, _MOST_PIXELS_OFF, _MOST_BENT = 1e5, 1e7, 1e3  # beyond them a camera file is wrong
_REACH = 5.0  # times the distance of what cameras look at: a far beyond it is likely of another unit
_SPECK, _ROOM = 0.15, 4.0  # of the distance of what cameras look at, between which points of a scene spread
_OUTSIDE = 0.1  # share of keypoints outside the images, from which on they are of others
_MOST_MOMENTS, _RATES = 1e9, (1e-3, 1e5)
_INTERPOLATION = "interpolation"
_LENS_KEYS = (
    "focal_length",
    "pixel_aspect_ratio",
    "skew",
    "principal_point",
    "radial_distortion",
    "tangential_distortion",
)
_LIKE_FOCAL = re.compile("(?i)f_?[xy]|fl_?[xy]|focal.*|(pixel_?)?aspect.*")
_LAST_NUMBER = re.compile(r"(.*?)(\d+)\D*")  # of an item's name, and what is before it
_EVERY = 4  # the published interpolation protocol: train on every fourth, test midway between


_READINGS = {  # what else may be in a camera file, with what mends it
    "orientation is camera-to-world (transpose it)": transposed,
    "position is the translation t of a world-to-camera matrix (write -orientation^T t)": by_translation,
    "the axes are OpenGL's (then negate the last two rows of orientation)": opposite,
}


@dataclass(frozen=True)
class RigShot:
    """An item to write: ``camera`` of the full-size image in the unscaled world, ``rgb`` uint8 (H, W, 3),
    ``split`` train, val or "" for neither. Items of one ``time_id`` were taken at the same moment.

    Where it has them: ``depth`` (H, W) along the optical axis, unscaled world, 0 where there is none, and its
    ``confidence`` (H, W) in [0, 1]; ``covisible`` bool (H, W); ``keypoints`` (J, 3), pixels x, y and 0 or 1.
    """

    name: str
    time_id: int
    camera_id: int
    split: str
    camera: Camera
    rgb: Tensor | np.ndarray
    depth: np.ndarray | None = None
    confidence: np.ndarray | None = None
    covisible: np.ndarray | None = None
    keypoints: np.ndarray | None = None


def read_scene(
    root: str | Path,
    scene: str,
    *,
    scale: int = 2,
    box: Sequence[float] | None = None,
    depth: str | None = None,
    depth_kind: str | None = None,
    split: str | None = None,
    masks: str | None = None,
) -> Scene:
    """Read ``root/scene``; pixels are decoded when a frame is first loaded, of images with alpha at once.

    With ``val_ids`` these are tested and ``train_ids`` trained on (split "vrig"). Without, every fourth item
    from the first is trained on and those midway between are tested (split "interpolation"). The canonical
    time is the training time nearest to the middle of them.

    Args:
        scale: which of the stored sizes, sides ``scale`` times smaller than the full-size image.
        box: x0 y0 z0 x1 y1 z1 in normalised units; None takes the bounds of all training rays.
        depth: folder of the training images' depth, ``depth`` of dycheck's captures; None: none is used.
        depth_kind: along the optical ``axis`` or the pixel's ``ray``; None: along the axis, unless views
            agree much better along rays, which is refused.
        split: ``mono``, ``intl`` or another ending of names in ``splits/``: ``train_mono``, ``val_mono``;
            None: ``train`` and ``val``, where these are there, else the lists of ``dataset.json``.
        masks: ``off``: images' alpha means nothing; None: pixels of alpha 0 do not count, and images of which
            none does are left out.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and key.
    """
    folder = scene_folder(root, scene, "HyperNeRF")
    one_of(depth_kind, "data.depth_kind", *METRIC, None)
    one_of(masks, "data.masks", "off", None)
    images = folder / "rgb" / f"{whole(scale, 'data.scale', 1)}x"
    if not images.is_dir():
        there = ", ".join(in_order(p.name for p in folder.glob("rgb/*x") if p.is_dir())) or "none"
        advice = f"set data.scale to one of those there: {there}"
        raise mismatch(images, "a folder of images", "none", advice)
    world = Entry(folder / "scene.json", read_json(folder / "scene.json"))
    center, size = world.numbers("center", 3, -MOST_UNITS, MOST_UNITS), world.number("scale", *_SCALES)
    near, far = (world.number(key, 0, MOST_UNITS) for key in ("near", "far"))
    if near >= far:
        raise mismatch(f"{world.file}: near, far", "near < far", f"{near:g} and {far:g}")
    normalised = Normalisation(center, size, near, far)
    how, ids, train_ids, test_ids = _read_split(folder / "dataset.json")
    of_train, of_test = (part if split is None else f"{part}_{split}" for part in ("train", "val"))
    if split is not None or (folder / "splits" / "train.json").is_file():
        wheres = [folder / "splits" / f"{part}.json" for part in (of_train, of_test)]
        train_ids = _names(wheres[0], "frame_names", read_json(wheres[0]), ids)
        test_ids = _names(wheres[1], "frame_names", read_json(wheres[1]), ids, train_ids)
        how = f"splits/{of_train}.json and {of_test}.json"
    numbers, camera_ids, assumed = _read_items(folder / "metadata.json", ids)
    if how == _INTERPOLATION and _are_out_of_order(ids, numbers, camera_ids):
        train_ids, test_ids = _every_fourth(sorted(ids, key=numbers.get))
        line = "ids are not in the order of time, in which every fourth is trained on"
        assumed.append(f"{folder / 'dataset.json'}: {line}; list train_ids and val_ids to choose others")
    first, last = min(numbers.values()), max(numbers.values())
    where = f"{folder / 'dataset.json'}: ids"
    paths = {item: with_suffix(inside(images, item, where)) for item in ids}
    there, told = with_images(ids, list(paths.values()), where)
    advice = "remove those that are not meant"
    if scale > 1:
        largest = [images.with_name("1x") / paths[item].name for item in there]
        refuse_other_sizes(largest, [paths[item] for item in there])
    assumed += [*told, *beside_images([paths[item] for item in there], where, advice)]
    train_ids, test_ids = ([item for item in part if item in set(there)] for part in (train_ids, test_ids))
    for part, names in (("train_ids", train_ids), ("val_ids", test_ids)):
        if not names:
            raise mismatch(folder / "dataset.json", f"an image of {part} that is there", "none")

    poses, headers, depths, unit = [], {}, {}, size  # poses of the unscaled world
    unread: dict[str, None] = {}  # keys of lenses
    if depth is not None:
        place = inside(folder, depth, "data.depth") / f"{scale}x"
        depths = depths_beside(place, train_ids)
        unit, told = unit_of([*depths.values()], near / size, far / size)
        unit, assumed = unit * size, assumed + told

    def frame(item: str) -> Frame:
        path = paths[item]
        file = inside(folder / "camera", f"{item}.json", where)
        if not file.is_file():
            raise mismatch(
                file, "the camera of an image", "none", "write it, or take the id out of dataset.json"
            )
        entry = Entry(file, read_json(file))
        camera = camera_of(entry, near, far)
        unread.update(dict.fromkeys(_unread_lens(entry, camera)))
        poses.append(camera.camera_to_world)
        camera = normalised.camera(camera).smaller(scale)
        size = camera.width, camera.height
        header, options = inspect_image(path, size, f", the camera's image_size / {scale}"), {}
        headers[path] = header
        if header.has_alpha and masks is None:
            options["load_valid"] = StoredMask(path, size, of_alpha=True)
        if item in depths:
            trust = folder / "confidence" / f"{scale}x" / f"{item}.npy"
            trust = trust if trust.is_file() else None
            options["load_sensed"] = SensedDepth(depths[item], camera, unit, trust, depth_kind or "axis")
        mask = folder / "covisible" / f"{scale}x" / of_test / f"{item}.png"
        if mask.is_file():
            inspect_image(mask, size, f" as {path.name}")
            options["load_covisible"] = MovingMask(mask, size)
        points = folder / "keypoint" / f"{scale}x" / of_train / f"{item}.json"
        if points.is_file():
            options["keypoints"] = _read_keypoints(points)
        load = StoredImage(path, size, opaque=True)
        time = (numbers[item] - first) / ((last - first) or 1)
        return Frame(item, time, camera, load, camera_id=camera_ids[item], **options)

    everything = [tuple(map(frame, items)) for items in (train_ids, test_ids)]
    masked = {f.name: f.load_valid for part in everything for f in part if f.load_valid is not None}
    dark = {name: mask for name, mask in masked.items() if mask.is_dark()}
    train, test = (tuple(f for f in part if f.name not in dark) for part in everything)
    if dark:
        if not train or not test:
            next(iter(dark.values()))()  # refuses it
        line = f"alpha is 0 everywhere in {len(dark)} images, which are left out ({min(dark)}, ..)"
        assumed.append(f"{images}: {line}; if alpha is of other use, set data.masks=off")
    refuse_copied_poses((*train, *test), folder / "camera")
    advice = {"unit": "multiply it by {}", "far_key": "mend far in scene.json"}
    assumed += doubt_depths(train, size, depth_kind, folder / (depth or ""), **advice)
    assumed += _doubt_evidence(folder, scale, train, test)
    splits = {"train": train, "val": test}
    numbered = {split: {f.name: numbers[f.name] for f in part} for split, part in splits.items()}
    by_name = {f.name: f.camera for f in (*train, *test)}
    assumed += check_times(numbered, str(folder / "metadata.json"), by_name)
    if first == last:
        assumed.append(f"{folder / 'metadata.json'}: all items are of time {first}: one moment")
    canonical, points = middle_of(f.time for f in train), folder / "points.npy"
    counts = {len(f.keypoints) for f in train if f.keypoints is not None}
    if len(counts) > 1:
        where = folder / "keypoint" / f"{scale}x" / of_train
        raise mismatch(where, "as many keypoints in each file", f"{min(counts)} and {max(counts)}")
    seconds = None
    if (folder / "extra.json").is_file():
        extra = Entry(folder / "extra.json", read_json(folder / "extra.json"))
        seconds = (last - first) / extra.number("fps", *_RATES)
    assumed += exif_turned([path for path, header in headers.items() if header.is_turned], images)
    assumed += mixed_linear(headers, images)
    if unread:
        line = f"{', '.join(unread)}: not read, which seem to be of the lens"
        assumed.append(f"{folder / 'camera'}: {line}; write them as {', '.join(_LENS_KEYS)}")
    known = [folder / name for name in ("confidence", *([] if depth is None else [depth]))]
    assumed += side_files(
        [folder, images], known, "set data.depth (data=iphone) for depth, cut masks into alpha"
    )
    middle = torch.stack([f.camera.center for f in train]).mean(0).tolist()
    if not near_origin(middle, far).is_same:
        place = [round(value, 1) for value in torch.stack(poses)[:, :3, 3].mean(0).tolist()]
        got = f"{center}, with cameras around {place}, too far from it for single precision"
        raise mismatch(world.where("center"), "the middle of what is filmed", got, "write that")
    if (line := _doubt_range(poses, size, near, far)) is not None:
        assumed.append(f"{world.file}: near, far: {line}")
    assumed += doubt_readings(poses, _READINGS, folder / "camera", "write them anew")
    has_masks = any(f.load_valid for f in train)
    protocol = {
        "dataset": "hypernerf" if depth is None else "iphone",
        "scale": scale,
        "split": how,
        "resolution": [train[0].camera.width, train[0].camera.height],
        "train_frames": len(train),
        "test_frames": len(test),
        "seconds": seconds,
        "depth": None if depth is None else f"{depth}, of {len(depths)} of {len(train)} training frames",
        "masks": "ignore: pixels of alpha 0 are not trained or measured on" if has_masks else None,
        "assumed": assumed or None,
    }
    bounds = box_of(box) or frustum_box(f.camera for f in train)
    truth = read_truth(folder / "trajectories.npz", canonical, normalised)
    cloud = read_cloud(points, 3) if points.exists() else None
    if cloud is not None and _are_normalised(cloud, poses, normalised):
        line = "points lie where the cameras look if they are normalised already, and else do not"
        protocol["assumed"] = [*assumed, f"{points}: {line}; if so, write them as unscaled world coordinates"]
    still = None if cloud is None else normalised.to_scene(cloud).float()
    return Scene(scene, train, (), test, bounds, canonical, False, truth, protocol, still, world=normalised)


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
    fps: float | None = None,
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
        fps: moments a second, where known.
    """
    folder, metadata = Path(folder), {}
    remove(folder, "dataset.json", "metadata.json", "scene.json", "points.npy", "trajectories.npz")
    remove(folder, "camera/*.json", "rgb/*x/*.png", "extra.json", "splits/*.json", "depth/*x/*.npy")
    remove(folder, "confidence/*x/*.npy", "covisible/*x/*/*.png", "keypoint/*x/*/*.json")
    parts: dict[str, list[str]] = {"train": [], "val": [], "": []}
    for shot in shots:
        if shot.name in metadata or shot.split not in parts:
            got = f"{shot.name!r} of split {shot.split!r}"
            raise mismatch("shots", "different names, each of train, val or ''", got)
        _write_shot(folder, shot, scales)
        parts[shot.split].append(shot.name)
        times = dict.fromkeys(("time_id", "warp_id", "appearance_id"), int(shot.time_id))
        metadata[shot.name] = times | {"camera_id": shot.camera_id}
    write_array(folder / "points.npy", points, np.float64)
    write_truth(folder / "trajectories.npz", trajectories)
    world = {"scale": float(scale), "center": [float(v) for v in center]}
    world |= {"near": float(near), "far": float(far)}
    dataset = {"count": len(metadata), "num_exemplars": len(parts["train"]), "ids": list(metadata)}
    dataset |= {"train_ids": parts["train"], "val_ids": parts["val"]}
    if fps is not None:
        write_json(folder / "extra.json", {"fps": float(fps), "factor": max(scales)})
    for name, content in (("scene", world), ("metadata", metadata), ("dataset", dataset)):
        write_json(folder / f"{name}.json", content)


def camera_of(entry: Entry, near: float, far: float) -> Camera:
    """Read the camera that a file holds, in its units: the unscaled world and the full-size image.

    Raises:
        SceneError: for a key that is missing or has a wrong number of values, for no rotation, and for a lens
            that cannot be undone.
    """
    check_pinhole(entry)
    width, height = entry.numbers("image_size", 2, 1, _MOST_PIXELS)
    if width % 1 or height % 1:
        raise mismatch(entry.where("image_size"), "whole numbers", f"{width:g} x {height:g}")
    focal = entry.number("focal_length", 1e-3, _MOST_PIXELS_OFF)
    aspect = entry.number("pixel_aspect_ratio", *_ASPECTS, 1.0)
    skew = entry.number("skew", -_MOST_PIXELS_OFF, _MOST_PIXELS_OFF, 0.0)
    cx, cy = entry.numbers("principal_point", 2, -_MOST_PIXELS_OFF, _MOST_PIXELS_OFF)
    rows, where, matrix = entry.get("orientation"), entry.where("orientation"), np.eye(4)
    if not isinstance(rows, list) or [len(r) if isinstance(r, list) else 0 for r in rows] != [3, 3, 3]:
        raise mismatch(where, "3 x 3 numbers", short(rows))
    matrix[:3, :3] = np.array([[number(v, where) for v in row] for row in rows]).T
    matrix[:3, 3] = entry.numbers("position", 3)
    tangential = "tangential" if "tangential" in entry.own else "tangential_distortion"
    k = tuple(entry.numbers("radial_distortion", 3, -_MOST_BENT, _MOST_BENT, [0.0] * 3))
    p = tuple(entry.numbers(tangential, 2, -_MOST_BENT, _MOST_BENT, [0.0] * 2))
    lens, pose = Lens(k, p) if any(k + p) else None, torch.from_numpy(pose_of(matrix, where))
    camera = Camera(int(width), int(height), focal, focal * aspect, cx, cy, pose, near, far, skew, lens)
    check_camera(camera, entry.where("principal_point"), entry.where("radial_distortion"))
    return camera


def _unread_lens(entry: Entry, camera: Camera) -> list[str]:
    """List the keys that seem to be of the lens and are not read, where they say another thing."""
    read = {*_LENS_KEYS} - ({"tangential_distortion"} if "tangential" in entry.own else set())
    lens = camera.lens or Lens()
    known = [0, camera.fx, camera.fy, camera.cx, camera.cy, camera.fy / camera.fx, camera.skew]
    known = np.array([*known, *lens.k, *lens.p])

    def is_new(value: object) -> bool:
        values = value if isinstance(value, list) else [value]
        return any(
            not np.isclose(known, each).any() if is_number(each) else each is not None for each in values
        )

    keys = [key for key in entry.own if key not in read | {"tangential"}]
    like = [key for key in keys if LIKE_LENS.fullmatch(key) or _LIKE_FOCAL.fullmatch(key)]
    return [key for key in like if is_new(entry.own[key])]


def write_camera(path: Path, camera: Camera) -> None:
    """Write a camera for ``camera_of``, every digit of it but near and far, whole or not at all."""
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


def _read_split(path: Path) -> tuple[str, list[str], list[str], list[str]]:
    """Read how a ``dataset.json`` is split: vrig or interpolation, all items, those to train and to test on.

    Raises:
        SceneError: for lists that are none, name an item twice, an unknown one or one in both parts.
    """
    content = {"ids": [], "train_ids": [], "val_ids": []} | read_json(path)
    ids = _names(path, "ids", content)
    if len(ids) > files.MOST_FRAMES:
        raise mismatch(f"{path}: ids", f"at most {files.MOST_FRAMES} items", len(ids))
    train = _names(path, "train_ids", content, ids)
    val = _names(path, "val_ids", content, ids, train)
    if val and not train:
        raise mismatch(f"{path}: train_ids", "at least one beside val_ids", "none")
    if val:
        return "vrig", ids, train, val
    if len(ids) <= _EVERY:
        expected = f"more than {_EVERY} items to test between where val_ids is empty"
        raise mismatch(f"{path}: ids", expected, len(ids))
    return _INTERPOLATION, ids, *_every_fourth(ids)


def _every_fourth(ids: list[str]) -> tuple[list[str], list[str]]:
    """Split items as the published interpolation protocol does: to train on, and midway to test on."""
    chosen = range(0, len(ids), _EVERY)
    return [ids[i] for i in chosen], [ids[i + _EVERY // 2] for i in chosen[:-1]]


def _are_out_of_order(ids: list[str], numbers: dict[str, int], cameras: dict[str, int | None]) -> bool:
    """Tell whether the items of some camera are not in the order of time."""
    latest: dict[int | None, int] = {}
    for item in ids:
        if numbers[item] < latest.get(cameras[item], 0):
            return True
        latest[cameras[item]] = numbers[item]
    return False


def _names(path: Path, key: str, content: dict, ids: list[str] | None = None, train=()) -> list[str]:
    """Check the list ``key`` of a file: different names, of ``ids`` if given, none of ``train``; else
    SceneError.
    """
    names = content.get(key)
    are_names = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not are_names or len({*names}) < len(names):
        raise mismatch(f"{path}: {key}", "a list of different names", short(names))
    known = {*names} if ids is None else {*ids}
    if unknown := [name for name in names if name not in known]:
        raise mismatch(f"{path}: {key}", "items of dataset.json's ids", short(unknown[0]), "remove it")
    if both := {*train} & {*names}:
        raise mismatch(f"{path}: {key}", "none of the items to train on", short(min(both)))
    return names


def _read_keypoints(path: Path) -> Tensor:
    """Read keypoints (J, 3): x, y and whether they are seen; SceneError for other rows. On disk the middle of
    the first pixel is (0, 0), as dycheck's loader has it.
    """
    rows = read_json(path, list)
    if not all(isinstance(row, list) and len(row) == 3 for row in rows):
        raise mismatch(path, "a list of [x, y, seen]", short(rows))
    points = torch.tensor([[number(value, str(path)) for value in row] for row in rows]).reshape(-1, 3)
    points[:, 2] = (points[:, 2] > 0).float()
    points[:, :2] += 0.5 * points[:, 2:]
    return points


def _doubt_range(poses: Sequence[Tensor], scale: float, near: float, far: float) -> str | None:
    """Doubt a range that is too far in the normalised world, and would do in the unscaled one."""
    if (aim := common_point(poses)) is None:
        return None
    away = max(float((pose[:3, 3].double() - aim).norm()) for pose in poses)
    if not (far > _REACH * scale * away and away < far < _REACH * away):
        return None
    line = f"far is {far / (scale * away):.2g} times the distance of what all cameras look at"
    line += ", as if it were not multiplied by scale"
    return f"{line}; if so, write {scale * near:.4g} and {scale * far:.4g}"


def _are_normalised(points: np.ndarray, poses: Sequence[Tensor], world: Normalisation) -> bool:
    """Tell whether points (N, 3) of the unscaled world seem to be normalised: then they lie around what
    cameras look at, within their distance from it, and else they do not, or in a speck.
    """
    if (aim := common_point(poses)) is None or not len(points):
        return False
    away = median(float((pose[:3, 3].double() - aim).norm()) for pose in poses)
    middle = np.median(points, 0)
    spread = float(np.median(np.linalg.norm(points - middle, axis=-1)))

    def fits(target: Tensor, unit: float) -> bool:
        distance = float(np.linalg.norm(middle - np.asarray(target))) / (unit * away)
        return distance < 1 and _SPECK < spread / (unit * away) < _ROOM

    return fits(world.to_scene(aim), world.scale) and not fits(aim, 1.0)


def _doubt_evidence(folder: Path, scale: int, train: Sequence[Frame], test: Sequence[Frame]) -> list[str]:
    """Say in lines that co-visible masks or keypoints are there and none is read, that some test images lack
    such masks, and that keypoints are not in pixels of the images.
    """
    lines = []
    for kind, used in (
        ("covisible", [f for f in test if f.load_covisible is not None]),
        ("keypoint", keyed := [f for f in train if f.keypoints is not None]),
    ):
        found = next((folder / kind).rglob("*.*"), None)
        if found is not None and not used:
            advice = f"with data.scale={scale} they lie in {kind}/{scale}x/, in a folder of the split's name"
            lines.append(f"{folder / kind}: none is read, as {found.relative_to(folder)}; {advice}")
    without = [f.name for f in test if f.load_covisible is None]
    if 0 < len(without) < len(test):
        count = f"{len(test) - len(without)} of {len(test)}"
        said = f"masks of {count} test images; {without[0]}.png is not there"
        lines.append(f"{folder / 'covisible'}: {said}: masked metrics are means over the others alone")
    seen = [
        f.keypoints[f.keypoints[:, 2] > 0, :2] / torch.tensor([f.camera.width, f.camera.height])
        for f in keyed
    ]
    places = torch.cat(seen) if seen else torch.zeros(0, 2)
    if len(places):
        outside = float(((places < 0) | (places > 1)).any(1).float().mean())
        pixel = 1.5 / min(keyed[0].camera.width, keyed[0].camera.height)
        if outside > _OUTSIDE or float(places.max()) <= pixel:
            got = f"{outside:.0%} lie outside the images" if outside else "all lie in their first pixel"
            lines.append(f"{folder / 'keypoint'}: {got}; write x and y in pixels of rgb/{scale}x")
    return lines


def _read_items(path: Path, ids: list[str]) -> tuple[dict[str, int], dict[str, int | None], list[str]]:
    """Read the number of each item's moment in a ``metadata.json``, and of its camera, where it has one; also
    say in lines what was assumed.

    A moment is ``time_id``, or where none of ``ids`` has one ``warp_id``; where that only counts the items,
    as one camera after the other, the number in their names, which then tell cameras, too. Entries of other
    items are not looked at.

    Raises:
        SceneError: for an item that is missing or has no time, and for a number that is not whole.
    """
    content = read_json(path)
    for item in ids:
        if not isinstance(content.get(item), dict):
            raise mismatch(f"{path}: {item!r}", "an object for this item", short(content.get(item)))
    entries = {item: Entry(path, content[item], f"{item!r}.") for item in ids}
    key = "time_id" if any("time_id" in entry.own for entry in entries.values()) else "warp_id"

    def counted(entry: Entry, name: str) -> int:
        number = entry.number(name, 0, _MOST_MOMENTS)
        if number % 1:
            raise mismatch(entry.where(name), "a whole number", f"{number:g}")
        return int(number)

    moments, cameras = {item: counted(entry, key) for item, entry in entries.items()}, dict.fromkeys(ids)
    having = {item: entry for item, entry in entries.items() if entry.get("camera_id") is not None}
    cameras |= {item: counted(entry, "camera_id") for item, entry in having.items()}
    frames, takers, is_sure = [], None, True
    with suppress(SceneError):  # names of numbers alone tell only with camera_id
        if (read := read_names(ids, str(path))) is not None:
            frames, takers = read.frames, read.cameras
    if not frames and all(ends := [_LAST_NUMBER.fullmatch(item) for item in ids]):
        takers, frames = [end[1] for end in ends], [float(end[2]) for end in ends]
        pairs = {*zip(takers, cameras.values())}
        is_sure = len(pairs) == len({*takers}) == len({*cameras.values()})
    named, views = dict(zip(ids, frames)), cameras
    if takers and len({*cameras.values()}) == 1:  # a number that says nothing
        order = in_order({*takers})
        views = {item: order.index(camera) for item, camera in zip(ids, takers)}
    if not _counts_items(moments, named, views):
        return moments, cameras, []
    line = f"{path}: {key} counts the items in another order than the numbers in their names"
    if key == "time_id" or not is_sure:
        return moments, cameras, [f"{line}; if cameras film at once, give items of one moment one time_id"]
    return named, views, [f"{line}: times are these numbers; write time_id if they are wrong"]


def _counts_items(moments: dict[str, int], named: dict[str, float], cameras: dict[str, int | None]) -> bool:
    """Tell whether numbers of moments seem to say nothing of these: they differ everywhere, while names give
    items of several cameras one number, and they do not grow with that.
    """
    pairs = {(number, cameras[item]) for item, number in named.items()}
    are_distinct = len(pairs) == len(named) and len({*moments.values()}) == len(moments)
    in_turn = [named[item] for item in sorted(named, key=moments.get)]
    return are_distinct and None not in cameras.values() and in_turn != sorted(in_turn)


def _write_shot(folder: Path, shot: RigShot, scales: Sequence[int]) -> None:
    height, width = shot.camera.height, shot.camera.width
    rgb = check_pixels(shot.name, shot.rgb, (height, width, 3))
    for s in scales:
        means = rgb.reshape(height // s, s, width // s, s, 3).mean((1, 3))
        write_image(folder / "rgb" / f"{s}x" / f"{shot.name}.png", np.rint(means).astype(np.uint8))
        middles = slice(s // 2, None, s), slice(s // 2, None, s)  # depths of two things have no mean
        for kind, values in (("depth", shot.depth), ("confidence", shot.confidence)):
            values = None if values is None else np.asarray(values)[middles][..., None]
            write_array(folder / kind / f"{s}x" / f"{shot.name}.npy", values)
        if shot.covisible is not None:
            mask = np.uint8(255) * np.asarray(shot.covisible, bool)[middles]
            write_image(folder / "covisible" / f"{s}x" / (shot.split or "val") / f"{shot.name}.png", mask)
        if shot.keypoints is not None:
            rows = np.asarray(shot.keypoints, float) / (s, s, 1)
            rows[:, :2] -= 0.5 * rows[:, 2:]
            place = folder / "keypoint" / f"{s}x" / (shot.split or "train")
            write_json(place / f"{shot.name}.json", rows.tolist())
    write_camera(folder / "camera" / f"{shot.name}.json", shot.camera)
