"""Read what the frames of every ``transforms*.json`` have in common, whatever its layout.

Intrinsics are ``fl_x fl_y cx cy w h k1 k2 k3 p1 p2 camera_model``, ``camera_angle_x`` or ``camera_angle_y``
alone, or a matrix such as ``cam_K``, at the top of the file or in a frame. A pose is camera-to-world with
OpenGL's axes (x right, y up, looking along -z), unless the caller says otherwise. What a file leaves open is
assumed here, in one way, and told in a line.
"""

from __future__ import annotations

import math
import os
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from reprlib import repr as short
from typing import TypeVar

import numpy as np
import torch

from forewarp.data.cameras import FLIP, IN_PIXELS, SPLITS, check_camera, pose_of
from forewarp.data.files import (
    SIDE,
    SUFFIXES,
    Entry,
    SceneError,
    existing,
    frames_of,
    mismatch,
    nearly,
    one_of,
    side_files,
)
from forewarp.data.images import TURN, Header, by, exif_turned, inspect_image, refuse_other_sizes
from forewarp.data.names import LEAST_SPAN, in_order, name_parts, read_names, refuse_far
from forewarp.ops.backend import is_number
from forewarp.scene.camera import Camera, Lens

Thing = TypeVar("Thing")
MODELS = ("OPENCV", "PINHOLE", "RADIAL", "SIMPLE_RADIAL", "SIMPLE_PINHOLE")
# Keys of programs that say that the lens is none of these, whatever k1 .. say, or say which it is.
_LENSES = ("is_fisheye", "fisheye", "ftheta_p0", "latlong", "equirectangular", "panorama", "orthographic")
_NAMES_LENS = re.compile(r"(?i)((camera|lens|distortion|projection)_?)?(model|type|projection|lens)")
_NO_PINHOLE = re.compile(
    "(?i)fish|equi(dist|rect|sol)|pano|spheric|omnidir|ortho|lat_?long|cylind|kannala|thin_?prism|ftheta"
)
_UNREAD_LENSES = ("distortion_params", "distortion", "dist_coeffs", "distortion_coefficients", "dist")
LIKE_LENS = re.compile(
    r"(?i)(k_?[1-9]|kappa_?\d|p_?[12]|radial.*|tangential.*|brown.*|.*distort.*|dist_?coe.*|rolling_shutter.*"
    r"|ocam.*|xi|c_?[xy]|pp_?[xy]|principal_?point.*|shift_?[xy])"
)
_LENS_TERMS = ("k1", "k2", "k3", "p1", "p2")
_TERMS = {"PINHOLE": 0, "SIMPLE_PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2}  # of these that models have
_LENS = (*_LENS_TERMS, "cx", "cy")
_LIKE_SPLIT = re.compile(
    "(?i)(is_?)?(train(ing)?|val(idation)?|test(ing)?|eval(uation)?|(hold|held)_?out)"
    "(_?(frames?|ids?|idxs?|ind(ex|ices)|images?|views?|files?|split|set))?|splits?|(is_?)?bad"
)
_PATHS = ("file_path", "mask_path", "depth_file_path", "moving_path", "resting_path")
_READ = {*_PATHS, "depth_scale", *_LENS, *_UNREAD_LENSES}  # or told elsewhere
# Matrices of intrinsics, as programs call them.
_INNER = ("cam_K", "K", "intrinsics", "intrinsic", "intrinsic_matrix", "camera_intrinsics", "camera_matrix")
_LIKE_ANGLE = re.compile("(?i)([hvxy]_?)?(fov|field_of_view)(_?([hvxy]|deg|degrees|rad|vert.*|hor.*))?")
_LIKE_FOCAL = re.compile("(?i)fx|f|focal(_?len(gth)?)?(_?x)?|flx")
_HAS_FOCAL = re.compile(
    "(?i)fl_?x|fx|focal(_?length)?(_?[xy])?|camera_angle_[xy]|k|cam_k|intrinsics?|(camera|intrinsic)_matrix"
)
_CUT_OUT = re.compile("(?i)(white|black)_?(is_?)?(transparent|bkgd|background)")  # of images without alpha
_FOCAL = ("fl_x", "fl_y", "camera_angle_x")
_SAME_FOCAL = 0.02  # share by which two focal lengths of one camera may differ
_SAME_ZOOM = 0.002  # share by which a frame's own angle may differ, rounded, from a focal length of all
_RESIZED = 0.1  # by which more or less than half of both sides it is another image's, unless w and h say not
_OUTSIDE = 0.9  # share of a side beyond which a principal point is another image's
_TIMES = ("timestamp", "time_stamp", "frame_time", "time_id", "t", "frame_id", "frame")  # of programs
_MOST_TIME = 1e20
_OWN_NUMBERS = 0.5  # share of training's span that frames of an own numbering leave, and of these that tell
_LEAST_EVEN, _OWN_STEPS = 3, 2.0  # frames of even times that tell; steps by which a split's differ, at least
_LEAST_UNIT = 0.5  # of all times, that those in [0, 1] span
_ROUNDING = 1e-6  # beyond 0 and 1
_FEW = 0.1  # share of the frames, one at least, whose times are in doubt where those of all others agree
_LEAST_FRAMES = 8  # from which on their order tells
_APART = 3.0  # longest steps of all other times, by which one is far from them


@dataclass(frozen=True)
class ListedImage:
    """A frame of a file whose image is there: ``camera`` in the file's units, at the size of the image, its
    near and far 0; ``time`` in any unit, None where the frame has none.
    """

    entry: Entry
    path: Path
    header: Header
    camera: Camera
    time: float | None


def read_frames(
    file: Path,
    content: dict,
    *,
    axes: str | None,
    inverse: bool,
    scale: int = 1,
    longer: bool = False,
    optional: bool = False,
) -> tuple[list[ListedImage], list[str]]:
    """Read all frames of a file in its order, less those without an image.

    Args:
        file: for errors and as the place that paths start from.
        content: content of the file.
        axes, inverse: of its poses, see ``pose_in``.
        scale: take images that are ``scale`` times smaller, from ``images_4`` in place of ``images``.
        longer: see ``camera_of``.
        optional: no image need be there.

    Returns:
        the frames, and lines that say what was assumed.

    Raises:
        SceneError: for every key or image that is missing or wrong.

    Cost: one read of each PNG, of a JPEG's beginning and end.
    """
    entries, unread = with_intrinsics(frames_of(file, content), str(file))
    paths = [image_of(entry, "file_path", scale) for entry in entries]
    if optional and not any(map(os.path.isfile, paths)):
        return [], [f"{file}: none of its {len(paths)} images is there: left out", *unread]
    there, assumed = with_images(list(zip(entries, paths)), paths, str(file))
    if scale > 1:
        whole = [image_of(entry, "file_path") for entry, _ in there]
        refuse_other_sizes(whole, [path for _, path in there])
    images = []
    for entry, path in there:
        header, pose = inspect_image(path), pose_in(entry, axes, inverse)
        camera = camera_of(entry, header.size, scale, path, pose=pose, longer=longer)
        time = entry.number("time", -_MOST_TIME, _MOST_TIME) if "time" in entry.own else None
        images.append(ListedImage(entry, path, header, camera, time))
    bare = [path for entry, path in there if Path(entry.get("file_path")).suffix not in SUFFIXES]
    assumed += beside_images(bare, f"{file}: file_path", "write the one that is meant, or remove the others")
    assumed += unread + exif_turned([image.path for image in images if image.header.is_turned], file)
    assumed += _beyond_model(image.entry for image in images)
    keys = [] if any("time" in entry.own for entry in entries) else _TIMES
    like_times = [key for key in keys if all(type(entry.own.get(key)) in (int, float) for entry in entries)]
    for key in like_times[:1]:
        assumed.append(f"{file}: {key} of the frames is not read; call it time, if it is that")
    return images, assumed + left_aside((image.entry, image.camera) for image in images)


def beside_images(images: Iterable[Path], where: str, advice: str) -> list[str]:
    """Say in a line where an image that is named without a suffix has another of its name beside it.

    Args:
        images: that are named so, and read.
        where: what names them.
        advice: what to do.
    """
    for path in images:
        others = [path.with_suffix(s) for s in SUFFIXES if s.lower() != path.suffix.lower()]
        if other := next((other for other in others if os.path.isfile(other)), None):
            return [f"{where}: no suffix: {path.name} is read, not {other.name} beside it; {advice}"]
    return []


def _beyond_model(entries: Iterable[Entry]) -> list[str]:
    """Say in a line where a camera model has no such term of a lens as is there."""
    for entry in entries:
        model = entry.get("camera_model")
        beyond = _LENS_TERMS[_TERMS.get(model, len(_LENS_TERMS)) :]
        if key := next((key for key in beyond if entry.get(key) not in (None, 0)), None):
            said = f"{model} has no {key}, which is {short(entry.get(key))} and is undone"
            advice = f"write camera_model OPENCV if that is right, or {key} 0 if the images have no such lens"
            return [f"{entry.where('camera_model')}: {said}; {advice}"]
    return []


def unread_beside(
    file: Path, content: dict, images: Sequence[Path], beside: Sequence[Path] = ()
) -> list[str]:
    """Say in lines which keys of a file, and which files beside its images, look like masks, depth or a lens
    and are not read.

    Args:
        file, content: of the frames.
        images: that are read.
        beside: folders that are read as well.
    """
    entries = frames_of(file, content)
    named = [entry.get(key) for entry in entries for key in _PATHS]
    read = [*images, *beside, file.parent / "confidence"]
    read += [file.parent / os.path.normpath(path) for path in named if isinstance(path, str)]
    folders = [file.parent, *(image.parent for image in images)]
    lines = side_files(folders, read, "name them in each frame by mask_path or depth_file_path")
    keys = dict.fromkeys([*content, *(key for entry in entries for key in entry.own)])
    like = [key for key in keys if key not in _READ and (SIDE.search(key) or LIKE_LENS.fullmatch(key))]
    like += [key for key in ("lens",) if key in keys and isinstance(content.get(key), dict)]

    def is_said(value: object) -> bool:
        values = value if isinstance(value, list) else [value]
        return any(each not in (None, False, 0, "") for each in values)

    like = [key for key in like if any(is_said(entry.get(key)) for entry in entries)]
    has_own = any({"fl_x", "camera_angle_x"} & {*entry.own} for entry in entries)
    if (key := _cameras_elsewhere(content)) and not has_own:
        advice = "write fl_x, fl_y, cx, cy and the lens of its camera into each frame"
        lines.append(f"{file}: {key}: not read, which seems to be of each camera; {advice}")
    own = dict.fromkeys(key for entry in entries for key in entry.own if key not in _FOCAL)
    own = [key for key in own if _LIKE_FOCAL.fullmatch(key) or _LIKE_ANGLE.fullmatch(key)]
    if own:
        advice = "call a focal length in pixels fl_x, an angle in radians camera_angle_x"
        lines.append(f"{file}: frames: {own[0]}: not read, which seems to be of the camera; {advice}")
    cut = [key for key in keys if _CUT_OUT.fullmatch(key) and any(is_said(e.get(key)) for e in entries)]
    if cut:
        advice = "cut the subject out by alpha, or name masks by mask_path and set data.masks=alpha"
        lines.append(f"{file}: {cut[0]}: not read; where images show their background, {advice}")
    lines += _unread_splits(file, content, entries)
    if "depth_file_path" in entries[0].common:
        lines.append(f"{file}: depth_file_path at the top is not read; write that of each frame into it")
    if not like:
        return lines
    advice = "masks are read from mask_path, depth from depth_file_path, a lens from k1 k2 k3 p1 p2 and cx cy"
    said = f"{', '.join(like[:4])}: not read, which seem to be masks, depth or a lens"
    return [f"{file}: {said}; {advice}", *lines]


def _unread_splits(file: Path, content: dict, entries: Sequence[Entry]) -> list[str]:
    """Say in a line which keys seem to say what is trained and tested on, and are not read."""
    keys = [key for key in dict.fromkeys(key for entry in entries for key in entry.own)]
    keys = [key for key in keys if len({str(entry.own.get(key)) for entry in entries}) > 1]
    keys = [] if any(f"{split}_filenames" in content for split in SPLITS) else keys
    keys += [key for key, value in content.items() if isinstance(value, (list, dict)) and value]
    keys = [key for key in keys if _LIKE_SPLIT.fullmatch(key)]
    if not keys:
        return []
    is_one = file.stem == "transforms"
    how = "name frames in train_filenames and test_filenames" if is_one else "write each split into its file"
    said = f"{', '.join(keys)}: not read, which seem to say what is trained and tested on"
    return [f"{file}: {said}; {how}, and remove frames that are bad"]


def _cameras_elsewhere(content: Mapping) -> str | None:
    """Find the key that holds objects with a focal length, as of cameras that frames name; None without."""
    for key, value in content.items():
        inner = [value, *value.values()] if isinstance(value, dict) else value
        is_list = isinstance(inner, list) and key != "frames"
        for each in inner if is_list else ():
            if isinstance(each, dict) and any(_HAS_FOCAL.fullmatch(str(name)) for name in each):
                return key
    return None


def image_of(entry: Entry, key: str, scale: int = 1) -> Path:
    """Find the image that a key names, with or without its suffix, ``scale`` times smaller."""
    path = entry.path(key)
    if scale > 1 and path.parent == entry.file.parent:
        raise mismatch(entry.where(key), "images in a folder", path.stem, "set data.scale=1")
    folder = path.parent if scale == 1 else path.parent.with_name(f"{path.parent.name}_{scale}")
    return with_suffix(folder / path.name)


def camera_of(
    entry: Entry,
    stored: tuple[int, int],
    scale: int,
    image: Path,
    *,
    pose: torch.Tensor,
    longer: bool = False,
) -> Camera:
    """Read the camera of an image of ``stored`` pixels (width, height), its near and far 0.

    Args:
        entry: whose intrinsics are of an image ``scale`` times as large.
        stored: width and height of the image on disk.
        scale: see ``entry``.
        image: file of the image, for errors.
        pose: camera-to-world (4, 4) with OpenCV's axes.
        longer: ``camera_angle_x`` is the angle of the longer side, as Blender's is (sensor fit AUTO).

    Raises:
        SceneError: for a key that is missing, wrong or contradicts another, for a lens that is no pinhole
            with Brown's distortion or cannot be undone, and for intrinsics of a larger image.
    """
    model = entry.get("camera_model", "OPENCV")
    one_of(model, entry.where("camera_model"), *MODELS, advice="undistort the images")
    check_pinhole(entry)
    sizes = [entry.number(key, 1, 1e6, n * scale) for key, n in zip("wh", stored)]
    if any(abs(n - size / scale) >= 1 for n, size in zip(stored, sizes)):
        expected = " x ".join(f"{size / scale:g}" for size in sizes)
        factors = [n * scale / size for n, size in zip(stored, sizes)]
        advice = "write w and h of the images, and fl_x, fl_y, cx and cy in their pixels"
        if all(abs(n - size / scale) < 1 for n, size in zip(stored, sizes[::-1])):
            advice = TURN
        elif abs(factors[0] / factors[1] - 1) < _SAME_FOCAL:
            advice = f"multiply w, h, fl_x, fl_y, cx and cy by {factors[0]:.4g}, or resize the images"
        raise mismatch(image, f"{expected} pixels as {entry.where('w')} and h say", by(stored), advice)
    width, height = map(round, sizes)
    fx = _focal(entry, width, height, longer)
    fy = entry.number("fl_y", 0.01 * height, 100 * height, fx)
    if "fl_y" in entry.common and "fl_y" not in entry.own:  # of a zoom all keep the shape of their pixels
        of_all = entry.common.get("fl_x", None if "fl_x" in entry.own else fy)
        fy *= fx / of_all if is_number(of_all) and of_all > 0 else 1
    cx, cy = (entry.number(key, -n, 2 * n, n / 2) for key, n in (("cx", width), ("cy", height)))
    if entry.get("w") is None and (cx >= _OUTSIDE * width or cy >= _OUTSIDE * height):
        got = f"({cx:g}, {cy:g}) of images of {by(stored)} pixels"
        advice = "they are of larger images: divide fl_x, fl_y, cx and cy by how many times these are smaller"
        raise mismatch(entry.where("cx"), "a principal point inside the image", got, advice)
    across, down = 2 * cx / width, 2 * cy / height
    of_one_factor = down > 0 and abs(across / down - 1) < _SAME_FOCAL and abs(across - 1) > _RESIZED
    if entry.get("w") is None and entry.get("h") is None and of_one_factor:
        expected = "w and h beside a principal point that is not in the middle"
        got = f"none, and ({cx:g}, {cy:g}) of images of {by(stored)} pixels"
        advice = (
            "write w and h of these images if they were cropped; if resized, multiply fl_x, fl_y, cx and cy"
        )
        raise mismatch(entry.where("cx"), expected, got, f"{advice} by {1 / across:.4g}")
    k = tuple(entry.number(key, -1e6, 1e6, 0.0) for key in ("k1", "k2", "k3"))
    p = tuple(entry.number(key, -1e6, 1e6, 0.0) for key in ("p1", "p2"))
    for key in ("k4", "k5", "k6"):
        if entry.number(key, default=0.0) != 0:
            raise mismatch(entry.where(key), "0", entry.get(key), "undistort the images")
    for key in _UNREAD_LENSES:
        if entry.get(key) and not any(k + p):
            expected, got = "a lens as k1 k2 k3 p1 p2", short(entry.get(key))
            raise mismatch(entry.where(key), expected, got, "write its terms under these names")
    lens = Lens(k, p) if any(k + p) else None
    camera = Camera(width, height, fx, fy, cx, cy, pose, 0.0, 0.0, lens=lens)
    camera = camera.resized(*stored) if (width, height) != tuple(stored) else camera
    check_camera(camera, entry.where("cx"), entry.where("k1"))
    return camera


def check_pinhole(entry: Entry) -> None:
    """Refuse a camera whose file says that it is a fisheye, a panorama or orthographic, as programs write it.

    Raises:
        SceneError: naming the key.
    """
    for key, value in {**entry.common, **entry.own}.items():
        is_other = key in _LENSES and value not in (None, False, 0)
        if isinstance(value, str) and _NAMES_LENS.fullmatch(key):
            is_other = _NO_PINHOLE.search(value) is not None
        if is_other:
            raise mismatch(entry.where(key), "a pinhole camera", short(value), "undistort the images")


def _focal(entry: Entry, width: int, height: int, longer: bool) -> float:
    """Return the horizontal focal length in pixels, from ``fl_x``, ``fl_y``, ``camera_angle_x`` or, where it
    stands alone, ``camera_angle_y``; a frame's own number wins over one at the top.
    """
    least, most = 0.01 * width, 100 * width
    angle, of_all = entry.own.get("camera_angle_y"), [key for key in _FOCAL if key in entry.common]
    is_zoom = of_all and not any(key in entry.own for key in _FOCAL)
    if is_zoom and is_number(angle) and 0 < angle < math.pi:
        focals = [entry.common.get(key) for key in ("fl_x", "fl_y")]
        ratio = focals[0] / focals[1] if all(is_number(f) and f > 0 for f in focals) else 1.0
        focal = ratio * 0.5 * height / math.tan(0.5 * angle)
        usual = _focal(replace(entry, own={}), width, height, longer)
        return focal if abs(focal / usual - 1) > _SAME_ZOOM else usual
    named = next((key for key in ("fl_x", "fl_y") if entry.get(key) is not None), None)
    across = "camera_angle_x" if entry.get("camera_angle_x") is not None or named else "camera_angle_y"
    angle = entry.get(across)
    if named is None and angle is None:
        raise _no_focal(entry)
    if is_number(angle) and math.pi < angle < 180:
        advice = f"if it is in degrees, write {math.radians(angle):.6g}"
        raise mismatch(entry.where(across), "radians inside (0, pi)", angle, advice)
    if angle is not None:
        angle = entry.number(across, 0, math.pi)
        if angle in (0, math.pi):
            raise mismatch(entry.where(across), "radians inside (0, pi)", angle)
    half = None if angle is None else 2 * math.tan(0.5 * angle)
    if across == "camera_angle_y":
        return height / half
    across_pixels = (max(width, height) if longer else width) / half if half else None
    if named is None:
        return across_pixels
    if is_number(focal := entry.get(named)) and 0 < focal < least:
        expected = f"a focal length in pixels, of {least:g} to {most:g}"
        raise mismatch(entry.where(named), expected, focal, IN_PIXELS.replace("fl_x", named))
    focal = entry.number(named, least, most)
    offs = [0 if half is None else abs(side / half / focal - 1) for side in (width, height)]
    is_own = [any(key in entry.own for key in keys) for keys in (("camera_angle_x",), ("fl_x", "fl_y"))]
    if is_own == [True, False] and min(offs if height > width else offs[:1]) > _SAME_ZOOM:
        return across_pixels
    if ("camera_angle_x" in entry.own) == (named in entry.own) and min(offs) >= _SAME_FOCAL:
        told = 2 * math.atan(0.5 * width / focal)
        expected = f"{told:.4g} radians ({math.degrees(told):.1f} degrees), as {named} says"
        got = f"{angle:.4g} ({math.degrees(angle):.1f} degrees)"
        raise mismatch(entry.where("camera_angle_x"), expected, got, "remove the one that is wrong")
    return focal


def _no_focal(entry: Entry) -> SceneError:
    """Make the error that a camera has no focal length, naming a key that seems to tell it in another way."""
    for key, value in {**entry.common, **entry.own}.items():
        where, expected = entry.where(key), "fl_x or camera_angle_x"
        if _intrinsics(_transposed(value)) is not None:
            return mismatch(where, "intrinsics with the last row 0 0 1", short(value), "transpose it")
        if key in _INNER and value is not None:
            advice = "write it as fl_x, fl_y, cx and cy, in pixels"
            return mismatch(where, expected, short(value), advice)
        if _LIKE_ANGLE.fullmatch(key):
            down = "y" if re.search("(?i)^(v|y)|(v|y)$|vert", key) else "x"
            advice = f"call it camera_angle_{down}, in radians"
            return mismatch(where, expected, f"{key} {short(value)}", advice)
        if _LIKE_FOCAL.fullmatch(key):
            return mismatch(where, expected, f"{key} {short(value)}", "call it fl_x, in pixels")
    if key := _cameras_elsewhere(entry.common):
        advice = "write fl_x, fl_y, cx, cy and the lens of its camera into each frame"
        return mismatch(entry.where("fl_x"), "fl_x or camera_angle_x", f"{key}, which is not read", advice)
    return mismatch(entry.where("fl_x"), "fl_x or camera_angle_x", "neither")


def _transposed(value: object) -> object:
    """Transpose 3 x 3, 4 x 3 or 4 x 4 values, or nine in a row; leave others as they are."""
    if not isinstance(value, list):
        return None
    rows = [value[i : i + 3] for i in (0, 3, 6)] if len(value) == 9 else value
    are_rows = all(isinstance(row, list) and len(row) == len(rows[0]) for row in rows)
    return [list(column) for column in zip(*rows)] if are_rows else None


def with_intrinsics(entries: Sequence[Entry], where: str) -> tuple[list[Entry], list[str]]:
    """Write a matrix of intrinsics out as ``fl_x fl_y cx cy``, which win where both are at one place.

    Args:
        entries: the frames of a file.
        where: the file.

    Returns:
        the frames, and lines that say which matrices are not read.
    """
    read, told = [], {}
    for entry in entries:
        parts = {}
        for place in ("own", "common"):
            keys = getattr(entry, place)
            key = next((key for key in _INNER if _intrinsics(keys.get(key)) is not None), None)
            if key is not None:
                values = dict(zip(("fl_x", "fl_y", "cx", "cy"), _intrinsics(keys[key])))
                off = [k for k, v in values.items() if abs(_as_number(keys.get(k), v) / v - 1) > _SAME_FOCAL]
                if off and not told:
                    told[key] = f"{where}: {key} is left aside, as {off[0]} says another thing; remove one"
                parts[place] = {**({} if off else values), **keys}
        read.append(replace(entry, **parts) if parts else entry)
    for key, value in {**entries[0].common, **entries[0].own}.items():
        is_read = key in _INNER and _intrinsics(value) is not None
        is_other = key in _INNER and key not in told and isinstance(value, (list, dict)) and not is_read
        if is_other or (key not in _INNER and _intrinsics(value) is not None):
            line = f"{key} is not read, which seems to be intrinsics; write it as fl_x fl_y cx cy"
            told[key] = f"{where}: {line}"
    return read, list(told.values())


def _as_number(value: object, default: float) -> float:
    return value if isinstance(value, (int, float)) and abs(value) < _MOST_TIME else default


def _intrinsics(value: object) -> list[float] | None:
    """Return fx, fy, cx and cy of a matrix without skew, 3 x 3, 3 x 4 or 4 x 4, or nine numbers in a row;
    None where a value is none, such as a pose.
    """
    if not isinstance(value, list):
        return None
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    matrix = matrix.reshape(3, 3) if matrix.shape in ((9,), (1, 9)) else matrix
    if matrix.shape not in ((3, 3), (3, 4), (4, 4)) or matrix[:3, 3:].any():
        return None
    (fx, skew, cx), (zero, fy, cy), last = matrix[:3, :3].tolist()
    is_one = last == [0, 0, 1] and zero == 0 and abs(skew) <= 1e-6 * abs(fx)
    return [fx, fy, cx, cy] if is_one and min(fx, fy, cx, cy) > 0 and np.isfinite(matrix).all() else None


def left_aside(cameras: Iterable[tuple[Entry, Camera]]) -> list[str]:
    """Say in a line where ``camera_angle_y`` is another angle than the camera's, or no angle.

    One at the top says nothing of frames with a focal length or angle of their own.
    """
    for entry, camera in cameras:
        told, is_own = entry.get("camera_angle_y"), "camera_angle_y" in entry.own
        if told is None or (not is_own and any(key in entry.own for key in _FOCAL)):
            continue
        angle = 2 * math.atan(0.5 * camera.height / camera.fy)
        got = f"{short(told)}, no radians inside (0, pi),"
        if is_number(told) and 0 < told < math.pi:
            if abs(math.tan(0.5 * told) / math.tan(0.5 * angle) - 1) <= _SAME_FOCAL:
                continue
            got = f"{math.degrees(told):.1f} degrees"
        said = f"{got} left aside, as the other keys say {math.degrees(angle):.1f} degrees"
        return [f"{entry.where('camera_angle_y')}: {said}; write fl_y if they are wrong"]
    return []


def pose_in(entry: Entry, axes: str | None, inverse: bool) -> torch.Tensor:
    """Read a frame's ``transform_matrix``: camera-to-world (4, 4) float64 with OpenCV's axes.

    Args:
        entry: the frame.
        axes: of the camera in the file: opengl (or None) or opencv.
        inverse: the file's matrix is world-to-camera.

    Raises:
        SceneError: for another of ``axes`` or ``inverse``, for no matrix of a pose, or one in Mitsuba's axes.
    """
    one_of(axes, "data.axes", "opengl", "opencv", None)
    one_of(inverse, "data.inverse", True, False)
    if entry.get("from_mitsuba"):
        advice = "negate the first and the third column of each transform_matrix, and remove the key"
        raise mismatch(entry.where("from_mitsuba"), "poses in OpenGL's axes", "those of Mitsuba", advice)
    pose = pose_of(entry.own.get("transform_matrix"), entry.where("transform_matrix"))
    pose = np.linalg.inv(pose) if inverse else pose
    return torch.from_numpy(pose if axes == "opencv" else pose @ FLIP)


def with_suffix(path: Path) -> Path:
    """Find an image whose suffix a path may leave out; a PNG where none is there."""
    if path.suffix in SUFFIXES:
        return existing(path)
    named = [existing(path.with_name(path.name + suffix)) for suffix in SUFFIXES]
    return next((candidate for candidate in named if os.path.isfile(candidate)), named[0])


def hold_out_every(things: Sequence[Thing], every: int) -> tuple[list[Thing], list[Thing]]:
    """Split things in the order of time: each ``every``-th is held out, the first and the last never.

    >>> hold_out_every(range(10), 4)
    ([0, 1, 3, 4, 5, 7, 8, 9], [2, 6])
    """
    held, kept = slice(max(1, min(every // 2, len(things) - 2)), -1, every), list(things)
    del kept[held]
    return kept, list(things[held])


def with_images(things: Sequence[Thing], images: Sequence[Path], where: str) -> tuple[list[Thing], list[str]]:
    """Leave out what has no image, and say so.

    Args:
        things: one for each of ``images``.
        images: files that should be there.
        where: the file that lists them.

    Returns:
        the things whose image is there, and lines that say what was assumed.

    Raises:
        SceneError: where no image is there.
    """
    there = [os.path.isfile(image) for image in images]
    if all(there):
        return list(things), []
    missing = images[there.index(False)]
    instead = nearly(missing)
    if not any(there):
        raise mismatch(where, f"the images that it lists, as {missing}", "none of them", instead)
    count = f"{there.count(False)} of {len(there)}"
    line = f"{where}: {count} images are not there and left out ({missing.name}, ..)"
    line += f"; {instead}" if instead else ""
    return [thing for thing, is_there in zip(things, there) if is_there], [line]


def times_of(
    names: list[str],
    times: Sequence[float | None],
    where: str,
    pattern: str | None = None,
    cameras: Sequence[Camera] | None = None,
) -> tuple[list[float], str | None]:
    """Give each image a time in [0, 1], where the file has none by the numbers in the images' names.

    Images of several cameras with one number share a time. Times in the file that are not all in [0, 1], such
    as milliseconds or numbers of frames, are scaled to it.

    Args:
        names: paths of the images without suffix, ``cam01/0003``; of all splits together.
        times: what the file says.
        where: the file, for errors.
        pattern: see ``names.read_names``; with one names win over the file.
        cameras: of the images, whose places and directions tell cameras of a rig from parts of one film.

    Returns:
        the times, and a line that says what was assumed; None if the file has all times, in [0, 1] and well
        spread.

    Raises:
        SceneError: if only some images have a time, or names can be read in two ways.

    >>> times_of(["a/0001", "a/0003", "b/0001", "b/0003"], [None] * 4, "t.json")[0]
    [0.0, 1.0, 0.0, 1.0]
    >>> times_of(["a", "b", "c"], [300, 400, 500], "t.json")
    ([0.0, 0.5, 1.0], 't.json: all times lie from 300 to 500: taken as 0 to 1')
    """
    given = [time is not None for time in times]
    if pattern is None and all(given):
        first, last = min(times), max(times)
        span = f"all times lie from {first:.10g} to {last:.10g}"
        odd = _odd_time(names, times)
        if not _within_unit(times):
            length, taken = last - first, "taken as 0 to 1" if last > first else "taken as one moment"
            lines = [f"{span}: {taken}", odd]
            times = [(time - first) / (length or 1) for time in times]
        else:
            is_short = len(times) > 1 and last - first < LEAST_SPAN
            lines = [f"{span}, where 0 to 1 is the whole sequence" if is_short else "", odd]
            times = [min(max(time, 0.0), 1.0) for time in times]
        return times, f"{where}: {'; '.join(filter(None, lines))}" if any(lines) else None
    if pattern is None and any(given):
        got = f"{sum(given)} of {len(given)}, and none for {names[given.index(False)]}"
        raise mismatch(f"{where}: frames: time", "one in all frames or in none", got)
    why = "times in the frames are not read" if any(given) else "no time in the frames"
    views = None if cameras is None else _views_of(cameras)
    read = read_names(names, where, pattern, views)
    if read is None:
        order, last = in_order(range(len(names)), lambda i: names[i]), max(len(names) - 1, 1)
        line = f"{where}: {why}: spread evenly in the order of the images' names"
        return [rank / last for rank in np.argsort(order).tolist()], line
    return read.times, f"{where}: {why}: {read.how}"


def _odd_time(names: Sequence[str], times: Sequence[float]) -> str:
    """Say that a few times are out of the order of the numbers in the images' names, of one folder, or are
    those of other images, where all others follow it; nothing where they do not.
    """
    folders: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        folders.setdefault(name.rpartition("/")[0], []).append(i)
    for rows in folders.values():
        read, most = None, max(1, int(_FEW * len(rows)))
        with suppress(SceneError):  # names that do not tell
            read = read_names([names[i] for i in rows], "")
        if read is None or len(rows) < _LEAST_FRAMES:
            continue
        order = sorted(range(len(rows)), key=lambda k: (read.frames[k], times[rows[k]]))
        rows = [rows[k] for k in order]
        ascent = {*_longest_ascent(rows, times)}
        odd = [row for row in rows if row not in ascent]
        if 0 < len(odd) <= most:
            said = f"time {times[odd[0]]:.10g} of {names[odd[0]]} is out of the order of the images' names"
            return f"{said}; mend it, if it is wrong"
        time, count = Counter(times[i] for i in rows).most_common(1)[0]
        is_film = len({*read.frames}) == len(rows) and 1 < count < len(rows)
        if is_film and (count >= len(rows) - most or len(rows) - len({times[i] for i in rows}) <= most):
            some = ", ".join([names[i] for i in rows if times[i] == time][:2])
            said = f"{count} of {len(rows)} images have one time, {time:.10g} ({some}, ..)"
            return f"{said}; mend it, if it is wrong"
    return ""


def _longest_ascent(rows: Sequence[int], times: Sequence[float]) -> list[int]:
    """Return the most of the rows, in order, whose times never fall."""
    ends, last, before = [], [], {}
    for row in rows:
        at = bisect_right(ends, times[row])
        ends[at:], last[at:] = [times[row], *ends[at + 1 :]], [row, *last[at + 1 :]]
        before[row] = last[at - 1] if at else None
    chain, row = [], last[-1]
    while row is not None:
        chain.append(row)
        row = before[row]
    return chain[::-1]


def _views_of(cameras: Sequence[Camera]) -> list[list[float]]:
    """Return where cameras stand and look: positions, and directions as far away as all of them are apart."""
    poses = torch.stack([camera.camera_to_world for camera in cameras])
    places, axes = poses[:, :3, 3], poses[:, :3, 2]
    return torch.cat([places, axes * float((places - places[0]).abs().max())], 1).tolist()


def check_times(
    splits: Mapping[str, Mapping[str, float | None]], where: str, cameras: Mapping[str, Camera] | None = None
) -> list[str]:
    """Refuse times in two units, or a few far from all others: ``times_of`` would squeeze the rest; and those
    of a split that counts its own images, as cameras on one path or images between its own tell.

    Args:
        splits: of each split the frames' names and what the file says of their times.
        where: the file, for errors.
        cameras: of the frames, by name.

    Returns:
        a line where a split seems to count its own images, which follow those of training.

    Raises:
        SceneError: naming a frame, where times are to be scaled to [0, 1] and three or more would span next
            to nothing, all but the farthest or those of training, or a split's that lie in [0, 1] less than
            half of it; and the times of a split of which ``_of_own_numbers`` tells that.
    """
    named = {name: time for times in splits.values() for name, time in times.items()}
    if None in named.values():
        return []
    lines = [line for split in splits for line in _of_own_numbers(splits, split, where)]
    if _within_unit(named.values()):
        return lines
    times = sorted({*named.values()})
    whole = times[-1] - times[0]
    advice = "write all times in one unit, or from 0 to 1"

    def is_squeezed(some: Iterable[float], least: float = LEAST_SPAN) -> bool:
        return len({*some}) > 2 and max(some) - min(some) < least * whole

    refuse_far(named, where, "time", advice)
    for highest in (1 + _ROUNDING, math.inf):  # -1 that stands for none, or 20 among shares
        rest = [time for time in times if -_ROUNDING <= time <= highest]
        away = {name: max(rest[0] - t, t - rest[-1]) for name, t in named.items()} if len(rest) > 2 else {}
        odd = [name for name, distance in away.items() if distance > 0]
        name = max(odd, key=away.get, default="")
        stand_for_none = len({named[name] for name in odd}) == 1 and named[odd[0]] < 0
        are_few = 0 < len(odd) <= max(1, _FEW * len(named)) or stand_for_none
        is_far = are_few and away[name] > _APART * np.diff(rest).max()
        if is_far and (away[name] >= rest[-1] - rest[0] or named[name] == -1):  # else a pause
            expected = f"a time near all others, {rest[0]:.10g} to {rest[-1]:.10g}"
            raise mismatch(f"{where}: time of {name}", expected, f"{named[name]:.10g}", advice)
    for split, of in splits.items():
        some = of.values()
        in_unit = _within_unit(some)
        if (split == "train" and is_squeezed(some)) or (in_unit and is_squeezed(some, _LEAST_UNIT)):
            expected = f"one unit in all splits, which have {times[0]:.10g} to {times[-1]:.10g}"
            got = f"{min(some):.10g} to {max(some):.10g} ({next(iter(of))}, ..)"
            raise mismatch(f"{where}: times of {split} frames", expected, got, advice)
        if cameras is not None and split != "train" and _counts_itself(of, splits["train"], cameras):
            got = f"{min(some):.10g} to {max(some):.10g}, where the camera was at other times of training"
            expected = f"one numbering of all images, {times[0]:.10g} to {times[-1]:.10g}"
            raise mismatch(f"{where}: times of {split} frames", expected, got, "count all images together")
    return lines


def _of_own_numbers(splits: Mapping[str, Mapping[str, float]], split: str, where: str) -> list[str]:
    """Refuse times of a split that are even in the numbers of its images' names, as those of training are,
    but not together with these, although no number is in both; say so in a line where its images come before
    or after all others, as those of another film might.
    """
    train, of = ({_last_number(name): time for name, time in splits[key].items()} for key in ("train", split))
    if split == "train" or min(len(train), len(of)) < _LEAST_EVEN or {None, *train} & {*of}:
        return []
    first = min(*train, *of)
    numbers = [[float(min(n - first, 1 << 62)) for n in some] for some in (train, of)]  # names may hold dates
    (number, time), (other, at) = (
        (np.array(n), np.array([*s.values()])) for n, s in zip(numbers, (train, of))
    )
    if not (number.std() and other.std()):
        return []
    (rate, start), (own, _) = fits = [np.polyfit(*some, 1) for some in ((number, time), (other, at))]
    errors = [np.abs(np.polyval(fit, n) - t).max() for fit, n, t in zip(fits, (number, other), (time, at))]
    off, step = np.abs(rate * other + start - at).max(), _OWN_STEPS * abs(rate)
    if max(errors) > step / 2 or off <= step or min(rate, own) <= 0:
        return []
    first, last = (float(np.polyval((rate, start), n)) for n in (other.min(), other.max()))
    expected = f"{first:.4g} to {last:.4g} by their numbers, as of training"
    got = f"{at.min():.4g} to {at.max():.4g}, as of images counted by themselves"
    if other.min() < number.max() and number.min() < other.max():
        advice = "count all images together"
        raise mismatch(f"{where}: times of {split} frames", expected, got, advice)
    line = f"times of {split} frames are {got}, and {expected}"
    return [f"{where}: {line}; if all are of one film, count all images together"]


def _last_number(name: str) -> float | None:
    """Return the last number of a name, None without."""
    return (name_parts(name)[1::2] or [None])[-1]


def _counts_itself(
    of: Mapping[str, float], train: Mapping[str, float], cameras: Mapping[str, Camera]
) -> bool:
    """Tell whether frames of a film are numbered by themselves: one after the other from the first, while
    training cameras stand where theirs do at quite other times.
    """
    times, path = sorted(of.values()), sorted(train, key=train.get)
    whole = train[path[-1]] - train[path[0]] if path else 0.0
    is_dense = len(times) > 2 and {b - a for a, b in zip(times, times[1:])} == {1}
    if not is_dense or times[-1] - times[0] > _OWN_NUMBERS * whole:
        return False
    places = torch.stack([cameras[name].center.double() for name in path])
    step = float((places[1:] - places[:-1]).norm(dim=-1).median())
    at = torch.tensor([train[name] for name in path], dtype=torch.float64)
    away = torch.cdist(torch.stack([cameras[name].center.double() for name in of]), places)
    off = (at - torch.tensor([*of.values()], dtype=torch.float64)[:, None]).abs()
    is_near = away <= 2 * step
    elsewhere = is_near.any(1) & ~(is_near & (off <= LEAST_SPAN * whole)).any(1)
    return step > 0 and float(elsewhere.double().mean()) > _OWN_NUMBERS


def _within_unit(times: Iterable[float]) -> bool:
    """Tell whether all times lie in [0, 1], but for rounding."""
    return all(-_ROUNDING <= time <= 1 + _ROUNDING for time in times)
