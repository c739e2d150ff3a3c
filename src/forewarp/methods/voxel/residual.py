"""What a coarse stage leaves of its pictures: does it go with direction, or with resolution?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forewarp.fields.radiance_grid import FieldAtTime
from forewarp.methods.voxel.effects.background import Together
from forewarp.metrics.limits import low_passed
from forewarp.scene.batch import Target
from forewarp.scene.view import View

if TYPE_CHECKING:
    from forewarp.methods.voxel.forward_warp import ForwardWarp

_WIDER = 4.0  # the box that places are told in: all that a static background holds lies in it


@dataclass(frozen=True)
class Residual:
    """What a coarse stage without view dependence leaves of its training pictures.

    ``psnr`` it reaches; ``by_direction``: share of the squared error that a colour linear in the direction,
    one for every place and fitted to other pictures, takes away (below 0: it only adds noise); ``allowed``:
    PSNR of the nearest pictures that the last stage's lattice can hold.
    """

    psnr: float
    by_direction: float
    allowed: float


@torch.no_grad()
def residual(method: ForwardWarp, targets: Sequence[Target], voxel_size: float, rays: int = 1500) -> Residual:
    """Evidence from what is left of some training pictures.

    Args:
        method: fitted, without view dependence.
        targets: training views.
        voxel_size: of the last stage's lattice, world units.
        rays: of each picture.
    """
    generator = torch.Generator().manual_seed(0)
    places, directions, errors, views, bounds = [], [], [], [], []
    for number, target in enumerate(targets):
        camera = target.frame.camera
        pixels = torch.randperm(camera.width * camera.height, generator=generator)[:rays]
        shown = _seen(method, target, pixels)
        error = target.rgb.reshape(-1, 3)[pixels] - shown[0]
        places.append(shown[1]), directions.append(camera.rays(pixels).directions), errors.append(error)
        views.append(torch.full((len(pixels),), number))
        voxel = voxel_size * camera.fx / max(float(shown[2]), 1e-6)
        bounds.append(float((low_passed(target.rgb, voxel) - target.rgb).square().mean()))
    error = torch.cat(errors)
    share = _explained(
        torch.cat(places),
        torch.cat(directions),
        error,
        torch.cat(views),
        2 * method.radiance.lattice.voxel_size,
    )
    return Residual(_psnr(float(error.square().mean())), share, _psnr(sum(bounds) / len(bounds)))


def _psnr(error: float) -> float:
    return -10 * math.log10(max(error, 1e-10))


def _seen(method: ForwardWarp, target: Target, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of some pixels the colour drawn (R, 3), the canonical place (R, 3), NaN where nothing is met, and the
    median distance to what is met.
    """
    view, time = View(target.frame.camera, pixels), target.frame.time
    drawn = method.at(target.moment).render(view, target.background.to(method.device))
    place, box = _places(method, time), method.radiance.lattice.box
    rays = view.rays().to(method.device)
    found = method.renderer.picture(place, rays, rays.origins.new_zeros(3))
    solid = found.opacity > 0.5
    low, high = (found.rgb.new_tensor(end) for end in (box.scaled(_WIDER).low, box.scaled(_WIDER).high))
    at = low + (high - low) * found.rgb / found.opacity.clamp(min=1e-6)[:, None]
    at[~solid] = math.nan
    return (
        drawn.rgb.clamp(0, 1).cpu(),
        at.cpu(),
        found.depth[solid].median() if bool(solid.any()) else found.depth.new_tensor(1.0),
    )


def _places(method: ForwardWarp, time: float) -> FieldAtTime:
    """The radiance at a time with canonical places in the place of colours."""
    box = method.radiance.lattice.box.scaled(_WIDER)

    def placed(grid, voxels: Tensor):
        at = grid.lattice.to_world(voxels)
        low, high = at.new_tensor(box.low), at.new_tensor(box.high)
        share = ((at - low) / (high - low)).clamp(1e-4, 1 - 1e-4)
        return grid.with_values(torch.cat([grid.raw_density[:, None], torch.logit(share)], -1))

    field = placed(method.radiance(), method.radiance.voxels)
    if method.motion is not None and time != method.canonical_time:
        field = method.motion.warp(field, method.radiance.voxels, method.motion.flow(method.radiance, time))[
            0
        ]
    if method.background is None:
        return field
    return Together(field, placed(method.background(), method.background.voxels))


def _explained(places: Tensor, directions: Tensor, errors: Tensor, views: Tensor, cell: float) -> float:
    """Share of the squared error that a colour linear in direction, one a cell of space, takes from pictures
    that it was not fitted to, beyond what one that is the same from all sides takes.

    Args:
        places: (P, 3), NaN where there is none.
        directions: (P, 3) unit.
        errors: (P, 3).
        views: (P,), the picture of each.
        cell: side of a cell, world units.
    """
    known = places.isfinite().all(-1)
    places, directions, errors, views = (x[known] for x in (places, directions, errors, views))
    if not len(places):
        return 0.0
    _, cells = torch.unique((places / cell).floor().long(), dim=0, return_inverse=True)
    count = int(cells.max()) + 1
    inputs = torch.cat([torch.ones_like(directions[:, :1]), directions.float()], -1).double()
    left = [0.0, 0.0]
    for half in (0, 1):
        fitted, other = views % 2 == half, views % 2 != half
        for kind, width in enumerate((1, 4)):
            weights = _fits(inputs[fitted, :width], errors[fitted].double(), cells[fitted], count)
            rest = errors[other] - torch.einsum("pi,pic->pc", inputs[other, :width], weights[cells[other]])
            left[kind] += float(rest.square().sum())
    return (left[0] - left[1]) / max(float(errors.square().sum()), 1e-12)


def _fits(inputs: Tensor, values: Tensor, cells: Tensor, count: int) -> Tensor:
    """Least squares of ``values`` (P, C) on ``inputs`` (P, I) in every cell, drawn to 0: (cells, I, C)."""
    width = inputs.shape[1]
    squares = inputs.new_zeros(count, width, width).index_add_(0, cells, inputs[:, :, None] * inputs[:, None])
    products = inputs.new_zeros(count, width, values.shape[1]).index_add_(
        0, cells, inputs[:, :, None] * values[:, None]
    )
    drawn = torch.eye(width, dtype=inputs.dtype) * 2.0  # as much as two pictures that show no error
    return torch.linalg.solve(squares + drawn, products)
