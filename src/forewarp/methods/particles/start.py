"""Where particles begin: on the visual hull, at measured depths, at known points, or where neighbouring views
agree; and their kernels compiled ahead.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache, lru_cache, partial
from tempfile import TemporaryFile

import torch
from torch import Tensor

from forewarp.methods.method import Start
from forewarp.methods.particles.options import Numbers
from forewarp.ops.adam import AdamState, adam_rows
from forewarp.ops.backend import cores, use_numba
from forewarp.ops.gaussians import (
    FLAT,
    Gaussians,
    Pinhole,
    Warp,
    compare,
    compile_backward_kernels,
    project,
    rasterize,
)
from forewarp.ops.grid import dilate
from forewarp.ops.nodes import carry_nodes, pull_nodes, skin_weights, spread_nodes
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Camera, Lens, Rays
from forewarp.scene.cloud import Cloud, nearest
from forewarp.scene.frame import Frame, Scene, instants_of, sightings, spread, visual_hull, where_seen

_FRAMES = 12  # whose silhouettes carve the hull
_MOSTLY = 0.75  # share of an image's pixels at rest, from which on masks of rest count
SMALL_MOVERS = 0.1  # share of an image's pixels, up to which all that moves is small, and moves as bodies
_VOTERS, _AROUND = 30, 8  # images that say what rests: of the whole film, around the canonical time
_SURFACE = 1.05  # of the depth that an image shows, up to which a point is its surface
_EDGE = 5e-3  # share of an image's width by which masks of what moves are enlarged
_DRIFT = 0.2  # share of an image's width by which a silhouette is taken to move in all the time there is
_ROUGH, _FINE = 48, 112  # voxels along the mean side of the box, and of what is left of it
_FEW = 16  # points that are too few to begin with
_CAMERAS = 64  # whose distance from a point is looked at

_DEPTHS = 48  # planes of a sweep, evenly in inverse depth
_WHOLLY = 0.999  # share of a pixel from which on all of it is learned from
_SIDE = 64  # lattice points along the longer side of an image
_SWEPT, _NEIGHBOURS = 10, 8  # images that are swept; neighbours in time of each
_DOUBT = 0.02  # of full scale, by which colours must be more alike where no plane was expected
_SHELLED, _COARSER = 24, 4  # images without a hole once points lie behind all; how much larger a hole is
_NEAREST_PLANE = 0.02  # share of the far plane at which planes begin at the earliest

_MEASURED = 32  # images whose measured depths are looked at
_FIRST = 0.6  # share of all points that the first image may give
_TRUSTED = 0.5  # least confidence of a depth at which a particle begins
_BEHIND = 0.1  # share of a distance by which what lies behind another thing is farther

_PATIENCE_S = 120.0  # that the other compiling process is waited for


def first_points(start: Start, count: int, shell: float = 0.0) -> Cloud:
    """Find at most about ``count`` points to begin with, and their colours.

    Of the first that there is: what the stage before left; the visual hull, where images have alpha; places
    at measured depths; points that are known to stand still with what neighbouring views agree on (``shell``:
    see ``swept``); random points of the box.

    Cost: of the hull, about a second; of neighbouring views, a few.
    """
    left, scene = None if start.handover is None else start.handover.cloud, start.scene
    cloud = None
    if left is not None and len(left) >= _FEW:
        visible = left.opacity > 0.05
        cloud = left[visible] if int(visible.sum()) >= _FEW else left
    elif scene.has_alpha:
        cloud = hull_surface(scene, list(start.frames), count)
    cloud = cloud or measured(scene, count) or swept(scene, list(start.frames), count, shell)
    if cloud is None or len(cloud) < _FEW:
        cloud = anywhere(scene.box, count)
    return cloud if len(cloud) <= count else cloud[torch.randperm(len(cloud))[:count].sort().values]


def anywhere(box: Box, count: int) -> Cloud:
    """Draw grey points all over a box."""
    low, size = torch.tensor(box.low), torch.tensor(box.size)
    points = low + size * torch.rand(count, 3)
    spacing = (float(size.prod()) / max(count, 1)) ** (1 / 3)
    return Cloud(points, torch.full_like(points, 0.5), torch.full((count,), 0.1), spacing)


def hull_surface(scene: Scene, frames: list[int], count: int) -> Cloud | None:
    """Draw points on the surface of the visual hull of the first frames; None where nothing is left of it.

    Silhouettes are grown by how far later frames may have moved. Colours are means over the frames.
    """
    first = [scene.train[i] for i in frames[:_FRAMES]]
    images, cameras = [frame.load() for frame in first], [frame.camera for frame in first]
    drifts = [_DRIFT * abs(f.time - scene.canonical_time) * f.camera.width for f in first]
    masks = [dilate(rgba[..., 3] > 127, max(1, round(drift))) for rgba, drift in zip(images, drifts)]
    side = max(max(camera.width, camera.height) for camera in cameras)  # small images tell no finer shape
    rough = Lattice.of_count(scene.box, min(_ROUGH, side) ** 3)
    points = rough.to_world(rough.all_voxels())
    inside = visual_hull(points, cameras, masks)
    if not bool(inside.any()):
        return None
    pad = max(rough.spacing)
    low, high = points[inside].amin(0) - pad, points[inside].amax(0) + pad
    box = Box(low, high).intersection(scene.box.padded(pad))
    fine = Lattice.of_count(box, min(_FINE, 2 * side) ** 3)
    voxels = fine.all_voxels()
    # Only what the rough hull, a voxel wider, allows is looked at again.
    allowed = dilate(inside.reshape(rough.shape))
    at = rough.to_lattice(fine.to_world(voxels)).round().long()
    at = torch.minimum(at.clamp(min=0), torch.tensor(rough.shape) - 1)
    maybe = allowed[at.unbind(-1)]
    solid = torch.zeros(fine.shape, dtype=torch.bool)
    solid.view(-1)[maybe] = visual_hull(fine.to_world(voxels[maybe]), cameras, masks)
    shell = (solid & dilate(~solid)).nonzero()
    if not len(shell):
        return None
    area = len(shell) * fine.voxel_size**2
    points = fine.to_world(shell[torch.randint(len(shell), (count,))] + torch.rand(count, 3) - 0.5)
    colors = seen_colors(points, cameras, images)
    return Cloud(points, colors, torch.full((count,), 0.5), (area / count) ** 0.5)


def at_rest(scene: Scene, points: Tensor, surface: Callable[[Frame], Tensor] | None = None) -> Tensor:
    """Tell which points (N, 3) of the canonical state rest in the whole film, by masks of its images: bool.

    Where masks around the canonical time show that most of an image rests in the whole film, these decide
    (``_by_resting``). Else, where more than a tenth of the images moves (what is small moves as a body), all
    images vote. A point rests unless most of the images in which it is surface show it within masks of what
    moves: of some that are spread over the film, or of those around the canonical time. Of what is surface in
    no image, where it lies counts. Where no image says what moves, masks of what rests count; without any, no
    point rests.

    Args:
        scene: the film.
        points: places.
        surface: returns the depth (H, W) along an image's rays up to which it shows matter, 0: no end; None:
            nothing hides anything.

    Cost: some 40 masks, and as many depths.
    """
    if (rests := _by_resting(scene, points)) is not None:
        return rests
    has_moving = any(frame.load_moving for frame in scene.train)
    known = [frame for frame in scene.train if (frame.load_moving if has_moving else frame.load_resting)]
    known.sort(key=lambda frame: frame.time)
    near = sorted(known, key=lambda frame: abs(frame.time - scene.canonical_time))[:_AROUND]
    voters = [known[i] for i in spread(len(known), _VOTERS)]
    moving = [float(frame.load_moving().float().mean()) for frame in voters] if has_moving else [1.0]
    rests = torch.full((len(points),), bool(known) and sum(moving) > SMALL_MOVERS * len(moving))
    for frames in (voters, near) if bool(rests.any()) else ():
        moves, seen, moves_behind, seen_behind = torch.zeros(4, len(points), dtype=torch.int32)
        for frame in frames:
            camera = frame.camera
            row, column, visible = where_seen(camera, points)
            row, column = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
            mask = frame.load_moving() if has_moving else ~frame.load_resting()
            inside = dilate(mask, max(1, round(_EDGE * camera.width)))[row, column]
            shown = visible
            if surface is not None:
                depth = surface(frame)[row, column]
                away = (points - camera.center.to(points)).norm(dim=-1)
                shown = visible & ((away < _SURFACE * depth) | (depth == 0))
            moves, seen = moves + (shown & inside).int(), seen + shown.int()
            moves_behind, seen_behind = moves_behind + (visible & inside).int(), seen_behind + visible.int()
        hidden = seen == 0
        moves, seen = moves.where(~hidden, moves_behind), seen.where(~hidden, seen_behind)
        rests &= 2 * moves <= seen
    return rests


def _by_resting(scene: Scene, points: Tensor) -> Tensor | None:
    """Tell by masks of what rests in the whole film which points (N, 3) rest: bool; None where these show
    less than most of an image, as what seems to rest there creeps, as clothes do.

    What moves in none of the first images rests, too, where no mask of rest shows it.
    """
    near = sorted(scene.train, key=lambda frame: abs(frame.time - scene.canonical_time))[:_FRAMES]
    known = [frame for frame in near if frame.load_resting is not None]
    masks = [frame.load_resting() for frame in known]
    if not masks or sum(float(mask.float().mean()) for mask in masks) < _MOSTLY * len(masks):
        return None
    at_rest, looked = sightings(points, [frame.camera for frame in known], masks)
    cameras = [frame.camera for frame in near]
    nowhere = [torch.zeros(camera.height, camera.width, dtype=torch.bool) for camera in cameras]
    moving = [frame.load_moving() if frame.load_moving else mask for frame, mask in zip(near, nowhere)]
    moves, seen = sightings(points, cameras, moving)
    return (seen > 0) & (2 * at_rest >= looked) & (2 * moves <= seen)


def covered_pixels(scene: Scene, frames: list[int]) -> float:
    """Return how many pixels of an image show anything, the mean over the first frames."""
    counts = [float((scene.train[i].load()[..., 3] > 127).sum()) for i in frames[:_FRAMES]]
    return max(sum(counts) / len(counts), 1.0)


def widths(scene: Scene, points: Tensor, covered: float) -> Tensor:
    """Return how far apart (N,) particles at points (N, 3) may be, world units: evenly spread over the
    ``covered`` pixels, and seen by the camera that shows them largest.
    """
    pixel = torch.full((len(points),), float("inf"))
    for i in spread(len(scene.train), _CAMERAS):
        camera = scene.train[i].camera
        distances = (points - camera.center.to(points)).norm(dim=-1)
        pixel = torch.minimum(pixel, distances / max(camera.fx, camera.fy))
    return pixel * (covered / max(len(points), 1)) ** 0.5


def first_values(
    cloud: Cloud, widest: Tensor | None = None, beyond: Tensor | None = None
) -> dict[str, Tensor]:
    """Make round particles at points, as large as the points are apart, but no larger than ``widest`` (N,).

    Those ``beyond`` (N,) bool the box may be many times as large as the others.

    Points of a sweep lie at uncertain depths, so that they are farther apart in space than in the images: as
    large as that, particles would blur what they show, and many steps would go into making them smaller.
    """
    points = cloud.points.float()
    squared, _ = nearest(points, points, 4)
    apart = squared[:, 1:].sqrt().mean(-1) if squared.shape[1] > 1 else torch.full((len(points),), cloud.size)
    median = float(apart.median()) or cloud.size
    size = apart.clamp(0.1 * median, 4 * median)
    if beyond is not None:
        size = torch.where(beyond, apart, size)
    if widest is not None:
        size = torch.minimum(size, widest.clamp(min=1e-3 * median))
    shape = {"scales": size.log()[:, None].repeat(1, 3)}
    shape["quaternions"] = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(points), 1)
    colors = ((cloud.colors.float() - 0.5) / FLAT)[:, None].clone()
    return {"means": points.clone(), **shape, "opacity": torch.zeros(len(points), 1), "colors": colors}


def fresh_values(
    start: Start, stage: Numbers, shell: float, beyond: Callable[[Tensor], Tensor]
) -> tuple[dict[str, Tensor], float, float]:
    """Make the first particles of a fit.

    Args:
        start, stage: of the method.
        shell: see ``swept``.
        beyond: tells which points (N, 3) lie outside the box in which motion is looked for, (N,) bool.

    Returns:
        their values; how many pixels of an image show anything; and the median distance of what lies within
        the box from its middle.
    """
    scene = start.scene
    covered = covered_pixels(scene, list(start.frames))
    count = round(stage.initial_share * stage.final_count(covered, len(scene.train)))
    cloud = first_points(start, count, shell)
    outside = beyond(cloud.points)
    near = cloud.points if bool(outside.all()) else cloud.points[~outside]
    distances = (near - near.median(0).values).norm(dim=-1)
    extent = float(distances.median()) or scene.box.diagonal
    # Points of a hull lie on its surface, and are as far apart as particles should be large.
    widest = None if scene.has_alpha else widths(scene, cloud.points, covered)
    return first_values(cloud, widest, outside), covered, extent


def measured(scene: Scene, count: int) -> Cloud | None:
    """Place points (about ``count`` of the first image) at the depths that a sensor measured; None without.

    Images come in the order of their distance from the canonical time, and each adds what fills its holes, or
    lies behind all that is there: what something moved away from. What stands before points that are there
    already is what has moved meanwhile.
    """
    order = sorted(range(len(scene.train)), key=lambda i: abs(scene.train[i].time - scene.canonical_time))
    order = [i for i in order if scene.train[i].load_sensed is not None]
    points, colors, size = torch.zeros(0, 3), torch.zeros(0, 3), math.nan
    for i in (order[k] for k in spread(len(order), _MEASURED)):
        frame, camera = scene.train[i], scene.train[i].camera
        step = max(1, round((camera.width * camera.height / (_FIRST * count)) ** 0.5))
        rows, columns = _every(step, camera, step // 2, step // 2)
        distance, trust = frame.load_sensed()[:, rows, columns]
        known = (distance > 0) & (trust >= _TRUSTED)
        if frame.load_valid is not None:
            known &= frame.load_valid()[rows, columns]
        rows, columns, distance = rows[known], columns[known], distance[known]
        rays = camera.rays(rows * camera.width + columns)
        new = rays.origins + distance[:, None] * rays.directions
        added = distance > (1 + _BEHIND) * _farthest(points, new, camera, step)
        points = torch.cat([points, new[added]])
        colors = torch.cat([colors, frame.load()[rows[added], columns[added], :3].float() / 255])
        if math.isnan(size) and len(distance):
            size = float(distance.median()) * step / camera.fx
    return Cloud(points, colors, torch.full((len(points),), 0.5), size) if len(points) else None


def _every(step: int, camera: Camera, top: int, left: int) -> tuple[Tensor, Tensor]:
    """Return row and column (P,) of the pixels that are ``step`` apart, from the first one on."""
    rows, columns = torch.arange(top, camera.height, step), torch.arange(left, camera.width, step)
    return torch.cartesian_prod(rows, columns).unbind(-1)


def _farthest(points: Tensor, new: Tensor, camera: Camera, step: int) -> Tensor:
    """Return how far the farthest of ``points`` (N, 3) is in the cell, ``step`` pixels wide, that shows each
    of ``new`` (P, 3); 0 where there is none.
    """
    across = -(-camera.width // step)
    cells = across * -(-camera.height // step)

    def cells_of(places: Tensor) -> Tensor:
        inside, row, column = _pixels(camera, places)
        return torch.where(inside, row // step * across + column // step, cells)

    far = torch.zeros(cells + 1)
    away = (points - camera.center.to(points)).norm(dim=-1)
    far.scatter_reduce_(0, cells_of(points), away, "amax")
    far[cells] = 0.0
    return far[cells_of(new)]


def swept(scene: Scene, frames: list[int], count: int, shell: float = 0.0) -> Cloud | None:
    """Find points (about ``count``) that neighbouring views agree on; None where there is a single view.

    Each lattice point of an image takes the depth at which its colour is most like what its neighbours in
    time show there, the best half of them counted. Images come one after the other, and each adds only what
    fills its holes: what stands before points that are there already is mostly a wrong depth, or what has
    moved meanwhile. Points known to stand still are kept.

    Args:
        scene, frames, count: see above; frames in play go first.
        shell: 0: nothing lies outside the box. Else, of what is not found in it, how far planes reach, in far
            planes (at least 1); and there lie points wherever an image shows none: no ray goes past all.
    """
    if len(scene.train) < 2:
        return None
    order = frames if len(frames) >= _SWEPT else list(range(len(scene.train)))
    chosen = [order[i] for i in spread(len(order), _SWEPT)]
    side = max(8, min(_SIDE, round((2 * count) ** 0.5)))
    still = scene.still.float() if scene.still is not None else torch.zeros(0, 3)
    cameras, images = zip(*((scene.train[i].camera, scene.train[i].load()) for i in chosen))
    points, colors, sizes = [still], [seen_colors(still, cameras, images)], []
    small = cache(partial(_small, scene.train, side))
    low, high = torch.tensor(scene.box.low), torch.tensor(scene.box.high)
    middle = (low + high) / 2
    for beyond in (1.0,) if shell == 0 else (1.0, shell):  # what lies in the box goes first in all images
        for i in chosen:
            new, color, size = _sweep(scene, i, side, small, torch.cat(points), beyond)
            fills = ((new >= low) & (new <= high)).all(-1)
            if beyond > 1:  # before the box is what only seems to be there
                center = scene.train[i].camera.center.to(new)
                fills = ~fills & ((new - center).norm(dim=-1) > (middle - center).norm())
            points.append(new[fills])
            colors.append(color[fills])
            sizes += [size] if beyond == 1 else []
    if shell > 0:
        for i in spread(len(scene.train), _SHELLED):
            rays, color, _ = _holes(small(i), max(4, side // _COARSER), torch.cat(points))
            points.append(rays.origins + shell * small(i)[2].far * rays.directions)
            colors.append(color)
    points, colors = torch.cat(points), torch.cat(colors)
    if not len(points):
        return None
    size = float(torch.stack(sizes).nanmedian())  # none where known points fill all cells
    size = scene.box.diagonal / side if math.isnan(size) else size
    return Cloud(points, colors, torch.full((len(points),), 0.5), size)


_Small = Callable[[int], tuple[Tensor, Tensor, Camera]]  # an image's number -> see ``_small``


def _small(frames: Sequence[Frame], side: int, i: int) -> tuple[Tensor, Tensor, Camera]:
    """Return an image (h, w, 3) whose longer side is about four times the lattice's; which of its pixels the
    photo has and are learned from (h, w); and its camera. Its lens is undone: it would be, for every plane.
    """
    frame, camera = frames[i], frames[i].camera
    scale = min(1.0, 4 * side / max(camera.width, camera.height))
    size = max(1, round(camera.height * scale)), max(1, round(camera.width * scale))
    valid = None if frame.load_valid is None else frame.load_valid()[..., None].float()
    planes = [frame.load()[..., :3].float() / 255] + ([] if valid is None else [valid])
    planes = torch.cat([plane.permute(2, 0, 1)[None] for plane in planes], 1)
    planes = torch.nn.functional.interpolate(planes, size, mode="area")
    camera, inside = camera.resized(size[1], size[0]), torch.ones(size, dtype=torch.bool)
    if camera.lens is not None:
        places = _bent_pixels(*camera.inner)
        planes = torch.nn.functional.grid_sample(planes, places, padding_mode="border", align_corners=False)
        camera, inside = replace(camera, lens=None), (places[0].abs() <= 1).all(-1)
    learned = inside if valid is None else inside & (planes[0, 3] > _WHOLLY)
    return planes[0, :3].permute(1, 2, 0).contiguous(), learned, camera


@lru_cache(maxsize=8)
def _bent_pixels(*inner: float | Lens) -> Tensor:
    """Return where a lens puts the pixels of an image without it (1, H, W, 2), in [-1, 1]; once for all
    images of a camera with this ``inner``, as looking for where a lens folds takes a tenth of a second.
    """
    camera = Camera.at_origin(*inner)
    pixel, _ = camera.project(replace(camera, lens=None).rays(dtype=torch.float64).directions)
    size = torch.tensor([camera.width, camera.height])
    return (2 * pixel / size - 1).float().reshape(1, camera.height, camera.width, 2)


def _sweep(
    scene: Scene, i: int, side: int, small: _Small, before: Tensor, beyond: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return points (P, 3) of an image's lattice at their best depths, their colours, and their size ().

    None is at a pixel that is not valid, or in a cell of the lattice with a point of ``before`` (N, 3), or
    farther than ``beyond`` far planes.
    """
    rays, color, step = _holes(small(i), side, before)
    camera = small(i)[2]
    neighbours = _neighbours(scene, i)
    near = _nearest_plane(camera, [scene.train[j].camera for j in neighbours])
    depths = 1 / torch.linspace(1 / near, 1 / (beyond * camera.far), _DEPTHS)
    points = rays.origins[:, None] + depths[:, None] * rays.directions[:, None]  # (P, D, 3)
    costs = torch.stack([_difference(points, color, *small(j)) for j in neighbours])
    best_half = costs.sort(0).values[: max(1, len(neighbours) // 2)].mean(0)
    best_half += torch.where(depths > camera.far, _DOUBT, 0.0)  # what has no texture fits everywhere
    depth = depths[best_half.argmin(-1)]
    points, size = rays.origins + depth[:, None] * rays.directions, depth.median() * step / camera.fx
    return points, color, size


def _neighbours(scene: Scene, i: int) -> list[int]:
    """Choose the images nearest in time to one; of an instant, those whose cameras are nearest."""
    times = instants_of(scene.train)
    away = [float((frame.camera.center - scene.train[i].camera.center).norm()) for frame in scene.train]
    others = (j for j in range(len(times)) if j != i)
    return sorted(others, key=lambda j: (abs(times[j] - times[i]), away[j], abs(j - i)))[:_NEIGHBOURS]


def _holes(image: tuple[Tensor, Tensor, Camera], side: int, before: Tensor) -> tuple[Rays, Tensor, int]:
    """Return the rays of an image's lattice whose cells hold none of the points ``before`` (N, 3), their
    colours (P, 3), and how many pixels they are apart. There is none at a pixel that is not valid.
    """
    rgb, valid, camera = image
    step = max(1, round(max(camera.width, camera.height) / side))
    first = (min(step // 2, length - 1) for length in (camera.height, camera.width))
    rows, columns = _every(step, camera, *first)
    rays = camera.rays(rows * camera.width + columns)
    is_hole = _in_holes(before, rays.origins + rays.directions, camera, side)
    is_hole &= valid[rows, columns]  # what is not learned from is no start either
    return rays[is_hole], rgb[rows[is_hole], columns[is_hole]], step


def _nearest_plane(camera: Camera, neighbours: Sequence[Camera]) -> float:
    """Return where planes begin: not before the camera's near plane, nor where what the neighbours see has
    shifted by half an image, which nothing could tell.
    """
    baselines = [float((neighbour.center - camera.center).norm()) for neighbour in neighbours]
    median = sorted(baselines)[len(baselines) // 2]
    half_an_image = 2 * camera.fx * median / max(camera.width, camera.height)
    return min(max(camera.near, half_an_image, _NEAREST_PLANE * camera.far), 0.5 * camera.far)


def _difference(points: Tensor, color: Tensor, rgb: Tensor, valid: Tensor, camera: Camera) -> Tensor:
    """Return how unlike another image is (P, D) at points (P, D, 3); 1 where it does not show them."""
    inside, row, column = _pixels(camera, points)
    return torch.where(inside & valid[row, column], (rgb[row, column] - color[:, None]).abs().mean(-1), 1.0)


def _pixels(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return whether a camera sees points (..., 3), and the row and column (...) of the nearest pixel."""
    pixel, z = camera.project(points)
    column, row = pixel.floor().long().unbind(-1)
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return inside, row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)


def _in_holes(points: Tensor, new: Tensor, camera: Camera, side: int) -> Tensor:
    """Return which ``new`` points (P, 3) of an image lie in lattice cells without earlier ``points``."""
    step = max(camera.width, camera.height) / side

    def cells(of: Tensor) -> Tensor:
        pixel, z = camera.project(of)
        column, row = (pixel / step).floor().long().unbind(-1)
        inside = (z > 0) & (column >= 0) & (column < side) & (row >= 0) & (row < side)
        return torch.where(inside, row * side + column, side * side)

    filled = torch.zeros(side * side + 1, dtype=torch.bool)
    filled[cells(points)] = True
    filled[-1] = False  # outside the image nothing is filled
    return ~filled[cells(new)]


def seen_colors(points: Tensor, cameras: Sequence[Camera], images: Sequence[Tensor]) -> Tensor:
    """Return the mean colour (N, 3) that images (H, W, 4) uint8 show at points (N, 3), by their alpha."""
    total, weight = torch.zeros(len(points), 3), torch.full((len(points), 1), 1e-6)
    for camera, rgba in zip(cameras, images):
        inside, row, column = _pixels(camera, points)
        shown = rgba[row, column].float() / 255
        alpha = shown[:, 3:] * inside[:, None]
        total, weight = total + shown[:, :3] * alpha, weight + alpha
    return torch.where(weight > 1e-3, total / weight, 0.5)


@torch.no_grad()
def compile_kernels(means: Tensor, has_planes: bool) -> None:
    """Run each operator once on a single particle; nothing random is drawn.

    What was never compiled on a machine is compiled by two processes, where it has two cores. Where no kernel
    is used, as on a GPU, there is nothing to compile.

    Args:
        means: of particles, which are not touched: they say which device it is.
        has_planes: whether images come with planes beside their colours.
    """
    if not use_numba(means):
        return
    from forewarp.ops.kernels import nodes as kernels

    zero, one, first = torch.zeros(1, 3), torch.ones(1, 1), torch.ones(1)
    missed = kernels.carry.stats.cache_misses.total()
    carry_nodes(zero[:, None], zero[:, None], first, zero)
    with _backward_compiled_beside(kernels.carry.stats.cache_misses.total() > missed):
        given = _single()
        rasterize(project(*given), 9, 8)
        two = torch.zeros(2, 1, 3)  # of a single node, half of its gradients would pass for contiguous
        spread_nodes(two, two, torch.zeros(2, 6), first, first, 1.0, 1.0)
        edges = torch.zeros(1, 1, dtype=torch.int64)
        pull_nodes(torch.zeros(1, 6), zero, torch.zeros(1, 12), edges, one, 1.0)
        skin_weights(one, one)
        moments = zero.clone(), zero.clone(), first.clone()
        adam_rows([AdamState(torch.zeros(1, 3), torch.ones(1, 3), *moments, 1e-3)], (0.9, 0.99), 1e-15)
    valid = torch.ones(72, dtype=torch.bool) if has_planes else None
    compare(*given, torch.zeros(72, 4, dtype=torch.uint8), torch.ones(3), valid=valid)


def compile_backward() -> None:
    """Compile what leads from splats and an image back to particles: about half of all compiling."""
    compile_backward_kernels(*_single())


def _single() -> tuple[Gaussians, Warp, Pinhole, Tensor, Tensor]:
    """Return a particle, its warp, a camera, and what time makes of colours and opacity."""
    zero, one = torch.zeros(1, 3), torch.ones(1, 1)
    particles = Gaussians(zero, zero, torch.ones(1, 4), one, torch.zeros(1, 1, 3))
    warp = Warp(torch.zeros(1, 12), torch.zeros(1, 1, dtype=torch.int32), one)
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    pinhole = Pinhole(identity, (0.0, 0.0, -2.0), (8.0, 8.0), (4.0, 4.0), (9, 8), 0.1)
    return particles, warp, pinhole, torch.zeros(0), torch.ones(1)


@contextmanager
def _backward_compiled_beside(new: bool) -> Iterator[None]:
    """Let another process ``compile_backward`` meanwhile, if kernels are ``new`` and there is a core for it.

    It leaves them in the cache on disk, where this process finds them; what it does not get done is
    compiled here, and why is told. It is never killed, as half a file in the cache would be worse than none.
    """
    if not new or cores() < 2:
        yield
        return
    with TemporaryFile() as errors:
        # Without the current folder, where a file may be called as a package that is imported.
        code = "import sys; sys.path = [place for place in sys.path if place]; "
        code += f"from {__name__} import compile_backward; compile_backward()"
        process = None
        with suppress(OSError):
            process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=errors)
        yield
        if process is None:
            return
        with suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
        if process.returncode:
            errors.seek(0)
            lines = errors.read().decode(errors="replace").strip().splitlines()
            why = lines[-1] if lines else f"status {process.returncode}"
            print(f"kernels are compiled by one process, as a second one failed: {why}")
