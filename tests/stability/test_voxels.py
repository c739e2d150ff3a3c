"""Warping, grids, convolutions and time under bad conditions (cases 1 to 4, 10, 11, 15 to 22, 29)."""

import math
from functools import partial

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import EMPTY, VoxelGrid
from forewarp.fields.networks import mlp
from forewarp.losses import tv_density, tv_flow
from forewarp.methods.voxel.backward import Deformation
from forewarp.methods.voxel.effects import Motion, UNet3d
from forewarp.ops.grid import neighbour_pairs, trilinear
from forewarp.ops.splat import average_splat
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.view import Moment
from forewarp.training.schedule import Curriculum
from tests.support import tiny_scene as tiny
from tests.support.hard_cases import LATTICE, SHAPE, check_finite, grid, voxels

pytestmark = pytest.mark.stability


def source_of(count, device, seed=0):
    made = torch.randn(count, 4, generator=torch.Generator().manual_seed(seed))
    return made.to(device).requires_grad_()


def motion():
    return Motion(TrajectoryField(LATTICE.box, bases=2, frames=5, canonical_time=0.0, nodes=8))


@pytest.mark.parametrize("sliver", [1e-9, 1e-7, 1e-4])
def test_coverage_of_a_billionth(place, sliver):
    positions = torch.tensor([[1.0, 1.0, 1.0 - sliver], [0.0, -1 + sliver, 2.0]], device=place)
    positions.requires_grad_()
    source = source_of(2, place)
    result = average_splat(source, positions, SHAPE)
    slopes = check_finite((result.values, result.coverage), source, positions)
    assert float(slopes[1].abs().max()) < 10 / 1e-2  # tau caps what would be 1 / sliver
    assert float(result.values.detach().abs().max()) <= float(source.detach().abs().max()) * (1 + 1e-6)


def test_all_voxels_land_in_one_cell(place):
    count = 20_000
    generator = torch.Generator().manual_seed(1)
    positions = (1.2 + 0.6 * torch.rand(count, 3, generator=generator)).to(place).requires_grad_()
    source = source_of(count, place)
    result = average_splat(source, positions, SHAPE)
    check_finite((result.values, result.coverage), source, positions)
    assert int((result.index >= 0).sum()) == 8
    assert float(result.coverage.detach().sum()) == pytest.approx(count, rel=1e-4)
    exact = average_splat(source.detach().double(), positions.detach().double(), SHAPE)
    torch.testing.assert_close(result.values.double(), exact.values, atol=1e-4, rtol=1e-3)


def test_expansion_opens_holes_everywhere(place):
    canonical = grid(6.0, device=place)
    home = voxels(device=place)
    spacing = torch.tensor(LATTICE.spacing, device=place)
    flow = ((home * 0.9 - torch.tensor([1.0, 1.5, 2.0], device=place)) * spacing).requires_grad_()
    warped, coverage, dropped = motion().warp(canonical, home.long(), flow)
    check_finite((warped.values, coverage), canonical.values, flow)
    assert dropped > 0
    assert float(warped.raw_density.detach().max()) <= 6.0 + 1e-5
    assert float(warped.raw_density.detach().min()) >= EMPTY - 1e-5


@pytest.mark.parametrize("bad", [1e3, -1e30, math.inf, -math.inf, math.nan])
def test_flow_far_outside_infinite_and_nan(place, bad):
    canonical = grid(6.0, device=place)
    flow = torch.zeros(60, 3, device=place)
    flow[::2, 1] = bad
    flow.requires_grad_()
    warped, coverage, dropped = motion().warp(canonical, voxels(device=place).long(), flow)
    gradients = check_finite((warped.values, coverage), canonical.values, flow)
    assert dropped == 30  # counted, not silent
    assert torch.equal(warped.values[coverage == 1], canonical.values[:30])  # where the other half stays
    assert int((coverage != 0).sum()) == 30
    assert (gradients[1][::2] == 0).all()


