"""The effects of the voxel methods, and the dense volumes between them."""

import math

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import EMPTY, Activation, RadianceGrid
from forewarp.methods.voxel.effects import (
    ConvBlock,
    Crop,
    LearnedUpsampler,
    Motion,
    SphericalHarmonics,
    Together,
    TrilinearUpsampler,
    UNet3d,
    ViewNetwork,
    convolve,
    densify,
    interpolate_dense,
    occupied_crop,
    overlapped,
    refined,
    sparsify,
)
from forewarp.ops.grid import index_of
from forewarp.ops.splat import average_splat
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays
from tests.support.hard_cases import index_with

BOX = Box((0, 0, 0), (1, 6, 8))  # spacings 1/2, 2, 2
LATTICE = Lattice(BOX, (3, 4, 5))


def motion(**changes):
    return Motion(TrajectoryField(BOX, bases=2, frames=5, canonical_time=0.0, nodes=8), **changes)


def solid(raw=6.0):
    index = torch.arange(60, dtype=torch.int32).reshape(LATTICE.shape)
    colors = torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
    values = torch.cat([torch.full((60, 1), raw), colors], -1)
    return RadianceGrid(LATTICE, index, values, Activation(-4.6, 1.0))


def test_flow_is_in_world_units():
    canonical = solid()
    shift = torch.tensor([0.5, 0.0, -2.0])  # one voxel up in x, one down in z
    warped, coverage, dropped = motion().warp(canonical, LATTICE.all_voxels(), shift.expand(60, 3))
    arrived = warped.values[warped.index[1:, :, :4].long()]
    torch.testing.assert_close(arrived, canonical.values.reshape(3, 4, 5, 4)[:2, :, 1:])
    assert dropped == 60 - 2 * 4 * 4
    assert len(coverage) == len(warped.values)


@pytest.mark.parametrize("fade", [0.5, 0.0])
def test_holes_are_empty_and_not_fog(fade):
    canonical = solid()
    flow = torch.zeros(60, 3)
    flow[:, 2] = 2.0 * (1 - 1e-4)  # a sliver of one in ten thousand stays in the first plane of z
    warped, coverage, _ = motion(fade=fade).warp(canonical, LATTICE.all_voxels(), flow)
    padded = torch.cat([warped.raw_density, torch.tensor([EMPTY])])
    opened = padded[warped.index[:, :, 0].long()]
    fog = 1 - math.exp(-80 * float(warped.activation.sigma(opened).max()) * LATTICE.voxel_size)
    assert fog < 1e-3
    assert warped.raw_density.max() == pytest.approx(6.0, abs=1e-4)
    assert 0 < coverage.min() < 2e-4


def test_what_rests_is_copied_and_what_moves_is_splatted(monkeypatch):
    canonical, flow = solid(), torch.zeros(60, 3)
    flow[40:] = torch.tensor([0.3, 0.4, 0.0])
    flow[:40] = 0.01  # 0.02 voxels along x at most
    splatted = []

    def noted(values, *others):
        splatted.append(len(values))
        return average_splat(values, *others)

    monkeypatch.setattr("forewarp.methods.voxel.effects.average_splat", noted)
    with torch.no_grad():
        warped, coverage, _ = motion(rest=0.05).warp(canonical, LATTICE.all_voxels(), flow)
        every, _, _ = motion(rest=0.0).warp(canonical, LATTICE.all_voxels(), flow)
    assert splatted == [20, 60]
    assert (warped.values[warped.index[:1].long()] == canonical.values[:20].reshape(1, 4, 5, 4)).all()
    reached = (warped.index >= 0) & (every.index >= 0)
    one, other = (grid.values[grid.index[reached].long()] for grid in (warped, every))
    assert (one[:, 1:] - other[:, 1:]).abs().max() < 0.2  # 0.05 voxels of colours that are a few apart
    motion(rest=0.05).warp(canonical, LATTICE.all_voxels(), flow.requires_grad_())
    assert splatted == [20, 60, 60]  # or it would never learn to move


SHAPE = (5, 6, 7)
CROPPED = Lattice(Box((0, 0, 0), (4, 5, 6)), SHAPE)


def sparse_grid(voxels):
    index = torch.full(SHAPE, -1, dtype=torch.int32)
    for row, at in enumerate(voxels):
        index[at] = row
    values = torch.arange(4.0 * len(voxels)).reshape(-1, 4)
    return RadianceGrid(CROPPED, index, values, Activation(0.0, 1.0))


