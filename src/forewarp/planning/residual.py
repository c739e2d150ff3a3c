"""What a fit without colours that change leaves over, and how much of it time and direction explain."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from forewarp.methods.effect import Residual
from forewarp.methods.method import Method
from forewarp.scene.frame import spread
from forewarp.scene.view import Target, View

VIEWS = 40  # images whose errors are looked at
_PIXELS = 12_000  # of each, of which
_SOLID = 0.9  # at least so opaque ones count
_FEWEST = 1000  # pixels in all, below which a fit shows nothing
_CELL = 0.1  # side of a cell, of the extent of what is seen
_FOLDS = 5  # of the images, each predicted from the others
_RIDGE = 2.0  # as strong as two images without error
_COSINES = 2  # of a colour over time


@torch.no_grad()
def residual(method: Method, targets: Sequence[Target]) -> Residual | None:
    """Measure the errors of a fitted method that stands still, in some of its training images.

    In each cell of space a colour linear in direction, cosines over time, and a constant colour are fitted to
    the errors in four fifths of the images, and compared in the others.

    Args:
        method: fitted without motion, and with colours that do not change.
        targets: training views.

    Returns:
        None where hardly anything is opaque yet.
    """
    generator, samples = torch.Generator().manual_seed(0), []
    targets = [targets[i] for i in spread(len(targets), VIEWS)]
    for number, target in enumerate(targets):
        camera = target.frame.camera
        pixels = torch.randperm(camera.width * camera.height, generator=generator)[:_PIXELS]
        pixels = pixels if target.valid is None else pixels[target.valid.flatten()[pixels]]
        view = View(camera, pixels)
        drawn, rays = method.at(target.moment).render(view, target.background.to(method.device)), view.rays()
        depth, error = drawn.depth.cpu(), target.rgb.reshape(-1, 3)[pixels] - drawn.rgb.clamp(0, 1).cpu()
        places = rays.origins + depth[:, None] * rays.directions
        solid = (drawn.opacity.cpu() > _SOLID) & places.isfinite().all(-1)
        of_image = torch.full((int(solid.sum()), 2), target.frame.time)
        of_image[:, 0] = number
        samples.append(torch.cat([places[solid], rays.directions[solid], error[solid], of_image], -1))
    places, directions, errors, views, times = torch.cat(samples).double().split([3, 3, 3, 1, 1], dim=-1)
    if len(places) < _FEWEST:
        return None
    cells = cells_of(places)
    over_time = torch.cos(math.pi * times * torch.arange(1, _COSINES + 1))
    by_time, by_direction = (explained(x, errors, cells, views[:, 0]) for x in (over_time, directions))
    return Residual(by_time, by_direction)


def cells_of(places: Tensor) -> Tensor:
    """Number the cells of space in which places (P, 3) lie."""
    extent = (places.quantile(0.98, dim=0) - places.quantile(0.02, dim=0)).max().clamp(min=1e-9)
    return torch.unique((places / (_CELL * extent)).floor().long(), dim=0, return_inverse=True)[1]


def explained(inputs: Tensor, errors: Tensor, cells: Tensor, views: Tensor) -> float:
    """Return the share of the squared error that ``inputs`` explain beyond what a constant does.

    Args:
        inputs: (P, I), of which a value linear in them is fitted in each cell.
        errors: (P, C).
        cells: (P,), the cell of each.
        views: (P,), the image of each; images that a fit has not seen tell.
    """
    inputs, left = torch.cat([torch.ones_like(inputs[:, :1]), inputs], -1), [0.0, 0.0]
    for fold in range(_FOLDS):
        told = views % _FOLDS == fold
        for kind, width in enumerate((1, inputs.shape[1])):
            weights = _fits(inputs[~told, :width], errors[~told], cells[~told], int(cells.max()) + 1)
            fit = torch.einsum("pi,pic->pc", inputs[told, :width], weights[cells[told]])
            left[kind] += float((errors[told] - fit).square().sum())
    return (left[0] - left[1]) / max(float(errors.square().sum()), 1e-12)


def _fits(inputs: Tensor, values: Tensor, cells: Tensor, count: int) -> Tensor:
    """Ridge regression of ``values`` (P, C) on ``inputs`` (P, I) in every cell: (cells, I, C)."""

    def summed(vectors: Tensor) -> Tensor:
        products = inputs[:, :, None] * vectors[:, None]
        return inputs.new_zeros(count, *products.shape[1:]).index_add_(0, cells, products)

    ridge = torch.eye(inputs.shape[1], dtype=inputs.dtype) * _RIDGE
    return torch.linalg.solve(summed(inputs) + ridge, summed(values))
