"""``format=ply``: Gaussians in the layout of splat viewers, voxels as coloured points; and the PLY writer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.export.tracks import Progress, Source, tracks_of
from forewarp.scene.cloud import Ellipsoids

_TYPES = {"float32": "float", "uint8": "uchar"}
_ALL = 1 << 31  # more points than there are
_LOGIT_EPS = 1e-6  # opacities are clamped to [eps, 1 - eps], as their logits are written


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
    """Return the columns ``x y z red green blue`` of points (N, 3) with colours (N, 3) in [0, 1]."""
    xyz = points.detach().float().cpu().numpy()
    rgb = (colors.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()
    return dict(zip(("x", "y", "z", "red", "green", "blue"), (*xyz.T, *rgb.T)))


def splat_columns(cloud: Ellipsoids, degree: int = 3) -> dict[str, np.ndarray]:
    """Return the columns of Gaussians as splat viewers read them.

    ``x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*``: normals are 0; ``f_rest`` has all coefficients
    of red, then green, then blue, ``(degree + 1)^2 - 1`` each, 0 above the cloud's own degree; opacity is a
    logit, scales are natural logarithms of standard deviations, ``rot`` is a quaternion w, x, y, z.
    """
    count, (scales, quaternions) = len(cloud), cloud.axes
    harmonics = cloud.harmonics.new_zeros(count, (degree + 1) ** 2, 3)
    stored = min(cloud.harmonics.shape[1], harmonics.shape[1])
    harmonics[:, :stored] = cloud.harmonics[:, :stored]
    rest = harmonics[:, 1:].transpose(1, 2).reshape(count, -1)
    logit = torch.logit(cloud.opacity.double(), eps=_LOGIT_EPS)[:, None]
    normals = torch.zeros_like(cloud.centers)
    blocks = [cloud.centers, normals, harmonics[:, 0], rest, logit, scales.log(), quaternions]
    table = torch.cat([block.detach().float() for block in blocks], 1).cpu().numpy()
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [*(f"f_rest_{i}" for i in range(rest.shape[1])), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return dict(zip(names, table.T))


def export_ply(source: Source, folder: Path, progress: Progress, *, degree: int, up: str) -> dict:
    """Write ``frames/frame_0000.ply`` and so on; of particles also ``canonical.ply`` and ``motion.npz``,
    which moves it.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: called after each file.
        degree: of the spherical harmonics in a file, 0 to 3.
        up: see ``Source.rotation_to``; ``canonical.ply`` and ``motion.npz`` are not rotated.

    Returns:
        the facts for ``about.json``.

    Raises:
        ValueError: for a method that is neither particles nor can be followed.
    """
    source.refuse_without_tracks("ply")
    (folder / "frames").mkdir()
    rotation, total = source.rotation_to(up), len(source.times)
    files = [folder / "frames" / f"frame_{number:04d}.ply" for number in range(total)]
    if not source.has_ellipsoids:
        tracks = tracks_of(source, _ALL, progress)
        for file, places in zip(files, tracks.positions @ rotation.T.float()):
            write_ply(file, point_columns(places, tracks.colors[0]))
        return {
            "points": len(tracks),
            "kind": "points of the surface",
            "colors": "sRGB, 8 bits, as in the pictures",
            "up": up,
        }
    for number, (file, time) in enumerate(zip(files, source.times)):
        cloud = source.method.ellipsoids(time)
        write_ply(file, splat_columns(cloud if up == "world" else cloud.turned(rotation), degree))
        progress(number + 1, total)
    template = source.method.template()
    write_ply(folder / "canonical.ply", splat_columns(template, degree))
    motion = {name: value.cpu().numpy() for name, value in source.method.movement(source.times).items()}
    np.savez(folder / "motion.npz", times=np.array(source.times, np.float32), **motion)
    return {
        "particles": len(template),
        "kind": "Gaussian splats",
        "up": up,
        "degree": degree,
        "degree of the run": int(template.harmonics.shape[1] ** 0.5) - 1,
        "colors": "sRGB, as in the pictures: 1/2 + 0.28209479177387814 f_dc is the mean over directions",
    }