@pytest.mark.parametrize(
    ("voxels", "margin", "low", "high"),
    [
        ([(2, 3, 4)], 0, (2, 3, 4), (3, 4, 5)),
        ([(2, 3, 4)], 1, (1, 2, 3), (3, 4, 5)),
        ([(4, 5, 6)], 0, (3, 4, 5), (4, 5, 6)),
        ([(0, 1, 2), (3, 1, 2)], 9, (0, 0, 0), (4, 5, 6)),
        ([], 2, (0, 0, 0), (4, 5, 6)),
    ],
)
def test_the_crop_holds_all_voxels_and_at_least_two_an_axis(voxels, margin, low, high):
    assert occupied_crop(sparse_grid(voxels).index, margin) == Crop(low, high)


def test_dense_and_back():
    sparse = sparse_grid([(1, 2, 3), (2, 2, 5)])
    crop = occupied_crop(sparse.index, 1)
    assert crop.shape == (4, 3, 5)
    dense = densify(sparse, crop)
    assert dense.shape == (1, 4, 4, 3, 5)
    assert dense[0, :, 1, 1, 1].tolist() == [0, 1, 2, 3]
    assert dense[0, :, 2, 1, 3].tolist() == [4, 5, 6, 7]
    assert int((dense[0, 0] == EMPTY).sum()) == 4 * 3 * 5 - 2
    back = sparsify(sparse, CROPPED, crop, dense)
    assert int((back.index >= 0).sum()) == 60
    for at in [(1, 2, 3), (2, 2, 5)]:
        assert torch.equal(back.values[back.index[at]], sparse.values[sparse.index[at]])


def test_a_refined_crop_has_its_corners_on_the_same_points():
    crop = Crop((1, 2, 3), (3, 4, 6)).scaled(2)
    assert (crop.low, crop.high, crop.shape) == ((2, 4, 6), (6, 8, 12), (5, 5, 7))


def test_the_first_step_is_the_identity_and_it_can_learn():
    net = UNet3d(channels=4, width=16, levels=2)
    residual = net.residual(net.features(torch.randn(1, 4, 3, 4, 5)))
    assert (residual == 0).all()
    residual.sum().backward()
    assert net.head.weight.grad.abs().sum() > 0


def test_a_voxel_alone_is_not_normalised():
    block = ConvBlock(2, 3)
    alone, doubled = torch.randn(1, 2, 1, 1, 1), torch.randn(1, 2, 2, 1, 1)
    torch.testing.assert_close(block(alone), torch.relu(block.conv(alone)))
    torch.testing.assert_close(block(doubled), torch.relu(block.conv(block.norm(doubled))))


@pytest.mark.parametrize("size", [(1, 2, 3), (9, 10, 12), (42, 32, 8)])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_convolution_is_the_layers_own_on_any_number_of_threads(size, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        layer = torch.nn.Conv3d(16, 16, 3, padding=1)
        x = torch.randn(1, 16, *size).to(memory_format=torch.channels_last_3d).requires_grad_()
        weights = torch.randn(1, 16, *size)
        found = torch.autograd.grad((convolve(layer, x) * weights).sum(), [x, *layer.parameters()])
        exact = layer.double()
        wanted = torch.autograd.grad((exact(x.double()) * weights).sum(), [x, *exact.parameters()])
    finally:
        torch.set_num_threads(before)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other.float(), rtol=1e-3, atol=1e-3)


def test_one_thread_takes_the_fast_convolution_too(monkeypatch):
    layer, x = torch.nn.Conv3d(16, 16, 3, padding=1), torch.randn(1, 16, 8, 8, 8)
    taken = []
    monkeypatch.setattr(torch.nn.functional, "conv3d", lambda x, *_, **__: taken.append(x.is_mkldnn) or x)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    convolve(layer, x)
    assert taken == [torch.backends.mkldnn.is_available()]


COARSE = Lattice(Box((0, 0, 0), (2, 3, 4)), (3, 4, 5))


def coarse_grid(present=None):
    present = torch.ones(COARSE.shape, dtype=torch.bool) if present is None else present
    index = index_with(present)
    values = torch.randn(int(present.sum()), 4, generator=torch.Generator().manual_seed(0))
    return RadianceGrid(COARSE, index, values, Activation(-4.6, 0.5))


def corner():
    present = torch.zeros(COARSE.shape, dtype=torch.bool)
    present[:2, 1:3, 2] = True
    return present


POINTS = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([2.0, 3.0, 4.0])


def answers(radiance):
    at = radiance.lattice.to_lattice(POINTS)
    return torch.cat([radiance.density(at)[:, None], radiance.features(at)], -1)


