"""Read and write the arrays beside a scene's images: exact trajectories, clouds of points."""

from __future__ import annotations

import zipfile
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch
from torch import Tensor

from forewarp.data.cameras import MOST_UNITS
from forewarp.data.files import mismatch, numbers_of, opened, read_bytes
from forewarp.files import MOST_ARRAYS, MOST_POINTS, unpack_arrays, written_whole
from forewarp.scene.frame import Truth
from forewarp.scene.world import SAME, World

_SAME_TIME = 1e-6


def read_truth(path: Path, canonical_time: float, world: World = SAME) -> Truth | None:
    """Read trajectories from an .npz with ``points`` (N, T, 3), which a world moves to the scene's, and
    ``times`` (T,); None without the file.

    Raises:
        SceneError: for other keys, shapes or values, or a first time that is not the canonical one.
    """
    if not path.exists():
        return None
    arrays = load_numpy(path)
    names = sorted(arrays) if isinstance(arrays, dict) else []
    if not {"points", "times"} <= set(names):
        raise mismatch(path, "arrays points and times", names)
    points, times = (_numbers(arrays[name], f"{path}: {name}") for name in ("points", "times"))
    if points.ndim != 3 or points.shape[1:] != (times.size, 3) or times.ndim != 1 or not points.size:
        raise mismatch(path, "points (N, T, 3) and times (T,)", f"{points.shape} and {times.shape}")
    if times.min() < 0 or times.max() > 1 or abs(times[0] - canonical_time) > _SAME_TIME:
        expected = f"numbers in [0, 1] that begin at the canonical time {canonical_time:g}"
        got = f"{times.min():g} to {times.max():g} beginning at {times[0]:g}"
        raise mismatch(f"{path}: times", expected, got)
    return Truth(world.to_scene(points).float(), torch.from_numpy(times.astype(np.float64)))


def shortened(truth: Truth, end: float) -> Truth | None:
    """Keep trajectories up to time ``end``, rescaled to 1; return None if fewer than two times remain."""
    kept = truth.times <= end + _SAME_TIME
    if end <= 0 or int(kept.sum()) < 2:
        return None
    return Truth(truth.points[:, kept], (truth.times[kept] / end).clamp(max=1))


def read_cloud(path: Path, columns: int) -> np.ndarray:
    """Read points (N, columns) float64, N >= 1, places first, from a .npy file, the ``v`` lines of an .obj
    or the vertices of a .ply, of which places alone are read.

    Raises:
        SceneError: where the file is missing, has another shape, values that are not finite, or places beyond
            ``MOST_UNITS``.
    """
    if path.suffix == ".obj":
        points = _obj_vertices(path, columns)
    else:
        points = _ply_places(path) if path.suffix == ".ply" else load_numpy(path)
    advice = "export it again"
    check_shape(points, path, f"points (N, {columns})", None, columns, advice=advice)
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.array(points, np.float64)
    bad = ~np.isfinite(points).all(1)
    if bad.any():
        got = f"{points[bad][0].tolist()} in row {bad.argmax()} and {bad.sum()} such rows"
        raise mismatch(path, "finite numbers", got, advice)
    farthest = np.abs(points[:, :3]).max(1)
    if farthest.max() > MOST_UNITS:
        got = f"{farthest.max():g} in row {farthest.argmax()}"
        raise mismatch(path, f"points within {MOST_UNITS:g} units", got, advice)
    return points


_PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}


def _ply_places(path: Path) -> np.ndarray:
    """Read the places (N, 3) of a PLY's vertices, text or binary, which must be its first element."""
    head, _, body = read_bytes(path, MOST_POINTS).partition(b"end_header")
    lines = [line.split() for line in head.decode("latin1").splitlines()]
    order = next((_PLY_ORDERS.get(line[1]) for line in lines if line[:1] == ["format"] and line[1:]), None)
    starts = [i for i, line in enumerate(lines) if line[:1] == ["element"]]
    vertices = lines[starts[0] : (*starts, None)[1]] if starts else [[]]
    properties = [line for line in vertices[1:] if line[:1] == ["property"] and len(line) > 2]
    columns = [(line[-1], _PLY_TYPES.get(line[1])) for line in properties]
    is_read = vertices[0][1:2] == ["vertex"] and vertices[0][-1].isdecimal() and order is not None
    if not head.startswith(b"ply") or not is_read:
        expected = f"a PLY ({', '.join(_PLY_ORDERS)}) whose first element is vertices"
        raise mismatch(path, expected, "another file")
    are_numbers = None not in dict(columns).values() and len(dict(columns)) == len(columns)
    if not {*"xyz"} <= dict(columns).keys() or not are_numbers:
        expected = "vertices of plain numbers with different names, x, y, z too"
        raise mismatch(path, expected, f"{columns or 'none'}")
    count = int(vertices[0][-1])
    if order == "=":
        table = _ply_rows(body.decode("latin1").split(), count, len(columns), path)
        rows = dict(zip(dict(columns), table.T))
    else:
        dtype, begin = np.dtype([(name, order + kind) for name, kind in columns]), body.find(b"\n") + 1
        if len(body) - begin < count * dtype.itemsize:
            raise mismatch(path, f"{count} vertices", "a file that ends before", "copy it again")
        rows = np.frombuffer(body, dtype, count, begin)
    return np.stack([np.asarray(rows[name], np.float64) for name in "xyz"], 1)


