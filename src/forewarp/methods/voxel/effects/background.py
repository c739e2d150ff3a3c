"""The static background effect: a grid that never moves, marched together with the one that does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from forewarp.fields.radiance import DirectRadiance
from forewarp.fields.radiance_grid import FieldAtTime, RadianceGrid
from forewarp.scene.box import Lattice


class StaticBackground(DirectRadiance):
    """Density and colour of all that stands still, over the whole scene's box; usually finer than what moves.

    Arguments as ``DirectRadiance``; its colour has three channels and does not depend on direction.
    """


@dataclass(frozen=True)
class Together:
    """Two fields in one space: ``sigma = sigma_m + sigma_s``, ``c = (sigma_m c_m + sigma_s c_s) / sigma``.

    Points are given in the lattice of ``still``, whose box must hold that of ``moving``.
    """

    moving: FieldAtTime
    still: RadianceGrid

    @property
    def lattice(self) -> Lattice:
        """The static one's."""
        return self.still.lattice

    @property
    def voxel_size(self) -> float:
        """Of the two that of the finer, whichever it is: what moves may lie in a small box."""
        return min(self.moving.voxel_size, self.still.voxel_size)

    @cached_property
    def cells(self) -> Tensor:
        """Cells in which either may hold matter."""
        return self.still.cells | overlapped(self.moving.cells, self.moving.lattice, self.lattice)

    def _moved(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The points in the moving field's lattice, and which lie in it."""
        own = self.moving.lattice.to_lattice(self.lattice.to_world(points))
        last = torch.tensor(self.moving.lattice.shape, device=own.device) - 1
        return own, ((own >= 0) & (own <= last)).all(-1)

    def _moving_density(self, points: Tensor) -> Tensor:
        own, inside = self._moved(points)
        rows = inside.nonzero()[:, 0]
        return points.new_zeros(len(points)).index_copy(0, rows, self.moving.density(own[rows]))

    def density(self, points: Tensor) -> Tensor:
        """Sigma (P,)."""
        return self.still.density(points) + self._moving_density(points)

    def colors(self, points: Tensor, directions: Tensor, shade: Callable | None) -> Tensor:
        """Colour (P, 3): each field's, weighted by its density."""
        own, inside = self._moved(points)
        rows = inside.nonzero()[:, 0]
        still = self.still.colors(points, directions, None)
        moving = self.moving.colors(own[rows], directions[rows], shade)
        sigma = self.moving.density(own[rows])
        # Where both are empty neither counts; the floor keeps 0 / 0 out of values and gradients.
        share = sigma / (sigma + self.still.density(points[rows])).clamp(min=torch.finfo(sigma.dtype).tiny)
        mixed = torch.lerp(still[rows], moving, share[:, None])
        return still.index_copy(0, rows, mixed)


def overlapped(cells: Tensor, source: Lattice, target: Lattice) -> Tensor:
    """Cells of ``target`` that share space with a cell of ``source`` that is True.

    Args:
        cells: of ``source`` (X-1, Y-1, Z-1) bool.

    Returns:
        of ``target`` (X'-1, Y'-1, Z'-1) bool.

    Cost: eight reads a target cell inside the source's box, one running sum of the source's cells.
    """
    total = torch.nn.functional.pad(cells.int(), (1, 0, 1, 0, 1, 0))
    for axis in range(3):
        total = total.cumsum(axis, dtype=torch.int32)
    bounds, parts = [], []
    for axis in range(3):
        edges = torch.arange(target.shape[axis], dtype=torch.float64, device=cells.device)
        edges = edges * target.spacing[axis] + (target.box.low[axis] - source.box.low[axis])
        edges = edges / source.spacing[axis]
        last = cells.shape[axis]
        low, high = edges[:-1].floor().clamp(0, last).long(), edges[1:].ceil().clamp(0, last).long()
        inside = (high > low).nonzero()[:, 0]
        parts.append(inside)
        bounds.append((low[inside], high[inside]))
    result = torch.zeros([n - 1 for n in target.shape], dtype=torch.bool, device=cells.device)
    if all(len(p) for p in parts):
        count = _box_counts(total, bounds)
        result[parts[0][:, None, None], parts[1][:, None], parts[2]] = count > 0
    return result


def _box_counts(total: Tensor, bounds: list[tuple[Tensor, Tensor]]) -> Tensor:
    """How many are set in every box of ``bounds``, from the running sum over all three axes."""
    for axis, (low, high) in enumerate(bounds):
        total = total.index_select(axis, high) - total.index_select(axis, low)
    return total
