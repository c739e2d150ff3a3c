"""Reading a grid at several strides."""

import pytest
import torch

from forewarp.fields.grids import VoxelGrid, read_strided
from forewarp.ops.grid import trilinear_reference
from forewarp.scene.box import Box, Lattice


def grid_of(shape):
    lattice = Lattice(Box((-1, 0, 0), (1, 2, 3)), shape)
    grid = VoxelGrid(lattice, torch.ones(shape, dtype=torch.bool), {"features": 2})
    with torch.no_grad():
        grid.features.normal_(generator=torch.Generator().manual_seed(0))
    return grid


def points_in(grid, count=50):
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    return share * torch.tensor(grid.lattice.box.size) + torch.tensor(grid.lattice.box.low)


def test_it_equals_reads_of_coarser_grids():
    grid = grid_of((5, 9, 13))
    points = points_in(grid)
    volume = grid.features.detach().reshape(5, 9, 13, 2)
    for stride, read in zip((1, 2, 4), read_strided(grid, points, (1, 2, 4)).split(2, -1)):
        coarse = volume[::stride, ::stride, ::stride]
        index = torch.arange(coarse[..., 0].numel(), dtype=torch.int32).reshape(coarse.shape[:3])
        at = Lattice(grid.lattice.box, tuple(coarse.shape[:3])).to_lattice(points)
        expected = trilinear_reference(coarse.reshape(-1, 2), index, at, torch.zeros(2))
        torch.testing.assert_close(read, expected, atol=1e-5, rtol=1e-5)


def test_a_new_lattice_is_noticed_and_other_sizes_are_refused_or_padded():
    grid = grid_of((5, 5, 5))
    points = points_in(grid)
    assert read_strided(grid, points, (1, 2, 4)).shape == (50, 6)
    lattice = Lattice(grid.lattice.box, (6, 5, 5))
    grid.resample(lattice, torch.ones(6, 5, 5, dtype=torch.bool), {"features": 0.0})
    with pytest.raises(ValueError, match=r"expected sizes of 4 k \+ 1, but got \(6, 5, 5\)"):
        read_strided(grid, points, (1, 2, 4))
    assert read_strided(grid, points, (1, 2, 4), padded=True).isfinite().all()


def test_outside_it_reads_nothing_and_gradients_reach_values_and_points():
    grid = grid_of((5, 5, 5)).double()
    assert not read_strided(grid, torch.full((2, 3), 9.0, dtype=torch.float64), (1, 2)).any()
    points = (0.9 * points_in(grid, 3).double() + 0.05).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, _: read_strided(grid, p, (1, 2, 4)), (points, grid.features))
