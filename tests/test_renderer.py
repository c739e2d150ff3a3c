import importlib.util
import math

import pytest
import torch

from forewarp.fields.grids import Activation, RadianceGrid, shaded
from forewarp.methods.voxel.effects import SphericalHarmonics
from forewarp.ops import backend
from forewarp.ops.grid import index_of
from forewarp.ops.march import trace
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays
from tests.support.reference import composite, march_samples

LATTICE = Lattice(Box((0, 0, 0), (1, 3, 8)), (3, 4, 5))  # spacings 1/2, 1, 2; voxel_size 1


class Slab:
    """Constant density and colour in the whole box."""

    lattice = LATTICE
    voxel_size = LATTICE.voxel_size
    cells = torch.ones(2, 3, 4, dtype=torch.bool)

    def __init__(self, sigma, feature=0.0):
        self.sigma, self.feature = sigma, feature

    def density(self, points):
        return torch.full((len(points),), self.sigma, dtype=points.dtype)

    def colors(self, points, directions, view):
        return shaded(torch.full((len(points), 3), self.feature, dtype=points.dtype), directions, view)


def rays(origins, directions, near=0.0, far=20.0):
    directions = torch.nn.functional.normalize(torch.tensor(directions, dtype=torch.float64), dim=-1)
    return Rays(torch.tensor(origins, dtype=torch.float64), directions, near, far)


THROUGH = rays([[0.5, 1.5, -2.0], [0.5, -1.0, 3.0]], [[0, 0, 1], [0, 1, 0]])
MISS = rays([[5.0, 1.5, -2.0], [0.5, 1.0, 9.0]], [[0, 0, 1], [0, 0, 1]])
WHITE = torch.ones(3, dtype=torch.float64)


def cloud():
    generator = torch.Generator().manual_seed(0)
    values = 4 * torch.randn(60, 4, generator=generator, dtype=torch.float64)
    index = torch.arange(60, dtype=torch.int32).reshape(LATTICE.shape)
    return RadianceGrid(LATTICE, index, values, Activation(0.0, 1.0))


def test_a_slab_absorbs_by_its_length():
    drawn = Renderer(step=0.01)(Slab(0.3), THROUGH, WHITE)
    expected = torch.tensor([1 - math.exp(-0.3 * 8), 1 - math.exp(-0.3 * 3)]).double()
    torch.testing.assert_close(drawn.opacity, expected, atol=2e-3, rtol=0)
    torch.testing.assert_close(drawn.rgb, (1 - 0.5 * expected)[:, None].expand(2, 3), atol=2e-3, rtol=0)
    torch.testing.assert_close(drawn.opacity + drawn.transmittance, WHITE[:2])
    # Mean depth of an exponential cut off at L, from where the box begins.
    mean = [b + 1 / 0.3 - length / math.expm1(0.3 * length) for b, length in ((2, 8), (1, 3))]
    torch.testing.assert_close(drawn.depth, torch.tensor(mean).double(), atol=1e-2, rtol=0)


def test_equals_the_slow_twin():
    field = cloud()
    all_rays = rays(
        [[0.4, 1.2, -2.0], [0.5, -1.0, 3.1], [9.0, 9.0, 9.0], [0.2, 1.0, 4.0]],
        [[0.1, 0.2, 1], [0.1, 1, 0.3], [1, 0, 0], [0.3, 1, -1]],
    )
    drawn = Renderer(step=0.5, color_threshold=0.0)(field, all_rays, WHITE, keep_all_weights=True)
    spacing = torch.tensor(LATTICE.spacing).double()
    start, along = all_rays.origins / spacing, all_rays.directions / spacing
    ids, distances = march_samples(start, along, 0.0, 20.0, 0.5, field.cells, torch.full((4,), 0.5))
    ids, distances = torch.tensor(ids), torch.tensor(distances).double()
    points = start[ids] + distances[:, None] * along[ids]
    weights, through = composite(field.density(points) * 0.5, ids, 4)
    rgb = torch.tensor(through).double()[:, None] * WHITE
    for ray, weight, color in zip(ids.tolist(), weights, torch.sigmoid(field.features(points))):
        rgb[ray] += weight * color
    torch.testing.assert_close(drawn.rgb, rgb)
    torch.testing.assert_close(drawn.all_weights, torch.tensor(weights).double())
    assert torch.equal(drawn.all_ray_ids, ids)
    torch.testing.assert_close(drawn.transmittance, torch.tensor(through).double())
    assert drawn.samples == len(ids)


def test_what_misses_shows_the_background():
    for background in (torch.tensor([0.2, 0.4, 0.6]).double(), torch.rand(2, 3).double()):
        drawn = Renderer()(Slab(5.0), MISS, background)
        assert torch.equal(drawn.rgb, background.expand(2, 3))
        assert drawn.depth.tolist() == drawn.opacity.tolist() == [0, 0]
        assert drawn.samples == len(drawn.weights) == 0


def test_no_rays_and_one_sample():
    drawn = Renderer()(Slab(1.0), THROUGH[:0], WHITE)
    assert drawn.rgb.shape == (0, 3)
    short = rays([[0.5, 1.5, 4.0]], [[0, 0, 1]], near=0.0, far=0.3)
    drawn = Renderer(step=0.5)(Slab(1.0), short, WHITE)
    assert drawn.samples == 1
    assert drawn.opacity.item() == pytest.approx(1 - math.exp(-0.5))


