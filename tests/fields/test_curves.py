"""Curves by a few coefficients, and the field of every voxel's curve."""

import pytest
import torch

from forewarp.fields.curves import Curve, TrajectoryField
from forewarp.fields.grids import VoxelGrid
from forewarp.scene.box import Box, Lattice

BOX = Box((-1, -1.5, -2), (1, 1.5, 2))
LATTICE = Lattice(BOX, (5, 6, 7))


@pytest.mark.parametrize("kind", ["spline", "cosines"])
@pytest.mark.parametrize("straight", [False, True])
def test_a_sum_of_bases_is_their_sum(kind, straight):
    curve = Curve(kind, 7, times=20, canonical_time=0.4, straight=straight)
    parts = [(0.3, 2.0), (0.8, -1.5), (1.0, 0.25)]
    expected = sum(factor * curve(time) for time, factor in parts)
    torch.testing.assert_close(curve.summed(parts), expected)
    assert torch.equal(curve.summed([(0.3, 1.0)]), curve(0.3))


def test_a_sum_reaches_as_far_as_it_is_told():
    curve = Curve("spline", 7, times=20, canonical_time=0.0)
    torch.testing.assert_close(curve.summed([(1.1, 1.0)], beyond=0.2), curve(1.1, 0.2))
    with pytest.raises(ValueError, match=r"^spline: expected times in \[0, 1\], but got 1.1"):
        curve.summed([(1.1, 1.0)])


def field(seed=0, **changes):
    torch.manual_seed(seed)
    options = {"bases": 3, "frames": 8, "canonical_time": 0.3, "nodes": 8, "width": 16, "layers": 2}
    made = TrajectoryField(BOX, **(options | changes))
    torch.nn.init.normal_(made.network[-1].weight, std=0.1)
    return made


def voxels(part=slice(None)):
    active = torch.zeros(LATTICE.shape, dtype=torch.bool)
    active[part] = True
    return VoxelGrid(LATTICE, active, {"density": 1})


def test_everything_stands_still_at_first():
    still = TrajectoryField(BOX, bases=3, frames=8, canonical_time=0.3)
    assert (still.flow(voxels(), 0.9) == 0).all()


@pytest.mark.parametrize(("nodes", "features"), [(0, 0), (8, 2)])
def test_flow_is_exactly_zero_at_the_canonical_time_only_and_paths_agree_with_it(nodes, features):
    moving, grid, times = field(nodes=nodes, features=features), voxels(), torch.tensor([0.0, 0.3, 1.0])
    assert (moving.flow(grid, 0.3) == 0).all()
    assert moving.flow(grid, 0.8).abs().max() > 1e-3
    home = LATTICE.to_world(grid.voxels)
    paths = moving.trajectories(home, times)
    assert paths.shape == (210, 3, 3)
    assert torch.equal(paths[:, 1], home)
    for i, time in enumerate(times.tolist()):
        torch.testing.assert_close(paths[:, i] - home, moving.flow(grid, time), atol=1e-5, rtol=1e-4)


def test_a_known_translation():
    moving = field(bases=1, frames=2, canonical_time=0.0)
    torch.nn.init.zeros_(moving.network[-1].weight)
    # T = 2: b(1) - b(0) = -sqrt(2); coefficients are scaled by half the longest side.
    moving.network[-1].bias.data = torch.tensor([0.5, -0.2, 0.1]) / (-(2**0.5) * 2.0)
    flow = moving.flow(voxels(), 1.0)
    torch.testing.assert_close(flow, torch.tensor([0.5, -0.2, 0.1]).expand_as(flow))


def test_bases_wait_until_they_are_let_in():
    moving = field()
    whole = moving.flow(voxels(), 0.9)
    assert moving.play(1) == 1
    first = moving.flow(voxels(), 0.9)
    assert not torch.allclose(whole, first)
    first.sum().backward()
    weight_rows = moving.network[-1].weight.grad.reshape(3, 3, -1).abs().sum((0, 2))
    assert weight_rows[0] > 0
    assert (weight_rows[1:] == 0).all()


