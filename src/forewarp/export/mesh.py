"""``format=mesh``: the surface at each time, by marching cubes, with colours."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from forewarp.export.ply import point_columns, write_ply
from forewarp.export.source import Progress, Source
from forewarp.methods.method import HasBounds, HasSolid
from forewarp.scene.box import Box, Lattice
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.view import Moment

_BLUR = 0.5  # spacings of the lattice that ellipsoids are blurred by, so that none falls between its points
_REACH = 1 / 255  # opacity below which an ellipsoid ends, as in pictures
_SURE = 1 - 1e-6  # most opacity of a place, so that its optical depth is finite
_PAIRS = 1 << 19  # of an ellipsoid and a point, at a time


class Mesh(NamedTuple):
    """``vertices`` (V, 3) in world units, their ``colors`` (V, 3) in [0, 1], and ``faces`` (F, 3) rows of
    vertices, counter-clockwise seen from outside.
    """

    vertices: Tensor
    colors: Tensor
    faces: np.ndarray


def lattice_in(box: Box, resolution: int) -> Lattice:
    """Make a lattice of cubes: ``resolution`` points along the longest side of a box, and two more around.

    >>> lattice_in(Box((0, 0, 0), (1, 2, 1)), 5).shape
    (7, 9, 7)
    """
    step = max(box.size) / (resolution - 1)
    counts = [math.ceil(side / step - 1e-6) + 5 for side in box.size]
    low = [c - 0.5 * step * (n - 1) for c, n in zip(box.center, counts)]
    high = [l + step * (n - 1) for l, n in zip(low, counts)]
    return Lattice(Box(tuple(low), tuple(high)), tuple(counts))


def solid_of(cloud: Ellipsoids, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """Opacity (X, Y, Z) and colour (X, Y, Z, 3) of ellipsoids on a lattice: ``1 - prod_i (1 - o_i g_i)``,
    with ``g_i`` the Gaussian, 1 in its middle, blurred by half a spacing; the mean colour by optical depth.

    Cost: linear in the points inside every ellipsoid; memory in a chunk of them.
    """
    step = lattice.spacing[0]
    blurred = cloud.covariances.double() + (_BLUR * step) ** 2 * torch.eye(3).to(cloud.covariances).double()
    opacity = cloud.opacity.double().clamp(max=_SURE)
    reach = (2 * (opacity / _REACH).clamp(min=1).log())[:, None] * blurred.diagonal(dim1=-2, dim2=-1)
    middle, half = lattice.to_lattice(cloud.centers.double()), reach.sqrt() / step
    last = torch.tensor(lattice.shape, device=middle.device) - 1
    low = torch.minimum((middle - half).ceil().clamp(min=0), last + 1.0).long()
    high = torch.minimum((middle + half).floor(), last.double()).clamp(min=-1).long()
    counts = (high - low + 1).clamp(min=0) * (opacity > _REACH)[:, None]
    total = counts.prod(-1)
    inverse, colors = torch.linalg.inv(blurred) * step**2, cloud.colors.double()
    depth = torch.zeros(lattice.count, 4, dtype=torch.float64, device=middle.device)
    strides = torch.tensor([lattice.shape[1] * lattice.shape[2], lattice.shape[2], 1], device=middle.device)
    ends = total.cumsum(0)
    begin = 0
    while begin < len(cloud):
        done = int(ends[begin - 1]) if begin else 0
        end = max(begin + 1, int(torch.searchsorted(ends, done + _PAIRS, right=True)))
        rows = torch.arange(begin, end, device=middle.device)
        owner = rows.repeat_interleave(total[rows])
        rank = torch.arange(len(owner), device=middle.device) + done - (ends - total)[owner]
        wide, deep = counts[owner, 1], counts[owner, 2]
        offset = torch.stack([rank // (wide * deep), rank // deep % wide, rank % deep], -1)
        point = low[owner] + offset
        away = point - middle[owner]
        fall = torch.exp(-0.5 * torch.einsum("pi,pij,pj->p", away, inverse[owner], away))
        added = -torch.log1p(-opacity[owner] * fall)[:, None]
        depth.index_add_(0, (point * strides).sum(-1), torch.cat([added, added * colors[owner]], -1))
        begin = end
    mean = depth[:, 1:] / depth[:, :1].clamp(min=1e-12)
    found = -torch.expm1(-depth[:, 0])
    return found.float().cpu().reshape(lattice.shape), mean.float().cpu().reshape(*lattice.shape, 3)


def mesh_of(opacity: Tensor, colors: Tensor, lattice: Lattice, level: float) -> Mesh | None:
    """Find the surface where an opacity (X, Y, Z) is ``level``, with colours (X, Y, Z, 3), by marching cubes;
    None if it is nowhere.
    """
    from scipy.ndimage import map_coordinates
    from skimage.measure import marching_cubes

    if not float(opacity.min()) < level < float(opacity.max()):
        return None
    places, faces, _, _ = marching_cubes(opacity.numpy(), level, gradient_direction="ascent")
    weighed = torch.cat([opacity[..., None] * colors, opacity[..., None]], -1).numpy()
    read = [map_coordinates(weighed[..., i], places.T, order=1) for i in range(4)]
    shown = np.stack(read[:3], -1) / np.maximum(read[3], 1e-12)[:, None]
    vertices = lattice.to_world(torch.from_numpy(places.astype(np.float32)))
    return Mesh(vertices, torch.from_numpy(shown).clamp(0, 1), faces)


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write an OBJ whose vertices have colours behind their places."""
    rows = np.concatenate([mesh.vertices.numpy(), mesh.colors.numpy()], -1)
    with path.open("w") as file:
        np.savetxt(file, rows, "v %.7g %.7g %.7g %.4f %.4f %.4f")
        np.savetxt(file, mesh.faces + 1, "f %d %d %d")


