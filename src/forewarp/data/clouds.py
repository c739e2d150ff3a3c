"""Point clouds on disk."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np

from forewarp.data.files import read_bytes
from forewarp.data.truth import load_numpy
from forewarp.data.views import MOST_UNITS
from forewarp.files import replace_file
from forewarp.scene.errors import SceneError

_MOST_BYTES = 1 << 28  # of text


def read_cloud(path: Path, columns: int) -> np.ndarray:
    """The points (N, columns) float32, N >= 1, of a .npy file or of the ``v`` lines of an .obj file; their
    places come first.

    Raises:
        SceneError: where the file is missing, has another shape, values that are not finite, or places beyond
            ``MOST_UNITS``.
    """
    points = _obj_vertices(path, columns) if path.suffix == ".obj" else load_numpy(path)
    shape = getattr(points, "shape", None)
    if (
        shape is None
        or len(shape) != 2
        or shape[1] != columns
        or not shape[0]
        or points.dtype.kind not in "iuf"
    ):
        raise SceneError(f"{path}: expected points (N, {columns}), but got shape {shape}; export it again")
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


def write_cloud(path: Path, points: np.ndarray) -> None:
    """Write points (N, C) as float32 .npy, whole or not at all."""
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(points, np.float32))
    replace_file(path, buffer.getvalue())


def _obj_vertices(path: Path, columns: int) -> np.ndarray:
    rows, lines = [], read_bytes(path, _MOST_BYTES).decode(errors="replace").splitlines()
    for number, line in enumerate(lines, 1):
        if line.split(maxsplit=1)[:1] == ["v"]:
            rows.append(numbers_of(line.split()[1:], columns, f"{path}: line {number}"))
    return np.array(rows).reshape(-1, columns)


def numbers_of(words: list[str], count: int, where: str) -> list[float]:
    """``count`` finite numbers written in a line of text.

    >>> numbers_of(["1", "2.5"], 2, "a.txt: line 1")
    [1.0, 2.5]
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = None
    if values is None or len(values) != count or not all(map(math.isfinite, values)):
        got = f"{len(words)} values" if values and len(values) != count else repr(" ".join(words))[:60]
        raise SceneError(f"{where}: expected {count} finite numbers, but got {got}")
    return values