def _ply_rows(words: list[str], count: int, columns: int, path: Path) -> np.ndarray:
    """Parse the numbers (count, columns) of a text; those that are not finite, too."""
    if len(words) < count * columns:
        raise mismatch(path, f"{count} vertices", "a file that ends before", "copy it again")
    words = words[: count * columns]
    try:
        return np.array(words, np.float64).reshape(count, columns)
    except ValueError:
        for row in range(count):  # which names the first that is no number
            numbers_of(words[row * columns : (row + 1) * columns], columns, f"{path}: vertex {row}")
        raise


def write_array(path: Path, values: Tensor | np.ndarray | None, dtype: type = np.float32) -> None:
    """Write depth (H, W) or points (N, C) as .npy, whole or not at all; nothing of None."""
    if values is None:
        return
    with written_whole(path) as beside:
        np.save(beside, np.asarray(values, dtype))


def write_truth(path: Path, truth: Truth | None) -> None:
    """Write trajectories for ``read_truth``, whole or not at all; nothing of None."""
    if truth is None:
        return
    points, times = np.asarray(truth.points, np.float32), np.asarray(truth.times, np.float64)
    with written_whole(path) as beside:
        np.savez(beside, points=points, times=times)


def check_shape(values: object, where: object, expected: str, *shape: int | None, advice: str = "") -> None:
    """Refuse what is no array of numbers of a shape, in which None is any length but 0."""
    got = getattr(values, "shape", ())
    fits = len(got) == len(shape) and all(n and n == (k or n) for n, k in zip(got, shape))
    if not fits or values.dtype.kind not in "iuf":
        raise mismatch(
            where, expected, f"shape {got}" if hasattr(values, "shape") else "several arrays", advice
        )


def load_numpy(path: Path) -> np.ndarray | dict[str, np.ndarray]:
    """Load the array of a .npy file, the arrays of an .npz; SceneError where they cannot be read."""
    with opened(path, MOST_ARRAYS, "a NumPy file") as stream:
        try:
            if zipfile.is_zipfile(stream):
                stream.seek(0)
                return unpack_arrays(stream.read())
            # Mapped, so that a header that declares more than the file holds is refused without allocation.
            # np.load would leave a file open that begins as an archive and is none.
            return np.lib.format.open_memmap(path, mode="r")
        except Exception as error:  # OSError, ValueError, MemoryError, BadZipFile, zlib.error and more
            got = f"one that cannot be read ({short(str(error))})"
            raise mismatch(path, "a NumPy file", got) from error


def _numbers(array: object, where: str) -> np.ndarray:
    """Check an array of finite numbers within ``MOST_UNITS``."""
    is_array = isinstance(array, np.ndarray)  # of a member of an archive that is none NumPy gives the bytes
    with np.errstate(invalid="ignore"):  # of a NaN of the signalling kind even comparing warns
        if not is_array or array.dtype.kind not in "iuf" or not (np.abs(array) <= MOST_UNITS).all():
            got = f"{array.dtype} with others" if is_array else "no array"
            raise mismatch(where, f"finite numbers within {MOST_UNITS:g}", got)
    return array


def _obj_vertices(path: Path, columns: int) -> np.ndarray:
    lines = read_bytes(path, MOST_POINTS).decode(errors="replace").splitlines()
    rows = [
        numbers_of(line.split()[1:], columns, f"{path}: line {i}")
        for i, line in enumerate(lines, 1)
        if line.split(maxsplit=1)[:1] == ["v"]
    ]
    return np.array(rows).reshape(-1, columns)
