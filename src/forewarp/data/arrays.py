"""Read and write the arrays beside a scene's images: exact depth, exact trajectories, clouds of points."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch
from torch import Tensor

from forewarp.data.cameras import MOST_UNITS
from forewarp.data.files import SceneError, numbers_of, read_bytes
from forewarp.data.images import read_gray16
from forewarp.files import MOST_ARRAYS, MOST_POINTS, written_whole
from forewarp.ops.grid import reduced_depth
from forewarp.scene.frame import Truth

_SAME_TIME = 1e-6


class StoredDepth:
    """Ray depth (H, W) float32 in world units, 0 on the background; read at each call.

    A .npy file, or a grey 16-bit PNG whose values times ``scale`` are world units (None is refused).
    ``size`` (width, height) is what the file must hold; with ``halve`` half of that is given.
    """

    def __init__(
        self, path: Path, size: tuple[int, int], halve: bool = False, scale: float | None = None
    ) -> None:
        if path.suffix == ".png" and scale is None:
            raise SceneError(
                f"{path}: expected depth_scale in the transforms file, world units for one step of a 16-bit "
                "depth, but got none"
            )
        self.path, self.size, self.halve, self.scale = path, size, halve, scale

    def __call__(self) -> Tensor:
        """Read the depth; SceneError where the file holds anything else."""
        depth = read_gray16(self.path) if self.path.suffix == ".png" else load_numpy(self.path)
        expected = f"{self.path}: expected finite depths >= 0 of shape {self.size[::-1]}"
        if getattr(depth, "shape", None) != self.size[::-1] or depth.dtype.kind not in "iuf":
            raise SceneError(f"{expected}, but got shape {getattr(depth, 'shape', None)}")
        with np.errstate(over="ignore", invalid="ignore"):  # too large for float32: refused as infinite
            depth = (depth * (1.0 if self.scale is None else self.scale)).astype(np.float32)
        if not np.isfinite(depth).all() or (depth < 0).any():
            raise SceneError(f"{expected}, but got values from {depth.min()} to {depth.max()}")
        tensor = torch.from_numpy(depth)
        return reduced_depth(tensor) if self.halve else tensor


def read_truth(path: Path, canonical_time: float) -> Truth | None:
    """Read trajectories from an .npz with ``points`` (N, T, 3) and ``times`` (T,); None without the file.

    Raises:
        SceneError: for other keys, shapes or values, or a first time that is not the canonical one.
    """
    if not path.exists():
        return None
    arrays = load_numpy(path)
    names = set(getattr(arrays, "files", ()))
    if not {"points", "times"} <= names:
        raise SceneError(f"{path}: expected arrays points and times, but got {sorted(names)}")
    points, times = _numbers(arrays, "points", path), _numbers(arrays, "times", path)
    if points.ndim != 3 or points.shape[1:] != (times.size, 3) or times.ndim != 1 or not points.size:
        got = f"{points.shape} and {times.shape}"
        raise SceneError(f"{path}: expected points (N, T, 3) and times (T,), but got {got}")
    if times.min() < 0 or times.max() > 1 or abs(times[0] - canonical_time) > _SAME_TIME:
        raise SceneError(
            f"{path}: times: expected numbers in [0, 1] that begin at the canonical time {canonical_time:g}, "
            f"but got {times.min():g} to {times.max():g} beginning at {times[0]:g}"
        )
    return Truth(torch.from_numpy(points.astype(np.float32)), torch.from_numpy(times.astype(np.float64)))


def shortened(truth: Truth, end: float) -> Truth | None:
    """Keep trajectories up to time ``end``, rescaled to 1; return None if fewer than two times remain."""
    kept = truth.times <= end + _SAME_TIME
    if end <= 0 or int(kept.sum()) < 2:
        return None
    return Truth(truth.points[:, kept], (truth.times[kept] / end).clamp(max=1))


def read_cloud(path: Path, columns: int) -> np.ndarray:
    """Read points (N, columns) float32, N >= 1, places first, from a .npy file or the ``v`` lines of an .obj.

    Raises:
        SceneError: where the file is missing, has another shape, values that are not finite, or places beyond
            ``MOST_UNITS``.
    """
    points = _obj_vertices(path, columns) if path.suffix == ".obj" else load_numpy(path)
    shape = getattr(points, "shape", ())
    if len(shape) != 2 or shape[1] != columns or not shape[0] or points.dtype.kind not in "iuf":
        got = f"shape {shape}" if hasattr(points, "shape") else "several arrays"
        raise SceneError(f"{path}: expected points (N, {columns}), but got {got}; export it again")
    with np.errstate(over="ignore", invalid="ignore"):
        points = points.astype(np.float32)
    finite = np.isfinite(points).all(1)
    if not finite.all():
        raise SceneError(
            f"{path}: expected finite numbers, but got {points[~finite][0].tolist()} in row "
            f"{int((~finite).argmax())} and {int((~finite).sum())} such rows; export it again"
        )
    farthest = np.abs(points[:, :3]).max(1)
    if farthest.max() > MOST_UNITS:
        row = int(farthest.argmax())
        raise SceneError(
            f"{path}: expected points within {MOST_UNITS:g} units, but got {farthest[row]:g} in row {row}; "
            "export it again"
        )
    return points


def write_array(path: Path, values: Tensor | np.ndarray) -> None:
    """Write depth (H, W) or points (N, C) as float32 .npy, whole or not at all."""
    with written_whole(path) as beside:
        np.save(beside, np.asarray(values, np.float32))


def write_truth(path: Path, truth: Truth) -> None:
    """Write trajectories for ``read_truth``, whole or not at all."""
    points, times = np.asarray(truth.points, np.float32), np.asarray(truth.times, np.float64)
    with written_whole(path) as beside:
        np.savez(beside, points=points, times=times)


def load_numpy(path: Path):
    """Load a .npy or .npz file without objects; SceneError where it cannot be read."""
    content = read_bytes(path, MOST_ARRAYS, "a NumPy file")
    try:
        if zipfile.is_zipfile(io.BytesIO(content)):
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                unpacked = sum(part.file_size for part in archive.infolist())
            if unpacked > MOST_ARRAYS:
                raise ValueError(f"{unpacked} bytes unpacked")
        elif content.startswith(b"\x93NUMPY"):
            _check_length(content)
        return np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # OSError, ValueError, MemoryError, BadZipFile, zlib.error and more
        raise SceneError(
            f"{path}: expected a NumPy file, but got one that cannot be read ({short(str(error))})"
        ) from error


def _check_length(content: bytes) -> None:
    """Refuse a .npy file whose header declares more data than it holds, before memory is allocated."""
    stream = io.BytesIO(content)
    major, _ = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    shape, _, kind = read(stream)
    if math.prod(shape) * kind.itemsize > len(content):
        raise ValueError(f"an array of {shape} in {len(content)} bytes")


def _numbers(arrays, name: str, path: Path) -> np.ndarray:
    """Take the array ``name``, of finite numbers within ``MOST_UNITS``."""
    try:
        array = arrays[name]
        if not isinstance(array, np.ndarray):  # of a member of an archive that is none NumPy gives the bytes
            raise ValueError("no NumPy header")
    except Exception as error:  # as in load_numpy
        raise SceneError(
            f"{path}: {name}: expected an array, but got one that cannot be read ({short(str(error))})"
        ) from error
    with np.errstate(invalid="ignore"):  # of a NaN of the signalling kind even comparing warns
        good = array.dtype.kind in "iuf" and bool((np.abs(array) <= MOST_UNITS).all())
    if not good:
        expected = f"numbers within {MOST_UNITS:g}"
        raise SceneError(f"{path}: {name}: expected finite {expected}, but got {array.dtype} with others")
    return array


def _obj_vertices(path: Path, columns: int) -> np.ndarray:
    rows, lines = [], read_bytes(path, MOST_POINTS).decode(errors="replace").splitlines()
    for number, line in enumerate(lines, 1):
        if line.split(maxsplit=1)[:1] == ["v"]:
            rows.append(numbers_of(line.split()[1:], columns, f"{path}: line {number}"))
    return np.array(rows).reshape(-1, columns)
