"""A user's own capture: ``transforms.json`` as nerfstudio and instant-ngp write it, and images, PNG or JPEG.

A pose on disk is camera-to-world with OpenGL's axes (x right, y up, looking along -z). The camera
(``w h fl_x fl_y cx cy k1 k2 k3 p1 p2 camera_model``) stands at the top or, where it differs, in a frame. All
lengths (``near``, ``far``, ``aabb``; ``data.near``, ``data.far``, ``data.box``) are in the file's units,
which may be any: the scene is normalised. The optional ``points.npy`` (N, 3), or the PLY that the file names,
holds points that never move.

Beyond nerfstudio's keys a frame may have ``camera``, a name or a number of which of several cameras took it;
``moment``, the number from 0 of the instant that it belongs to, where cameras film at times of their own;
``moving_path``, a grey PNG as large as the unscaled image, bright where something moves, which is scored
apart; ``resting_path``, in some frames, bright where something rests in the whole film; ``depth_file_path``
is nerfstudio's. ``moving_from`` says where masks of motion come from, ``seconds`` how long the film is.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from reprlib import repr as short

import numpy as np
from torch import Tensor

from forewarp.data import llff
from forewarp.data.arrays import read_cloud, write_array
from forewarp.data.cameras import MOST_UNITS, SPLITS, box_of, number_or_none, opengl_rows, space_of
from forewarp.data.depth import (
    LEVELS,
    METRIC,
    MILLIMETRES,
    SensedDepth,
    confidence_of,
    depths_beside,
    depths_named,
    doubt_depths,
)
from forewarp.data.directions import check_directions
from forewarp.data.files import (
    SUFFIXES,
    inside,
    layout_of,
    mismatch,
    number,
    one_of,
    read_json,
    remove,
    scene_folder,
    stated,
    whole,
)
from forewarp.data.images import (
    MovingMask,
    StoredImage,
    StoredMask,
    alpha_of,
    by,
    check_pixels,
    hides_image,
    inspect_image,
    mixed_linear,
    refuse_other_sizes,
    write_image,
)
from forewarp.data.names import in_order, read_names
from forewarp.data.rigs import held_cameras, held_moments, refuse_copied_poses, split_rig
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
from forewarp.scene.frame import Frame, Scene, middle_of

FILE, POINTS = "transforms.json", "points.npy"
SCALES = (1, 2, 4, 8)
_UNIT = "depth_unit_scale_factor"  # nerfstudio's, of all depths
_OF_CAMERA = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_model", "k1", "k2", "k3", "p1", "p2")


@dataclass(frozen=True)
class PosedShot:
    """An image to write: ``name`` its file, .png or .jpg; ``pixels`` uint8 (H, W, 3), or (H, W, 4) of
    straight alpha; ``camera`` of that size, its near and far are not written; ``time`` in [0, 1] or None;
    ``split`` train, val or test, or "" where the reader is to choose; ``moving`` bool (H, W), what moves, and
    ``resting``, what rests in the whole film, None where it is not known; ``taken_by`` the name of the
    camera, of a rig, and ``moment`` the number of the instant, from 0; ``depth`` (H', W') along the optical
    axis and its ``confidence``, as measured.
    """

    name: str
    camera: Camera
    pixels: Tensor | np.ndarray
    time: float | None = None
    split: str = ""
    moving: np.ndarray | None = None
    resting: np.ndarray | None = None
    taken_by: str | None = None
    moment: int | None = None
    depth: np.ndarray | None = None
    confidence: np.ndarray | None = None


def read_scene(
    root: str | Path,
    scene: str,
    *,
    scale: int = 1,
    near: float | None = None,
    far: float | None = None,
    box: Sequence[float] | None = None,
    normalise: bool = True,
    test_every: int = 8,
    name_pattern: str | None = None,
    test_cameras: Sequence[str | int] | None = None,
    test_moments: Sequence[int] | None = None,
    axes: str | None = None,
    inverse: bool = False,
    masks: str | None = None,
    alpha: str | None = None,
    depth: str | None = None,
    depth_kind: str | None = None,
    depth_scale: float | None = None,
) -> Scene:
    """Read ``root/scene``; pixels are decoded when a frame is first loaded, masks at once.

    The subject is cut out where masks are alpha, or where some image has a pixel that is not opaque: images
    with an alpha channel are decoded until one such is found.

    Without ``time`` in the file, numbers in the images' names tell it; see ``names.read_names``. Frames
    without an image are left out and counted.

    Args:
        scale: 1, 2, 4 or 8: take the smaller images in ``images_<scale>`` beside ``images``.
        near, far: along the unit ray, the file's units; None takes the file's or derives them.
        box: x0 y0 z0 x1 y1 z1 in the file's units; None takes the file's ``aabb``, or all that is seen.
        normalise: put what is looked at into the origin and the farthest camera at distance 1.
        test_every: every n-th frame is a test frame, the first and the last never, where the file does not
            list ``<split>_filenames``.
        name_pattern: regular expression that reads ``time`` or ``frame``, and ``camera``, in the images'
            names; None: the file's times, or what names say in one way.
        test_cameras: names of the cameras held out, of frames that have ``camera``; None: see above.
        test_moments: numbers of the frames' moments, or without these of the times, from 0, that no camera
            is trained on; None: see above.
        axes: of the poses in the file: opengl or opencv; None: OpenGL's, unless the cameras look away from
            what they surround, which is refused.
        inverse: poses in the file are world-to-camera.
        masks: what the dark pixels of ``mask_path``, or without it of the images' alpha, mean: ``alpha``
            (beside the subject), ``ignore`` (not to be trained or measured on) or ``off`` (nothing). None:
            those of ``mask_path`` ignore, as nerfstudio's do; alpha is alpha, unless there is an image
            beneath it, which is refused.
        alpha: colours are ``straight`` or ``premultiplied``; None: as the edges of some images show.
        depth: folder, of any place or in the scene's, of training images' depth, .npy or PNG of 16 bits,
            named as they are; a folder ``confidence`` beside it is read likewise. None: ``depth_file_path``
            of the frames, where they have it; ``off``: none is used.
        depth_kind: in the file's units along the optical ``axis`` or the pixel's ``ray``; ``relative``, but
            for a scale and a shift of each image; ``inverse``, 1 / depth likewise. Points that never move
            tell both. None: along the axis, unless views agree much better along rays, which is refused.
        depth_scale: units of the file for one unit of a metric depth; None: its ``depth_unit_scale_factor``,
            or a thousandth of a PNG, 1 of .npy.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and key.
    """
    one_of(masks, "data.masks", "alpha", "ignore", "off", None)
    one_of(scale, "data.scale", *SCALES)
    whole(test_every, "data.test_every", 2)
    one_of(normalise, "data.normalise", True, False)
    depth_kind = "axis" if depth_kind == "metric" else depth_kind  # as older runs have it
    one_of(depth_kind, "data.depth_kind", *METRIC, "relative", "inverse", None)
    is_metric = depth_kind in (*METRIC, None)
    if not isinstance(depth, (str, Path, type(None))):
        raise mismatch("data.depth", "a folder, off or null", repr(depth))
    folder, ordered = scene_folder(root, scene, "nerfstudio"), []
    file = folder / FILE
    if layout_of(folder) == "LLFF":
        if axes == "opencv" or inverse:
            expected = (
                f"none with {llff.FILE}, whose rows are camera-to-world with axes down, right, backwards"
            )
            key = "data.axes" if axes == "opencv" else "data.inverse"
            raise mismatch(key, expected, axes if axes == "opencv" else inverse, "leave it out")
        file, (content, ordered) = folder / llff.FILE, llff.as_transforms(folder, near, far)
    else:
        content = stated(read_json(file))
    entries, absent, assumed = _read_entries(file, content, scale, axes, inverse, masks)
    assumed += ordered + mixed_linear({entry.path: entry.header for entry in entries}, file)
    beside = [] if depth in (None, "off") else [file.parent / depth]
    units = {key: content[key] for key in (_UNIT, "depth_scale") if content.get(key) is not None}
    content = {key: value for key, value in content.items() if key != _UNIT}
    if depth_scale is None and units:
        key, unit = units.popitem()
        if units and units[_UNIT] != unit:
            advice = f"remove {key} or {_UNIT}"
            raise mismatch(f"{file}: {key}", f"the unit that {_UNIT} says, {units[_UNIT]}", unit, advice)
        depth_scale = number_or_none(unit, f"{file}: {key}", 1 / MOST_UNITS)
    assumed += unread_beside(file, content, [entry.path for entry in entries], beside)
    names = [entry.name for entry in entries]
    cameras = [entry.camera for entry in entries]
    times, told = times_of(names, [entry.time for entry in entries], str(file), name_pattern, cameras)
    if name_pattern is not None and all(entry.taken_by is None for entry in entries):
        cameras = read_names(names, str(file), name_pattern).cameras or [None] * len(names)
        entries = [replace(entry, taken_by=camera) for entry, camera in zip(entries, cameras)]
    given = {entry.name: entry.time for entry in entries}
    entries = [replace(entry, time=time) for entry, time in zip(entries, times)]
    entries.sort(key=lambda entry: entry.time)
    views = in_order({entry.taken_by for entry in entries} - {None})
    by_name = test_cameras is not None or test_moments is not None
    if by_name and not views:
        advice = "write a name or a number in each frame"
        raise mismatch("data.test_cameras", f"a camera in the frames of {file}", "none", advice)
    parts, how = {"train": entries, "val": [], "test": []}, "cameras and moments held out by name"
    if not by_name:
        parts, how = _split_entries(file, content, entries, test_every, absent)
    cut_out = {split: [e.load for e in part if e.is_cut_out] for split, part in parts.items()}
    paths = {split: [load.path for load in loads] for split, loads in cut_out.items()}
    premultiplied, multiplied = alpha_of(alpha, paths, file)
    assumed += multiplied
    for split, loads in cut_out.items():
        for load in loads:  # none is decoded yet
            load.premultiplied = premultiplied[split]
    if parts["val"] and parts["val"] == parts["test"]:
        assumed.append(f"{file}: val_filenames equals test_filenames: validation is on the test frames")
    of_splits = {split: {e.name: given[e.name] for e in part} for split, part in parts.items()}
    if name_pattern is None:
        assumed += check_times(of_splits, str(file), {e.name: e.camera for e in entries})
    near, far = number_or_none(near, "data.near"), number_or_none(far, "data.far", 1 / MOST_UNITS)
    near = number_or_none(content.get("near"), f"{file}: near") if near is None else near
    far = number_or_none(content.get("far"), f"{file}: far", 1 / MOST_UNITS) if far is None else far
    bounds = _bounds(file, content, box)
    shown = (e for e in entries if e.load.mask or (e.is_cut_out and bool((e.load()[..., 3] < 255).any())))
    has_alpha = (first := next(shown, None)) is not None
    if has_alpha and masks is None and hides_image(first.load()):
        expected, got = "one colour where pixels are transparent", "an image beneath them too"
        advice = "set data.masks=alpha if that is beside the subject, data.masks=off if alpha is of other use"
        raise mismatch(first.path, expected, got, advice)
    if masks is None and entries[0].beside["load_valid"] is not None:
        line = "dark pixels of mask_path are not trained or measured on"
        assumed.append(f"{file}: {line}; if they are beside a subject to cut out, set data.masks=alpha")
    options = {"near": near, "far": far, "box": bounds, "normalise": normalise, "cut_out": has_alpha}
    space, seen = space_of([entry.camera for entry in entries], str(file), **options)

    cloud = _points_of(file, content)
    still = None if cloud is None else space.to_scene(read_cloud(cloud, 3)).float()
    depths, place = {}, None if depth in (None, "off") else file.parent / depth
    if depth is None:
        depths, lines = depths_named({e.name: e.depth for e in parts["train"] if e.depth is not None})
        assumed += lines
    elif place is not None:
        depths = depths_beside(place, [entry.name for entry in parts["train"]])
    if depths and not is_metric and still is None:
        advice = "write points.npy, or set data.depth_kind=axis"
        raise mismatch("data.depth_kind", "points that never move, to fit depth to", "none", advice)

    def sensed(name: str, camera: Camera) -> SensedDepth | None:
        if (path := depths.get(name)) is None:
            return None
        unit = 1.0
        if is_metric:
            unit = (MILLIMETRES if path.suffix == ".png" else 1.0) if depth_scale is None else depth_scale
            unit = number(unit, "data.depth_scale", 1 / MOST_UNITS, MOST_UNITS) * space.scale
        top = place or file.parent / path.relative_to(file.parent).parts[0]
        return SensedDepth(path, camera, unit, confidence_of(path, top), depth_kind or "axis", still)

    def frame(e: ImageEntry) -> Frame:
        camera_id, camera = None if e.taken_by is None else views.index(e.taken_by), space.camera(e.camera)
        beside = {**e.beside, "load_sensed": sensed(e.name, camera)}
        return Frame(e.name, e.time, camera, e.load, **beside, camera_id=camera_id, moment=e.moment)

    train, val, test = (tuple(map(frame, parts[split])) for split in SPLITS)
    refuse_copied_poses((*train, *val, *test), file)
    fits = f"set data.depth_kind=relative, or inverse if it is 1 / depth, which fits each to {POINTS}"
    keys = {"unit": "set data.depth_scale={}", "stretched": f"{fits}, or data.depth=off to do without"}
    assumed += doubt_depths(train, space.scale, depth_kind, place or file, **keys)
    ranks = {time: n for n, time in enumerate(sorted({*times}))}
    moments = {e.name: ranks[e.time] if e.moment is None else e.moment for e in entries}
    held = held_cameras(test_cameras, views, []), held_moments(test_moments, max(moments.values()) + 1)
    if by_name:
        train, test = split_rig(((moments[f.name], f) for f in train), *held)
    if not isinstance(moving_from := content.get("moving_from", "moving_path of the frames"), str):
        raise mismatch(f"{file}: moving_from", "text", short(moving_from))
    is_given = name_pattern is None and given[entries[0].name] is not None
    start = middle_of(frame.time for frame in train)
    count, rigged = sum(f.load_sensed is not None for f in train), by_name or None
    ignored = "ignore: PSNR is of the pixels that count, other metrics see the true colour elsewhere"
    if cloud is None and "ply_file_path" in content:
        assumed.append(f"{file}: ply_file_path names no file: there are no points to begin from")
    if still is not None and cloud.suffix == ".ply":
        line = f"its {len(still)} points are taken for points that never move"
        assumed.append(f"{cloud}: {line}; remove it if the subject is among them")
    protocol = {
        "dataset": "video_with_poses",
        "resolution": [train[0].camera.width, train[0].camera.height],
        "times": "as given" if is_given else "from the images' names",
        "split": how,
        "test_frames": len(test),
        "normalisation": space.told,
        "near": space.near,
        "far": space.far,
        "derived": [name for name in ("near", "far", "box") if options[name] is None],
        "views": len(views) or None,
        "test_cameras": rigged and [views[k] for k in held[0]],
        "test_moments": rigged and sorted(held[1]),
        "masks": train[0].load_valid and ignored,
        "moving": train[0].load_moving and moving_from,
        "seconds": number_or_none(content.get("seconds"), f"{file}: seconds"),
        "depth": f"{depth_kind or 'axis'}, of {count} of {len(train)} training frames" if depths else None,
        "assumed": [*assumed, *filter(None, [told])] or None,
    }
    return Scene(scene, train, val, test, seen, start, has_alpha, protocol=protocol, still=still, world=space)


def _points_of(file: Path, content: dict) -> Path | None:
    """Find points that never move: ``points.npy``, the file's ``ply_file_path``, or ``sparse_pc.ply``."""
    named = content.get("ply_file_path", "sparse_pc.ply")
    paths = file.parent / POINTS, inside(file.parent, named, f"{file}: ply_file_path")
    return next((path for path in paths if path.is_file()), None)


