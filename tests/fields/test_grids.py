"""Voxel grids, the radiance on them, and reading them at several strides."""

import math

import pytest
import torch

from forewarp.fields import grids
from forewarp.methods.method import Method
from forewarp.ops.grid import occupied_cells, trilinear_reference
from forewarp.scene.box import Box, Lattice
from tests.support.hard_cases import index_with

SHAPE = (3, 4, 5)
LATTICE = Lattice(Box((0, 0, 0), (2, 3, 4)), SHAPE)
ALL = torch.ones(SHAPE, dtype=torch.bool)
THIRD = (torch.arange(60) % 3 == 0).reshape(SHAPE)
COMMON = {"alpha_init": 1e-2, "density_scale": 0.5, "alpha_threshold": 0.0}


def radiance_grid(raw=3.0, present=ALL, alpha_threshold=0.0):
    values = torch.ones(int(present.sum()), 4)
    values[:, 0] = raw
    activation = grids.Activation(grids.density_shift(1e-2), 1.0)
    return grids.RadianceGrid(LATTICE, index_with(present), values, activation, alpha_threshold)


@pytest.mark.parametrize("alpha", [1e-5, 1e-2, 0.5, 0.99])
def test_raw_inverts_alpha(alpha):
    activation = grids.Activation(grids.density_shift(1e-2), density_scale=0.1)
    raw = activation.raw(alpha, 0.05)
    assert activation.alpha(torch.tensor([raw]), 0.05).item() == pytest.approx(alpha, rel=1e-3)


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_an_opacity_that_has_no_raw_density_is_refused(alpha):
    with pytest.raises(ValueError, match=r"alpha_init: expected a number in \(0, 1\), but got"):
        grids.density_shift(alpha)


def test_absent_space_is_empty_and_not_fog():
    empty = radiance_grid(present=~ALL)
    sigma = empty.density(torch.tensor([[1.0, 1.0, 1.0]]))
    assert 1 - math.exp(-80 * sigma.item()) < 1e-4
    assert not empty.cells.any()
    assert empty.features(torch.ones(2, 3)).tolist() == [[0, 0, 0]] * 2
    assert empty.fill.tolist() == [grids.EMPTY, 0, 0, 0]


def test_density_and_features_are_read_from_the_voxels():
    whole, points = radiance_grid(raw=2.0), torch.rand(6, 3)
    torch.testing.assert_close(whole.density(points), whole.activation.sigma(torch.full((6,), 2.0)))
    torch.testing.assert_close(whole.features(points), torch.ones(6, 3))
    assert (whole.raw_density.shape, whole.color.shape) == ((60,), (60, 3))


def test_cells_too_transparent_are_skipped():
    assert radiance_grid(raw=3.0, alpha_threshold=1e-3).cells.all()
    assert not radiance_grid(raw=-9.0, alpha_threshold=1e-3).cells.any()
    assert radiance_grid(raw=-9.0).cells.all()
    solid = radiance_grid(raw=-9.0, alpha_threshold=1e-3)
    solid.values[solid.index[1, 1, 1], 0] = 5.0
    present = torch.full(SHAPE, -1, dtype=torch.int32)
    present[1, 1, 1] = 0
    assert torch.equal(solid.cells, occupied_cells(present))


def numbered(active):
    """Every voxel's density is its number in the lattice, its colour that number and its negative."""
    grid = grids.VoxelGrid(LATTICE, active, {"density": 1, "color": 2})
    number = torch.arange(60.0).reshape(SHAPE)[active][:, None]
    grid.density.data = number.clone()
    grid.color.data = torch.cat([number, -number], -1)
    return grid


def test_one_row_an_active_voxel():
    grid = numbered(THIRD)
    assert (grid.density.shape, grid.color.shape) == ((20, 1), (20, 2))
    assert torch.equal(grid.index >= 0, THIRD)
    assert torch.equal(grid.voxels, THIRD.nonzero())
    assert "33.3%" in repr(grid)


