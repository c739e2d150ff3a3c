import pytest
import torch

from forewarp.fields.grids import Activation, RadianceGrid
from forewarp.methods.voxel.effects import Together, overlapped
from forewarp.ops.grid import index_of
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays

WIDE = Lattice(Box((-2, -2, -2), (2, 3, 2)), (9, 11, 7))
SMALL = Lattice(Box((-1, -0.5, -1), (1, 1, 0.7)), (5, 4, 6))


def grid_on(lattice, raw, color, seed=None):
    """Every voxel active; constant, or random about the values given."""
    generator = torch.Generator().manual_seed(seed or 0)
    values = torch.tensor([[raw, *color]], dtype=torch.float64).repeat(lattice.count, 1)
    if seed is not None:
        values = values + torch.randn(values.shape, generator=generator, dtype=torch.float64)
    index = index_of(lattice.all_voxels(), lattice.shape)
    return RadianceGrid(lattice, index, values, Activation(0.0, 0.3))


def random_points(count=4000):
    world = torch.rand(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return WIDE.to_lattice(world * torch.tensor([4.0, 5.0, 4.0]) - 2)


def inside(points):
    own = SMALL.to_lattice(WIDE.to_world(points))
    return own, ((own >= 0) & (own <= torch.tensor(SMALL.shape) - 1)).all(-1)


def test_densities_add_and_colours_are_weighted_by_them():
    moving, still = grid_on(SMALL, 1.0, (0, 1, 2), seed=3), grid_on(WIDE, -1.0, (1, 0, -1), seed=4)
    together, points = Together(moving, still), random_points()
    own, within = inside(points)
    assert 100 < within.sum() < 3900
    a, b = torch.where(within, moving.density(own), 0.0), still.density(points)
    torch.testing.assert_close(together.density(points), a + b)
    mixed = (
        a[:, None] * moving.colors(own, points, None) + b[:, None] * still.colors(points, points, None)
    ) / (a + b)[:, None]
    torch.testing.assert_close(together.colors(points, points, None), mixed)


def test_what_is_thin_and_moves_is_not_stepped_over():
    lattice = Lattice(Box((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)), (33, 33, 33))
    sheet = torch.cartesian_prod(torch.tensor([16]), torch.arange(33), torch.arange(33))
    values = torch.tensor([[20.0, 0, 0, 0]], dtype=torch.float64).repeat(len(sheet), 1)
    moving = RadianceGrid(
        lattice, index_of(sheet, lattice.shape), values, Activation(0.0, lattice.voxel_size / 9)
    )
    still = grid_on(WIDE, -50.0, (0, 0, 0))
    assert WIDE.voxel_size > 30 * lattice.voxel_size
    y, z = torch.rand(2, 200, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 0.3 - 0.15
    origins = torch.stack([torch.full_like(y, -2.0), y, z], -1)
    directions = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(200, 3)
    rays = Rays(origins, directions, 0.0, 5.0)
    seen = Renderer()(Together(moving, still), rays, torch.zeros(3, dtype=torch.float64))
    assert float(seen.opacity.min()) > 0.99


def test_directions_change_only_what_moves():
    moving, still = grid_on(SMALL, 1.0, (0, 0, 0)), grid_on(WIDE, -50.0, (0, 0, 0))
    points = random_points()
    red = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    colors = Together(moving, still).colors(
        points, points, lambda features, directions: red.expand(len(features), 3)
    )
    _, within = inside(points)
    torch.testing.assert_close(colors[within], red.expand(int(within.sum()), 3))
    torch.testing.assert_close(
        colors[~within], torch.full((int((~within).sum()), 3), 0.5, dtype=torch.float64)
    )


@pytest.mark.parametrize("shape", [(5, 4, 6), (30, 25, 40), (2, 2, 2)])
def test_cells_are_those_that_share_space(shape):
    source = Lattice(SMALL.box, shape)
    cells = torch.rand([n - 1 for n in shape], generator=torch.Generator().manual_seed(5)) < 0.2
    cells.view(-1)[0] = True
    found = overlapped(cells, source, WIDE)
    points = torch.rand(60_000, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    own = points * torch.tensor([n - 1 for n in shape])
    x, y, z = own.long().unbind(-1)
    target = WIDE.to_lattice(source.to_world(own)).long()
    hit = cells[x, y, z]
    expected = torch.zeros_like(found)
    expected[target[hit].unbind(-1)] = True
    assert found[expected].all()  # nothing is missed
    assert found.sum() <= expected.sum() + 60  # thin slivers that no point of the sample met


def test_an_empty_moving_grid_leaves_the_still_one():
    still = grid_on(WIDE, 1.0, (0, 1, 2), seed=4)
    empty = RadianceGrid(
        SMALL,
        torch.full(SMALL.shape, -1, dtype=torch.int32),
        torch.zeros(0, 4, dtype=torch.float64),
        still.activation,
    )
    rays = Rays(
        torch.tensor([[0.1, 0.2, -3.0]], dtype=torch.float64),
        torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
        0.0,
        9.0,
    )
    both = Renderer()(Together(empty, still), rays, torch.ones(3, dtype=torch.float64))
    same = Renderer(step=0.5 * SMALL.voxel_size / WIDE.voxel_size)  # the steps of the finer of the two
    alone = same(still, rays, torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(both.rgb, alone.rgb, atol=1e-5, rtol=0)  # an absent voxel has 1e-6 of opacity
    assert not empty.cells.any()


@pytest.mark.parametrize("raw", [-60.0, -800.0, 30.0, 1e4])
def test_extreme_densities_stay_finite_in_values_and_gradients(raw):
    moving, still = grid_on(SMALL, raw, (0, 1, 2)), grid_on(WIDE, raw, (1, 0, -1))
    for grid in (moving, still):
        grid.values.requires_grad_()
    points = random_points(50)
    together = Together(moving, still)
    (together.colors(points, points, None).sum() + together.density(points).sum()).backward()
    for grid in (moving, still):
        assert grid.values.grad.isfinite().all()
