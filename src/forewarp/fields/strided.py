"""Reading one voxel grid at several distances (TiNeuVox)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.ops.grid import trilinear


def read_strided(grid: VoxelGrid, points: Tensor, strides: Sequence[int], *, padded: bool = False) -> Tensor:
    """Interpolate trilinearly between every s-th voxel, for each stride s.

    Args:
        grid: with one parameter (N, C).
        points: (P, 3), world units.
        strides: ascending, the last a multiple of the others. Along each axis a lattice of n voxels needs
            n - 1 to be a multiple of the last.
        padded: add zeros behind the last voxel until that is so, and stretch all over the box: voxels are
            then not where the lattice has them.

    Returns:
        (P, C S), the channels of the first stride first; 0 outside the box. Differentiable in the grid's
        values and in the points.

    Raises:
        ValueError: for a lattice of other sizes, unless ``padded``.

    Cost: as of S trilinear reads.
    """
    values, (index, strided) = grid.parameter(grid.names[0]), _indices(grid, tuple(strides), padded)
    lattice = grid.lattice
    at, last = lattice.to_lattice(points), points.new_tensor(lattice.shape) - 1
    inside = ((at >= 0) & (at <= last)).all(-1, keepdim=True)
    at = at * ((points.new_tensor(index.shape) - 1) / last)
    zero = values.new_zeros(values.shape[1])
    read = [trilinear(values, one, at / stride, zero) for one, stride in zip(strided, strides)]
    return torch.cat(read, -1) * inside


def _indices(grid: VoxelGrid, strides: tuple[int, ...], padded: bool) -> tuple[Tensor, list[Tensor]]:
    """Return the index, padded where asked for, and every s-th entry of it; kept until the grid changes."""
    known = getattr(grid, "_strided", None)
    if known is None or known[0] is not grid.index or known[1] != (strides, padded):
        missing = [(1 - n) % strides[-1] for n in grid.index.shape]
        if any(missing) and not padded:
            raise ValueError(
                f"a strided grid: expected sizes of {strides[-1]} k + 1, but got {tuple(grid.index.shape)}"
            )
        ends = [end for more in reversed(missing) for end in (0, more)]
        index = torch.nn.functional.pad(grid.index, ends, value=-1)
        known = grid.index, (strides, padded), (index, [index[::s, ::s, ::s].contiguous() for s in strides])
        grid._strided = known
    return known[2]