def test_activate_keeps_values_in_the_right_rows_and_births_the_rest():
    grid = numbered(THIRD)
    active = torch.zeros(SHAPE, dtype=torch.bool)
    active[:2] = True
    rows, old, number = grid.activate(active, {"density": -5.0}), THIRD[:2].flatten(), torch.arange(40.0)
    assert torch.equal(rows >= 0, old)
    assert torch.equal(grid.density[old, 0], number[old])
    assert (grid.density[~old] == -5).all()
    assert torch.equal(grid.color[old, 1], -number[old])
    assert torch.equal(grid.index.flatten()[:40], torch.arange(40, dtype=torch.int32))
    assert (grid.index[2] == -1).all()


def test_a_new_voxel_gets_the_mean_colour_of_its_active_neighbours():
    start = torch.zeros(SHAPE, dtype=torch.bool)
    start[0, 0, 0] = start[1, 1, 2] = start[2, 3, 4] = True  # numbers 0, 27, 59
    grid, active = numbered(start), start.clone()
    active[0, 0, 1] = active[2, 3, 0] = True  # beside the first two; beside none
    grid.activate(active, {"density": 0.0})
    assert grid.color[grid.index[0, 0, 1]].tolist() == [13.5, -13.5]
    assert grid.color[grid.index[2, 3, 0]].tolist() == [0, 0]
    empty = numbered(~ALL)
    assert (empty.activate(THIRD, {"density": 1.0}) == -1).all()
    assert (empty.density == 1).all()
    assert (empty.color == 0).all()


def test_resampling_a_linear_field_is_exact_and_absent_voxels_read_empty():
    grid = grids.VoxelGrid(LATTICE, ALL, {"density": 1})
    gradient = torch.tensor([1.0, -2.0, 0.5])
    grid.density.data = (LATTICE.to_world(grid.voxels) @ gradient)[:, None]
    finer = Lattice(LATTICE.box, (7, 5, 9))
    grid.resample(finer, torch.ones(finer.shape, dtype=torch.bool), {"density": 0.0})
    torch.testing.assert_close(grid.density.data[:, 0], finer.to_world(finer.all_voxels()) @ gradient)
    none = grids.VoxelGrid(LATTICE, ~ALL, {"density": 1})
    none.resample(finer, torch.ones(finer.shape, dtype=torch.bool), {"density": -10.0})
    torch.testing.assert_close(none.density.data, torch.full((315, 1), -10.0))


def holding(grid):
    method = Method()
    method.grid = grid
    return method


def test_a_checkpoint_brings_its_own_lattice():
    source = numbered(THIRD)
    source.resample(Lattice(LATTICE.box, (4, 4, 3)), torch.ones(4, 4, 3, dtype=torch.bool), {"density": 0.0})
    stored, loaded = holding(source), holding(numbered(ALL))
    parameter, index = loaded.grid.density, loaded.grid.index
    assert loaded.misfit(stored.state_dict()) is None
    loaded.load_state_dict(stored.state_dict())
    assert loaded.grid.lattice == source.lattice
    assert loaded.grid.density is parameter  # an optimiser may hold it
    assert loaded.grid.index is not index  # caches of what is read know it by its identity
    for name, value in source.state_dict().items():
        if torch.is_tensor(value):
            assert torch.equal(loaded.grid.state_dict()[name], value)


@pytest.mark.parametrize(
    ("features", "names"), [(3, {"density", "color"}), (12, {"density", "color", "shading"})]
)
def test_direct_radiance_owns_what_it_uses(features, names):
    radiance = grids.DirectRadiance(LATTICE, ALL, features=features, **COMMON)
    assert {n for n, _ in radiance.named_parameters()} == names
    grid = radiance()
    assert grid.values.shape == (60, 1 + features)
    assert grid.activation.alpha(grid.raw_density, 0.5)[0].item() == pytest.approx(1e-2, rel=1e-3)
    raw = torch.tensor(radiance.births(5e-3)["density"])
    assert radiance.activation.alpha(raw, LATTICE.voxel_size).item() == pytest.approx(5e-3, rel=1e-3)


def test_feature_radiance_starts_uniform_and_learns():
    radiance = grids.FeatureRadiance(LATTICE, ALL, features=12, grid_features=4, width=16, **COMMON)
    grid = radiance()
    assert grid.values.shape == (60, 13)
    assert (grid.values == 0).all()
    grid.values.sum().backward()
    assert radiance.network[-1].weight.grad.abs().sum() > 0


