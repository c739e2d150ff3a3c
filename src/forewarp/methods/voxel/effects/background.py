"""The static background effect: a second grid that never moves, rendered together with the moving one."""

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
    """Density and colour of everything static, over the whole scene's box; usually the finer grid.

    Arguments as for ``DirectRadiance``; the colour has three channels and does not depend on direction.
    """


@dataclass(frozen=True)
class Together:
    """Two fields in one: ``sigma = sigma_m + sigma_s``, ``c = (sigma_m c_m + sigma_s c_s) / sigma``.

    Points are in coordinates of the ``static`` lattice, whose box must contain that of ``moving``.
    """

    moving: FieldAtTime
    static: RadianceGrid

    @property
    def lattice(self) -> Lattice:
        """Lattice of the static grid."""
        return self.static.lattice

    @property
    def voxel_size(self) -> float:
        """The smaller of the two voxel sizes."""
        return min(self.moving.voxel_size, self.static.voxel_size)

    @cached_property
    def cells(self) -> Tensor:
        """Cells in which either field may hold matter."""
        return self.static.cells | overlapped(self.moving.cells, self.moving.lattice, self.lattice)

    def _moved(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points in coordinates of the moving lattice, and which of them lie inside."""
        own = self.moving.lattice.to_lattice(self.lattice.to_world(points))
        last = torch.tensor(self.moving.lattice.shape, device=own.device) - 1
        return own, ((own >= 0) & (own <= last)).all(-1)

    def _moving_density(self, points: Tensor) -> Tensor:
        own, inside = self._moved(points)
        rows = inside.nonzero()[:, 0]
        return points.new_zeros(len(points)).index_copy(0, rows, self.moving.density(own[rows]))

    def density(self, points: Tensor) -> Tensor:
        """Density (P,)."""
        return self.static.density(points) + self._moving_density(points)

    def colors(self, points: Tensor, directions: Tensor, shade: Callable | None) -> Tensor:
        """Colour (P, 3): the mean of both fields' colours, weighted by density."""
        own, inside = self._moved(points)
        rows = inside.nonzero()[:, 0]
        static = self.static.colors(points, directions, None)
        moving = self.moving.colors(own[rows], directions[rows], shade)
        sigma = self.moving.density(own[rows])
        # The floor avoids 0 / 0 where both fields are empty.
        share = sigma / (sigma + self.static.density(points[rows])).clamp(min=torch.finfo(sigma.dtype).tiny)
        mixed = torch.lerp(static[rows], moving, share[:, None])
        return static.index_copy(0, rows, mixed)


def overlapped(cells: Tensor, source: Lattice, target: Lattice) -> Tensor:
    """Find the cells of lattice ``target`` that overlap a True cell of lattice ``source``.

    Args:
        cells: cells of ``source``, (X-1, Y-1, Z-1) bool.

    Returns:
        cells of ``target``, (X'-1, Y'-1, Z'-1) bool.

    Cost: eight reads per target cell inside the source's box, and one cumulative sum of the source's cells.
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
    """Count the True cells in every box of ``bounds``, from their cumulative sum over all axes."""
    for axis, (low, high) in enumerate(bounds):
        total = total.index_select(axis, high) - total.index_select(axis, low)
    return total
