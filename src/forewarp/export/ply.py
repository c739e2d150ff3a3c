"""``format=ply``: Gaussians or coloured points; ``format=mesh``: the surface; and the PLY writer of both."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.export.tracks import Progress, Source, tracks_of
from forewarp.glb.writer import morton
from forewarp.methods.method import HasBounds, HasSolid
from forewarp.ops.gaussians import FLAT
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import mean_up
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.view import Moment
from forewarp.scene.world import World

Columns = Mapping[str, np.ndarray]  # by name, in their order
_TYPES = {"float32": "float", "uint32": "uint", "uint8": "uchar"}
_ALL = 1 << 31  # more points than there are
ALONG = 0.98  # cosine of the angle between the upward direction and an axis, from which on that is vertical
_LOGIT_EPS = 1e-6  # opacities are clamped to [eps, 1 - eps], as their logits are written


def write_ply(
    path: Path, elements: Mapping[str, Columns], faces: np.ndarray | None = None, comments: Sequence[str] = ()
) -> None:
    """Write a binary little-endian PLY.

    Args:
        path: of the file.
        elements: by name, each with its properties by name, in their order: (N,) float32, uint32 or uint8.
        faces: (F, 3) rows of the vertices of triangles; None: the file has only points.
        comments: lines of the header.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    parts = []
    for element, columns in elements.items():
        layout = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
        table = np.empty(len(next(iter(columns.values()))), layout)
        lines.append(f"element {element} {len(table)}")
        for name, column in columns.items():
            table[name] = column
            lines.append(f"property {_TYPES[column.dtype.name]} {name}")
        parts.append(table.tobytes())
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


# PlayCanvas's compressed PLY: rows of a chunk; bits of three numbers packed in one; bounds of logarithms of
# scales, and of harmonics.
_CHUNK_ROWS, _BITS, _SCALES, _HARMONICS = 256, (11, 10, 11), 20.0, 4.0


