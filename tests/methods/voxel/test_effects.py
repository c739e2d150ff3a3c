"""The effects of the voxel methods, and the dense volumes between them."""

import math
from collections import Counter

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import EMPTY, Activation, RadianceGrid
from forewarp.methods.method import parameter_count
from forewarp.methods.voxel import effects
from forewarp.methods.voxel.effects import LearnedUpsampler, UNet3d, outline_of
from forewarp.ops.grid import index_of
from forewarp.ops.splat import average_splat
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays

BOX = Box((0, 0, 0), (1, 6, 8))  # spacings 1/2, 2, 2
LATTICE = Lattice(BOX, (3, 4, 5))


ACTIVATION = Activation(-4.6, 0.5)


def grid_of(lattice, voxels, values=None, activation=ACTIVATION):
    """A grid of some voxels (N, 3), by default with random values."""
    if values is None:
        values = torch.randn(len(voxels), 4, generator=torch.Generator().manual_seed(0))
    return RadianceGrid(lattice, index_of(voxels, lattice.shape), values, activation)


def motion(**changes):
    return effects.Motion(TrajectoryField(BOX, bases=2, frames=5, canonical_time=0.0, nodes=8), **changes)


def solid():
    """A full grid of one density and random colours."""
    grid = grid_of(LATTICE, LATTICE.all_voxels())
    grid.values[:, 0] = 6.0
    return grid


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
    canonical, flow = solid(), torch.zeros(60, 3)
    flow[:, 2] = 2.0 * (1 - 1e-4)  # a sliver of one in ten thousand stays in the first plane of z
    warped, coverage, _ = motion(fade=fade).warp(canonical, LATTICE.all_voxels(), flow)
    padded = torch.cat([warped.raw_density, torch.tensor([EMPTY])])
    opened = padded[warped.index[:, :, 0].long()]
    fog = 1 - math.exp(-80 * float(warped.activation.sigma(opened).max()) * LATTICE.voxel_size)
    assert fog < 1e-3
    assert warped.raw_density.max() == pytest.approx(6.0, abs=1e-4)
    assert 0 < coverage.min() < 2e-4


def test_what_rests_is_copied_and_what_moves_is_splatted(monkeypatch):
    canonical, flow, splatted = solid(), torch.full((60, 3), 0.01), []  # 0.02 voxels along x at most
    flow[40:] = torch.tensor([0.3, 0.4, 0.0])

    def noted(values, *others):
        splatted.append(len(values))
        return average_splat(values, *others)

    monkeypatch.setattr("forewarp.methods.voxel.effects.average_splat", noted)
    with torch.no_grad():
        warped, every = (
            motion(rest=rest).warp(canonical, LATTICE.all_voxels(), flow)[0] for rest in (0.05, 0.0)
        )
    assert (warped.values[warped.index[:1].long()] == canonical.values[:20].reshape(1, 4, 5, 4)).all()
    reached = (warped.index >= 0) & (every.index >= 0)
    ours, splats = (grid.values[grid.index[reached].long()] for grid in (warped, every))
    assert (ours[:, 1:] - splats[:, 1:]).abs().max() < 0.2  # 0.05 voxels of colours that are a few apart
    motion(rest=0.05).warp(canonical, LATTICE.all_voxels(), flow.requires_grad_())
    assert splatted == [20, 60, 60]  # with gradients all, or it would never learn to move


CROPPED = Lattice(Box((0, 0, 0), (4, 5, 6)), (5, 6, 7))


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
    index = index_of(torch.tensor(voxels, dtype=torch.long).reshape(-1, 3), CROPPED.shape)
    assert effects.occupied_crop(index, margin) == effects.Crop(low, high)


def test_dense_and_back():
    sparse = grid_of(CROPPED, torch.tensor([(1, 2, 3), (2, 2, 5)]), torch.arange(8.0).reshape(2, 4))
    crop = effects.occupied_crop(sparse.index, 1)
    dense = effects.densify(sparse, crop)
    assert dense.shape == (1, 4, *crop.shape) == (1, 4, 4, 3, 5)
    assert dense[0, :, 1, 1, 1].tolist() == [0, 1, 2, 3]
    assert dense[0, :, 2, 1, 3].tolist() == [4, 5, 6, 7]
    assert int((dense[0, 0] == EMPTY).sum()) == 4 * 3 * 5 - 2
    back = effects.sparsify(sparse, CROPPED, crop, dense)
    assert int((back.index >= 0).sum()) == 60
    assert back.values[back.index[sparse.index >= 0].long()].equal(sparse.values)