def test_refined_divides_the_spacing():
    assert refined(COARSE, 2).shape == (5, 7, 9)
    assert refined(COARSE, 2).spacing == (0.5, 0.5, 0.5)
    assert refined(COARSE, 1.5).shape == (4, 5, 7)


@pytest.mark.parametrize("make", [coarse_grid, lambda: coarse_grid(corner())])
def test_coarse_voxels_keep_their_values(make):
    coarse = make()
    fine = TrilinearUpsampler(scale=2)(coarse)
    for at in (coarse.index >= 0).nonzero():
        row = fine.index[tuple((2 * at).tolist())]
        torch.testing.assert_close(fine.values[row], coarse.values[coarse.index[tuple(at.tolist())]])


def test_interpolation_in_occupied_cells_equals_that_of_the_whole_box():
    coarse = coarse_grid(corner())
    crop = occupied_crop(coarse.index, 9)
    dense = interpolate_dense(densify(coarse, crop), crop, 2)
    whole = sparsify(coarse, refined(COARSE, 2), crop.scaled(2), dense)
    fine = TrilinearUpsampler(scale=2)(coarse)
    assert len(fine.values) < len(whole.values)
    torch.testing.assert_close(answers(fine), answers(whole), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("present", [None, corner()])
def test_the_learned_layer_starts_as_plain_interpolation_to_the_bit(present):
    coarse = coarse_grid(present)
    learned = LearnedUpsampler(scale=2, channels=4)
    crop = occupied_crop(coarse.index, learned.margin)
    plain = interpolate_dense(densify(coarse, crop), crop, 2)
    fine = learned.alone(coarse)
    assert torch.equal(fine.values, sparsify(coarse, fine.lattice, crop.scaled(2), plain).values)
    fine.values.sum().backward()
    assert learned.head.weight.grad.abs().sum() > 0


def stepped(recompute):
    """Detail, every gradient, and the bytes that the backward pass held, of a layer that has learned."""
    torch.manual_seed(0)
    learned = LearnedUpsampler(scale=2, channels=4, width=8, features=6, recompute=recompute)
    torch.nn.init.normal_(learned.head.weight)
    features = torch.randn(1, 6, *COARSE.shape, requires_grad=True)
    held = {}

    def hold(kept):
        place = id(kept) if kept.is_mkldnn else kept.data_ptr()
        held[place] = kept.numel() * kept.element_size()
        return kept

    with torch.autograd.graph.saved_tensors_hooks(hold, lambda kept: kept):
        detail = learned.residual(features, occupied_crop(coarse_grid().index, 0))
    detail.square().sum().backward()
    return detail.detach(), [features.grad, *(p.grad for p in learned.parameters())], sum(held.values())


def test_recomputing_holds_less_and_changes_nothing():
    (detail, gradients, held), (plain, plain_gradients, plain_held) = stepped(True), stepped(False)
    assert torch.equal(detail, plain)
    assert len(gradients) == len(plain_gradients) == 13
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(gradients, plain_gradients))
    assert all(gradient.abs().sum() > 0 for gradient in gradients[:-2])
    assert held < 0.5 * plain_held


def test_harmonics_hand_worked():
    features = torch.zeros(1, 12)
    features[0, :3] = torch.tensor([0.1, 0.2, 0.3])
    features[0, 3:6] = torch.tensor([1.0, 0.0, 0.0])  # with y: red
    features[0, 6:9] = torch.tensor([0.0, 1.0, 0.0])  # with z: green
    features[0, 9:12] = torch.tensor([0.0, 0.0, 1.0])  # with x: blue
    color = SphericalHarmonics()(features, torch.tensor([[0.6, 0.8, -0.5]]))
    torch.testing.assert_close(color, torch.sigmoid(torch.tensor([[0.1 + 0.8, 0.2 - 0.5, 0.3 + 0.6]])))


@pytest.mark.parametrize("view", [SphericalHarmonics(), ViewNetwork(features=12, width=8)])
def test_colours_lie_in_the_unit_cube_for_any_number_of_samples(view):
    for samples in (0, 1, 7):
        directions = torch.nn.functional.normalize(torch.randn(samples, 3), dim=-1)
        color = view(1e3 * torch.randn(samples, view.features), directions)
        assert color.shape == (samples, 3)
        assert ((color >= 0) & (color <= 1)).all()


def test_gradcheck():
    features = torch.randn(3, 12, dtype=torch.float64, requires_grad=True)
    directions = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(SphericalHarmonics(), (features, directions))
    assert torch.autograd.gradcheck(ViewNetwork(width=4).double(), (features, directions))


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