def packed_columns(columns: Columns) -> dict[str, dict[str, np.ndarray]]:
    """Pack the columns of Gaussians as PlayCanvas's compressed PLY has them.

    256 rows are a ``chunk`` with the bounds of places, scales and colours, between which a ``vertex`` has 11,
    10 and 11 bits for a place and for scales, and 8 for each colour and the opacity; of a quaternion it has
    which part is largest, and 10 bits for each other. ``sh`` has 8 bits for each coefficient of direction, in
    [-4, 4]. (The format is described by its reader and writer in playcanvas/splat-transform 2.7.)

    Args:
        columns: see ``splat_columns``; rows beside each other are best close to each other.

    Returns:
        the file's elements.
    """
    count = len(columns["x"])
    rows = np.minimum(np.arange(-(-count // _CHUNK_ROWS) * _CHUNK_ROWS), count - 1).reshape(-1, _CHUNK_ROWS)
    chunk = {}

    def packed(values: list[np.ndarray], names: Sequence[str], bits: Sequence[int]) -> np.ndarray:
        """Pack some values (N,), most significant first; those with a name between bounds of their chunk."""
        word, lows, highs = np.zeros(count, np.uint32), {}, {}
        for value, name, width in zip(values, names, bits):
            if name:
                table = value[rows]
                low, high = table.min(1, keepdims=True), table.max(1, keepdims=True)
                value = ((table - low) / np.where(high > low, high - low, 1)).reshape(-1)[:count]
                lows[f"min_{name}"], highs[f"max_{name}"] = low[:, 0], high[:, 0]
            top = (1 << width) - 1
            word = word << width | np.rint(value * top).clip(0, top).astype(np.uint32)
        chunk.update(lows | highs)
        return word

    places = [columns[axis] for axis in "xyz"]
    scales = [columns[f"scale_{i}"].clip(-_SCALES, _SCALES) for i in range(3)]
    colors = [np.float32(0.5) + np.float32(FLAT) * columns[f"f_dc_{i}"] for i in range(3)]
    opacity = 1 / (1 + np.exp(-columns["opacity"].astype(np.float64)))
    quaternions = np.stack([columns[f"rot_{i}"] for i in range(4)], -1).astype(np.float64)
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    largest = np.abs(quaternions).argmax(-1)
    quaternions *= np.where(np.take_along_axis(quaternions, largest[:, None], -1) < 0, -1, 1)
    others = np.array([[j for j in range(4) if j != i] for i in range(4)])[largest]  # (N, 3), ascending
    parts = np.take_along_axis(quaternions, others, -1) * math.sqrt(0.5) + 0.5
    vertex = {
        "packed_position": packed(places, ("x", "y", "z"), _BITS),
        "packed_rotation": packed([largest / 3, *parts.T], ("",) * 4, (2, 10, 10, 10)),
        "packed_scale": packed(scales, ("scale_x", "scale_y", "scale_z"), _BITS),
        "packed_color": packed([*colors, opacity], ("r", "g", "b", ""), (8,) * 4),
    }
    rest = {name: column for name, column in columns.items() if name.startswith("f_rest_")}
    steps = {name: np.floor((column / (2 * _HARMONICS) + 0.5) * 256) for name, column in rest.items()}
    sh = {name: step.clip(0, 255).astype(np.uint8) for name, step in steps.items()}
    return {"chunk": chunk, "vertex": vertex} | ({"sh": sh} if sh else {})


def header_comments(source: Source, rotation: Tensor) -> list[str]:
    """Return what viewers read in a header: ``Vertical axis: z``, as nerfstudio and Brush write it, where the
    images' mean upward direction, after a rotation (3, 3), is along an axis or against it; and the source's
    shift, if there is any.
    """
    upwards = (rotation @ mean_up(source.cameras)).abs()
    lines = [f"Vertical axis: {'xyz'[int(upwards.argmax())]}"] if float(upwards.max()) > ALONG else []
    shift = " ".join(f"{value:.12g}" for value in source.shift)
    return lines + [f"Shift: {shift}"] * any(source.shift)


def movement_in_data(parts: Mapping[str, Tensor], world: World) -> dict[str, Tensor]:
    """Move what ``HasEllipsoids.movement`` returns from a scene's world to that of its data."""
    parts = dict(parts)
    if "maps" in parts and not world.is_same:
        linear, added = parts["maps"].double().split([3, 1], -1)
        origin = world.to_data(added.new_zeros(3))  # of the scene
        moved = added / world.scale - linear @ origin[:, None]
        parts["maps"] = torch.cat([linear, moved], -1).float()
        parts["node_places"] = world.to_data(parts["node_places"]).float()
        parts["node_shift"] = parts["node_shift"] / world.scale
    return parts


def export_ply(
    source: Source, folder: Path, progress: Progress, *, degree: int, up: str, compressed: bool
) -> dict:
    """Write ``frames/frame_0000.ply`` and so on; of particles also ``canonical.ply`` and ``motion.npz``,
    which moves it.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: called after each file.
        degree: of the spherical harmonics in a file, 0 to 3.
        up: see ``Source.rotation_to``; ``canonical.ply`` and ``motion.npz`` are not rotated.
        compressed: write ``frames/frame_0000.compressed.ply`` alone, of the run's degree at most.

    Returns:
        the facts for ``about.json``.

    Raises:
        ValueError: for ``compressed`` without particles.
    """
    rotation, total, world = source.rotation_to(up), len(source.times), source.in_files
    if compressed and not source.has_ellipsoids:
        got = f"one of {source.model}"
        raise ValueError(f"compressed: expected a run of particles, but got {got}; leave it out")
    (folder / "frames").mkdir()
    suffix = ".compressed.ply" if compressed else ".ply"
    files = [folder / "frames" / f"frame_{number:04d}{suffix}" for number in range(total)]
    comments = header_comments(source, rotation)
    if not source.has_ellipsoids:
        tracks = tracks_of(source, _ALL, progress).in_data(world)
        for file, places in zip(files, tracks.positions @ rotation.T.float()):
            write_ply(file, {"vertex": point_columns(places, tracks.colors[0])}, comments=comments)
        facts = {"points": len(tracks), "kind": "points of the surface"}
        return facts | {"colors": "sRGB, 8 bits, as in the images", "up": up, "rotation": rotation.tolist()}
    template = source.method.template().in_data(world)
    own_degree = math.isqrt(template.harmonics.shape[1]) - 1
    degree = min(degree, own_degree) if compressed else degree
    order = morton(template.centers.cpu().numpy()).argsort(kind="stable") if compressed else slice(None)
    for number, (file, time) in enumerate(zip(files, source.times)):
        cloud = source.method.ellipsoids(time).in_data(world)
        columns = splat_columns(cloud if up == "world" else cloud.turned(rotation), degree)
        columns = {name: column[order] for name, column in columns.items()}
        write_ply(file, packed_columns(columns) if compressed else {"vertex": columns}, comments=comments)
        progress(number + 1, total)
    if not compressed:
        comments = header_comments(source, source.rotation_to("world"))
        write_ply(folder / "canonical.ply", {"vertex": splat_columns(template, degree)}, comments=comments)
        motion = movement_in_data(source.method.movement(source.times), world)
        motion = {name: value.cpu().numpy() for name, value in motion.items()}
        about = {"times": np.array(source.times, np.float32), "shift": np.array(source.shift)}
        np.savez(folder / "motion.npz", **about, **motion)
    kind = "Gaussian splats, compressed" if compressed else "Gaussian splats"
    facts = {"particles": len(template), "kind": kind, "up": up, "rotation": rotation.tolist()}
    facts |= {"degree": degree, "degree of the run": own_degree}
    colors = "sRGB, as in the images: 1/2 + 0.28209479177387814 f_dc is the mean over directions"
    return facts | {"colors": colors}


_BLUR = 0.5  # spacings of the lattice that Gaussians are blurred by, so that none falls between its points
_CUTOFF = 1 / 255  # opacity below which a Gaussian ends, as in rendered images
_MAX_OPACITY = 1 - 1e-6  # of a Gaussian, so that its optical depth is finite
_CHUNK = 1 << 19  # pairs of a Gaussian and a lattice point that are evaluated at once


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


def voxelize(cloud: Ellipsoids, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """Evaluate Gaussians on a lattice: opacity (X, Y, Z) and colour (X, Y, Z, 3).

    The opacity is ``1 - prod_i (1 - o_i g_i)``, where ``g_i`` is the Gaussian, 1 in its centre, blurred by
    half a lattice spacing; the colour is the mean weighted by optical depth ``-log(1 - o_i g_i)``.

    Cost: linear in the pairs of a Gaussian and a lattice point inside it; memory in a chunk of them.
    """
    step = lattice.spacing[0]
    blurred = cloud.covariances.double() + (_BLUR * step) ** 2 * torch.eye(3).to(cloud.covariances).double()
    opacity, colors = cloud.opacity.double().clamp(max=_MAX_OPACITY), cloud.colors.double()
    # The box of lattice points in which a Gaussian's opacity is above the cutoff.
    radius_squared = (2 * (opacity / _CUTOFF).clamp(min=1).log())[:, None]
    half = (radius_squared * blurred.diagonal(dim1=-2, dim2=-1)).sqrt() / step
    center = lattice.to_lattice(cloud.centers.double())
    last = torch.tensor(lattice.shape, device=center.device) - 1
    low = (center - half).ceil().clamp(min=0).minimum(last + 1.0).long()
    high = (center + half).floor().clamp(min=-1).minimum(last.double()).long()
    counts = (high - low + 1).clamp(min=0) * (opacity > _CUTOFF)[:, None]
    sizes = counts.prod(-1)
    ends = sizes.cumsum(0)
    inverse = torch.linalg.inv(blurred) * step**2
    sums = torch.zeros(lattice.count, 4, dtype=torch.float64, device=center.device)  # optical depth, r, g, b
    strides = torch.tensor([lattice.shape[1] * lattice.shape[2], lattice.shape[2], 1], device=center.device)
    begin = 0
    while begin < len(cloud):
        done = int(ends[begin - 1]) if begin else 0
        end = max(begin + 1, int(torch.searchsorted(ends, done + _CHUNK, right=True)))
        rows = torch.arange(begin, end, device=center.device)
        owner = rows.repeat_interleave(sizes[rows])  # (P,), the Gaussian of each pair
        rank = torch.arange(len(owner), device=center.device) + done - (ends - sizes)[owner]
        wide, deep = counts[owner, 1], counts[owner, 2]
        point = low[owner] + torch.stack([rank // (wide * deep), rank // deep % wide, rank % deep], -1)
        offset = point - center[owner]
        gaussian = torch.exp(-0.5 * torch.einsum("pi,pij,pj->p", offset, inverse[owner], offset))
        depth = -torch.log1p(-opacity[owner] * gaussian)[:, None]
        sums.index_add_(0, (point * strides).sum(-1), torch.cat([depth, depth * colors[owner]], -1))
        begin = end
    mean = sums[:, 1:] / sums[:, :1].clamp(min=1e-12)
    total = -torch.expm1(-sums[:, 0])
    return total.float().cpu().reshape(lattice.shape), mean.float().cpu().reshape(*lattice.shape, 3)


def isosurface(
    opacity: Tensor, colors: Tensor, lattice: Lattice, level: float
) -> tuple[Tensor, Tensor, np.ndarray]:
    """Find the surface where an opacity (X, Y, Z) is ``level``, with colours (X, Y, Z, 3), by marching cubes.

    Returns:
        vertices (V, 3) in world units, their colours (V, 3) in [0, 1], and faces (F, 3), rows of vertices,
        counter-clockwise seen from outside.
    """
    from scipy.ndimage import map_coordinates
    from skimage.measure import marching_cubes

    places, faces, _, _ = marching_cubes(opacity.numpy(), level, gradient_direction="ascent")
    # Colours of lattice points count by their opacity, as empty ones have none.
    weighted = torch.cat([opacity[..., None] * colors, opacity[..., None]], -1).numpy()
    read = [map_coordinates(weighted[..., i], places.T, order=1) for i in range(4)]
    rgb = np.stack(read[:3], -1) / np.maximum(read[3], 1e-12)[:, None]
    vertices = lattice.to_world(torch.from_numpy(places.astype(np.float32)))
    return vertices, torch.from_numpy(rgb).clamp(0, 1), faces


@torch.no_grad()
def export_mesh(
    source: Source, folder: Path, progress: Progress, *, resolution: int, level: float, files: str, up: str
) -> dict:
    """Write ``mesh_0000.ply`` (or ``.obj``) and so on.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: called after each file.
        resolution: points of the lattice along the longest side of the box of all matter at all times.
        level: opacity of the surface.
        files: ``ply`` or ``obj``.
        up: see ``Source.rotation_to``.

    Returns:
        the facts for ``about.json``.

    Raises:
        ValueError: for a method that cannot tell where matter is, or where nothing or all is as opaque.
    """
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
    lattice, rotation, world = lattice_in(box, resolution), source.rotation_to(up), source.in_files
    comments, vertex_counts, face_counts = header_comments(source, rotation), [], []
    for number, time in enumerate(source.times):
        if source.has_ellipsoids:
            opacity, colors = voxelize(method.ellipsoids(time), lattice)
        else:
            opacity, colors = method.at(Moment(time)).solid(lattice)
        lowest, highest = float(opacity.min()), float(opacity.max())
        if not lowest < level < highest:
            raise ValueError(
                f"level: expected a number between the lowest and the highest opacity at time {time:.4g}, "
                f"{lowest:.3g} and {highest:.3g}, but got {level}"
            )
        vertices, rgb, faces = isosurface(opacity, colors, lattice, level)
        vertices, path = world.to_data(vertices) @ rotation.T, folder / f"mesh_{number:04d}.{files}"
        if files == "ply":
            write_ply(path, {"vertex": point_columns(vertices, rgb)}, faces, comments)
        else:
            with path.open("w") as file:  # colours behind the places, a common extension of OBJ
                file.writelines(f"# {comment}\n" for comment in comments)
                rows = np.concatenate([vertices.numpy(), rgb.numpy()], -1)
                np.savetxt(file, rows, "v %.7g %.7g %.7g %.4f %.4f %.4f")
                np.savetxt(file, faces + 1, "f %d %d %d")
        vertex_counts.append(len(vertices))
        face_counts.append(len(faces))
        progress(number + 1, len(source.times))
    facts = {"vertices": vertex_counts, "faces": face_counts, "level": level}
    facts |= {"up": up, "rotation": rotation.tolist()}
    colors = "sRGB, as in the images, the mean over directions"
    return facts | {"spacing": lattice.spacing[0] / world.scale, "colors": colors}
