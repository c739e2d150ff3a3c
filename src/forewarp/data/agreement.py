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


def disagreement(
    cameras: Sequence[Camera], distances: Sequence[Tensor], known: Tensor | None = None
) -> float | None:
    """Return the share by which distances of several views contradict each other, in the median of all pairs.

    Args:
        cameras: of the views.
        distances: (H, W) along the rays of each, 0 where there is none.
        known: points (N, 3) that the views are compared with, too.

    Returns:
        None where no two views show enough of the same, and none enough of what is known.
    """
    clouds = []
    for camera, away in zip(cameras, distances):
        there = away.flatten().nonzero()[:, 0]
        there = there[:: max(1, len(there) // _SAMPLES)]
        rays = camera.rays(there, torch.float64)
        clouds.append(rays.origins + away.flatten()[there].double()[:, None] * rays.directions)
    pairs = [(clouds[k], view) for k, view in permutations(range(len(cameras)), 2)]
    pairs += [] if known is None else [(known, view) for view in range(len(cameras))]
    shares = [_off(cameras[view], distances[view], points) for points, view in pairs]
    medians = [float(share.median()) for share in shares if len(share) >= _LEAST_PIXELS]
    return median(medians) if medians else None


def _off(camera: Camera, distances: Tensor, points: Tensor) -> Tensor:
    """Return the shares (P,) by which distances (H, W) of a view differ from those of points that it sees."""
    pixel, z = camera.project(points.double())
    size = pixel.new_tensor([camera.width, camera.height])
    inside = (z > 0) & (pixel >= 0).all(-1) & (pixel < size).all(-1)
    column, row = pixel[inside].long().unbind(-1)
    given, true = distances[row, column].double(), (points[inside].double() - camera.center).norm(dim=-1)
    return ((given - true).abs() / true)[given > 0]
