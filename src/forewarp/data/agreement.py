"""Tell by what neighbouring views show which of two readings of a scene's files is right."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import permutations
from statistics import median

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate

from forewarp.scene.camera import Camera
from forewarp.scene.frame import where_seen

# Views of a film that are compared, with others so many later: a share of all, and at least.
COMPARED, BESIDE = 3, ((0, 0), (24, 2), (8, 6))
SIDE = 64  # pixels of the longer side of images that are compared
_PLANES, _NEIGHBOURS, _PATCH = 32, 2, 3
_DISPARITY, _BOTH = 16, 0.3  # most pixels between two views; share of pixels that both show, at least
_TEXTURED = 0.02  # deviation of grey in [0, 1] around a pixel, below which any depth fits it
_LEAST_PIXELS, _SAMPLES = 100, 2000  # of a pair of views: fewest that tell, most that are looked at
_APART = 1e-3  # least difference of two readings, as a share, that tells
_WORST = 0.2  # difference of colours in [0, 1] from which on they are of two things
_LIKELIER, _MOST_PAIRS = 0.75, 0.8  # errors of a likelier reading as a share of the other's; share of pairs
_FEW = 20  # pixels of a pair of views, fewer of which tell nothing of their largest depths
_RAYS, _STEPS = 150, 48  # of a silhouette at most, and places on each
_REACH, _WIDER = 0.9, 1.5  # depth of a subject: of its distance at most, and in its half widths
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
            ends = 1 / camera.near, 1 / camera.far
            cost = _swept(camera, image, cameras[other], images[other], *ends, _PLANES)
            cost = cost[cost.isfinite()]
            if len(cost) >= _LEAST_PIXELS:
                errors.append(float(cost.median()))
    return sum(errors) / len(errors) if errors else torch.inf


def sweep_error(camera: Camera, image: Tensor, other: Camera, shown: Tensor) -> float:
    """Return how far colours of two views differ where each pixel has the depth that suits it best, whatever
    the unit of the cameras' places: the mean of pixels with texture; infinite where few are in both views.
    """
    baseline = float((camera.center - other.center).norm())
    nearest = _DISPARITY / (camera.fx * max(baseline, 1e-12))
    cost = _swept(camera, image, other, shown, 0.0, nearest, _DISPARITY + 1)
    both = cost[cost.isfinite()]
    if len(both) < max(_LEAST_PIXELS, _BOTH * len(cost)):
        return torch.inf
    return float(both.clamp(max=_WORST).mean())


def silhouette_error(
    camera: Camera, mask: Tensor, others: Sequence[tuple[Camera, Tensor]], point: Tensor
) -> float | None:
    """Return the share of a silhouette's pixels of which no place on the ray is inside all others.

    Args:
        camera, mask: of a view and its silhouette, (H, W) bool.
        others: views and their silhouettes, likewise.
        point: (3,) float64, about which the subject is.

    Returns:
        the share, None where nothing is in the silhouette.
    """
    there = mask.flatten().nonzero()[:, 0]
    if len(there) == 0:
        return None
    there = there[:: max(1, len(there) // _RAYS)]
    pixels = torch.stack([there % camera.width, there // camera.width], -1) + 0.5
    aside = float((pixels - camera.project(point[None])[0]).norm(dim=-1).max()) / camera.fx
    reach = min(_REACH, _WIDER * aside)  # as deep as wide
    away = float((point - camera.center).norm()) * torch.linspace(1 - reach, 1 + reach, _STEPS).double()
    rays = camera.rays(there, dtype=torch.float64)
    points = (rays.origins[:, None] + away[:, None] * rays.directions[:, None]).flatten(0, 1)
    inside = torch.ones(len(points), dtype=torch.bool)
    for other, shown in others:
        row, column, seen = where_seen(other, points)
        inside &= seen & shown[row.clamp(0, other.height - 1), column.clamp(0, other.width - 1)]
    return 1 - float(inside.view(-1, _STEPS).any(1).double().mean())


def _swept(
    camera: Camera, image: Tensor, other: Camera, shown: Tensor, first: float, last: float, planes: int
) -> Tensor:
    """Return the least difference (P,) over planes between two inverse depths, of pixels with texture;
    infinite where another view does not see them.
    """
    axis = camera.camera_to_world[:3, 2]
    rays = camera.rays(dtype=torch.float64)
    inverse = torch.linspace(first, last, planes, dtype=torch.float64)[:, None, None]
    along = rays.directions / (rays.directions @ axis)[:, None]
    pixel, z = other.project(other.center + inverse * (camera.center - other.center) + along)
    grid = 2 * pixel / pixel.new_tensor([other.width, other.height]) - 1
    is_seen = (z > 0) & (grid.abs() < 1).all(-1)
    grid = grid.reshape(planes, camera.height, camera.width, 2).clamp(-2, 2)
    warped = grid_sample(
        shown.double().permute(2, 0, 1).expand(planes, -1, -1, -1), grid, align_corners=False
    )
    colors = image.double().permute(2, 0, 1)
    difference = avg_pool2d(
        (warped - colors).abs().mean(1, keepdim=True), _PATCH, 1, _PATCH // 2, count_include_pad=False
    )[:, 0]
    difference = difference.flatten(1).masked_fill(~is_seen, torch.inf).amin(0)
    grey = colors.mean(0)[None]
    mean, square = (
        avg_pool2d(values, _PATCH, 1, _PATCH // 2, count_include_pad=False) for values in (grey, grey**2)
    )
    textured = ((square - mean**2).clamp(min=0).sqrt() > _TEXTURED).flatten()
    return difference[textured]


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
    clouds = [_points([(camera, one) for one in both])[1] for camera, *both in zip(cameras, *readings)]
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


def small_image(pixels: Tensor, side: int = SIDE) -> Tensor:
    """Make an image uint8 (H, W, C) ``side`` pixels long: (h, w, 3) in [0, 1]."""
    height, width = (max(1, round(n * side / max(pixels.shape[:2]))) for n in pixels.shape[:2])
    planes = pixels[..., :3].permute(2, 0, 1)[None].float() / 255
    return interpolate(planes, (height, width), mode="area")[0].permute(1, 2, 0)


def _points(readings: Sequence[tuple[Camera, Tensor]]) -> tuple[Tensor, list[Tensor]]:
    """Return some pixels (P,) of a view that have distances (H, W) along their rays in all readings, and the
    points (P, 3) float64 that they show in each.
    """
    there = torch.stack([distances > 0 for _, distances in readings]).all(0).flatten().nonzero()[:, 0]
    there = there[:: max(1, len(there) // _SAMPLES)]
    rays = {id(camera): camera.rays(there, torch.float64) for camera, _ in readings}
    points = []
    for camera, distances in readings:
        origins, directions = rays[id(camera)].origins, rays[id(camera)].directions
        points.append(origins + distances.flatten()[there].double()[:, None] * directions)
    return there, points


def _seen(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return where a camera sees points (P, 3): pixels (P, 2), and which are in its image, bool (P,)."""
    pixel, z = camera.project(points)
    size = pixel.new_tensor([camera.width, camera.height])
    return pixel, (z > 0) & (pixel >= 0).all(-1) & (pixel < size).all(-1)


