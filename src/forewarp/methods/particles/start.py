"""Where particles begin: on the visual hull, at known points, or where neighbouring views agree."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.methods.method import Start
from forewarp.methods.particles.nodes import nearest
from forewarp.methods.particles.sweep import seen_colors, swept
from forewarp.ops.gaussians import FLAT
from forewarp.ops.grid import dilate
from forewarp.scene.box import Box, Lattice
from forewarp.scene.cloud import Cloud
from forewarp.scene.frame import Scene, spread
from forewarp.scene.silhouettes import visual_hull

_FRAMES = 12  # whose silhouettes are looked at
_DRIFT = 0.2  # share of a picture's width by which a silhouette is taken to move in all the time there is
_ROUGH, _FINE = 48, 112  # voxels along the mean side of the box, and of what is left of it
_FEW = 16  # points that are too few to begin with
_CAMERAS = 64  # whose distance from a point is looked at


def first_points(start: Start, count: int) -> Cloud:
    """About ``count`` points to begin with, and their colours.

    What a stage before left comes first; then the visual hull, where pictures have alpha; then points that
    are known to stand still, and what neighbouring views agree on; in the end random points of the box.

    Cost: of the hull, about a second; of neighbouring views, a few.
    """
    handed, scene = None if start.handover is None else start.handover.cloud, start.scene
    cloud = None
    if handed is not None and len(handed) >= _FEW:
        keep = handed.opacity > 0.05
        cloud = handed[keep] if int(keep.sum()) >= _FEW else handed
    elif scene.has_alpha:
        cloud = hull_surface(scene, list(start.frames), count)
    if cloud is None:
        cloud = swept(scene, list(start.frames), count)
    if cloud is None or len(cloud) < _FEW:
        cloud = anywhere(scene.box, count)
    return thinned(cloud, count)


def thinned(cloud: Cloud, count: int) -> Cloud:
    """At most ``count`` of a cloud's points, at random."""
    if len(cloud) <= count:
        return cloud
    return cloud[torch.randperm(len(cloud))[:count].sort().values]


def anywhere(box: Box, count: int) -> Cloud:
    """Grey points all over a box."""
    low, size = torch.tensor(box.low), torch.tensor(box.size)
    points = low + size * torch.rand(count, 3)
    side = (float(size.prod()) / max(count, 1)) ** (1 / 3)
    return Cloud(points, torch.full_like(points, 0.5), torch.full((count,), 0.1), side)


def hull_surface(scene: Scene, frames: list[int], count: int) -> Cloud | None:
    """Points on the surface of the visual hull of the first frames; None where nothing is left.

    Silhouettes are grown by how far later frames may have moved. Colours are means over the frames.
    """
    frames = frames[:_FRAMES]
    pictures = [scene.train[i].load() for i in frames]
    cameras = [scene.train[i].camera for i in frames]
    masks = []
    for i, rgba in zip(frames, pictures):
        late = abs(scene.train[i].time - scene.canonical_time)
        masks.append(dilate(rgba[..., 3] > 127, max(1, round(_DRIFT * late * rgba.shape[1]))))
    rough = Lattice.of_count(scene.box, _ROUGH**3)
    points = rough.to_world(rough.all_voxels())
    inside = visual_hull(points, cameras, masks)
    if not bool(inside.any()):
        return None
    pad = max(rough.spacing)
    low, high = points[inside].amin(0) - pad, points[inside].amax(0) + pad
    box = Box(tuple(low.tolist()), tuple(high.tolist())).intersection(scene.box.padded(pad))
    fine = Lattice.of_count(box, _FINE**3)
    voxels = fine.all_voxels()
    # Only what the rough hull, a voxel wider, allows is looked at again.
    wide = _grown(inside.reshape(rough.shape))
    at = rough.to_lattice(fine.to_world(voxels)).round().long()
    at = torch.minimum(at.clamp(min=0), torch.tensor(rough.shape) - 1)
    maybe = wide[at.unbind(-1)]
    solid = torch.zeros(len(voxels), dtype=torch.bool)
    solid[maybe] = visual_hull(fine.to_world(voxels[maybe]), cameras, masks)
    solid = solid.reshape(fine.shape)
    shell = solid & _grown(~solid)
    found = shell.nonzero()
    if not len(found):
        return None
    found = found[torch.randint(len(found), (count,))] + torch.rand(count, 3) - 0.5
    points = fine.to_world(found)
    colors = seen_colors(points, cameras, pictures)
    area = int(shell.sum()) * fine.voxel_size**2
    return Cloud(points, colors, torch.full((count,), 0.5), (area / count) ** 0.5)


def _grown(mask: Tensor) -> Tensor:
    """A mask (X, Y, Z) one voxel wider on all sides; beyond its faces is nothing."""
    return torch.nn.functional.max_pool3d(mask[None, None].float(), 3, 1, 1)[0, 0] > 0


def covered_pixels(scene: Scene, frames: list[int]) -> float:
    """How many pixels of a picture show anything, the mean over some frames."""
    shown = [float((scene.train[i].load()[..., 3] > 127).sum()) for i in frames[:_FRAMES]]
    return max(sum(shown) / len(shown), 1.0)


def widths(scene: Scene, points: Tensor, covered: float) -> Tensor:
    """How far apart (N,) particles at points (N, 3) may be, world units: evenly spread over the pixels that
    show anything (``covered``), and seen by the camera that shows them largest.
    """
    smallest = torch.full((len(points),), float("inf"))
    for i in spread(len(scene.train), _CAMERAS):
        camera = scene.train[i].camera
        away = (points - camera.center.to(points)).norm(dim=-1)
        smallest = torch.minimum(smallest, away / max(camera.fx, camera.fy))
    return smallest * (covered / max(len(points), 1)) ** 0.5


def first_values(cloud: Cloud, widest: Tensor | None = None) -> dict[str, Tensor]:
    """Round particles at points, as large as the points are apart, but not larger than ``widest`` (N,).

    Points of a sweep lie at uncertain depths, so that they are farther apart in space than in the pictures:
    as large as that, particles would blur what they show, and many steps would go into making them smaller.
    """
    points = cloud.points.float()
    away, _ = nearest(points, points, 4)
    apart = away[:, 1:].sqrt().mean(-1) if away.shape[1] > 1 else torch.full((len(points),), cloud.size)
    middle = float(apart.median()) or cloud.size
    size = apart.clamp(0.1 * middle, 4 * middle)
    if widest is not None:
        size = torch.minimum(size, widest.clamp(min=1e-3 * middle))
    turns = torch.zeros(len(points), 4)
    turns[:, 0] = 1
    return {
        "means": points.clone(),
        "log_scales": size.log()[:, None].repeat(1, 3),
        "turns": turns,
        "opacity": torch.zeros(len(points), 1),
        "color": ((cloud.colors.float() - 0.5) / FLAT)[:, None].clone(),
    }
