"""NHR scenes: a performer filmed by a dome of still cameras, all at the same moments.

``CamPose.inf`` has a line per camera, the columns of [R|T] camera-to-world with OpenCV's axes in the order
z, x, y, centre; ``Intrinsic.inf`` a block per camera, its number and a 3 x 3 matrix. Frame f, from 0, has
``img/<f>/img_%04d.jpg``, the foreground in ``img/<f>/mask/`` under the same names, and its points x y z r g b
in ``pointclouds/frame<f + 1>.npy`` (older: .obj). Beside them there may be ``trajectories.npz``.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from forewarp.data.arrays import read_cloud, read_truth, shortened, write_array, write_truth
from forewarp.data.cameras import box_of, pose_of
from forewarp.data.files import MARKERS, SceneError, number, numbers_of, read_bytes, scene_folder, whole
from forewarp.data.images import MaskedImage, inspect_image, write_jpeg
from forewarp.files import replace_file
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene, Truth

_PADDING = 0.1  # of the points' extent, on every side
_ORDER = [2, 0, 1, 3]  # of a pose's columns in a line: z axis, x axis, y axis, centre
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
    test_views: Sequence[int] | None = None,
    test_every: int = 1,
) -> Scene:
    """Read ``root/scene``; of the images only headers are read, pixels are decoded when a frame is loaded.

    Args:
        half_resolution: average 2 x 2 pixels; an odd last row or column is cut off.
        box: x0 y0 z0 x1 y1 z1 in world units; None takes the bounds of all point clouds, 10 % wider per side.
        frames: how many, from the first; where there are fewer, all. The last of them is at the time 1.
        test_views: numbers of the cameras held out; None spreads 6 of every 56 over them.
        test_every: measure every n-th frame only.

    Raises:
        SceneError: for every file or value that is missing or wrong, with file and line.

    Cost: two small reads an image and one of every point.
    """
    folder = scene_folder(root, scene, MARKERS["nhr"])
    if not isinstance(half_resolution, bool):
        raise SceneError(f"data.half_resolution: expected true or false, but got {half_resolution!r}")
    poses, lenses = _read_cameras(folder)
    held = _held_out(test_views, len(poses), folder)
    every, (moments, there) = whole(test_every, "data.test_every", 1), _moments(folder, frames)
    sizes = _read_sizes(folder, moments, len(poses), half_resolution)
    bounds = _bounds(folder, moments) if box is None else box_of(box)
    cameras = [_camera(*of, half_resolution, bounds) for of in zip(sizes, lenses, poses, strict=True)]

    def view(f: int, k: int) -> Frame:
        place, name = folder / "img" / str(f), f"img_{k:04d}.jpg"
        load = MaskedImage(place / name, place / "mask" / name, sizes[k], half_resolution)
        ability = "space" if k in held else "all"
        return Frame(
            f"{f}/img_{k:04d}", f / max(moments - 1, 1), cameras[k], load, ability=ability, camera_id=k
        )

    train = tuple(view(f, k) for f in range(moments) for k in range(len(poses)) if k not in held)
    test = tuple(view(f, k) for f in range(0, moments, every) for k in held)
    protocol = {
        "dataset": "nhr",
        "resolution": [list(size) for size in sorted({(c.width, c.height) for c in cameras}, reverse=True)],
        "half_resolution": half_resolution,
        "frames": moments,
        "views": len(poses),
        "test_views": held,
        "test_frames": len(test),
        "mask_box": True,
    }
    truth = _trajectories(folder, moments, there)
    return Scene(scene, train, (), test, bounds, 0.0, True, truth, protocol)


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
        raise ValueError("cameras: expected none with a lens, as the format has none; undistort the images")
    _remove(folder)
    for f, frame in enumerate(frames):
        _write_frame(folder, f, frame, cameras)
    if trajectories is not None:
        write_truth(folder / "trajectories.npz", trajectories)
    _write_cameras(folder, cameras)


def _write_frame(folder: Path, f: int, frame: DomeFrame, cameras: Sequence[Camera]) -> None:
    counts = (len(frame.images), len(frame.masks))
    if counts != (len(cameras),) * 2:
        raise ValueError(f"frame {f}: expected {len(cameras)} images and as many masks, but got {counts}")
    place = folder / "img" / str(f)
    for k, (camera, image, mask) in enumerate(zip(cameras, frame.images, frame.masks)):
        name, shape = f"img_{k:04d}.jpg", (camera.height, camera.width)
        got = tuple(image.shape), tuple(mask.shape)
        if got != ((*shape, 3), shape):
            raise ValueError(f"frame {f}: {name}: expected the camera's size {shape}, but got {got}")
        write_jpeg(place / name, image)
        write_jpeg(place / "mask" / name, mask)
    write_array(folder / "pointclouds" / f"frame{f + 1}.npy", frame.points)


def _remove(folder: Path) -> None:
    """Remove the scene that is there, poses first; other files stay."""
    for name in ("CamPose.inf", "Intrinsic.inf", "trajectories.npz"):
        (folder / name).unlink(missing_ok=True)
    for pattern in ("img/*/img_*.jpg", "img/*/mask/img_*.jpg", "pointclouds/frame*.*"):
        for stale in folder.glob(pattern):
            stale.unlink()
    for emptied in (*folder.glob("img/*/mask"), *folder.glob("img/*")):
        if not any(emptied.iterdir()):
            emptied.rmdir()


def _write_cameras(folder: Path, cameras: Sequence[Camera]) -> None:
    """Write what ``_read_cameras`` reads, with all digits, the poses last."""
    lenses = [
        f"{k}\n{c.fx!r} {c.skew!r} {c.cx!r}\n0.0 {c.fy!r} {c.cy!r}\n0.0 0.0 1.0\n\n"
        for k, c in enumerate(cameras)
    ]
    replace_file(folder / "Intrinsic.inf", "".join(lenses))
    poses = [camera.camera_to_world[:3, _ORDER].double().T.flatten().tolist() for camera in cameras]
    replace_file(folder / "CamPose.inf", "".join(" ".join(map(repr, pose)) + "\n" for pose in poses))


def _read_cameras(folder: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Read the poses (4, 4) and intrinsic matrices (3, 3), float64; refuse files with unequal numbers."""
    poses, lenses = _read_poses(folder / "CamPose.inf"), _read_lenses(folder / "Intrinsic.inf")
    if len(poses) != len(lenses):
        got = f"{len(lenses)} there and {len(poses)} in CamPose.inf"
        raise SceneError(f"{folder / 'Intrinsic.inf'}: expected as many cameras as poses, but got {got}")
    return poses, lenses