def likeliest_reading(
    groups: Sequence[Sequence[tuple[Camera, Tensor, Tensor]]],
    readings: Mapping[str, Callable[[Camera, Tensor], tuple[Camera, Tensor]]],
) -> str | None:
    """Name the reading of cameras and distances by which colours of views agree much better than as read.

    Args:
        groups: of views that are compared: each a camera, its image (H, W, 3) in [0, 1], and distances
            (H, W) along the rays, 0 where there is none, as read.
        readings: other cameras and distances of a view, by name.
    """
    each = [lambda *given: given, *readings.values()]
    errors: list[list[float]] = [[] for _ in each]
    for group in groups:
        views = [[read(camera, away) for camera, _, away in group] for read in each]
        for before, more in zip(errors, warp_errors([image for _, image, _ in group], views)):
            before.extend(more)
    return likeliest(errors[0], dict(zip(readings, errors[1:])))


def warp_errors(
    images: Sequence[Tensor], readings: Sequence[Sequence[tuple[Camera, Tensor]]]
) -> list[list[float]]:
    """Return how far colours differ where distances put pixels of one view into another.

    Args:
        images: (H, W, 3) in [0, 1].
        readings: each of the camera of each view, of the image's size, and (H, W) along its rays, 0 where
            there is none.

    Returns:
        of each reading for each pair a mean in [0, 1], of pixels that have a distance in all readings;
        infinite where the one shows next to nothing of the other.
    """
    clouds = [_points(views) for views in zip(*readings)]
    errors = [[] for _ in readings]
    for k, view in permutations(range(len(images)), 2):
        there, points = clouds[k]
        for n, of_reading in enumerate(errors):
            camera = readings[n][view][0]
            pixel, inside = _seen(camera, points[n])
            if int(inside.sum()) < _LEAST_PIXELS:
                of_reading.append(torch.inf)
                continue
            grid = 2 * pixel[inside] / pixel.new_tensor([camera.width, camera.height]) - 1
            shown = images[view].double().permute(2, 0, 1)[None]
            options = {"align_corners": False, "padding_mode": "border"}
            shown = grid_sample(shown, grid[None, None], **options)[0, :, 0].T
            given = images[k].reshape(-1, 3)[there][inside]
            of_reading.append(float((shown - given).abs().mean(-1).clamp(max=_WORST).mean()))
    return errors


def likeliest(mine: Sequence[float], others: Mapping[str, Sequence[float]]) -> str | None:
    """Name the reading under which pairs of views differ least, if nearly all differ much less than as read.

    Args:
        mine: errors of pairs of views as read, see ``warp_errors``.
        others: of the same pairs, by the names of other readings.
    """
    likelier = {}
    for name, errors in others.items():
        pairs = [(min(a, _WORST), b) for a, b in zip(mine, errors) if b < torch.inf]
        less = sum(b < a for a, b in pairs)
        if len(pairs) < max(len(mine) / 2, 1) or less < _MOST_PAIRS * len(pairs):
            continue
        now, then = map(median, zip(*pairs))
        if then < _LIKELIER * now:
            likelier[name] = then
    return min(likelier, key=likelier.get, default=None)


def plane_error(cameras: Sequence[Camera], distances: Sequence[Tensor]) -> float | None:
    """Return by which share, at most, distances (H, W) along the rays of two views differ where both have
    one, 0 where there is none; None where no two do.
    """
    clouds, errors = [_points([view])[1][0] for view in zip(cameras, distances)], []
    for k, view in permutations(range(len(cameras)), 2):
        pixel, inside = _seen(cameras[view], clouds[k])
        column, row = pixel[inside].long().unbind(-1)
        given = distances[view][row, column].double()
        off = (given / (clouds[k][inside] - cameras[view].center).norm(dim=-1) - 1).abs()[given > 0]
        if len(off) >= _FEW:
            errors.append(float(off.median()))
    return max(errors, default=None)
