"""Points where neighbouring views agree: a plane sweep, for pictures without silhouettes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud
from forewarp.scene.frame import Scene, spread

_DEPTHS = 48  # planes, evenly in inverse depth
_SIDE = 64  # lattice points along the longer side of a picture
_VIEWS, _OTHERS = 10, 8  # pictures that are swept; neighbours in time of each
_LEAST = 0.02  # share of the far plane at which planes begin at the earliest


def swept(scene: Scene, frames: list[int], count: int) -> Cloud | None:
    """Points (about ``count``) that neighbouring views agree on; None where there is a single view.

    Of each lattice point of a picture that depth is taken at which its colour is most like what its
    neighbours in time show there, the best half of them counted. Pictures come one after the other, and each
    adds only what fills its holes: what stands before points that are there already is mostly a wrong depth,
    or what has moved meanwhile. Points known to stand still are kept.
    """
    if len(scene.train) < 2:
        return None
    order = frames if len(frames) >= _VIEWS else list(range(len(scene.train)))
    chosen = [order[i] for i in spread(len(order), _VIEWS)]
    side = max(8, min(_SIDE, round((2 * count) ** 0.5)))
    known = scene.still if scene.still is not None else torch.zeros(0, 3)
    cameras, pictures = zip(*((scene.train[i].camera, scene.train[i].load()) for i in chosen))
    points, colors, sizes = [known.float()], [seen_colors(known.float(), cameras, pictures)], []
    for i in chosen:
        found, color, size = _sweep(scene, i, side)
        fresh = _in_holes(torch.cat(points), found, scene.train[i].camera, side)
        inside = _within(scene.box, found)
        points.append(found[fresh & inside])
        colors.append(color[fresh & inside])
        sizes.append(size)
    every, paint = torch.cat(points), torch.cat(colors)
    if not len(every):
        return None
    return Cloud(every, paint, torch.full((len(every),), 0.5), float(torch.stack(sizes).median()))


def _within(box: Box, points: Tensor) -> Tensor:
    low, high = torch.tensor(box.low), torch.tensor(box.high)
    return ((points >= low) & (points <= high)).all(-1)


def _small(scene: Scene, i: int, side: int) -> tuple[Tensor, Camera]:
    """A picture (h, w, 3) whose longer side is about four times the lattice's, and its camera."""
    camera, rgba = scene.train[i].camera, scene.train[i].load()
    scale = min(1.0, 4 * side / max(camera.width, camera.height))
    size = max(1, round(camera.height * scale)), max(1, round(camera.width * scale))
    rgb = rgba[..., :3].permute(2, 0, 1)[None].float() / 255
    rgb = torch.nn.functional.interpolate(rgb, size, mode="area")[0].permute(1, 2, 0)
    return rgb, camera.resized(size[1], size[0])


def _sweep(scene: Scene, i: int, side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points (P, 3) of a picture's lattice at their best depths, their colours, and their size ()."""
    rgb, camera = _small(scene, i, side)
    step = max(1, round(max(camera.width, camera.height) / side))
    rows, columns = torch.meshgrid(
        torch.arange(step // 2, camera.height, step),
        torch.arange(step // 2, camera.width, step),
        indexing="ij",
    )
    rays = camera.rays((rows * camera.width + columns).flatten())
    color = rgb[rows, columns].reshape(-1, 3)
    time = scene.train[i].time
    others = sorted(
        (j for j in range(len(scene.train)) if j != i),
        key=lambda j: (abs(scene.train[j].time - time), abs(j - i)),
    )[:_OTHERS]
    near = _nearest_plane(camera, [scene.train[j].camera for j in others])
    depths = 1 / torch.linspace(1 / near, 1 / camera.far, _DEPTHS)
    places = rays.origins[:, None] + depths[:, None] * rays.directions[:, None]  # (P, D, 3)
    costs = torch.stack([_difference(scene, j, side, places, color) for j in others])
    best = costs.sort(0).values[: max(1, len(others) // 2)].mean(0)
    depth = depths[best.argmin(-1)]
    points = rays.origins + depth[:, None] * rays.directions
    return points, color, depth.median() * step / camera.fx


def _nearest_plane(camera: Camera, others: Sequence[Camera]) -> float:
    """Where planes begin: not before the camera's near, nor where what the neighbours see has shifted by half
    a picture, which nothing could tell.
    """
    apart = [float((other.center - camera.center).norm()) for other in others]
    shifted = 2 * camera.fx * sorted(apart)[len(apart) // 2] / max(camera.width, camera.height)
    return min(max(camera.near, shifted, _LEAST * camera.far), 0.5 * camera.far)


def _difference(scene: Scene, j: int, side: int, places: Tensor, color: Tensor) -> Tensor:
    """How unlike another picture is (P, D) at places (P, D, 3); 1 where it does not show them."""
    rgb, camera = _small(scene, j, side)
    pixel, z = camera.project(places)
    column, row = pixel.floor().long().unbind(-1)
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    shown = rgb[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return torch.where(inside, (shown - color[:, None]).abs().mean(-1), 1.0)


def _in_holes(points: Tensor, found: Tensor, camera: Camera, side: int) -> Tensor:
    """Which of a picture's points (P, 3) lie in cells of its lattice that no earlier point falls into."""
    step = max(camera.width, camera.height) / side

    def cells(of: Tensor) -> Tensor:
        pixel, z = camera.project(of)
        column, row = (pixel / step).floor().long().unbind(-1)
        good = (z > 0) & (column >= 0) & (column < side) & (row >= 0) & (row < side)
        return torch.where(good, row * side + column, side * side)

    filled = torch.zeros(side * side + 1, dtype=torch.bool)
    filled[cells(points)] = True
    filled[-1] = False  # beside the picture nothing is filled
    return ~filled[cells(found)]


def seen_colors(points: Tensor, cameras: Sequence[Camera], pictures: Sequence[Tensor]) -> Tensor:
    """The mean colour (N, 3) of what pictures (H, W, 4) uint8 show at points (N, 3), by their alpha."""
    total, weight = torch.zeros(len(points), 3), torch.full((len(points), 1), 1e-6)
    for camera, rgba in zip(cameras, pictures):
        pixel, z = camera.project(points)
        column, row = pixel.floor().long().unbind(-1)
        inside = (z > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        shown = rgba[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)].float() / 255
        share = shown[:, 3:] * inside[:, None]
        total, weight = total + shown[:, :3] * share, weight + share
    return torch.where(weight > 1e-3, total / weight, 0.5)
