import importlib.util
import math
from dataclasses import replace

import pytest
import torch

from forewarp.fields.grids import Activation, RadianceGrid, shaded
from forewarp.methods.voxel.effects import SphericalHarmonics
from forewarp.ops import backend
from forewarp.ops.grid import index_of
from forewarp.ops.march import trace
from forewarp.renderer import Quadrature, Renderer
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


@pytest.mark.slow
def test_gradcheck():
    field = cloud()
    values = field.values.clone().requires_grad_()
    view = rays([[0.4, 1.2, -2.0], [0.5, -1.0, 3.1]], [[0.1, 0.2, 1], [0.1, 1, 0.3]])

    def run(values):
        drawn = Renderer(color_threshold=0.0)(replace(field, values=values), view, WHITE)
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
@pytest.mark.parametrize("strength", [0.3, 3.0, 100.0])
def test_a_pass_without_gradient_first_leaves_out_what_hardly_counts(strength):
    grid, view = blocks((9, 14, 12), strength)
    behind, weight, shading = torch.rand(len(view), 3), torch.rand(len(view), 3), SphericalHarmonics()
    drawn = []
    for renderer in (Renderer(), Renderer(trace_first=True)):
        values = grid.values.clone().requires_grad_()
        seen = renderer(replace(grid, values=values), view, behind, shading)
        (seen.rgb * weight).sum().backward()
        drawn.append((seen, values.grad))
    (whole, expected), (some, found) = drawn
    torch.testing.assert_close(some.rgb, whole.rgb, atol=3e-3, rtol=0)
    assert (found - expected).norm() < 0.01 * expected.norm()
    assert some.samples < 0.7 * whole.samples or strength < 100
    assert len(some.weights) < whole.samples


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
    says = "renderer: expected step > 0 and 0 <= color_threshold < 1 and 0 <= early"
    with pytest.raises(ValueError, match=says):
        Renderer(**wrong)


RED, ONES = torch.tensor([1.0, 0.0, 0.0]), torch.ones(3)


def some_rays(count=4, near=1.0, far=5.0, seed=0):
    """Rays from about (-3, 0, 0) that look along x."""
    g = torch.Generator().manual_seed(seed)
    origins = torch.tensor([-3.0, 0, 0]) + 0.2 * torch.randn(count, 3, generator=g)
    directions = torch.tensor([1.0, 0, 0]) + 0.05 * torch.randn(count, 3, generator=g)
    return Rays(origins, torch.nn.functional.normalize(directions, dim=1), near, far)


def slab(strength, low=-0.5, high=0.5):
    """Red matter between two planes across x."""

    def density(points):
        return strength * ((points[..., 0] > low) & (points[..., 0] < high)).to(points)

    def radiance(points, directions):
        assert directions.shape == (len(points), 1, 3)
        return density(points), RED.expand(*points.shape[:2], 3)

    return density, radiance


def along_x(count=3):
    origin, direction = torch.tensor([[[-3.0, 0, 0]], [[1.0, 0, 0]]]).repeat(1, count, 1)
    return Rays(origin, direction, 1, 5)


@pytest.mark.parametrize("open_end", [True, False])
def test_a_slab_hand_worked(open_end):
    seen = Quadrature(400, 400, open_end)(*slab(2.0), along_x(), ONES)
    through = math.exp(-2)
    torch.testing.assert_close(seen.opacity, torch.full((3,), 1 - through), atol=5e-3, rtol=0)
    pink = torch.tensor([[1, through, through]]).repeat(3, 1)
    torch.testing.assert_close(seen.rgb, pink, atol=5e-3, rtol=0)
    # The mean of an exponential that is cut off after 1, from the slab's face at 2.5.
    mean = 2.5 + 0.5 - through / (1 - through)
    torch.testing.assert_close(seen.depth, torch.full((3,), mean), atol=0.01, rtol=0)
    assert seen.depths.shape == seen.weights.shape == seen.density.shape == (3, 800)


def test_more_samples_lie_where_matter_is():
    seen = Quadrature(32, 64)(*slab(20.0, -0.1, 0.1), along_x(1), ONES)
    inside = (seen.depths > 2.8) & (seen.depths < 3.3)
    assert int(inside.sum()) > 60


def test_one_pass_alone_asks_for_density_nowhere():
    def never(points):
        raise AssertionError

    assert Quadrature(8, 0)(never, slab(1.0)[1], along_x(), ONES).depths.shape == (3, 8)


def test_an_open_end_hides_the_background_of_a_density_that_is_never_0():
    def fog(points, directions=None):
        thin = torch.full(points.shape[:2], 1e-6)
        return thin if directions is None else (thin, RED.expand(*points.shape[:2], 3))

    torch.testing.assert_close(Quadrature(8, 8)(fog, fog, along_x(1), ONES).rgb[0], RED)
    closed = Quadrature(8, 8, open_end=False)(fog, fog, along_x(1), ONES)
    torch.testing.assert_close(closed.rgb[0], ONES, atol=1e-4, rtol=0)


