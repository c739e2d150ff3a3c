import torch

from forewarp.fields.grids import VoxelGrid
from forewarp.scene.box import Box, Lattice

SHAPE = (3, 4, 5)
LATTICE = Lattice(Box((0, 0, 0), (2, 3, 4)), SHAPE)


def third():
    return (torch.arange(60) % 3 == 0).reshape(SHAPE)


def numbered(active):
    """Every voxel's density is its number in the lattice, its colour that number and its negative."""
    grid = VoxelGrid(LATTICE, active, {"density": 1, "color": 2})
    number = torch.arange(60.0).reshape(SHAPE)[active][:, None]
    grid.density.data = number.clone()
    grid.color.data = torch.cat([number, -number], -1)
    return grid


def test_one_row_an_active_voxel():
    grid = numbered(third())
    assert grid.density.shape == (20, 1)
    assert grid.color.shape == (20, 2)
    assert torch.equal(grid.index >= 0, third())
    assert torch.equal(grid.voxels, third().nonzero())
    assert grid.parameter("density") is grid.density
    assert "33.3%" in repr(grid)


def test_activate_keeps_values_in_the_right_rows_and_births_the_rest():
    grid = numbered(third())
    active = torch.zeros(SHAPE, dtype=torch.bool)
    active[:2] = True
    rows = grid.activate(active, {"density": -5.0})
    old = third()[:2].flatten()
    number = torch.arange(40.0)
    assert torch.equal(rows >= 0, old)
    assert torch.equal(grid.density[old, 0], number[old])
    assert (grid.density[~old] == -5).all()
    assert torch.equal(grid.color[old, 1], -number[old])
    assert torch.equal(grid.index.flatten()[:40], torch.arange(40, dtype=torch.int32))
    assert (grid.index[2] == -1).all()


def test_a_new_voxel_gets_the_mean_colour_of_its_active_neighbours():
    start = torch.zeros(SHAPE, dtype=torch.bool)
    start[0, 0, 0] = start[1, 1, 2] = start[2, 3, 4] = True  # numbers 0, 27, 59
    grid = numbered(start)
    active = start.clone()
    active[0, 0, 1] = active[2, 3, 0] = True  # beside the first two; beside none
    grid.activate(active, {"density": 0.0})
    assert grid.color[grid.index[0, 0, 1]].tolist() == [13.5, -13.5]
    assert grid.color[grid.index[2, 3, 0]].tolist() == [0, 0]


def test_an_empty_grid_can_be_filled():
    grid = VoxelGrid(LATTICE, torch.zeros(SHAPE, dtype=torch.bool), {"density": 1, "color": 2})
    rows = grid.activate(third(), {"density": 1.0})
    assert (rows == -1).all()
    assert (grid.density == 1).all()
    assert (grid.color == 0).all()


def test_resampling_a_linear_field_is_exact_and_absent_voxels_read_empty():
    grid = VoxelGrid(LATTICE, torch.ones(SHAPE, dtype=torch.bool), {"density": 1})
    slope = torch.tensor([1.0, -2.0, 0.5])
    grid.density.data = (LATTICE.to_world(grid.voxels) @ slope)[:, None]
    finer = Lattice(LATTICE.box, (7, 5, 9))
    grid.resample(finer, torch.ones(finer.shape, dtype=torch.bool), {"density": 0.0})
    torch.testing.assert_close(grid.density.data[:, 0], finer.to_world(finer.all_voxels()) @ slope)
    none = VoxelGrid(LATTICE, torch.zeros(SHAPE, dtype=torch.bool), {"density": 1})
    none.resample(finer, torch.ones(finer.shape, dtype=torch.bool), {"density": -10.0})
    torch.testing.assert_close(none.density.data, torch.full((315, 1), -10.0))


def test_a_checkpoint_brings_its_own_lattice():
    source = numbered(third())
    source.resample(Lattice(LATTICE.box, (4, 4, 3)), torch.ones(4, 4, 3, dtype=torch.bool), {"density": 0.0})
    other = VoxelGrid(LATTICE, torch.ones(SHAPE, dtype=torch.bool), {"density": 1, "color": 2})
    parameter = other.density
    other.load_state_dict(source.state_dict())
    assert other.lattice == source.lattice
    assert other.density is parameter  # an optimiser may hold it
    for name, value in source.state_dict().items():
        if torch.is_tensor(value):
            assert torch.equal(other.state_dict()[name], value)
