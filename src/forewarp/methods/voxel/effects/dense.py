"""Convert between sparse grids and the dense volumes that convolutions need."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forewarp.fields.radiance_grid import RadianceGrid
from forewarp.scene.box import Lattice


@dataclass(frozen=True)
class Crop:
    """The voxels ``low`` to ``high`` (inclusive) of a lattice."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels per axis."""
        return tuple(h - l + 1 for l, h in zip(self.low, self.high))

    def scaled(self, scale: int) -> Crop:
        """Return the same region on a lattice refined ``scale`` times; its corners do not move."""
        return Crop(tuple(v * scale for v in self.low), tuple(v * scale for v in self.high))


def occupied_crop(index: Tensor, margin: int) -> Crop:
    """Crop to the present voxels and a ``margin``, at least 2 voxels per axis; all if none is present."""
    present = (index >= 0).nonzero()
    if not len(present):
        return Crop((0, 0, 0), tuple(n - 1 for n in index.shape))
    low = [max(0, int(v) - margin) for v in present.amin(0)]
    high = [min(n - 1, max(int(v) + margin, l + 1)) for v, n, l in zip(present.amax(0), index.shape, low)]
    return Crop(tuple(min(l, h - 1) for l, h in zip(low, high)), tuple(high))


def densify(grid: RadianceGrid, crop: Crop) -> Tensor:
    """Return the crop's values (1, 1 + C, x, y, z); absent voxels are empty space. Differentiable."""
    region = tuple(slice(l, h + 1) for l, h in zip(crop.low, crop.high))
    rows = grid.index[region].reshape(-1).long()
    padded = torch.cat([grid.values, grid.fill[None]])
    dense = padded.index_select(0, torch.where(rows < 0, len(padded) - 1, rows))
    return dense.reshape(1, *crop.shape, -1).permute(0, 4, 1, 2, 3)


def sparsify(grid: RadianceGrid, lattice: Lattice, crop: Crop, dense: Tensor) -> RadianceGrid:
    """Make a grid on ``lattice`` with ``dense`` (1, 1 + C, x, y, z) in ``crop`` and nothing elsewhere."""
    index = torch.full(lattice.shape, -1, dtype=torch.int32, device=dense.device)
    count = dense[0, 0].numel()
    rows = torch.arange(count, dtype=torch.int32, device=dense.device).reshape(crop.shape)
    index[tuple(slice(l, h + 1) for l, h in zip(crop.low, crop.high))] = rows
    values = dense[0].permute(1, 2, 3, 0).reshape(count, -1)
    return replace(grid, lattice=lattice, index=index, values=values)