def test_a_voxel_alone_is_not_normalised():
    block = effects.ConvBlock(2, 3)
    alone, doubled = torch.randn(1, 2, 1, 1, 1), torch.randn(1, 2, 2, 1, 1)
    torch.testing.assert_close(block(alone), torch.relu(block.conv(alone)))
    torch.testing.assert_close(block(doubled), torch.relu(block.conv(block.norm(doubled))))


@pytest.mark.parametrize("size", [(1, 2, 3), (9, 10, 12)])
def test_the_convolution_of_one_thread_is_the_layers_own(size):
    layer = torch.nn.Conv3d(16, 16, 3, padding=1)
    x = torch.randn(1, 16, *size).to(memory_format=torch.channels_last_3d).requires_grad_()
    weights = torch.randn(1, 16, *size)
    found = torch.autograd.grad((effects.convolve(layer, x) * weights).sum(), [x, *layer.parameters()])
    exact = layer.double()
    wanted = torch.autograd.grad((exact(x.double()) * weights).sum(), [x, *exact.parameters()])
    for ours, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours, theirs.float(), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("threads", [1, 2])
def test_one_thread_takes_the_fast_convolution_too(monkeypatch, threads):
    layer, x, taken = torch.nn.Conv3d(16, 16, 3, padding=1), torch.randn(1, 16, 8, 8, 8), []
    monkeypatch.setattr(torch.nn.functional, "conv3d", lambda x, *_, **__: taken.append(x.is_mkldnn) or x)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    effects.convolve(layer, x)
    assert taken == [threads == 1 and torch.backends.mkldnn.is_available()]


COARSE = Lattice(Box((0, 0, 0), (2, 3, 4)), (3, 4, 5))
FULL = COARSE.all_voxels()
CORNER = torch.cartesian_prod(torch.arange(2), torch.arange(1, 3), torch.tensor([2]))


