"""Exact depth and exact trajectories beside a scene's images."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.data.files import replace_file
from forewarp.data.images import halved_depth
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Truth


class StoredDepth:
    """Ray depth in a .npy file, (H, W) float32 in world units, 0 on the background; read at each call.

    ``size`` (width, height) is what the file must hold; with ``halve`` half of that is given.
    """

    def __init__(self, path: Path, size: tuple[int, int], halve: bool = False) -> None:
        self.path, self.size, self.halve = path, size, halve

    def __call__(self) -> Tensor:
        """The depth; raises SceneError where the file holds anything else."""
        depth = _load(self.path)
        expected = f"{self.path}: expected finite depths >= 0 of shape {self.size[::-1]}"
        if (
            not isinstance(depth, np.ndarray)
            or depth.shape != self.size[::-1]
            or depth.dtype.kind not in "iuf"
        ):
            raise SceneError(f"{expected}, but got shape {getattr(depth, 'shape', None)}")
        if not np.isfinite(depth).all() or (depth < 0).any():
            raise SceneError(f"{expected}, but got values from {depth.min()} to {depth.max()}")
        tensor = torch.from_numpy(depth.astype(np.float32))
        return halved_depth(tensor) if self.halve else tensor


def write_depth(path: Path, depth: Tensor | np.ndarray) -> None:
    """Write ray depth (H, W) as float32 .npy, whole or not at all."""
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(depth, dtype=np.float32))
    replace_file(path, buffer.getvalue())


def read_truth(path: Path, canonical_time: float) -> Truth | None:
    """The trajectories in an .npz with ``points`` (N, T, 3) and ``times`` (T,); None without the file.

    Raises:
        SceneError: for other keys, shapes or values, or a first time that is not the canonical one.
    """
    if not path.exists():
        return None
    arrays = _load(path)
    names = set(getattr(arrays, "files", ()))
    if not {"points", "times"} <= names:
        raise SceneError(f"{path}: expected arrays points and times, but got {sorted(names)}")
    points, times = _numbers(arrays, "points", path), _numbers(arrays, "times", path)
    if points.ndim != 3 or points.shape[1:] != (times.size, 3) or times.ndim != 1 or not points.size:
        got = f"{points.shape} and {times.shape}"
        raise SceneError(f"{path}: expected points (N, T, 3) and times (T,), but got {got}")
    if times.min() < 0 or times.max() > 1 or abs(times[0] - canonical_time) > 1e-6:
        raise SceneError(
            f"{path}: times: expected numbers in [0, 1] that begin at the canonical time {canonical_time:g}, "
            f"but got {times.min():g} to {times.max():g} beginning at {times[0]:g}"
        )
    return Truth(torch.from_numpy(points.astype(np.float32)), torch.from_numpy(times.astype(np.float64)))


def write_truth(path: Path, truth: Truth) -> None:
    """Write trajectories for ``read_truth``, whole or not at all."""
    buffer = io.BytesIO()
    np.savez(buffer, points=np.asarray(truth.points, np.float32), times=np.asarray(truth.times, np.float64))
    replace_file(path, buffer.getvalue())


def _load(path: Path):
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SceneError(
            f"{path}: expected a NumPy file, but got one that cannot be read ({error})"
        ) from error


def _numbers(arrays, name: str, path: Path) -> np.ndarray:
    try:
        array = arrays[name]
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SceneError(
            f"{path}: {name}: expected an array, but got one that cannot be read ({error})"
        ) from error
    if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise SceneError(f"{path}: {name}: expected finite numbers, but got {array.dtype}")
    return array