@dataclass(frozen=True)
class ImageEntry(ListedImage):
    """A checked frame: ``name`` is its path without its suffix; ``is_cut_out`` says whether its own alpha may
    cut it out; ``beside`` are the masks ``load_valid``, ``load_moving`` and ``load_resting`` of a ``Frame``.
    """

    name: str
    load: StoredImage
    is_cut_out: bool
    beside: dict
    taken_by: str | None
    moment: int | None
    depth: Path | None


def _read_entries(
    file: Path, content: dict, scale: int, axes: str | None, inverse: bool, masks: str | None
) -> tuple[list[ImageEntry], set[str], list[str]]:
    """Read all frames of a nerfstudio-style ``transforms.json``; masks that ignore are decoded.

    Args:
        file, content, scale, axes, inverse: as of ``read_frames``.
        masks: see ``read_scene``.

    Returns:
        the entries, the names of those left out, and lines that say what was assumed.

    Raises:
        SceneError: for every key or image that is missing or wrong.
    """
    images, assumed = read_frames(file, content, axes=axes, inverse=inverse, scale=scale)
    entries, has_mask, dark = [], [], []
    for key in ("mask_path", "moving_path", "resting_path") if scale > 1 else ():
        if key == "mask_path" and masks == "off":
            continue
        named = [image for image in images if image.entry.get(key) is not None]
        small = [_mask_of(image, key, scale) for image in named]
        full = [image_of(image.entry, key) for image in named]
        refuse_other_sizes(full, small, are_masks=True)
    for image in images:
        mask, valid, entry, has_alpha = None, None, image.entry, image.header.has_alpha
        if masks != "off":
            mask = _mask_of(image, "mask_path", scale)
        if masks == "ignore" and mask is None and not has_alpha:
            expected = "a mask_path or alpha, as data.masks=ignore"
            raise mismatch(image.path, expected, "neither", "set data.masks=null")
        if masks != "alpha" and (mask or masks == "ignore"):
            valid = StoredMask(mask or image.path, image.header.size, of_alpha=mask is None)
            if valid.is_dark():
                dark.append(valid)
                continue
        opaque = masks == "off" or (masks == "ignore" and mask is None)
        load = StoredImage(image.path, image.header.size, mask=None if valid else mask, opaque=opaque)
        has_mask.append(mask is not None)
        name = _name_of(file.parent, entry.own.get("file_path"), entry.where("file_path"))
        beside = {"load_valid": valid}
        for kind in ("moving", "resting"):
            path = _mask_of(image, f"{kind}_path", scale)
            beside[f"load_{kind}"] = path and MovingMask(path, image.header.size)
        taken_by = entry.own.get("camera")
        taken_by = int(taken_by) if isinstance(taken_by, float) and taken_by.is_integer() else taken_by
        taken_by = str(taken_by) if type(taken_by) in (str, int) else None  # an object is another program's
        moment = whole(entry.own["moment"], entry.where("moment"), 0) if "moment" in entry.own else None
        depth = entry.path("depth_file_path") if "depth_file_path" in entry.own else None
        entries.append(
            ImageEntry(
                **vars(image),
                name=name,
                load=load,
                is_cut_out=has_alpha and not opaque,
                beside=beside,
                taken_by=taken_by,
                moment=moment,
                depth=depth,
            )
        )
    if dark:
        names = f"{len(dark)} masks are dark everywhere ({dark[0].path.name}{', ..' * (len(dark) > 1)})"
        assumed.append(f"{file}: {names}: nothing counts in their frames, which are left out")
        if not entries:
            dark[0]()  # refuses it
    for key, given in (
        ("mask_path", has_mask),
        ("moving_path", [e.beside["load_moving"] is not None for e in entries]),
        ("camera", [e.taken_by is not None for e in entries]),
        ("moment", [e.moment is not None for e in entries]),
        ("file_path: alpha", [e.is_cut_out or e.load.mask is not None for e in entries]),
    ):
        if any(given) and not all(given):
            got = f"{sum(given)} of {len(given)} and none in frames[{given.index(False)}]"
            raise mismatch(f"{file}: frames: {key}", "one in all frames or in none", got)
    names = [entry.name for entry in entries]
    for name, count in Counter(names).most_common(1):
        if count > 1:
            raise mismatch(f"{file}: frames", "each image once", f"{name} twice", "remove one")
    if axes is None:
        poses = [e.camera.camera_to_world for e in entries]
        assumed += check_directions(poses, str(file), inverse=inverse)
    listed = {_name_of(file.parent, frame.get("file_path"), f"{file}: frames") for frame in content["frames"]}
    return entries, listed - {*names}, assumed


