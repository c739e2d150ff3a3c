"""The camera files of NHR scenes: ``CamPose.inf`` and ``Intrinsic.inf``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from forewarp.data.clouds import numbers_of
from forewarp.data.files import number, read_bytes
from forewarp.data.views import pose_of
from forewarp.files import replace_file
from forewarp.scene.camera import Camera
from forewarp.scene.errors import SceneError

_ORDER = [2, 0, 1, 3]  # of a pose's columns in a line: z axis, x axis, y axis, centre
_MOST_PIXELS_OFF = 1e7  # beyond it a lens is a slip


def read_cameras(folder: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Poses and lenses, as ``read_poses`` and ``read_lenses`` give them; there must be as many of both."""
    poses, lenses = read_poses(folder / "CamPose.inf"), read_lenses(folder / "Intrinsic.inf")
    if len(poses) != len(lenses):
        got = f"{len(lenses)} there and {len(poses)} in CamPose.inf"
        raise SceneError(f"{folder / 'Intrinsic.inf'}: expected as many cameras as poses, but got {got}")
    return poses, lenses


def write_cameras(folder: Path, cameras: Sequence[Camera]) -> None:
    """Write what ``read_cameras`` reads, the poses last."""
    write_lenses(folder / "Intrinsic.inf", cameras)
    write_poses(folder / "CamPose.inf", cameras)


def read_poses(path: Path) -> list[np.ndarray]:
    """Camera-to-world (4, 4) float64 with OpenCV's axes, one a line.

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


def read_lenses(path: Path) -> list[np.ndarray]:
    """The matrix (3, 3) of every block: fx s cx, 0 fy cy, 0 0 1, in pixels of the stored images.

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
    """The numbered rows fx s cx, 0 fy cy, 0 0 1 as a checked matrix (3, 3)."""
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


def write_poses(path: Path, cameras: Sequence[Camera]) -> None:
    """Write what ``read_poses`` reads, every digit of it."""
    poses = [camera.camera_to_world[:3, _ORDER].double().T.flatten().tolist() for camera in cameras]
    replace_file(path, "".join(" ".join(map(repr, pose)) + "\n" for pose in poses).encode())


def write_lenses(path: Path, cameras: Sequence[Camera]) -> None:
    """Write what ``read_lenses`` reads, every digit of it."""
    blocks = [
        f"{k}\n{c.fx!r} {c.skew!r} {c.cx!r}\n0.0 {c.fy!r} {c.cy!r}\n0.0 0.0 1.0\n\n"
        for k, c in enumerate(cameras)
    ]
    replace_file(path, "".join(blocks).encode())


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """The lines that are not blank, as their numbers from 1 and their words."""
    text = read_bytes(path).decode("utf-8-sig", errors="replace")
    found = [(n, line.split()) for n, line in enumerate(text.split("\n"), 1) if line.strip()]
    if not found:
        raise SceneError(f"{path}: expected at least one camera, but got an empty file")
    return found
