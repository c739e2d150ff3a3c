"""``format=ply``: particles in the layout of Gaussian-splat viewers, voxels as coloured points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.export.source import Progress, Source, tracks_of
from forewarp.scene.cloud import Ellipsoids

_TYPES = {"float32": "float", "uint8": "uchar"}
_EVERY = 1 << 31  # points
_SURE = 1e-6  # opacities this near to 0 and 1 are written as this, as their logits are


def write_ply(path: Path, columns: Mapping[str, np.ndarray], faces: np.ndarray | None = None) -> None:
    """Write a binary little-endian PLY.

    Args:
        path: of the file.
        columns: (N,) float32 or uint8 each, properties of the vertices by name, in their order.
        faces: (F, 3) rows of the vertices of triangles; None: the file has only points.
    """
    dtype = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), dtype)
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    for name, column in columns.items():
        table[name] = column
        lines.append(f"property {_TYPES[column.dtype.name]} {name}")
    parts = [table.tobytes()]
    if faces is not None:
        corners = np.empty(len(faces), [("count", "u1"), ("rows", "<i4", 3)])
        corners["count"], corners["rows"] = 3, faces
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        parts.append(corners.tobytes())
    lines.append("end_header\n")
    path.write_bytes("\n".join(lines).encode() + b"".join(parts))


def point_columns(points: Tensor, colors: Tensor) -> dict[str, np.ndarray]:
    """Columns of points (N, 3) with colours (N, 3) in [0, 1]: ``x y z red green blue``."""
    places = _named(points, "xyz")
    shown = (colors.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()
    return places | dict(zip(("red", "green", "blue"), shown.T))


def splat_columns(cloud: Ellipsoids, degree: int = 3) -> dict[str, np.ndarray]:
    """Columns of ellipsoids as Gaussian-splat viewers read them.

    ``x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*``: normals are 0; ``f_rest`` has all coefficients
    of red, then green, then blue, ``(degree + 1)^2 - 1`` each, 0 above the cloud's own degree; opacity is a
    logit, scales are natural logarithms of standard deviations, ``rot`` is w, x, y, z.
    """
    count, scales_and_turns = len(cloud), cloud.axes
    own, wanted = cloud.harmonics.shape[1], (degree + 1) ** 2
    harmonics = cloud.harmonics.new_zeros(count, wanted, 3)
    harmonics[:, : min(own, wanted)] = cloud.harmonics[:, :wanted]
    rest = harmonics[:, 1:].transpose(1, 2).reshape(count, -1)
    columns = _named(cloud.centers, "xyz")
    columns |= _named(torch.zeros(count, 3), ("nx", "ny", "nz"))
    columns |= _numbered("f_dc", harmonics[:, 0])
    columns |= _numbered("f_rest", rest)
    columns |= _named(torch.logit(cloud.opacity.double(), eps=_SURE)[:, None], ["opacity"])
    columns |= _numbered("scale", scales_and_turns[0].log())
    return columns | _numbered("rot", scales_and_turns[1])


def _numbered(name: str, values: Tensor) -> dict[str, np.ndarray]:
    return _named(values, [f"{name}_{i}" for i in range(values.shape[1])])


def _named(values: Tensor, names) -> dict[str, np.ndarray]:
    return dict(zip(names, values.detach().float().cpu().numpy().T))


def export_ply(source: Source, folder: Path, progress: Progress, *, degree: int, up: str) -> dict:
    """Write ``frames/frame_0000.ply`` and so on; of particles also ``canonical.ply``, which is what
    ``motion.npz`` moves.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: told after each file.
        degree: of the harmonics in a file, 0 to 3.
        up: see ``Source.turn_to``; what ``motion.npz`` moves is not turned.

    Returns:
        what ``about.json`` says of it.

    Raises:
        ValueError: for a method that is neither particles nor can be followed.
    """
    source.refuse_without_tracks("ply")
    (folder / "frames").mkdir()
    turn = source.turn_to(up)
    if not source.has_ellipsoids:
        return _export_points(source, folder, progress, turn) | {"up": up}
    total = len(source.times)
    for number, time in enumerate(source.times):
        cloud = source.method.ellipsoids(time)
        cloud = cloud if up == "world" else cloud.turned(turn)
        write_ply(_frame(folder, number), splat_columns(cloud, degree))
        progress(number + 1, total)
    template = source.method.template()
    write_ply(folder / "canonical.ply", splat_columns(template, degree))
    motion = {name: value.cpu().numpy() for name, value in source.method.movement(source.times).items()}
    np.savez(folder / "motion.npz", times=np.array(source.times, np.float32), **motion)
    own = int(template.harmonics.shape[1] ** 0.5) - 1
    return {
        "particles": len(template),
        "kind": "Gaussian splats",
        "up": up,
        "degree": degree,
        "degree of the run": own,
        "colors": "sRGB, as in the pictures: 1/2 + 0.28209479177387814 f_dc is the mean over directions",
    }


def _export_points(source: Source, folder: Path, progress: Progress, turn: Tensor) -> dict:
    tracks = tracks_of(source, _EVERY, progress)
    for number, places in enumerate(tracks.positions @ turn.T.float()):
        write_ply(_frame(folder, number), point_columns(places, tracks.colors[0]))
    return {
        "points": len(tracks),
        "kind": "points of the surface",
        "colors": "sRGB, 8 bits, as in the pictures",
    }


def _frame(folder: Path, number: int) -> Path:
    return folder / "frames" / f"frame_{number:04d}.ply"
