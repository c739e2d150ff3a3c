"""NHR scenes: a performer filmed by a dome of still cameras, all at the same moments.

``CamPose.inf`` has a line per camera, the columns of [R|T] camera-to-world with OpenCV's axes in the order
z, x, y, centre; ``Intrinsic.inf`` a block per camera, its number and a 3 x 3 matrix. Frame f, from 0, has
``img/<f>/img_%04d.jpg``, the foreground in ``img/<f>/mask/`` under the same names, and its points x y z r g b
in ``pointclouds/frame<f + 1>.npy`` (older: .obj). Frames and cameras of an excerpt may be numbered otherwise,
with gaps: they are taken in order. Beside them there may be ``trajectories.npz``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain, pairwise, product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.data.arrays import read_cloud, read_truth, shortened, write_array, write_truth
from forewarp.data.cameras import box_of, check_camera, near_origin, pose_of
from forewarp.data.directions import inverted, opposite, refuse_other_readings
from forewarp.data.files import (
    SceneError,
    mismatch,
    nearly,
    numbers_of,
    one_of,
    opened,
    remove,
    scene_folder,
    whole,
)
from forewarp.data.images import (
    Header,
    StoredImage,
    bright,
    by,
    check_pixels,
    exif_turned,
    inspect_image,
    mixed_linear,
    write_image,
)
from forewarp.data.rigs import held_cameras, held_moments, refuse_copied_poses, split_rig
from forewarp.files import decoded, replace_file
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene, Truth, spread

_PADDING = 0.1  # of the points' extent, on every side
_ORDER = [2, 0, 1, 3]  # of a pose's columns in a line: z axis, x axis, y axis, centre
_READINGS = {  # what else may be in a line
    "the columns are x, y, z, centre": lambda poses: poses[..., _ORDER],
    "they are world-to-camera": inverted,
    "the axes are OpenGL's": opposite,
}
_COMPARED, _POINTS = 16, 500  # cameras and points by which the order of rows is doubted
_MISSED = 0.05  # share of a cloud that falls beside masks, from which on it is; right rows have 0.02
_MOST_PIXELS_OFF = 1e7  # beyond it a lens is wrong


@dataclass(frozen=True)
class DomeFrame:
    """A moment to write: per camera an image uint8 (H, W, 3) and a mask uint8 (H, W), 255 on the
    foreground, and ``points`` (N, 6), x y z in world units and r g b of 255.
    """

    images: Sequence[np.ndarray]
    masks: Sequence[np.ndarray]
    points: np.ndarray


def read_scene(
    root: str | Path,
    scene: str,
    *,
    half_resolution: bool = True,
    box: Sequence[float] | None = None,
    frames: int = 100,
    test_cameras: Sequence[int | str] | None = None,
    test_moments: Sequence[int] | None = None,
    test_every: int = 1,
) -> Scene:
    """Read ``root/scene``; of images only headers are read, and of masks a few: pixels are decoded when a
    frame is loaded.

    Args:
        half_resolution: average 2 x 2 pixels; an odd last row or column is cut off.
        box: x0 y0 z0 x1 y1 z1 in world units; None takes the bounds of all point clouds, 10 % wider per side.
        frames: how many, from the first; where there are fewer, all. The last of them is at the time 1, those
            between by their numbers.
        test_cameras: numbers of the cameras held out; None spreads 6 of every 56 over them.
        test_moments: numbers of the frames, from 0, that no camera is trained on; None: none.
        test_every: measure held-out cameras in every n-th frame only.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and line.

    Cost: two small reads an image and one of every point.
    """
    folder = scene_folder(root, scene, "NHR")
    one_of(half_resolution, "data.half_resolution", True, False)
    poses, doubted = _read_poses(folder / "CamPose.inf")
    matrices = _read_intrinsics(folder / "Intrinsic.inf")
    if len(poses) != len(matrices):
        got = f"{len(matrices)} there and {len(poses)} in CamPose.inf"
        advice = "write the block or line of the camera that one of them lacks, or remove it from both"
        raise mismatch(folder / "Intrinsic.inf", "as many cameras as poses", got, advice)
    if len(poses) < 2:
        advice = "write a line of CamPose.inf and a block of Intrinsic.inf for each camera"
        raise mismatch(folder / "CamPose.inf", "at least 2 cameras, one to measure", "1", advice)
    tests = max(1, round(len(poses) * 6 / 56))
    spread_out = [i * len(poses) // tests for i in range(tests)]
    held = held_cameras(test_cameras, [*map(str, range(len(poses)))], spread_out)
    every, moments = whole(test_every, "data.test_every", 1), whole(frames, "data.frames", 1)
    there = (path for path in folder.glob("img/*") if path.is_dir() and path.name.isdecimal())
    places = sorted(there, key=lambda path: (int(path.name), path.name))
    on_disk = [int(path.name) for path in places]
    twice = [f"{a.name} and {b.name}" for a, b in pairwise(places) if int(a.name) == int(b.name)]
    if twice or not places:
        expected, got = "a folder of images for each frame, named by its number", "".join(twice[:1]) or "none"
        raise mismatch(folder / "img", expected, got, "remove one" if twice else "")
    numbers, moments = on_disk[:moments], min(moments, len(places))
    held_times = held_moments(test_moments, moments)
    counted = (path.stem[4:] for place in places for path in place.glob("img_*.jpg"))
    first = min((int(number) for number in counted if number.isdecimal()), default=0)
    names = [f"img_{k:04d}.jpg" for k in range(first, first + len(poses))]
    sizes, headers = _read_sizes(places[:moments], names, half_resolution)
    turned = [path for path, header in headers.items() if header.is_turned]
    images = {path: header for path, header in headers.items() if path.parent.name != "mask"}
    bounds, assumed, points = _bounds(folder, numbers, on_disk) if box is None else (box_of(box), [], None)
    cameras = [_camera(*of, half_resolution, bounds) for of in zip(sizes, matrices, poses, strict=True)]
    for number, camera in enumerate(cameras):
        where = f"{folder / 'Intrinsic.inf'}: camera {number}"
        check_camera(camera, where, where)
    if points is not None:
        _refuse_order(folder / "CamPose.inf", cameras, [places[0] / "mask" / name for name in names], points)
    world = near_origin(bounds.center, max(camera.far for camera in cameras))
    cameras = [replace(c, camera_to_world=world.to_scene(c.camera_to_world)) for c in cameras]
    bounds = Box(*world.to_scene(np.array([bounds.low, bounds.high])).tolist())

    def view(f: int, k: int) -> Frame:
        place, name = places[f], names[k]
        load = StoredImage(place / name, sizes[k], 1 + half_resolution, place / "mask" / name)
        time = (numbers[f] - numbers[0]) / span
        return Frame(f"{place.name}/{Path(name).stem}", time, cameras[k], load, camera_id=k)

    span = max(numbers[-1] - numbers[0], 1)
    taken = ((f, view(f, k)) for f in range(moments) for k in range(len(poses)))
    train, test = split_rig(taken, held, held_times, every)
    refuse_copied_poses((*train, *test), folder / "CamPose.inf")
    if on_disk[0] != 0 or first != 0 or on_disk[-1] - on_disk[0] >= len(on_disk):
        said = f"frames {on_disk[0]} to {on_disk[-1]} ({len(on_disk)}) and cameras from {first}"
        assumed = [f"{folder / 'img'}: {said} taken in order, times by their numbers", *assumed]
    assumed += doubted + exif_turned(turned, folder / "img") + mixed_linear(images, folder / "img")
    protocol = {
        "dataset": "nhr",
        "resolution": [list(size) for size in sorted({(c.width, c.height) for c in cameras}, reverse=True)],
        "half_resolution": half_resolution,
        "frames": moments,
        "views": len(poses),
        "test_views": held,
        "test_frames": len(test),
        "normalisation": None if world.is_same else {"center": list(world.center), "scale": world.scale},
        "mask_box": True,
        "test_moments": sorted(held_times) or None,
        "assumed": assumed or None,
    }
    truth = read_truth(folder / "trajectories.npz", 0.0, world)
    if truth is not None and moments < len(places):  # the file's times are those of all frames on disk
        truth = shortened(truth, (numbers[-1] - numbers[0]) / (on_disk[-1] - on_disk[0]))
    return Scene(scene, train, (), test, bounds, 0.0, True, truth, protocol, world=world)


def write_scene(
    folder: str | Path,
    cameras: Sequence[Camera],
    frames: Iterable[DomeFrame],
    *,
    trajectories: Truth | None = None,
) -> None:
    """Write a scene that ``read_scene`` reads; each file appears whole or not at all.

    A scene already in ``folder`` is replaced: its poses are removed first and written last, so that an
    interrupted call leaves nothing that could be read by mistake. Near and far of the cameras are not stored.
    """
    folder = Path(folder)
    if any(camera.lens is not None for camera in cameras):
        raise mismatch("cameras", "none with a lens, as the format has none", "one", "undistort the images")
    remove(folder, "CamPose.inf", "Intrinsic.inf", "trajectories.npz", "pointclouds/frame*.*")
    remove(folder, "img/*/img_*.jpg", "img/*/mask/img_*.jpg")
    for emptied in (*folder.glob("img/*/mask"), *folder.glob("img/*")):
        if not any(emptied.iterdir()):
            emptied.rmdir()
    for f, frame in enumerate(frames):
        for k, (camera, image, mask) in enumerate(zip(cameras, frame.images, frame.masks, strict=True)):
            place, name, shape = folder / "img" / str(f), f"img_{k:04d}.jpg", (camera.height, camera.width)
            write_image(place / name, check_pixels(f"frame {f}: {name}", image, (*shape, 3)))
            write_image(place / "mask" / name, check_pixels(f"frame {f}: mask/{name}", mask, shape))
        write_array(folder / "pointclouds" / f"frame{f + 1}.npy", frame.points)
    write_truth(folder / "trajectories.npz", trajectories)
    blocks, poses = "", ""
    for k, c in enumerate(cameras):
        blocks += f"{k}\n{c.fx!r} {c.skew!r} {c.cx!r}\n0.0 {c.fy!r} {c.cy!r}\n0.0 0.0 1.0\n\n"
        poses += " ".join(map(repr, c.camera_to_world[:3, _ORDER].T.flatten().tolist())) + "\n"
    replace_file(folder / "Intrinsic.inf", blocks)
    replace_file(folder / "CamPose.inf", poses)


def _read_poses(path: Path) -> tuple[list[np.ndarray], list[str]]:
    """Read camera-to-world matrices (4, 4) float64 with OpenCV's axes, one a line; also say in a line where
    they may be written in another way.

    Raises:
        SceneError: naming the line that does not hold 12 numbers, or no rotation; and where the cameras would
            look at one thing if poses were written in another way.
    """
    poses, expected = [], "columns z, x, y, centre of [R|T], camera-to-world with OpenCV's axes"
    for line, words in _lines(path):
        matrix, where = np.eye(4), f"{path}: line {line}"
        values = np.array(numbers_of(words, 12, where))
        matrix[:3, _ORDER] = values.reshape(4, 3).T
        try:
            poses.append(pose_of(matrix, where))
        except SceneError as error:
            try:
                pose_of(values.reshape(3, 4), where)
            except SceneError:
                raise error from None
            raise mismatch(where, expected, "its rows", "write the columns one after the other") from None
    return poses, refuse_other_readings([*map(torch.from_numpy, poses)], _READINGS, path, expected)


def _read_intrinsics(path: Path) -> list[np.ndarray]:
    """Read the matrix (3, 3) of every block: fx s cx, 0 fy cy, 0 0 1, in pixels of the stored images.

    A block is a camera's number and nine numbers, however they are spread over lines; cameras count up from
    0 or from 1.

    Raises:
        SceneError: naming the line where a block begins that is anything else.
    """
    words = [(line, word) for line, row in _lines(path) for word in row]
    first, matrices = int(words[0][1] == "1"), []
    for k, block in enumerate((words[i : i + 10] for i in range(0, len(words), 10)), first):
        where = f"{path}: line {block[0][0]}"
        values = numbers_of([word for _, word in block], 10, where)
        matrix = np.array(values[1:]).reshape(3, 3)
        focals, offsets = matrix[[0, 1], [0, 1]], np.abs(matrix[[0, 0, 1], [1, 2, 2]])
        are_pixels = (focals >= 1e-3).all() and max(*focals, *offsets) <= _MOST_PIXELS_OFF
        if values[0] != k or matrix[1, 0] != 0 or matrix[2].tolist() != [0, 0, 1] or not are_pixels:
            expected = f"the number {k} of a camera and its matrix fx s cx, 0 fy cy, 0 0 1 in pixels"
            raise mismatch(where, expected, " ".join(f"{value:g}" for value in values))
        matrices.append(matrix)
    return matrices


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """List the lines that are not blank: their numbers from 1 and their words."""
    with opened(path) as stream:
        text = decoded(stream.read(), path)
    lines = [(n, line.split()) for n, line in enumerate(text.split("\n"), 1) if line.strip()]
    if not lines:
        raise mismatch(path, "at least one camera", "an empty file")
    return lines


def _read_sizes(
    folders: list[Path], names: list[str], halve: bool
) -> tuple[list[tuple[int, int]], dict[Path, Header]]:
    """Read the size (width, height) of every camera's images and check that all have it; also return the
    headers of images and masks.
    """
    sizes, headers = [None] * len(names), {}
    for folder in folders:
        for place in (folder, folder / "mask"):
            if extra := sorted({path.name for path in place.glob("img_*")}.difference(names)):
                expected = f"images of the {len(names)} cameras of CamPose.inf"
                advice = "" if extra[0].endswith(".jpg") else "write JPEG, .jpg"
                raise mismatch(place / extra[0], expected, "another", advice)
            for k, name in enumerate(names):
                why = f" as in img/{folders[0].name}/{name}"
                if not (place / name).is_file():
                    what = "the mask of an image" if place is not folder else f"an image of camera {k}"
                    advice = f"add it, or remove the folder img/{folder.name}"
                    raise mismatch(place / name, what, "none", nearly(place / name) or advice)
                headers[place / name] = inspect_image(place / name, sizes[k], why)
                sizes[k] = headers[place / name].size
                if halve and min(sizes[k]) < 2:
                    raise mismatch(place / name, "at least 2 x 2 pixels to halve", by(sizes[k]))
    return sizes, headers


def _refuse_order(path: Path, cameras: Sequence[Camera], masks: Sequence[Path], points: Tensor) -> None:
    """Refuse poses in another order than images: then much more of the first frame's cloud falls on masks if
    they are exchanged.

    Args:
        path: of the poses, for errors.
        cameras: as read.
        masks: of the first frame's images.
        points: (N, 3) of its cloud.
    """
    size = [(camera.width, camera.height) for camera in cameras]
    shown = lru_cache(None)(lambda k: bright(masks[k], size[k]))
    some = spread(len(cameras), _COMPARED)
    share = sum(_missed(cameras[k], shown(k), points) for k in some) / len(some)
    if not _MISSED < share < 1 - _MISSED:  # right, or masks that are inverted
        return
    from scipy.optimize import linear_sum_assignment  # late: it takes long, and hardly any scene needs it

    every, found = range(len(cameras)), []
    for with_blocks in (False, True):  # rows of poses alone, or blocks of Intrinsic.inf, too
        missed = np.zeros((len(cameras), len(cameras)))
        for k, row in product(every, every):
            camera = replace(cameras[row if with_blocks else k], camera_to_world=cameras[row].camera_to_world)
            missed[k, row] = _missed(camera, shown(k), points)
        rows = linear_sum_assignment(missed)[1].tolist()
        found.append((float(missed[every, rows].mean()), rows))
    now, (then, rows) = float(missed.trace()) / len(cameras), min(found)
    if then > now / 2 or now - then < _MISSED:
        return
    moved = [f"row {row} is of {masks[k].name}" for k, row in enumerate(rows) if row != k]
    how = ", ".join(moved[:3]) + ", .." * (len(moved) > 3)
    texts = sorted(every, key=str), sorted(every, key=lambda k: str(k + 1))
    if sorted(every, key=rows.__getitem__) in texts:
        how = f"rows are in the order of cameras' numbers as texts, as 1, 10, 11, 2: {how}"
    got = f"clouds of which {1 - now:.0%} falls on the masks, and {1 - then:.0%} if {how}"
    worse = found[1][0] - found[0][0]  # with the blocks of Intrinsic.inf in that order, too
    also = ", and the blocks of Intrinsic.inf"
    also = also if worse < -_MISSED / 2 else f"{also} if they are so, too," if worse < _MISSED / 2 else ""
    advice = f"put the rows of {path.name}{also} into the order of the images' names"
    raise mismatch(path, "a row for each image in the order of their names", got, advice)


def _missed(camera: Camera, mask: Tensor, points: Tensor) -> float:
    """Return which share of points (N, 3) a camera does not see on a mask (H, W)."""
    pixel, z = camera.project(points)
    column, row = pixel.floor().long().unbind(-1)
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
    return 1 - float(mask[row[inside], column[inside]].sum()) / len(points)


def _bounds(folder: Path, numbers: Sequence[int], on_disk: Sequence[int]) -> tuple[Box, list[str], Tensor]:
    """Put a box around the points of the frames of these numbers, the first of those on disk, with some
    padding; also return lines of what was assumed, and some points (N, 3) of the first.

    A cloud's number is its frame's and 1; those of an excerpt may be in its order, and others count from 0 as
    the frames do, which the lines that come with the box say.
    """
    place = folder / "pointclouds"
    paths = (*folder.glob("pointclouds/frame*.obj"), *folder.glob("pointclouds/frame*.npy"))  # .npy wins
    clouds = {int(path.stem[5:]): path for path in paths if path.stem[5:].isdecimal()}
    counted = [number + 1 for number in numbers]
    is_from_0 = on_disk[0] == 0 and 0 in clouds
    is_excerpt = on_disk[0] != 0 and any(number not in clouds for number in counted)
    assumed = []
    if is_from_0 and on_disk[-1] + 1 in clouds:
        line = f"frame0 to frame{on_disk[-1] + 1} are there, of which frame1 is taken for img/0"
        assumed = [f"{place}: {line}; remove frame0, or the last if clouds count from 0"]
    elif is_from_0 or (is_excerpt and len(clouds) == len(on_disk)):
        counted = sorted(clouds)[: len(numbers)] if len(clouds) == len(on_disk) else numbers
        ends = " to ".join(clouds[counted[k]].name for k in (0, -1) if counted[k] in clouds)
        said = f"{ends} ({len(counted)}) taken in the order of the frames"
        assumed = [f"{place}: {said}"]
    if lacking := [number for number in counted if number not in clouds]:
        advice = "add it, or set data.box=[x0,y0,z0,x1,y1,z1]"
        raise mismatch(place / f"frame{lacking[0]}.npy", "a point cloud of each frame", "none", advice)
    first = read_cloud(clouds[counted[0]], 6)[:, :3]
    points_of = chain([first], (read_cloud(clouds[number], 6)[:, :3] for number in counted[1:]))
    first = torch.from_numpy(first[:: -(-len(first) // _POINTS)].copy())
    corners = np.array([(points.min(0), points.max(0)) for points in points_of], np.float64)
    low, high = corners.min((0, 1)), corners.max((0, 1))
    margin = _PADDING * (high - low)
    try:
        return Box((low - margin).tolist(), (high + margin).tolist()), assumed, first
    except ValueError as error:
        got = f"{low.tolist()} to {high.tolist()}"
        raise mismatch(place, "points that span a box", got, "set data.box") from error


def _camera(size: tuple[int, int], matrix: np.ndarray, pose: np.ndarray, halve: bool, box: Box) -> Camera:
    """Make a camera whose near and far enclose the sphere around the box."""
    scale = 0.5 if halve else 1.0  # exactly, whatever an odd side loses
    width, height = (n // 2 if halve else n for n in size)
    fx, skew, cx, _, fy, cy = (scale * matrix[:2]).flatten().tolist()
    radius = box.diagonal / 2
    away = float(np.linalg.norm(pose[:3, 3] - box.center))
    near, far = max(away - radius, 1e-3 * radius), away + radius
    return Camera(width, height, fx, fy, cx, cy, torch.from_numpy(pose), near, far, skew=skew)