def test_the_encoded_positions_follow_the_active_voxels():
    radiance = grids.FeatureRadiance(LATTICE, ALL, features=3, grid_features=2, width=8, **COMMON)
    torch.nn.init.normal_(radiance.network[-1].weight)
    radiance()
    for keep in ([0, 1], [0], [1], [0, 1], [1]):
        active = torch.zeros_like(ALL)
        active[keep] = True
        radiance.activate(active, {})
    radiance.features.data[:] = 0
    fresh = grids.FeatureRadiance(LATTICE, active, features=3, grid_features=2, width=8, **COMMON)
    fresh.network = radiance.network
    fresh.features.data[:] = 0
    torch.testing.assert_close(radiance().values, fresh().values)


def test_a_point_is_encoded_alike_on_a_lattice_of_another_box():
    inner = Lattice(Box((0.5, 1, 1), (1.5, 2, 3)), SHAPE)
    centre = []
    for lattice in (LATTICE, inner):
        radiance = grids.FeatureRadiance(
            lattice, ALL, features=3, grid_features=1, width=4, box=LATTICE.box, **COMMON
        )
        radiance.network = torch.nn.Identity()  # its values are then the encoded positions, and the features
        centre.append(radiance.values().detach()[(radiance.voxels == torch.tensor([1, 0, 2])).all(-1)])
    assert centre[0][0, 0] == centre[1][0, 0] == 0  # the middle of the scene along x
    assert centre[0][0, 1] == -1
    assert centre[1][0, 1] == pytest.approx(-1 / 3, abs=1e-6)


def strided_grid(*shape):
    lattice = Lattice(Box((-1, 0, 0), (1, 2, 3)), shape)
    grid = grids.VoxelGrid(lattice, torch.ones(shape, dtype=torch.bool), {"features": 2})
    with torch.no_grad():
        grid.features.normal_(generator=torch.Generator().manual_seed(0))
    share = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    return grid, share * torch.tensor(lattice.box.size) + torch.tensor(lattice.box.low)


def test_strided_reads_equal_reads_of_coarser_grids():
    grid, points = strided_grid(5, 9, 13)
    volume = grid.features.detach().reshape(5, 9, 13, 2)
    for stride, read in zip((1, 2, 4), grids.read_strided(grid, points, (1, 2, 4)).split(2, -1)):
        coarse = volume[::stride, ::stride, ::stride]
        index = torch.arange(coarse[..., 0].numel(), dtype=torch.int32).reshape(coarse.shape[:3])
        at = Lattice(grid.lattice.box, tuple(coarse.shape[:3])).to_lattice(points)
        expected = trilinear_reference(coarse.reshape(-1, 2), index, at, torch.zeros(2))
        torch.testing.assert_close(read, expected, atol=1e-5, rtol=1e-5)


def test_a_new_lattice_is_noticed_and_other_sizes_are_padded():
    grid, points = strided_grid(5, 5, 5)
    assert grids.read_strided(grid, points, (1, 2, 4)).shape == (50, 6)
    lattice = Lattice(grid.lattice.box, (6, 5, 5))
    grid.resample(lattice, torch.ones(6, 5, 5, dtype=torch.bool), {"features": 0.0})
    assert grids.read_strided(grid, points, (1, 2, 4)).isfinite().all()


def test_strided_reads_are_0_outside_and_differentiable_inside():
    grid, points = strided_grid(5, 5, 5)
    grid = grid.double()
    assert not grids.read_strided(grid, torch.full((2, 3), 9.0, dtype=torch.float64), (1, 2)).any()
    points = (0.9 * points[:3].double() + 0.05).requires_grad_()
    read = lambda p, _: grids.read_strided(grid, p, (1, 2, 4))  # noqa: E731
    assert torch.autograd.gradcheck(read, (points, grid.features), fast_mode=True)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_a_length_that_density_cannot_be_measured_in_is_refused(scale):
    with pytest.raises(ValueError, match="density_scale: expected a length > 0"):
        grids.Activation(-4.6, scale)