@pytest.mark.parametrize("thin", [1e-1, 1e-4, 1e-9, 1e-30])
@pytest.mark.parametrize("axes", [1, 2])
def test_a_flat_box_gets_the_voxels_asked_for_and_no_more(thin, axes):
    """Cubic voxels would need a thousand times as many for a flat box."""
    box = Box((0, 0, 0), (thin, thin if axes == 2 else 2.0, 3.0))
    for count in (1e3, 1e5, 2e6):
        lattice = Lattice.of_count(box, count)
        assert min(lattice.shape) >= 4
        assert 0.4 * count < lattice.count < 2.5 * count
        assert all(s > 0 and math.isfinite(s) for s in (*lattice.spacing, lattice.voxel_size))


def test_a_place_that_is_no_number_reads_no_number(place):
    """A NaN position reads NaN; nothing is masked silently."""
    index = torch.arange(60, dtype=torch.int32, device=place).reshape(LATTICE.shape)
    points = torch.tensor([[math.nan, 1, 1], [1, 1, 1]], device=place)
    read = trilinear(torch.ones(60, 1, device=place), index, points, torch.zeros(1, device=place))
    assert read[:, 0].isnan().tolist() == [True, False]


SIZES = [(1, 1, 1), (1, 1, 2), (2, 1, 1), (3, 5, 7), (5, 4, 9)]
VOLUMES = [(size, "random", precision) for size in SIZES for precision in (torch.float32, torch.bfloat16)]
# Not in bfloat16: each norm multiplies the slopes of constant volumes by up to 316.
VOLUMES += [(size, value, torch.float32) for size in SIZES[::3] for value in ("constant", "zero", "huge")]


@pytest.mark.parametrize(("size", "value", "precision"), VOLUMES)
def test_the_unet_on_any_volume(device, size, value, precision):
    torch.manual_seed(0)
    net = UNet3d(channels=4, width=16, levels=3).to(device)
    torch.nn.init.normal_(net.head.weight)
    dense = {"constant": 3.0, "zero": 0.0, "huge": 1e6}.get(value, torch.randn(1, 4, *size))
    dense = (torch.ones(1, 4, *size) * dense).to(device).requires_grad_()
    with torch.autocast(device.type, dtype=precision, enabled=precision != torch.float32):
        out = net.residual(net.features(dense))
    assert out.shape == dense.shape
    check_finite(out, dense, *(p for p in net.parameters()))


@pytest.mark.slow
def test_half_precision_reads_only_what_was_written(device):
    """Torch's bfloat16 gradient of the weights reads unwritten memory for volumes two voxels deep."""
    net = UNet3d(channels=4, width=16, levels=3).to(device)
    for _ in range(20):
        junk = [torch.full((2**n,), math.nan, device=device) for n in range(4, 20) for _ in range(4)]
        del junk  # the allocator returns this memory next
        with torch.autocast(device.type, dtype=torch.bfloat16):
            out = net.features(torch.randn(1, 4, 3, 5, 7, device=device))
        check_finite(out, *(p for n, p in net.named_parameters() if "head" not in n))


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 4, 1), (2, 1, 3)])
def test_total_variation_on_axes_of_one_voxel(device, shape):
    index = torch.arange(math.prod(shape), dtype=torch.int32, device=device).reshape(shape)
    pairs = neighbour_pairs(index)
    flow = torch.randn(math.prod(shape), 3, device=device, requires_grad=True)
    check_finite(tv_flow(flow, pairs), flow)
    density = flow.detach()[:, 0].clone().requires_grad_()
    check_finite(tv_density(density, pairs), density)


MODELS = {
    "everything": tiny.forward_model(**tiny.EVERYTHING | {"background": None}),
    "inpainter": tiny.forward_model(inpainter=tiny.INPAINTER),
    "backward": tiny.backward_model(deformation=partial(Deformation, width=16, layers=2)),
    "forward": tiny.forward_model(),
}