def test_the_cache_follows_the_voxels():
    moving, grid = field(), voxels()
    moving.flow(grid, 0.9)
    active = torch.zeros(LATTICE.shape, dtype=torch.bool)
    active[2:] = True
    grid.activate(active, {})
    torch.testing.assert_close(moving.flow(grid, 0.9), field().flow(voxels(slice(2, None)), 0.9))


def test_curves_of_few_numbers():
    free, natural = (Curve("spline", 10, 20, 0.0, straight=straight) for straight in (False, True))
    assert (free.count, natural.count) == (10, 8)
    torch.testing.assert_close(natural.reach(), free.reach()[1:-1])
    times = torch.linspace(0, 1, 15)  # far from the ends both are the same
    torch.testing.assert_close(natural(times)[5:10, 2:6], free(times)[5:10, 3:7])
    assert Curve("cosines", 10, 20, 0.0, straight=True).count == 10
    assert Curve("spline", 4, 2, 0.0, straight=True)(0.25).tolist() == pytest.approx([0.75, 0.25])
    for few in (2, 3, 4):  # as free as there are times
        curve = Curve("spline", 4, few, 0.0, straight=True)
        assert torch.linalg.matrix_rank(curve(torch.linspace(0, 1, few))) == few == curve.count


def learned(**changes):
    return TrajectoryField(BOX, bases=3, frames=8, canonical_time=0.3, kind="nodes", **{"nodes": 8} | changes)


def swirl(points, times):
    """Paths that every lattice reads exactly: linear in place, cosines of the basis in time."""
    turn = torch.tensor([[0.0, -0.3, 0.1], [0.2, 0.1, 0.0], [0.0, 0.4, -0.2]])
    basis = learned().basis(times)
    return points[:, None] + (points @ turn.T + 0.1)[:, None] * (basis[:, :1] - 0.5 * basis[:, 2:])


def test_learned_nodes_begin_with_known_paths_and_interpolate_them():
    moving, grid, times = learned(), voxels(), torch.tensor([0.0, 0.3, 0.65, 1.0])
    moving.follow(grid)
    moving.fit(swirl, torch.linspace(0, 1, 8).tolist())
    home = LATTICE.to_world(grid.voxels)
    torch.testing.assert_close(moving.trajectories(home, times), swirl(home, times), atol=1e-4, rtol=1e-4)
    for i, time in enumerate(times.tolist()):
        went = moving.trajectories(home, times)[:, i] - home
        torch.testing.assert_close(moving.flow(grid, time), went, atol=1e-5, rtol=1e-4)


def test_learned_nodes_are_kept_around_active_voxels_and_new_ones_begin_as_their_neighbours():
    moving, grid = learned(), voxels(slice(2))
    before, after, rows = moving.follow(grid)
    count = len(moving.learned.voxels)
    assert len(before[0]) == moving.lattice.count > count == len(after[0]) == len(rows)
    assert moving.follow(grid) is None
    torch.nn.init.constant_(moving.learned.coefficients, 0.25)
    everywhere = torch.ones(LATTICE.shape, dtype=torch.bool)
    everywhere[3:] = False  # one voxel farther, which is about one node
    grid.activate(everywhere, {})
    _, after, rows = moving.follow(grid)
    assert (rows < 0).any()
    assert len(after[0]) > count
    assert (after[0] == 0.25).all()


def test_nodes_are_as_far_apart_in_a_smaller_box():
    small = Lattice(Box((-0.5, -0.75, -1), (0.5, 0.75, 1)), (5, 5, 5))
    whole, part = learned(nodes=20), learned(nodes=20, voxels=small)
    assert part.lattice.box == small.box
    assert part.lattice.voxel_size == pytest.approx(whole.lattice.voxel_size, rel=0.1)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"kind": "grid"}, r"^model.trajectory.kind: expected network or nodes, but got 'grid'"),
        ({"kind": "nodes", "nodes": 0}, r"^model.trajectory.nodes: expected a number > 0 of nodes, but"),
    ],
)
def test_refuses_coefficients_of_nothing(changes, text):
    with pytest.raises(ValueError, match=text):
        TrajectoryField(BOX, bases=3, frames=8, canonical_time=0.3, **changes)