def _mask_of(image: ListedImage, key: str, scale: int) -> Path | None:
    """Find the mask of an image, in a folder of the ``scale`` or else as large as the full-size image; None
    without such a key.

    Raises:
        SceneError: for a mask that is not as large.
    """
    entry, size = image.entry, image.header.size
    if entry.get(key) is None:
        return None
    path = image_of(entry, key)
    is_at_top = path.parent == entry.file.parent
    small = path if is_at_top else image_of(entry, key, scale)
    if scale == 1 or not (is_at_top or (path.is_file() and not small.is_file())):
        inspect_image(small, size, f" as {image.path.name}")
        return small
    found = inspect_image(path).size
    if any(abs(n - big / scale) >= 1 for n, big in zip(size, found)):
        raise mismatch(path, f"{by(scale * n for n in size)} pixels as {image.path.name}", by(found))
    return path


def _name_of(folder: Path, value: object, where: str) -> str:
    """Name an image by its path without the suffix."""
    path = inside(folder, value, where)
    return path.relative_to(folder).as_posix().removesuffix(path.suffix if path.suffix in SUFFIXES else "")


def _split_entries(
    file: Path, content: dict, entries: list[ImageEntry], test_every: int, absent: set[str]
) -> tuple[dict, str]:
    """Split the entries; also say in words how.

    Args:
        file, content: where ``<split>_filenames`` may list frames; what no list names trains, or tests where
            the training frames are listed.
        entries: in the order of time.
        test_every: every n-th is a test frame where nothing is listed, the first and the last never; of three
            frames or more at least one.
        absent: names of frames without an image, which a list may have.

    Raises:
        SceneError: for a list that names no frame or one of another list, but for equal val and test lists,
            and where a split is empty.
    """
    listed = [split for split in SPLITS if f"{split}_filenames" in content]
    if listed:
        names = {split: _listed(file, content, f"{split}_filenames", entries, absent) for split in listed}
        everywhere = set().union(*names.values())
        is_both = "val" in names and names["val"] == names.get("test")
        pairs = [pair for pair in combinations(listed, 2) if not (is_both and pair == ("val", "test"))]
        for one, other in pairs:
            if both := names[one] & names[other]:
                lists, got = f"{one}_filenames and {other}_filenames", f"{min(both)} in both"
                advice = "remove it from one" if len(both) == 1 else f"remove all {len(both)} from one"
                raise mismatch(file, f"{lists} that share no file", got, advice)
        parts = {split: [e for e in entries if e.name in names.get(split, ())] for split in SPLITS}
        for home in [split for split in ("train", "test") if split not in listed][:1]:
            parts[home] = [entry for entry in entries if entry.name not in everywhere]
        how = "as listed in the file"
        if not parts["test"] and names.get("test") and names["test"] <= absent:  # never rendered
            parts["train"], parts["test"] = hold_out_every(parts["train"], test_every)
            how += f", no image of test_filenames is there: every {test_every}th training frame held out"
    else:
        if len(entries) < 3:
            advice = "take more images; of two, name one in test_filenames"
            raise mismatch(file, "at least 3 images, one of them to test on", len(entries), advice)
        train, test = hold_out_every(entries, test_every)
        parts = {"train": train, "val": [], "test": test}
        how = f"every {test_every}th frame held out"
    for split in ("train", "test"):
        if not parts[split]:
            advice = f"name some in {split}_filenames"
            raise mismatch(file, f"a frame to {split} on", f"none of {len(entries)}", advice)
    return parts, how