def test_gradcheck():
    field = cloud()
    values = field.values.clone().requires_grad_()
    view = rays([[0.4, 1.2, -2.0], [0.5, -1.0, 3.1]], [[0.1, 0.2, 1], [0.1, 1, 0.3]])

    def run(values):
        drawn = Renderer(color_threshold=0.0)(field.with_values(values), view, WHITE)
        return drawn.rgb, drawn.depth, drawn.opacity

    assert torch.autograd.gradcheck(run, values)


def test_faint_samples_cost_no_colour_and_hardly_any_light():
    field, view = cloud(), rays([[0.4, 1.2, -2.0]], [[0.1, 0.2, 1]])
    whole, thrifty = (Renderer(color_threshold=t)(field, view, WHITE) for t in (0.0, 1e-2))
    assert len(thrifty.weights) < len(whole.weights) == whole.samples
    assert thrifty.all_weights is thrifty.all_ray_ids is None
    kept = Renderer(color_threshold=1e-2)(field, view, WHITE, keep_all_weights=True)
    assert len(kept.weights) < len(kept.all_weights) == len(kept.all_ray_ids) == kept.samples
    assert torch.equal(whole.opacity, thrifty.opacity)
    torch.testing.assert_close(whole.rgb, thrifty.rgb, atol=0.1, rtol=0)


def test_the_view_sees_features_and_directions():
    def view(features, directions):
        return directions.abs() + 0 * features[:, :3]

    drawn = Renderer()(Slab(1e3), THROUGH, WHITE, view)
    torch.testing.assert_close(drawn.rgb, THROUGH.directions.abs())


def test_jitter_follows_the_generator():
    grid, view = blocks((9, 14, 12), 3.0)
    for gradient in (True, False):  # without, the kernel draws
        generators = [torch.Generator().manual_seed(seed) for seed in (1, 1, 2)]
        with torch.set_grad_enabled(gradient):
            drawn = [Renderer()(grid, view, torch.ones(3), generator=g).rgb for g in generators]
        assert torch.equal(drawn[0], drawn[1])
        assert not torch.equal(drawn[0], drawn[2])


def test_another_threshold_by_stage():
    renderer = Renderer(step=0.3)
    assert renderer.with_threshold(None) is renderer
    other = Renderer(step=0.3, early_stop_eps=0.1).with_threshold(0.0)
    assert (other.step, other.color_threshold, other.early_stop_eps) == (0.3, 0.0, 0.1)


def blocks(shape, strength, seed=3):
    """A sparse grid of random matter with 12 colour features, and rays all around it, some along faces."""
    generator = torch.Generator().manual_seed(seed)
    lattice = Lattice(Box((-1, -1, -2), (1, 2, 1)), shape)
    voxels = (torch.rand(shape, generator=generator) < 0.4).nonzero()
    values = strength * torch.randn(len(voxels), 13, generator=generator)
    grid = RadianceGrid(lattice, index_of(voxels, shape), values, Activation(0.0, lattice.voxel_size))
    origins = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator), dim=-1) * 5
    directions = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator) - origins, dim=-1)
    face = torch.tensor([[-4, -1, -0.5], [-4, 2, 1], [-4, 0.1, -2]])
    origins, along = torch.cat([origins, face]), torch.tensor([[1.0, 0, 0]]).expand(3, 3)
    return grid, Rays(origins, torch.cat([directions, along]), 0.0, 12.0)


@pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="Numba is not installed")
@pytest.mark.parametrize(("strength", "threshold"), [(0.0, 1e-4), (0.3, 0.0), (3.0, 1e-4), (100.0, 0.0)])
def test_without_gradient_the_kernel_draws_the_same(monkeypatch, strength, threshold):
    grid, view = blocks((9, 14, 12), strength)
    behind, renderer = torch.rand(len(view), 3), Renderer(color_threshold=threshold)
    shading = SphericalHarmonics()
    with torch.no_grad():
        fast = renderer(grid, view, behind, shading)
        whole = Renderer(color_threshold=threshold, early_stop_eps=0.0)(grid, view, behind, shading)
        monkeypatch.setattr(backend, "numba_installed", lambda: False)
        slow = renderer(grid, view, behind, shading)
    for drawn in (fast, whole):
        for name in ("rgb", "opacity", "transmittance"):
            torch.testing.assert_close(getattr(drawn, name), getattr(slow, name), atol=2e-4, rtol=0)
        torch.testing.assert_close(drawn.depth, slow.depth, atol=2e-3, rtol=0)
    assert slow.samples > 0
    assert fast.samples < 0.7 * slow.samples or strength < 100
    assert abs(whole.samples - slow.samples) <= 1e-3 * slow.samples  # a cell's face belongs to either side


@pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="Numba is not installed")
def test_the_kernel_serves_only_where_nothing_else_is_asked_for(monkeypatch):
    asked = []
    monkeypatch.setattr("forewarp.renderer.trace", lambda *a, **k: asked.append(1) or trace(*a, **k))
    grid, view = blocks((9, 14, 12), 3.0)
    black = torch.zeros(3)
    Renderer()(grid, view, black)
    with torch.no_grad():
        Renderer()(Slab(1.0), THROUGH, WHITE)
        assert Renderer()(grid, view, black, keep_all_weights=True).all_weights is not None
        assert asked == []
        Renderer()(grid, view, black)
    assert asked == [1]


@pytest.mark.parametrize(
    "wrong", [{"step": 0.0}, {"color_threshold": 1.0}, {"color_threshold": -0.1}, {"early_stop_eps": 1.0}]
)
def test_refuses(wrong):
    with pytest.raises(
        ValueError, match="renderer: expected step > 0 and 0 <= color_threshold < 1 and 0 <= early"
    ):
        Renderer(**wrong)
