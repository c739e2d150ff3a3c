"""Tell by what neighbouring views show which of two readings of a scene's files is right."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from statistics import median

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from forewarp.scene.camera import Camera

SIDE = 64  # pixels of the longer side of images that are compared
_PLANES, _NEIGHBOURS, _PATCH = 32, 2, 3
_TEXTURED = 0.02  # deviation of grey in [0, 1] around a pixel, below which any depth fits it
_LEAST_PIXELS, _SAMPLES = 100, 2000  # of a pair of views: fewest that tell, most that are looked at
_APART = 1e-3  # least difference of two readings, as a share, that tells
_OCCLUDED, _OUTLIER = 0.15, 4.0  # share and multiple of the median error from which another thing is seen


def photo_error(cameras: Sequence[Camera], images: Sequence[Tensor]) -> float:
    """Return how far colours of neighbouring views differ where each pixel has the depth that suits it best.

    Args:
        cameras: at the size of the images, their near and far along the optical axis; two or more.
        images: (H, W, 3) in [0, 1], taken at one moment.

    Returns:
        the mean over views of the median over pixels with texture; infinite where no view shows another's.
    """
    centers, errors = torch.stack([camera.center for camera in cameras]), []
    for k, (camera, image) in enumerate(zip(cameras, images)):
        away = (centers - centers[k]).norm(dim=-1)
        away[k] = torch.inf
        for other in away.argsort()[:_NEIGHBOURS].tolist():
            cost = _swept(camera, image, cameras[other], images[other])
            if len(cost) >= _LEAST_PIXELS:
                errors.append(float(cost.median()))
    return sum(errors) / len(errors) if errors else torch.inf


def _swept(camera: Camera, image: Tensor, other: Camera, shown: Tensor) -> Tensor:
    """Return the least difference (P,) over planes of depth, of textured pixels that another view sees."""
    axis = camera.camera_to_world[:3, 2]
    rays = camera.rays(dtype=torch.float64)
    ends = 1 / torch.linspace(1 / camera.near, 1 / camera.far, _PLANES, dtype=torch.float64)
    along = rays.directions / (rays.directions @ axis)[:, None]
    pixel, z = other.project(camera.center + ends[:, None, None] * along)
    grid = 2 * pixel / pixel.new_tensor([other.width, other.height]) - 1
    is_seen = (z > 0) & (grid.abs() < 1).all(-1)
    grid = grid.reshape(_PLANES, camera.height, camera.width, 2).clamp(-2, 2)
    warped = grid_sample(
        shown.double().permute(2, 0, 1).expand(_PLANES, -1, -1, -1), grid, align_corners=False
    )
    planes = image.double().permute(2, 0, 1)
    difference = avg_pool2d(
        (warped - planes).abs().mean(1, keepdim=True), _PATCH, 1, _PATCH // 2, count_include_pad=False
    )[:, 0]
    difference = difference.flatten(1).masked_fill(~is_seen, torch.inf).amin(0)
    grey = planes.mean(0)[None]
    mean, square = (
        avg_pool2d(values, _PATCH, 1, _PATCH // 2, count_include_pad=False) for values in (grey, grey**2)
    )
    textured = ((square - mean**2).clamp(min=0).sqrt() > _TEXTURED).flatten()
    return difference[textured & difference.isfinite()]


def leaning(
    cameras: Sequence[Camera], readings: Sequence[Sequence[Tensor]], known: Tensor | None = None
) -> tuple[float, float, float] | None:
    """Compare two readings of the distances of several views by how far pairs of views contradict each other.

    Where the first is right its errors are noise; where the second is, they follow the difference of both
    readings' errors, however small it is beside the noise.

    Args:
        cameras: of the views.
        readings: two, of (H, W) along the rays of each view, 0 where there is none.
        known: points (N, 3) that the views are compared with, too.

    Returns:
        about 0 where the first is right and 1 where the second is, and the share by which distances of each
        differ, medians of all pairs; None where no two views show enough of the same in which both differ.
    """
    clouds = []  # of both readings, for each view
    for camera, *both in zip(cameras, *readings):
        there = (both[0] * both[1]).flatten().nonzero()[:, 0]
        there = there[:: max(1, len(there) // _SAMPLES)]
        rays = camera.rays(there, torch.float64)
        away = [distances.flatten()[there].double()[:, None] for distances in both]
        clouds.append([rays.origins + n * rays.directions for n in away])
    pairs = [(clouds[k], view) for k, view in permutations(range(len(cameras)), 2)]
    pairs += [] if known is None else [([known, known], view) for view in range(len(cameras))]
    found = [_lean(cameras[view], [given[view] for given in readings], both) for both, view in pairs]
    found = [of_pair for of_pair in found if of_pair is not None]
    return tuple(map(median, zip(*found))) if found else None


def _lean(
    camera: Camera, given: Sequence[Tensor], points: Sequence[Tensor]
) -> tuple[float, float, float] | None:
    """Fit by which share of their difference the errors of two readings (H, W) of a view are off.

    Args:
        camera: of the view.
        given: both readings.
        points: (P, 3) of another view by both readings. Each pair is looked up in one pixel, so that the
            noise of both is one and their difference has none.

    Returns:
        the share, and the size of both errors, as shares of the distance; None where the view does not show
        enough of the points.
    """
    middle, z = camera.project((points[0] + points[1]).double() / 2)
    inside = (
        (z > 0) & (middle >= 0).all(-1) & (middle < middle.new_tensor([camera.width, camera.height])).all(-1)
    )
    column, row = middle[inside].long().unbind(-1)
    first, second = (
        distances[row, column].double() / (cloud[inside].double() - camera.center).norm(dim=-1) - 1
        for distances, cloud in zip(given, points)
    )
    off = ((first + second) / 2).abs()
    off[given[0][row, column] <= 0] = torch.inf
    kept = off <= _OCCLUDED
    if len(off) == 0 or int(kept.sum()) < max(_LEAST_PIXELS, len(off) / 2):
        return None
    first, second, off = first[kept], second[kept], off[kept]
    near = off <= _OUTLIER * off.median()
    apart = (first - second)[near]
    if float(apart.square().mean().sqrt()) < _APART:
        return None
    share = float((first[near] * apart).sum() / apart.square().sum())
    return share, float(first.abs().median()), float(second.abs().median())