def _listed(file: Path, content: dict, key: str, entries: list[ImageEntry], absent: set[str]) -> set[str]:
    """Read the frame names in the list of paths, or of their last parts where these tell one frame, at
    ``content[key]``; refuse names that are no frame.
    """
    value, where = content[key], f"{file}: {key}"
    if not isinstance(value, list):
        raise mismatch(where, "a list of paths", short(value))
    names = {_name_of(file.parent, path, f"{where}[{i}]") for i, path in enumerate(value)}
    frames, last = absent | {entry.name for entry in entries}, {}
    for frame in sorted(frames):
        last.setdefault(os.path.basename(frame), []).append(frame)
    found = {name: [name] if name in frames else last.get(name, []) for name in names}
    for name in sorted(names):
        if len(found[name]) != 1:
            like = f", which is {' or '.join(found[name][:2])}; write the whole path" if found[name] else ""
            advice = "" if like else "remove it from the list, or add its frame"
            raise mismatch(where, "paths of frames", short(name) + like, advice)
    return {frame for (frame,) in found.values()}


def _bounds(file: Path, content: dict, box: Sequence[float] | None) -> Box | None:
    """Take the box, in the file's units, from the config, else from the file, else None."""
    corners = content.get("aabb")
    if box is not None or corners is None:
        return box_of(box)
    try:
        return Box(*(tuple(number(v, "aabb", -MOST_UNITS, MOST_UNITS) for v in corner) for corner in corners))
    except (TypeError, ValueError) as error:
        expected = "[[x0, y0, z0], [x1, y1, z1]], each low end below its high end"
        raise mismatch(f"{file}: aabb", expected, short(corners)) from error