def method_of(choice, device):
    torch.manual_seed(0)
    lattice = Lattice(tiny.BOX, (8, 7, 6))
    made = tiny.built(MODELS[choice], lattice, density_scale=lattice.voxel_size)
    for parameter in made.parameters():  # nothing starts from zero, or half of it has no gradient
        parameter.data += 0.05 * torch.randn(parameter.shape)
    return made.to(device)


def picture(method, device):
    state = method.at(Moment(0.7))
    field = list(state.fields.values())[-1]
    rays = tiny.camera_at(0.1, 8).rays().to(device)
    drawn = Renderer()(field, rays, torch.ones(3, device=device), method.view_dependence)
    return state, drawn


@pytest.mark.parametrize("choice", MODELS)
def test_autocast_changes_what_convolutions_say_and_no_place_and_no_density(device, choice):
    method = method_of(choice, device)
    with torch.no_grad():
        state, drawn = picture(method, device)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        other, half = picture(method, device)
        loss = (half.rgb - 0.3).square().mean()
    assert torch.equal(state.canonical.values, other.canonical.values)
    if state.flow is not None:
        assert torch.equal(state.flow, other.flow)
    exact = getattr(MODELS[choice], "inpainter", None) is None
    torch.testing.assert_close(drawn.rgb, half.rgb, atol=1e-4 if exact else 0.05, rtol=0)
    assert exact or not torch.equal(drawn.rgb, half.rgb)
    loss.backward()
    for name in ("rgb", "depth", "opacity", "weights", "colors"):
        assert getattr(half, name).dtype == torch.float32
        assert getattr(half, name).isfinite().all()
    for name, parameter in method.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name


def test_a_network_given_half_precision_answers_in_full(device):
    made, half = mlp(3, 2, width=8, layers=3).to(device), torch.bfloat16
    x = torch.randn(5, 3, device=device)
    with torch.autocast(device.type, dtype=half):
        assert torch.equal(made(x), made(x.clone()))
        assert made(x.to(half)).dtype == torch.float32
    torch.testing.assert_close(made(x.to(half)), made(x.to(half).float()))
    assert made.double()(x.double()).dtype == torch.float64


def field(device, **changes):
    torch.manual_seed(0)
    options = {"bases": 50, "frames": 4, "canonical_time": 0.0, "nodes": 8, "width": 16, "layers": 2}
    made = TrajectoryField(LATTICE.box, **(options | changes))
    torch.nn.init.normal_(made.network[-1].weight)
    return made.to(device)


def test_more_cosines_than_frames_are_cut_to_what_is_independent(place):
    moving = field(place)
    assert moving.bases == 3
    grid = VoxelGrid(LATTICE, torch.ones(LATTICE.shape, dtype=torch.bool), {"density": 1}).to(place)
    check_finite(moving.flow(grid, 1.0), *moving.network.parameters())


@pytest.mark.parametrize("time", [0.0, 1e-12, 1e-7, 0.5, 1.0])
def test_at_and_beside_the_canonical_time(place, time):
    moving = field(place)
    points = LATTICE.to_world(voxels(device=place))
    paths = moving.trajectories(points, torch.tensor([0.0, time], device=place))
    check_finite(paths, *moving.network.parameters())
    assert torch.equal(paths[:, 0], points)
    reach = float((paths.detach()[:, 1] - points).norm(dim=-1).max())
    assert reach <= 100 * time**0.5 + 1e-6 * LATTICE.box.diagonal  # no jump at the canonical time


@pytest.mark.parametrize("times", [[0.0], [0.5, 0.5], [0.3] * 7, [0.0, 1.0]])
def test_one_frame_and_equal_times_can_be_drawn(times):
    curriculum = Curriculum(times, times[0], start=10, error_share=0.5)
    for fraction in (0.0, 0.5, 1.0):
        curriculum.fraction = fraction
        assert 1 <= curriculum.in_play <= len(times)
        assert 0 <= curriculum() < len(times)
