"""Properties that hold for all inputs, tested by hypothesis on fixed examples."""

import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies

from forewarp.fields.grids import Activation, RadianceGrid
from forewarp.methods.voxel.effects import Crop, densify
from forewarp.ops.march import accumulate, render_weights
from forewarp.ops.splat import average_splat
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays
from tests.support.hard_cases import SHAPE, index_with, voxels

pytestmark = pytest.mark.stability

MANY = settings(
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture],  # the implementation stays the same
)
SEEDS = strategies.integers(0, 1_000_000)
SHIFTS = strategies.tuples(*[strategies.integers(-3, 3)] * 3)


def random(seed, *shape, low=0.0, high=1.0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=dtype)


def as_dense(result, shape=SHAPE):
    """Return a splat's values (X, Y, Z, C) and coverage (X, Y, Z) densely, 0 where nothing arrived."""
    rows = result.index.long()
    values = torch.cat([result.values, result.values.new_zeros(1, result.values.shape[1])])
    coverage = torch.cat([result.coverage, result.coverage.new_zeros(1)])
    return values[rows], coverage[rows]


@MANY
@given(SEEDS, strategies.integers(1, 200))
def test_mass_is_conserved_inside_the_box(place, seed, count):
    last = torch.tensor(SHAPE) - 1.0
    positions = (random(seed, count, 3) * last).to(place)
    source = random(seed + 1, count, 2, low=-1).to(place)
    result = average_splat(source, positions, SHAPE, tau=1e-30)
    assert float(result.coverage.double().sum()) == pytest.approx(count, rel=1e-5)
    carried = (result.values.double() * result.coverage.double()[:, None]).sum(0)
    torch.testing.assert_close(carried, source.double().sum(0), atol=1e-4, rtol=1e-4)
    assert result.dropped == 0


@MANY
@given(SEEDS, SHIFTS)
def test_the_splat_commutes_with_whole_voxel_shifts(place, seed, shift):
    positions = random(seed, 40, 3, low=3.25, high=5.75, dtype=torch.float64).to(place)
    source, by = random(seed + 1, 40, 2, dtype=torch.float64).to(place), torch.tensor(shift)
    wide = (10, 10, 10)
    first = as_dense(average_splat(source, positions, wide), wide)
    second = as_dense(average_splat(source, positions + by.to(place), wide), wide)
    for a, b in zip(first, second):
        torch.testing.assert_close(a.roll(shift, (0, 1, 2)), b, atol=1e-12, rtol=1e-9)


@MANY
@given(SEEDS)
def test_zero_flow_is_the_identity(place, seed):
    source = random(seed, 60, 3, low=-1e3, high=1e3).to(place)
    result = average_splat(source, voxels(device=place), SHAPE)
    assert torch.equal(result.values, source)
    assert (result.coverage == 1).all()


@MANY
@given(SEEDS, strategies.floats(-30, 12))
def test_weights_and_opacity_lie_between_0_and_1(device, seed, power):
    count, rays = 200, 12
    ids = (random(seed, count) * rays).long().sort().values.to(device)
    optical = (random(seed + 1, count) * 10.0**power).to(device)
    weights, transmittance = render_weights(optical, ids, rays)
    assert ((weights >= 0) & (weights <= 1)).all()
    assert ((transmittance >= 0) & (transmittance <= 1)).all()
    opacity = accumulate(weights, torch.ones(count, 1, device=device), ids, rays)[:, 0]
    assert float(opacity.max()) <= 1 + 1e-6
    torch.testing.assert_close(opacity + transmittance, torch.ones_like(opacity), atol=1e-6, rtol=0)


def field_of(seed, place, share=0.6, shape=(6, 7, 8)):
    lattice = Lattice(Box((-1, -1.2, -0.9), (1.0, 1.1, 1.3)), shape)
    index = index_with(random(seed, *shape) < share, place)
    values = random(seed + 1, int((index >= 0).sum()), 4, low=-3, high=6).to(place).requires_grad_()
    return RadianceGrid(lattice, index, values, Activation(-2.0, lattice.voxel_size))


def rays_of(seed, place, count=40):
    origins = 4 * torch.nn.functional.normalize(random(seed, count, 3, low=-1), dim=-1)
    targets = random(seed + 1, count, 3, low=-0.8, high=0.8)
    return Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1), 1.0, 7.0).to(place)


def drawn(field, view):
    return Renderer(color_threshold=0.0)(field, view, torch.ones(3, device=view.origins.device))


def slopes(pictures, values, names=("rgb", "depth", "opacity")):
    """Return the gradient of the summed squares of the pictures."""
    return torch.autograd.grad(sum(getattr(p, n).square().sum() for p in pictures for n in names), values)[0]


def check_slopes(ours, theirs, share):
    assert float(theirs.abs().max()) > 0
    torch.testing.assert_close(ours, theirs, atol=share * float(theirs.abs().max()), rtol=0)


@MANY
@given(SEEDS, strategies.integers(1, 40))
def test_rays_in_chunks_are_the_rays(place, seed, chunk):
    """Pictures agree to 1e-6; gradients, summed in another order, to 1e-5 of the largest."""
    field, view = field_of(seed, place), rays_of(seed, place)
    whole = drawn(field, view)
    parts = [drawn(field, view[i : i + chunk]) for i in range(0, len(view), chunk)]
    for name in ("rgb", "depth", "opacity", "transmittance"):
        joined = torch.cat([getattr(p, name) for p in parts])
        torch.testing.assert_close(getattr(whole, name), joined, atol=1e-6, rtol=1e-6)
    check_slopes(slopes([whole], field.values), slopes(parts, field.values), 1e-5)


@MANY
@given(SEEDS)
def test_packed_samples_in_occupied_cells_equal_every_sample_of_the_dense_grid(place, seed):
    """Skipping empty cells gives the dense grid's picture to 1e-4 and its gradient to 1e-3 of the largest.

    The difference is the faint density that absent voxels have where they are drawn.
    """
    sparse = field_of(seed, place, share=0.1)
    whole = Crop((0, 0, 0), tuple(n - 1 for n in sparse.lattice.shape))
    everywhere = torch.arange(sparse.lattice.count, dtype=torch.int32, device=place)
    rows = densify(sparse, whole)[0].flatten(1).T.detach().contiguous().requires_grad_()
    dense = RadianceGrid(sparse.lattice, everywhere.reshape(sparse.index.shape), rows, sparse.activation)
    view, here = rays_of(seed, place), (sparse.index >= 0).flatten()
    first, second = drawn(sparse, view), drawn(dense, view)
    assert first.samples <= second.samples
    torch.testing.assert_close(first.rgb, second.rgb, atol=1e-4, rtol=0)
    torch.testing.assert_close(first.opacity, second.opacity, atol=1e-4, rtol=0)
    names = ("rgb", "opacity")  # no depth: on nearly empty rays it depends on the faintest voxels
    check_slopes(slopes([first], sparse.values, names), slopes([second], dense.values, names)[here], 1e-3)