def test_opacity_and_depth_leave_out_a_sample_without_end():
    def fog(points, directions):
        return torch.full(points.shape[:2], 0.1), RED.expand(*points.shape[:2], 3)

    seen, closed = (Quadrature(200, 0, open_end)(None, fog, along_x(1), ONES) for open_end in (True, False))
    assert float(seen.weights.sum()) == pytest.approx(1)
    assert float(seen.opacity) == pytest.approx(1 - math.exp(-0.4), abs=2e-3)
    torch.testing.assert_close(seen.depth, closed.depth, atol=0.02, rtol=0)


def test_the_first_pass_has_no_gradient_and_the_second_has():
    strength = torch.tensor(2.0, requires_grad=True)
    density, radiance = slab(strength)
    asked = []

    def noted(points):
        asked.append(torch.is_grad_enabled())
        return density(points)

    seen = Quadrature(8, 8)(noted, radiance, along_x(), ONES)
    assert asked == [False]
    assert not seen.depths.requires_grad
    seen.opacity.sum().backward()
    assert strength.grad > 0


def test_outside_the_box_nothing_is_asked():
    box = Box((-1, -1, -1), (1, 1, 1))

    def everywhere(points, directions=None):
        assert (points.abs() <= 1 + 1e-5).all()
        dense = torch.full(points.shape[:2], 9.0)
        return dense if directions is None else (dense, RED.expand(*points.shape[:2], 3))

    some = along_x(3)
    some.directions[1] = torch.tensor([0.0, 0, 1])  # misses
    behind = torch.rand(3, 3)
    seen = Quadrature(16, 16, box=box)(everywhere, everywhere, some, behind)
    torch.testing.assert_close(seen.rgb[1], behind[1])
    assert seen.opacity[1] == seen.depth[1] == 0
    torch.testing.assert_close(seen.rgb[[0, 2]], RED.expand(2, 3), atol=1e-4, rtol=0)
    assert len(seen.depths) == 2


def test_samples_lie_between_the_first_and_the_last_kept_point():
    box, asked = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), []

    def kept(points):
        return (points[..., 0] > -0.3) & (points[..., 0] < 0.2) & (points[..., 1] > -0.5)

    def radiance(points, directions):
        asked.append(points)
        return 2.0 * torch.ones(len(points)), RED.expand(len(points), 3)

    three = along_x()
    three.origins[1:, 1] = torch.tensor([-0.6, 1.5])  # past all that is kept, and past the box
    seen = Quadrature(50, 0, False, box, kept)(None, radiance, three, ONES)
    step = 2 / 63  # the probes begin at the box's face
    assert seen.depths.shape == (1, 50)
    assert 2.7 - step <= float(seen.depths.min()) < float(seen.depths.max()) <= 3.2 + step
    assert len(asked[0]) > 44
    assert kept(asked[0]).all()
    expected = torch.tensor([1 - math.exp(-2 * 0.5), 0.0, 0.0])
    torch.testing.assert_close(seen.opacity, expected, atol=0.02, rtol=0)


def test_all_rays_may_miss():
    weight = torch.ones((), requires_grad=True)
    box = Box((-1, 7, -1), (1, 8, 1))
    seen = Quadrature(4, 4, box=box)(*slab(weight), along_x(), ONES, torch.Generator())
    assert (seen.rgb == 1).all()
    seen.rgb.sum().backward()
    assert weight.grad == 0


def test_pictures_in_pieces_and_permuted(monkeypatch):
    quadrature, some = Quadrature(12, 12), some_rays(9)
    behind = torch.rand(9, 3)
    whole = quadrature(*slab(2.0), some, behind)
    monkeypatch.setattr("forewarp.renderer._POINTS", 48)
    pieces = quadrature.image(*slab(2.0), some, behind)
    order = torch.randperm(9)
    turned = quadrature(*slab(2.0), some[order], behind[order])
    for name in ("rgb", "depth", "opacity"):
        torch.testing.assert_close(getattr(pieces, name), getattr(whole, name))
        torch.testing.assert_close(getattr(turned, name), getattr(whole, name)[order])


def test_a_generator_jitters_and_nothing_else_does():
    quadrature, some = Quadrature(12, 12), some_rays()
    still = [quadrature(*slab(2.0), some, ONES).depths for _ in range(2)]
    drawn = [quadrature(*slab(2.0), some, ONES, torch.Generator().manual_seed(s)).depths for s in (0, 0, 1)]
    assert torch.equal(*still)
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[1], drawn[2])
    assert (drawn[0].diff(dim=1) >= 0).all()


@pytest.mark.parametrize("wrong", [(2, 8), (8, -1)])
def test_quadrature_refuses(wrong):
    with pytest.raises(ValueError, match="model.sampling: expected samples >= 3 and fine_samples >= 0"):
        Quadrature(*wrong)