def write_scene(
    folder: str | Path,
    shots: Iterable[PosedShot],
    *,
    near: float | None = None,
    far: float | None = None,
    aabb: Box | None = None,
    points: np.ndarray | None = None,
    seconds: float | None = None,
    moving_from: str | None = None,
    mask: str | None = None,
) -> None:
    """Write a scene that ``read_scene`` reads; ``transforms.json`` is removed first and written last.

    Args:
        shots: consumed one by one; all or none have a split.
        near, far, aabb, points: where known, in the units of the cameras' places; ``points`` (N, 3) never
            move.
        seconds: between times 0 and 1.
        moving_from: who says what moves.
        mask: path in ``folder``, written by the caller, of an image that is dark where no frame counts.

    Raises:
        ValueError: for a shot that ``read_scene`` would refuse.
    """
    folder = Path(folder)
    remove(folder, FILE, POINTS, "confidence/**/*.npy")  # which is read wherever a depth is
    entries, lists, taken = [], {split: [] for split in ("", *SPLITS)}, set()
    for shot in shots:
        entries.append(_write_shot(folder, shot, taken) | stated({"mask_path": mask}))
        lists[shot.split].append(entries[-1]["file_path"])
    common = {key: entries[0][key] for key in _OF_CAMERA if entries and key in entries[0]}
    common = {key: value for key, value in common.items() if all(e.get(key) == value for e in entries)}
    content = {**common, **{f"{split}_filenames": lists[split] for split in SPLITS if lists[split]}}
    corners = None if aabb is None else [aabb.low, aabb.high]
    content |= stated({"near": near, "far": far, "seconds": seconds, "moving_from": moving_from})
    content |= stated({"aabb": corners})
    content["frames"] = [{k: v for k, v in entry.items() if k not in common} for entry in entries]
    write_array(folder / POINTS, points if points is not None and len(points) else None, np.float64)
    write_json(folder / FILE, content)


