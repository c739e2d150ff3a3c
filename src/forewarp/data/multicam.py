"""Rigs of fixed cameras in the layout of DyNeRF (Neural 3D Video): a video for each camera, and their poses.

``poses_bounds.npy`` has a row of 17 numbers for each camera, in the order of the videos' names, by number or
as texts: 3 x 5 numbers [R | T | (height, width, focal length)], row by row, and the depths of the nearest and
the farthest matter. [R|T] is camera-to-world, the axes of a camera are LLFF's: down, right, backwards. The
middle of an image is its principal point.

A camera is a video ``cam00.mp4``, or a folder of its frames ``cam00/`` or ``cam00/images/``, as preprocessors
leave them; a folder goes before a video. All cameras film at once: frame n of each is moment n; times follow
films' stamps or images' numbers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch import Tensor

from forewarp.data.agreement import photo_error, small_image
from forewarp.data.arrays import check_shape, load_numpy
from forewarp.data.cameras import MOST_UNITS, box_of, number_or_none, pose_of, space_of
from forewarp.data.directions import inverted, refuse_other_readings
from forewarp.data.files import SIDE as SIDE_FILES
from forewarp.data.files import (
    SUFFIXES,
    beside_images,
    images_alone,
    layout_of,
    left_out,
    mismatch,
    number,
    one_of,
    scene_folder,
    side_files,
    whole,
)
from forewarp.data.films import STORE, Film
from forewarp.data.images import (
    CACHE,
    TURN,
    Header,
    StoredImage,
    by,
    exif_turned,
    inspect_image,
    mixed_linear,
    read_image,
)
from forewarp.data.names import in_order, read_names
from forewarp.data.rigs import held_cameras, held_moments, refuse_copied_poses, split_rig
from forewarp.data.video import VIDEOS, doubts_of, extracted, stamps_of
from forewarp.files import written_whole
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene, middle_of, spread

FILE = "poses_bounds.npy"
_COMPARED = 24  # views, at most, by which an order is told
_AGREES = 0.8  # error of the right order as a share of the other's, at most
_BEYOND = 10.0  # times the median of near or far, by which a row's is off at most
_EVEN = 0.1  # frames by which even times may be off
_TAIL = 10  # the part of a film, a tenth, that is its end
_MOST_APART, _DRIFT = 0.5, 0.1  # frames by which two videos may run apart, and do so without a word
# A camera's axes down, right, backwards to OpenCV's, and back.
_ROLLED = 0.02  # by which the mean of upward axes is shorter than that of horizontal ones
_AXES = torch.tensor([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]], dtype=torch.float64)
_READINGS = {  # what else may be in a row
    "they are world-to-camera": lambda poses: inverted(poses @ _AXES) @ _AXES,
    "the axes are OpenCV's": lambda poses: poses @ _AXES,
}


@dataclass(frozen=True)
class _Track:
    """What a camera took: a video at ``path``, or ``images`` in a folder, ``size`` (width, height) on disk.

    ``stamps`` are the seconds of a video's frames, None of a folder; ``headers`` what each image says of
    itself; ``numbers`` are those in their names, ascending; ``assumed`` says what was left out.
    """

    path: Path
    size: tuple[int, int]
    stamps: np.ndarray | None = None
    images: tuple[Path, ...] = ()
    headers: Mapping[Path, Header] = field(default_factory=dict)
    numbers: np.ndarray | None = None
    assumed: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.images) if self.stamps is None else len(self.stamps)

    def name(self, moment: int) -> str:
        """Name a frame by its file or its number."""
        return f"{self.path.stem}/{self.images[moment].stem if self.images else f'{moment:04d}'}"


def read_scene(
    root: str | Path,
    scene: str,
    *,
    scale: int = 2,
    frames: int | None = None,
    test_cameras: Sequence[str] | None = None,
    test_moments: Sequence[int] | None = None,
    test_every: int = 1,
    camera_order: str | None = None,
    name_pattern: str | None = None,
    near: float | None = None,
    far: float | None = None,
    box: Sequence[float] | None = None,
    normalise: bool = True,
) -> Scene:
    """Read ``root/scene``; frames are decoded when they are first loaded.

    Args:
        scale: average blocks of so many pixels a side, of images as large as the file says. Frames that a
            preprocessor has made smaller are averaged less.
        frames: how many moments, from the first; None: all. The first is at the time 0, the last at 1.
        test_cameras: names of the cameras held out; None: the first.
        test_moments: numbers of the moments, from 0, that no camera is trained on; None: none.
        test_every: measure held-out cameras at every n-th moment only.
        camera_order: of the rows of poses: by the ``number`` in the cameras' names, or as ``text`` (cam1,
            cam10, cam2); None: where these differ, that in which neighbouring views agree.
        name_pattern: regular expression that reads ``time`` or ``frame`` in the names of folders' images;
            None: what these say in one way.
        near, far: along the unit ray, the file's units; None: what holds all depths of the file.
        box: x0 y0 z0 x1 y1 z1 in the file's units; None takes all that the cameras see from near to far.
        normalise: put what is looked at into the origin and the farthest camera at distance 1.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and row.

    Cost: a pass over each video that decodes its first frame alone; a small read of each image.
    """
    folder = scene_folder(root, scene, "DyNeRF")
    one_of(normalise, "data.normalise", True, False)
    scale, every = whole(scale, "data.scale", 1), whole(test_every, "data.test_every", 1)
    paths, others, left = _paths(folder)
    one_of(camera_order, "data.camera_order", "number", "text", None)
    tracks = [_look(path, name_pattern) for path in paths.values()]
    images = lambda: [small_image(_first_image(track)) for track in tracks]  # noqa: E731
    key = "set data.camera_order=number or data.camera_order=text"
    rows = getattr(load_numpy(folder / FILE), "shape", ())[:1] if others else ()
    if rows == (len(paths) + len(others),):
        expected = f"a row for each of {len(paths)} cameras, {', '.join(list(paths)[:3])}"
        got = f"{rows[0]} rows, as if {', '.join(others[:3])} were cameras, too"
        advice = "name all cameras cam00, cam01 .. in the order of the rows"
        raise mismatch(folder / FILE, expected, got, advice)
    whole_cameras, ordered = ordered_rows(folder / FILE, list(paths), images, camera_order, key)
    if others:
        some = ", ".join(others[:3]) + ", .." * (len(others) > 3)
        ordered.append(f"{folder}: {some} not read, as names of cameras begin with cam")
    count, assumed = _moments(tracks, None if frames is None else whole(frames, "data.frames", 1), folder)
    headers = {path: track.headers[path] for track in tracks for path in track.images[:count]}
    turned = [path for path, header in headers.items() if header.is_turned]
    left += [line for track in tracks for line in track.assumed][:1]  # all cameras are alike
    assumed += left + ordered + exif_turned(turned, folder) + mixed_linear(headers, folder)
    assumed += side_files([folder], [], "this layout has none: use experiment=video_with_poses for them")
    default = [0] if len(paths) > 1 else []  # one camera may be tested on moments
    held, moments = held_cameras(test_cameras, list(paths), default), held_moments(test_moments, count)
    factors = [_factor(track, camera, scale) for track, camera in zip(tracks, whole_cameras)]
    cameras = [camera.smaller(scale) for camera in whole_cameras]
    bytes_of_all = 4 * count * sum(camera.width * camera.height for camera in cameras)
    films = [track.path.name for track in tracks if track.stamps is not None]
    if films and bytes_of_all > CACHE.limit and STORE.limit == 0:
        line = f"all frames take {bytes_of_all / 1e9:.3g} GB, more than data.cache_bytes: each is sought in"
        stem = films[0].rsplit(".", 1)[0]
        advice = f"faster are folders of frames, mkdir {stem}; ffmpeg -i {films[0]} {stem}/%04d.png"
        assumed.append(f"{folder}: {line} its film, which takes seconds; {advice}")
    loads = []
    for track, camera, factor in zip(tracks, cameras, factors):
        if track.stamps is None:
            images = track.images[:count]
            loads.append([StoredImage(path, track.size, factor, opaque=True) for path in images])
        else:
            size = (camera.width, camera.height)
            loads.append(Film(track.path, track.stamps[:count], size, bytes_of_all).images)
    near, far = ends_of(cameras, list(paths), str(folder / FILE), near, far)
    options = {"near": near, "far": far, "box": box_of(box), "normalise": normalise}
    space, seen = space_of(cameras, str(folder / FILE), **options)
    cameras = [space.camera(camera) for camera in cameras]

    times, line = _times(tracks, count, folder)
    assumed += line

    def view(moment: int, k: int) -> Frame:
        return Frame(tracks[k].name(moment), times[moment], cameras[k], loads[k][moment], camera_id=k)

    taken = ((moment, view(moment, k)) for moment in range(count) for k in range(len(cameras)))
    train, test = split_rig(taken, held, moments, every)
    refuse_copied_poses((*train, *test), folder / FILE)
    sizes = sorted({(camera.width, camera.height) for camera in cameras}, reverse=True)
    stamps = next((track.stamps for track in tracks if track.stamps is not None), None)
    protocol = {
        "dataset": "multicam",
        "resolution": list(sizes[0]) if len(sizes) == 1 else [list(size) for size in sizes],
        "scale": scale,
        "frames": count,
        "views": len(cameras),
        "test_cameras": [list(paths)[k] for k in held],
        "test_moments": sorted(moments),
        "test_frames": len(test),
        "normalisation": space.told,
        "near": space.near,
        "far": space.far,
        "seconds": None if stamps is None or count == 1 else float(stamps[count - 1] - stamps[0]),
        "assumed": assumed or None,
    }
    canonical = middle_of(frame.time for frame in train)
    return Scene(scene, train, (), test, seen, canonical, False, protocol=protocol, world=space)


def write_poses(folder: str | Path, cameras: Sequence[Camera], *, near: float, far: float) -> None:
    """Write ``poses_bounds.npy``, which is all of a scene but the films.

    Args:
        folder: of the scene.
        cameras: which the format can tell: square pixels, no lens, the principal point in the middle.
        near, far: depths of the nearest and the farthest matter, in the units of the cameras' places.

    Raises:
        SceneError: for another camera.
    """
    rows = []
    for k, camera in enumerate(cameras):
        is_told = camera.lens is None and camera.skew == 0 and camera.fx == camera.fy
        if not is_told or (camera.cx, camera.cy) != (camera.width / 2, camera.height / 2):
            expected = "square pixels, the principal point in the middle and no lens"
            raise mismatch(f"camera {k}", expected, "another camera", "undistort and crop the images")
        inner = torch.tensor([[camera.height], [camera.width], [camera.fx]], dtype=torch.float64)
        pose = camera.camera_to_world.double() @ _AXES
        rows.append([*torch.cat([pose[:3], inner], 1).flatten().tolist(), near, far])
    with written_whole(Path(folder) / FILE) as beside:
        np.save(beside, np.array(rows))


def _paths(folder: Path) -> tuple[dict[str, Path], list[str], list[str]]:
    """Find the video or the folder of frames of each camera, by name, in the order of numbers; names of other
    videos and folders of images; and say in lines what was left out.
    """
    films = [path for path in folder.glob("cam*") if path.suffix.lower() in VIDEOS]
    films.sort(key=lambda path: (VIDEOS.index(path.suffix.lower()), path.name))
    inner = [(path, place) for path in folder.glob("cam*/") for place in (path / "images", path)]
    folders = {path: place for path, place in inner if _images(place)}
    cameras, sides = beside_images([*folders, *films], folder)
    unsaid = {path: image for path, image in sides.items() if not SIDE_FILES.search(path.name)}
    left = left_out(unsaid, folder)  # of masks and depth ``side_files`` speaks
    found, twice = {}, []
    for path in cameras:
        taken = found.setdefault(path.name if path in folders else path.stem, path)
        twice += [(taken, path)] if taken is not path else []
    if twice:
        (taken, other), more = twice[0], f", and so of {len(twice) - 1} more" if twice[1:] else ""
        name = f"{taken.name}{'/' if taken in folders else ''}"
        left.append(f"{folder}: {name} is read, not {other.name}{more}; remove what is old")
    found = {name: folders.get(path, path) for name, path in found.items()}
    there = [path for path in folder.glob("[!.]*") if path.suffix.lower() in VIDEOS]
    deep = [path for path in folder.glob("[!.]*/") if _images(path) or _images(path / "images")]
    if not found:
        expected = "a video for each camera, cam00.mp4, or a folder of its frames, cam00/"
        there = there or deep
        got, advice = "neither", ""
        if layout_of(folder) == "LLFF":
            advice = "of images/ by one camera that moves: use experiment=video_with_poses"
        elif there:
            first, kind = in_order(path.name for path in there)[0], there[0].suffix
            got = f"{len(there)} of other names, as {first}"
            advice = f"rename them to cam00{kind}, cam01{kind} .. in the order of the rows of {FILE}"
        raise mismatch(folder, expected, got, advice)
    others = {path.name for path in (*there, *deep) if path.stem not in found and path.name not in found}
    others = in_order(name for name in others - {path.name for path in sides} if not SIDE_FILES.search(name))
    return {name: found[name] for name in in_order(found)}, others, left


def _images(folder: Path) -> list[Path]:
    there = folder.glob("[!.]*") if folder.is_dir() else ()
    return in_order((path for path in there if path.suffix in SUFFIXES), lambda path: path.name)


def read_rows(path: Path, names: Sequence[str]) -> list[Camera]:
    """Read the cameras of whole images, their near and far the depths of the nearest and the farthest matter.

    Raises:
        SceneError: naming the row.
    """
    array = load_numpy(path)
    check_shape(array, path, "17 numbers for each camera", None, 17, advice="write them as LLFF does")
    if len(array) != len(names):
        expected = f"a row for each of {len(names)} cameras, {names[0]} to {names[-1]}"
        advice = "remove the row or the camera that the other lacks"
        raise mismatch(path, expected, f"{len(array)} rows", advice)
    cameras = []
    for k, (name, values) in enumerate(zip(names, np.array(array, np.float64))):
        where = f"{path}: row {k} ({name})"
        block, (near, far) = values[:15].reshape(3, 5), values[15:].tolist()
        pose = torch.from_numpy(pose_of((np.vstack([block[:, :4], [0, 0, 0, 1]]) @ _AXES.numpy()), where))
        height, width, focal = block[:, 4].tolist()
        sizes = [number(side, f"{where}: height and width", 1, 1e6) for side in (height, width)]
        if any(side % 1 for side in sizes):
            raise mismatch(f"{where}: height and width", "whole numbers", f"{height:g} and {width:g}")
        focal = number(focal, f"{where}: focal length", 0.01 * width, 100 * width)
        if not 0 < near < number(far, f"{where}: bounds", 0, MOST_UNITS):
            raise mismatch(f"{where}: bounds", "0 < near < far", f"{near:g} and {far:g}")
        middle = width / 2, height / 2
        cameras.append(Camera(int(width), int(height), focal, focal, *middle, pose, near, far))
    return cameras


def ends_of(
    cameras: Sequence[Camera], names: Sequence[str], where: str, near: float | None, far: float | None
) -> tuple[float, float]:
    """Return near and far along unit rays that hold the depths of all rows; what is given stays.

    Raises:
        SceneError: naming a row whose near or far is far beyond that of the others.
    """
    near, far = number_or_none(near, "data.near"), number_or_none(far, "data.far")
    for key, given, sign in (("near", near, -1), ("far", far, 1)):
        ends = [getattr(camera, key) for camera in cameras]
        beyond = [(end / median(ends)) ** sign for end in ends]
        row = beyond.index(max(beyond))
        if given is None and beyond[row] > _BEYOND:
            got = f"{ends[row]:.4g}, as of a point in a wrong place"
            advice = f"mend the row, or set data.{key}"
            expected = f"{key} within {_BEYOND:g} times that of other rows, {median(ends):.4g}"
            raise mismatch(f"{where}: row {row} ({names[row]})", expected, got, advice)
    aslant = max(math.hypot(1, math.hypot(c.width / c.fx, c.height / c.fy) / 2) for c in cameras)
    near = min(camera.near for camera in cameras) if near is None else near
    return near, aslant * max(camera.far for camera in cameras) if far is None else far


def _rolled(cameras: Sequence[Camera]) -> bool:
    """Tell whether cameras seem to be turned by a quarter about their axes: then their horizontal axes agree
    better than their upward ones, and they stand above each other.
    """
    poses = torch.stack([camera.camera_to_world.double() for camera in cameras])
    right, down = (poses[:, :3, column].mean(0) for column in (0, 1))
    along = [float((poses[:, :3, 3] @ axis).std()) if len(cameras) > 1 else 0.0 for axis in (right, down)]
    return float(right.norm() - down.norm()) > _ROLLED and along[1] > 2 * along[0]


def ordered_rows(
    path: Path, names: Sequence[str], images: Callable[[], list[Tensor]], order: str | None, key: str
) -> tuple[list[Camera], list[str]]:
    """Read the cameras of rows, in the order of names by numbers; also say in a line in which order rows
    were taken where names allow two.

    Args:
        path: of the rows.
        names: of cameras or images, in the order of their numbers.
        images: small ones, (H, W, 3) in [0, 1] each, by which the order is told.
        order: of the rows: ``number``, ``text``, or None: that in which neighbouring views agree.
        key: what to do where they do not tell.

    Raises:
        SceneError: as ``read_rows``, where poses seem to be written in another way, and where neighbouring
            views do not tell.
    """
    cameras, texts = read_rows(path, names), sorted(names)
    expected = "[R | T] camera-to-world with the axes down, right, backwards"
    lines = refuse_other_readings([c.camera_to_world for c in cameras], _READINGS, path, expected)
    if _rolled(cameras):
        line = "cameras seem to be turned by a quarter about their axes, as rows without LLFF's turn are"
        advice = "if images are upright, write [R | T] with the axes down, right, backwards"
        lines.append(f"{path}: {line}; {advice}")
    if order == "number" or texts == list(names):
        return cameras, lines
    rows = dict(zip(texts, read_rows(path, texts)))
    by_text = [rows[name] for name in names]
    if order == "text":
        return by_text, lines
    small, errors = images(), {}
    some = spread(len(small), _COMPARED)
    for by_what, all_of in (("number", cameras), ("text", by_text)):
        views = [all_of[k].resized(*small[k].shape[1::-1]) for k in some]
        errors[by_what] = photo_error(views, [small[k] for k in some])
    if not min(errors.values()) < _AGREES * max(errors.values()):  # both may be infinite
        orders = f"{', '.join(names[:3])} by number, {', '.join(texts[:3])} as texts"
        raise mismatch(path, "rows in one order", f"{orders}, and images that do not tell", key)
    best = min(errors, key=errors.get)
    line = f"rows are taken in the order of names by {best}, as neighbouring views agree so; else {key}"
    return cameras if best == "number" else by_text, [*lines, f"{path}: {line}"]


def _first_image(track: _Track) -> Tensor:
    """Read the first frame of a camera, uint8 (H, W, C)."""
    if track.stamps is None:
        return read_image(track.images[0])
    return torch.from_numpy(next(extracted(track.path, [0], None)).copy())


def _look(path: Path, name_pattern: str | None) -> _Track:
    """Find the size and number of a camera's frames."""
    if path.is_dir():
        images, left = images_alone(_images(path), path)
        headers, size = {}, None
        read = read_names([image.stem for image in images], str(path), name_pattern, one_camera=True)
        numbers = np.arange(len(images)) if read is None else np.array(read.frames)
        order = np.argsort(numbers, kind="stable")
        images, numbers = tuple(images[i] for i in order), numbers[order]
        for image in images:
            headers[image] = inspect_image(image, size, " as the first")
            size = headers[image].size
        place = path.parent if path.name == "images" else path
        return _Track(place, size, None, images, headers, numbers, left)
    stamps = stamps_of(path)
    first = next(extracted(path, [0], None), None) if len(stamps) else None
    if first is None:
        raise mismatch(path, "a video", "another file", "copy it again")
    return _Track(path, first.shape[1::-1], stamps, assumed=[f"{path}: {line}" for line in doubts_of(path)])