def _read_poses(path: Path) -> list[np.ndarray]:
    """Read camera-to-world matrices (4, 4) float64 with OpenCV's axes, one a line.

    Raises:
        SceneError: naming the line that does not hold 12 numbers, or no rotation.
    """
    poses = []
    for line, words in _lines(path):
        where = f"{path}: line {line}"
        columns = np.array(numbers_of(words, 12, where)).reshape(4, 3).T
        matrix = np.eye(4)
        matrix[:3, _ORDER] = columns
        poses.append(pose_of(matrix, where))
    return poses


def _read_lenses(path: Path) -> list[np.ndarray]:
    """Read the matrix (3, 3) of every block: fx s cx, 0 fy cy, 0 0 1, in pixels of the stored images.

    A block is a camera's number and nine numbers, however they are spread over lines; cameras count up from
    0 or from 1.

    Raises:
        SceneError: naming the line where a block is anything else.
    """
    words = [(line, word) for line, row in _lines(path) for word in row]
    first, matrices = int(words[0][1] == "1"), []
    for k, block in enumerate((words[i : i + 10] for i in range(0, len(words), 10)), first):
        line, word = block[0]
        if word != str(k):
            raise SceneError(f"{path}: line {line}: expected the number {k} of a camera, but got {word!r}")
        if len(block) < 10:
            raise SceneError(
                f"{path}: line {block[-1][0]}: expected nine numbers of camera {k}, but got the end of the "
                f"file after {len(block) - 1}"
            )
        rows = (block[i : i + 3] for i in (1, 4, 7))
        matrices.append(_matrix([(row[0][0], [word for _, word in row]) for row in rows], path))
    return matrices


def _matrix(rows: list[tuple[int, list[str]]], path: Path) -> np.ndarray:
    """Check the numbered rows fx s cx, 0 fy cy, 0 0 1 and make a matrix (3, 3)."""
    where = [f"{path}: line {line}" for line, _ in rows]
    (fx, skew, cx), (zero, fy, cy), last = (numbers_of(words, 3, at) for at, (_, words) in zip(where, rows))
    for at, focal, *others in ((where[0], fx, skew, cx), (where[1], fy, cy)):
        number(focal, f"{at}: focal length", 1e-3, _MOST_PIXELS_OFF)
        for value in others:
            number(value, f"{at}: principal point and skew", -_MOST_PIXELS_OFF, _MOST_PIXELS_OFF)
    if zero != 0:
        raise SceneError(f"{where[1]}: expected a row 0 fy cy, but got {zero:g} {fy:g} {cy:g}")
    if last != [0, 0, 1]:
        raise SceneError(f"{where[2]}: expected the row 0 0 1, but got {' '.join(f'{v:g}' for v in last)}")
    return np.array([[fx, skew, cx], [zero, fy, cy], last])


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """List the lines that are not blank: their numbers from 1 and their words."""
    text = read_bytes(path).decode("utf-8-sig", errors="replace")
    found = [(n, line.split()) for n, line in enumerate(text.split("\n"), 1) if line.strip()]
    if not found:
        raise SceneError(f"{path}: expected at least one camera, but got an empty file")
    return found