def _write_shot(folder: Path, shot: PosedShot, taken: set[str]) -> dict:
    """Write an image and make its entry; ``taken`` are the names so far, to which this one's is added."""
    camera = shot.camera
    stem, suffix = os.path.splitext(shot.name)
    name = _name_of(folder, f"images/{shot.name}", f"shots: {shot.name!r}")
    one_of(suffix, f"{shot.name}: suffix", *SUFFIXES)
    if name in taken:
        raise mismatch(shot.name, "names that differ without their suffix", "two alike")
    taken.add(name)
    if shot.split != "":
        one_of(shot.split, f"{shot.name}: split", *SPLITS)
    if camera.skew:
        raise mismatch(shot.name, "a camera without skew", f"a skew of {camera.skew:g}")
    shapes = [(camera.height, camera.width, channels) for channels in (3, 4)]
    channels = 2 if suffix.lower() == ".png" else 1  # a JPEG has no alpha
    pixels = check_pixels(shot.name, shot.pixels, *shapes[:channels])
    entry = {"file_path": f"images/{shot.name}", "w": camera.width, "h": camera.height, "fl_x": camera.fx}
    entry |= {"fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "camera_model": "OPENCV"}
    if camera.lens is not None:
        entry |= dict(zip(("k1", "k2", "k3", "p1", "p2"), camera.lens.k + camera.lens.p))
    entry |= stated({"time": number_or_none(shot.time, f"{shot.name}: time", most=1)})
    entry["transform_matrix"] = opengl_rows(camera.camera_to_world, shot.name)
    entry |= stated({"camera": shot.taken_by, "moment": shot.moment})
    write_image(folder / entry["file_path"], pixels)
    if shot.depth is not None:
        entry["depth_file_path"] = f"depth/{stem}.npy"
        write_array(folder / entry["depth_file_path"], shot.depth)
    if shot.confidence is not None:
        trust = np.asarray(shot.confidence)
        write_array(folder / f"confidence/{stem}.npy", trust / LEVELS if trust.dtype.kind in "iu" else trust)
    for kind, mask in (("moving", shot.moving), ("resting", shot.resting)):
        if mask is not None:
            mask = np.uint8(255) * np.asarray(mask, bool)
            entry[f"{kind}_path"] = f"{kind}/{stem}.png"
            write_image(folder / entry[f"{kind}_path"], check_pixels(shot.name, mask, shapes[0][:2]))
    return entry