def _bounds(source: Source) -> Box:
    """See ``export_mesh``: the box of all matter at all times."""
    method = source.method
    if not isinstance(method, HasBounds) or not (
        source.has_ellipsoids or isinstance(method.at(Moment(source.times[0])), HasSolid)
    ):
        raise ValueError(
            "format=mesh: expected a method that knows where matter is, as particles, forward or backward, "
            f"but got {source.model}"
        )
    box = method.bounds(list(source.times))
    if box is None:
        raise ValueError("run: expected matter to make a mesh of, but got none; train it longer")
    return box


@torch.no_grad()
def export_mesh(
    source: Source, folder: Path, progress: Progress, *, resolution: int, level: float, files: str, up: str
) -> dict:
    """Write ``mesh_0000.ply`` (or ``.obj``) and so on.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: told after each file.
        resolution: points of the lattice along the longest side of all matter.
        level: opacity at which the surface is.
        files: ``ply`` or ``obj``.
        up: see ``Source.turn_to``.

    Returns:
        what ``about.json`` says of it.

    Raises:
        ValueError: for a method that cannot tell where matter is, or where nothing or all is as opaque.
    """
    lattice = lattice_in(_bounds(source), resolution)
    vertices, faces, turn = [], [], source.turn_to(up).float()
    for number, time in enumerate(source.times):
        if source.has_ellipsoids:
            opacity, colors = solid_of(source.method.ellipsoids(time), lattice)
        else:
            opacity, colors = source.method.at(Moment(time)).solid(lattice)
        mesh = mesh_of(opacity, colors, lattice, level)
        if mesh is None:
            raise ValueError(
                f"level: expected a number between the lowest and the highest opacity at time {time:.4g}, "
                f"{float(opacity.min()):.3g} and {float(opacity.max()):.3g}, but got {level}"
            )
        mesh = mesh._replace(vertices=mesh.vertices @ turn.T)
        path = folder / f"mesh_{number:04d}.{files}"
        if files == "obj":
            write_obj(path, mesh)
        else:
            write_ply(path, point_columns(mesh.vertices, mesh.colors), mesh.faces)
        vertices.append(len(mesh.vertices))
        faces.append(len(mesh.faces))
        progress(number + 1, len(source.times))
    return {
        "vertices": vertices,
        "faces": faces,
        "level": level,
        "up": up,
        "spacing": lattice.spacing[0],
        "colors": "sRGB, as in the pictures, the mean over directions",
    }