def _held_out(views: Sequence[int] | None, count: int, folder: Path) -> list[int]:
    """Choose the cameras that are measured, ascending."""
    if count < 2:
        raise SceneError(f"{folder / 'CamPose.inf'}: expected at least 2 cameras, one to measure, but got 1")
    if views is None:
        tests = max(1, round(count * 6 / 56))
        return [i * count // tests for i in range(tests)]
    good = isinstance(views, Sequence) and all(type(k) is int and 0 <= k < count for k in views)
    if not good or not 0 < len(set(views)) < count or len(set(views)) < len(views):
        raise SceneError(
            f"data.test_views: expected different cameras of 0 to {count - 1}, not all, but got {views!r}"
        )
    return sorted(views)


def _moments(folder: Path, frames: int) -> tuple[int, int]:
    """Count the frames to read, numbered from 0 without a gap, and those on disk."""
    wanted, place = whole(frames, "data.frames", 1), folder / "img"
    there = {p.name for p in place.iterdir() if p.is_dir()} if place.is_dir() else set()
    numbers = [int(name) for name in there if name.isdecimal() and name == str(int(name))]
    count = min(wanted, len(numbers))
    missing = [f for f in range(max(count, 1)) if str(f) not in there]
    if missing:
        raise SceneError(f"{place / str(missing[0])}: expected a folder of images, but got none")
    return count, len(numbers)


def _trajectories(folder: Path, moments: int, there: int) -> Truth | None:
    """Read the trajectories of the first ``moments``; the file's times are those of all frames on disk."""
    truth = read_truth(folder / "trajectories.npz", 0.0)
    if truth is None or moments == there:
        return truth
    return shortened(truth, (moments - 1) / (there - 1))


def _read_sizes(folder: Path, moments: int, views: int, halve: bool) -> list[tuple[int, int]]:
    """Read the size (width, height) of every camera's images and check that all have it."""
    names = [f"img_{k:04d}.jpg" for k in range(views)]
    sizes: list[tuple[int, int]] = []
    for f in range(moments):
        for place in (folder / "img" / str(f), folder / "img" / str(f) / "mask"):
            _check_names(place, names)
            found = [inspect_image(place / name).size for name in names]
            sizes = sizes or found
            for name, size, expected in zip(names, found, sizes, strict=True):
                if size != expected:
                    raise SceneError(
                        f"{place / name}: expected {expected[0]} x {expected[1]} pixels as in "
                        f"img/0/{name}, but got {size[0]} x {size[1]}"
                    )
                if halve and min(size) < 2:
                    got = f"{size[0]} x {size[1]}"
                    raise SceneError(
                        f"{place / name}: expected at least 2 x 2 pixels to halve, but got {got}"
                    )
    return sizes


def _check_names(place: Path, names: list[str]) -> None:
    there = {name for name in os.listdir(place) if name.startswith("img_")} if place.is_dir() else set()
    for name in names:
        if name not in there:
            raise SceneError(
                f"{place / name}: expected an image of every camera of CamPose.inf, but got none"
            )
    if extra := sorted(there.difference(names)):
        raise SceneError(
            f"{place / extra[0]}: expected images of the {len(names)} cameras of CamPose.inf, but got another"
        )


def _bounds(folder: Path, moments: int) -> Box:
    """Put a box around the points of all frames, with some padding."""
    corners = []
    for f in range(1, moments + 1):
        path, old = (folder / "pointclouds" / f"frame{f}{suffix}" for suffix in (".npy", ".obj"))
        points = read_cloud(old if old.is_file() and not path.is_file() else path, 6)[:, :3]
        corners += [points.min(0), points.max(0)]
    low, high = np.min(corners, 0).astype(np.float64), np.max(corners, 0).astype(np.float64)
    margin = _PADDING * (high - low)
    try:
        return Box(tuple((low - margin).tolist()), tuple((high + margin).tolist()))
    except ValueError as error:
        raise SceneError(
            f"{folder / 'pointclouds'}: expected points that span a box, but got {low.tolist()} to "
            f"{high.tolist()}; set data.box"
        ) from error


def _camera(size: tuple[int, int], lens: np.ndarray, pose: np.ndarray, halve: bool, box: Box) -> Camera:
    """Make a camera whose near and far enclose the sphere around the box."""
    scale = 0.5 if halve else 1.0  # exactly, whatever an odd side loses
    width, height = (n // 2 if halve else n for n in size)
    fx, skew, cx, _, fy, cy = (scale * lens[:2]).flatten().tolist()
    radius = box.diagonal / 2
    away = float(np.linalg.norm(pose[:3, 3] - box.center))
    near, far = max(away - radius, 1e-3 * radius), away + radius
    return Camera(width, height, fx, fy, cx, cy, torch.from_numpy(pose), near, far, skew=skew)