def _moments(tracks: Sequence[_Track], most: int | None, folder: Path) -> tuple[int, list[str]]:
    """Count the moments that all cameras have, ``most`` at most; say in a line where some have more.

    Raises:
        SceneError: naming a camera whose frames are of other times than the first's, or numbered otherwise; a
            folder beside films that lacks frames.
    """
    lengths = [len(track) if most is None else min(len(track), most) for track in tracks]
    count, assumed = min(lengths), []
    films = [track for track in tracks if track.stamps is not None]
    if films:  # names of images tell their moments
        lengths = [len(track) for track in tracks]
    if min(lengths) < max(lengths):
        least = tracks[lengths.index(min(lengths))].path.name
        line = f"{folder}: {least} has {min(lengths)} frames, others up to {max(lengths)}: all are cut to the"
        assumed = [
            f"{line} first {count}" + ("; a film that begins later is of other moments" if films else "")
        ]
    for film in films[1:] if count > 1 else ():
        mine, first = ((f.stamps[:count] - f.stamps[0]) for f in (film, films[0]))
        apart = np.abs(mine - first) * (count - 1) / first[-1]  # in frames
        if apart.max() > _MOST_APART:
            rates = [(count - 1) / seconds[-1] for seconds in (first, mine)]
            at = int((apart > _MOST_APART).argmax())
            expected = f"frames at the times of {films[0].path.name}, {rates[0]:.4g} a second"
            got = f"{rates[1]:.4g} a second, {abs(mine[at] - first[at]):.3g} s apart at frame {at}"
            raise mismatch(film.path, expected, got, "convert all to one constant rate, or remove the camera")
        drift = float(np.median(apart[-max(1, count // _TAIL) :]))  # one frame may come late
        if drift > _DRIFT:
            line = f"runs apart from {films[0].path.name}, by {drift:.2g} frames at the end of {count}"
            assumed.append(f"{film.path}: {line}; convert both to one constant rate, or set data.frames")
    folders = [track for track in tracks if track.images]
    for track in folders if films else ():
        first, steps = track.numbers[0], np.diff(track.numbers[:count])
        if (first > 1 or (steps != 1).any()) and len(track) != len(films[0]):
            expected = f"all {len(films[0])} frames, as {films[0].path.name} has"
            got = f"{len(track)}, from {track.images[0].name} to {track.images[-1].name}"
            raise mismatch(track.path, expected, got, "extract them all, or the same ones of each film")
    numbers = [_numbers([path.stem for path in track.images[:count]]) for track in folders]
    for track, mine in zip(folders[1:], numbers[1:]):
        for at in range(count):
            if mine[at] != numbers[0][at]:
                expected = f"a frame of the number of {folders[0].path.name}/{folders[0].images[at].name}"
                advice = "remove a frame that one camera lacks from all"
                shifts = {a[-1] - b[-1] for a, b in zip(mine, numbers[0]) if a and b}
                if len(shifts) == 1:  # only who filmed knows whether it began later
                    other = (
                        f"if only its count begins at another number, rename its frames by {-shifts.pop():+d}"
                    )
                    advice = f"{other}; else {advice}"
                raise mismatch(track.path, expected, track.images[at].name, advice)
    return count, assumed


def _numbers(names: Sequence[str]) -> list[list[int]]:
    """Return the numbers in each name, without those that all names share."""
    found = [[int(digits) for digits in re.findall(r"\d+", name)] for name in names]
    if len({*map(len, found)}) != 1:
        return [each[-1:] for each in found]
    varied = [column for column in zip(*found) if len({*column}) > 1]
    return [[column[at] for column in varied] for at in range(len(found))]


def _times(tracks: Sequence[_Track], count: int, folder: Path) -> tuple[list[float], list[str]]:
    """Return the times in [0, 1] of ``count`` moments: by the stamps of a film, or by the numbers of images;
    also say in a line where these are not even.
    """
    film = next((track for track in tracks if track.stamps is not None), None)
    clock, even = (film.stamps if film else tracks[0].numbers)[:count], np.arange(count) / max(count - 1, 1)
    if count < 2 or not (np.diff(clock) > 0).all():
        return even.tolist(), []
    times = (clock - clock[0]) / (clock[-1] - clock[0])
    if np.abs(times - even).max() * (count - 1) <= _EVEN:
        return even.tolist(), []
    what = "the films' time stamps" if film else "the numbers in the images' names"
    return times.tolist(), [f"{folder}: times are those of {what}, which are not even"]


def _factor(track: _Track, camera: Camera, scale: int) -> int:
    """Return by how much frames are to be reduced, of which ``camera`` is that of whole ones."""
    whole = camera.width, camera.height
    if any(side % scale for side in whole):
        raise mismatch("data.scale", f"a divisor of both sides of {by(whole)} pixels", scale)
    divisors = [n for n in range(1, scale + 1) if scale % n == 0]
    fitting = {tuple(side // n for side in whole): scale // n for n in divisors}
    if track.size not in fitting:
        smaller = camera.width // track.size[0]
        is_smaller = smaller > 1 and tuple(side // smaller for side in whole) == track.size
        advice = f"set data.scale={smaller}" if is_smaller else ""
        advice = TURN if track.size[::-1] in fitting else advice
        expected = f"{' or '.join(map(by, fitting))} pixels as {FILE} and data.scale={scale} say"
        raise mismatch(track.path, expected, by(track.size), advice)
    return fitting[track.size]