def test_interpolation_in_occupied_cells_equals_that_of_the_whole_box():
    assert effects.refined(COARSE, 1.5).shape == (4, 5, 7)
    coarse = grid_of(COARSE, CORNER)
    crop = effects.occupied_crop(coarse.index, 9)
    dense = effects.interpolate_dense(effects.densify(coarse, crop), crop, 2)
    whole = effects.sparsify(coarse, effects.refined(COARSE, 2), crop.scaled(2), dense)
    fine = effects.TrilinearUpsampler(scale=2)(coarse)
    assert len(fine.values) < len(whole.values)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([4.0, 6.0, 8.0])
    torch.testing.assert_close(fine.density(points), whole.density(points), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(fine.features(points), whole.features(points), atol=1e-5, rtol=1e-4)
    kept = fine.values[fine.index[tuple(2 * CORNER.T)].long()]
    torch.testing.assert_close(kept, coarse.values)


@pytest.mark.parametrize("voxels", [FULL, CORNER])
def test_the_learned_layer_starts_as_plain_interpolation_to_the_bit(voxels):
    coarse, learned = grid_of(COARSE, voxels), effects.LearnedUpsampler(scale=2, channels=4)
    crop = effects.occupied_crop(coarse.index, learned.margin)
    plain = effects.interpolate_dense(effects.densify(coarse, crop), crop, 2)
    fine = learned(coarse)
    assert torch.equal(fine.values, effects.sparsify(coarse, fine.lattice, crop.scaled(2), plain).values)
    fine.values.sum().backward()
    assert learned.head.weight.grad.abs().sum() > 0


def stepped(recompute):
    """Detail, every gradient, and the bytes that the backward pass held, of a layer that has learned."""
    torch.manual_seed(0)
    learned = effects.LearnedUpsampler(scale=2, channels=4, width=8, features=6, recompute=recompute)
    torch.nn.init.normal_(learned.head.weight)
    features, held = torch.randn(1, 6, *COARSE.shape, requires_grad=True), {}

    def hold(kept):
        held[id(kept) if kept.is_mkldnn else kept.data_ptr()] = kept.numel() * kept.element_size()
        return kept

    with torch.autograd.graph.saved_tensors_hooks(hold, lambda kept: kept):
        detail = learned.residual(features, effects.occupied_crop(grid_of(COARSE, FULL).index, 0))
    detail.square().sum().backward()
    return [detail.detach(), features.grad, *(p.grad for p in learned.parameters())], sum(held.values())


def test_recomputing_holds_less_and_changes_nothing():
    (tensors, held), (plain, plain_held) = stepped(True), stepped(False)
    assert len(tensors) == len(plain) == 14
    assert all(map(torch.equal, tensors, plain))
    assert all(tensor.abs().sum() > 0 for tensor in tensors[:-2])
    assert held < 0.5 * plain_held


def test_harmonics_hand_worked():
    features = torch.zeros(1, 12)
    features[0, :3] = torch.tensor([0.1, 0.2, 0.3])
    features[0, 3:] = torch.eye(3).flatten()  # with y: red, with z: green, with x: blue
    color = effects.SphericalHarmonics()(features, torch.tensor([[0.6, 0.8, -0.5]]))
    torch.testing.assert_close(color, torch.sigmoid(torch.tensor([[0.1 + 0.8, 0.2 - 0.5, 0.3 + 0.6]])))


@pytest.mark.parametrize("view", [effects.SphericalHarmonics(), effects.ViewNetwork(features=12, width=4)])
def test_colours_lie_in_the_unit_cube_and_have_gradients(view):
    for samples in (0, 1, 7):
        directions = torch.nn.functional.normalize(torch.randn(samples, 3), dim=-1)
        color = view(1e3 * torch.randn(samples, view.features), directions)
        assert color.shape == (samples, 3)
        assert ((color >= 0) & (color <= 1)).all()
    inputs = [torch.randn(3, n, dtype=torch.float64, requires_grad=True) for n in (12, 3)]
    assert torch.autograd.gradcheck(view.double(), inputs)


WIDE = Lattice(Box((-2, -2, -2), (2, 3, 2)), (9, 11, 7))
SMALL = Lattice(Box((-1, -0.5, -1), (1, 1, 0.7)), (5, 4, 6))


def values_on(lattice, raw, color, seed=None, voxels=None):
    """A grid whose voxels (by default all) are constant, or random about the values given."""
    voxels = lattice.all_voxels() if voxels is None else voxels
    values = torch.tensor([[raw, *color]], dtype=torch.float64).repeat(len(voxels), 1)
    if seed is not None:
        values += torch.randn(values.shape, generator=torch.Generator().manual_seed(seed)).double()
    return grid_of(lattice, voxels, values, Activation(0.0, 0.3))


def random_points(count):
    world = torch.rand(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return WIDE.to_lattice(world * torch.tensor([4.0, 5.0, 4.0]) - 2)


def test_densities_add_colours_are_weighted_by_them_and_directions_change_only_what_moves():
    moving, still = values_on(SMALL, 1.0, (0, 1, 2), seed=3), values_on(WIDE, -1.0, (1, 0, -1), seed=4)
    together, points = effects.Together(moving, still), random_points(4000)
    inner = SMALL.to_lattice(WIDE.to_world(points))
    within = ((inner >= 0) & (inner <= torch.tensor(SMALL.shape) - 1)).all(-1)
    assert 100 < within.sum() < 3900
    a, b = torch.where(within, moving.density(inner), 0.0), still.density(points)
    torch.testing.assert_close(together.density(points), a + b)

    def shade(features, directions):
        return torch.sigmoid(features) * directions

    directions = random_points(4000).sin()
    first, second = moving.colors(inner, directions, shade), still.colors(points, directions, None)
    mixed = (a[:, None] * first + b[:, None] * second) / (a + b)[:, None]
    torch.testing.assert_close(together.colors(points, directions, shade), mixed)


def test_what_is_thin_and_moves_is_not_stepped_over():
    lattice = Lattice(Box((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)), (33, 33, 33))
    sheet = torch.cartesian_prod(torch.tensor([16]), torch.arange(33), torch.arange(33))
    values = torch.tensor([[20.0, 0, 0, 0]], dtype=torch.float64).repeat(len(sheet), 1)
    moving = grid_of(lattice, sheet, values, Activation(0.0, lattice.voxel_size / 9))
    assert WIDE.voxel_size > 30 * lattice.voxel_size
    origins = torch.rand(50, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 0.3 - 0.15
    origins[:, 0] = -2.0
    rays = Rays(origins, torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(50, 3), 0.0, 5.0)
    field = effects.Together(moving, values_on(WIDE, -50.0, (0, 0, 0)))
    assert float(Renderer()(field, rays, torch.zeros(3).double()).opacity.min()) > 0.99


@pytest.mark.parametrize("shape", [(5, 4, 6), (30, 25, 40), (2, 2, 2)])
def test_cells_are_those_that_share_space(shape):
    source = Lattice(SMALL.box, shape)
    cells = torch.rand([n - 1 for n in shape], generator=torch.Generator().manual_seed(5)) < 0.2
    cells.view(-1)[0] = True
    found = effects.overlapped(cells, source, WIDE)
    points = torch.rand(60_000, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    inner = points * torch.tensor([n - 1 for n in shape])
    hit = cells[inner.long().unbind(-1)]
    expected = torch.zeros_like(found)
    expected[WIDE.to_lattice(source.to_world(inner)).long()[hit].unbind(-1)] = True
    assert found[expected].all()  # nothing is missed
    assert found.sum() <= expected.sum() + 60  # thin slivers that no point of the sample met


def test_an_empty_moving_grid_leaves_the_still_one():
    still, empty = values_on(WIDE, 1.0, (0, 1, 2), seed=4), values_on(SMALL, 0.0, (0, 0, 0), voxels=FULL[:0])
    rays = Rays(*torch.tensor([[[0.1, 0.2, -3.0]], [[0.0, 0.0, 1.0]]], dtype=torch.float64), 0.0, 9.0)
    both = Renderer()(effects.Together(empty, still), rays, torch.ones(3).double())
    same = Renderer(step=0.5 * SMALL.voxel_size / WIDE.voxel_size)  # the steps of the finer of the two
    alone = same(still, rays, torch.ones(3).double())
    torch.testing.assert_close(both.rgb, alone.rgb, atol=1e-5, rtol=0)  # an absent voxel has 1e-6 of opacity
    assert not empty.cells.any()


@pytest.mark.parametrize("raw", [-800.0, 1e4])
def test_extreme_densities_stay_finite_in_values_and_gradients(raw):
    grids = values_on(SMALL, raw, (0, 1, 2)), values_on(WIDE, raw, (1, 0, -1))
    for grid in grids:
        grid.values.requires_grad_()
    points, together = random_points(50), effects.Together(*grids)
    (together.colors(points, points, None).sum() + together.density(points).sum()).backward()
    assert all(grid.values.grad.isfinite().all() for grid in grids)


@pytest.mark.parametrize(("learned", "levels"), [(False, 4), (True, 3)])
def test_the_outline_has_the_modules_levels_and_all_its_parameters(learned, levels):
    inpainter = UNet3d(channels=5, width=16, levels=levels, coverage_channel=True, head=not learned)
    upsampler = LearnedUpsampler(channels=5, features=16, width=8) if learned else None
    steps = outline_of(inpainter, upsampler, 32)
    parts = [inpainter, upsampler] if learned else [inpainter]
    assert sum(step["parameters"] for step in steps) == sum(map(parameter_count, parts))
    does = Counter(step["does"] for step in steps)
    assert (does["max_pool3d"], does["interpolate"]) == (levels - 1, levels - 1 + learned)
    convolutions = 2 * levels + 2 * (levels - 1) + 2 * learned  # two a level on either side, two up-sampled
    assert does["batch_norm"] == does["conv3d"] == does["relu"] == convolutions
    assert steps[0]["shape"] == [6, 32, 32, 32]  # with the coverage
    sides = [step["shape"][1] for step in steps]
    assert (min(sides), sides[-1]) == (32 >> levels - 1, 63 if learned else 32)
    assert not any(parameter.is_meta for part in parts for parameter in part.parameters())
