"""Extreme rays, densities and cameras (cases 5 to 9, 12 to 14 and 23 to 26)."""

import math

import pytest
import torch

from forewarp import losses
from forewarp.drawing.images import depth_colors
from forewarp.fields.grids import Activation
from forewarp.ops.march import render_weights
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Camera, RandomPatches, focus_point, look_at, mean_up, orbit
from tests.support.hard_cases import LATTICE, check_finite, grid, index_with, raw_of, rays

pytestmark = pytest.mark.stability

# Through the middle, along each axis, grazing a face and an edge, from inside, missing, away from the box.
AXES = torch.eye(3).tolist()
ORIGINS = [[-3.0, 0.5, 1.0], [0.0, -4.0, 1.0], [0.0, 0.5, -5.0], [-3.0, -1.0, 1.0], [-3.0, 2.0, 3.0]]
ORIGINS += [[0.1, 0.2, 0.3], [-3.0, 5.0, 1.0], [3.0, 0.5, 1.0]]
DIRECTIONS = [[1.0, 0.01, -0.02], AXES[1], AXES[2], AXES[0], AXES[0], [0.3, 1.0, 0.5], AXES[0], AXES[0]]
MISSES = [6, 7]
WHITE = torch.ones(3)


def draw(field, view, background=WHITE, **changes):
    return Renderer(**changes)(field, view, background.to(view.origins.device))


def all_rays(device):
    return rays(ORIGINS, DIRECTIONS, device=device)


@pytest.mark.parametrize("sigma", [0.0, 1e-12, 1e-6, 1.0, 1e4, 1e30])
def test_densities_from_nothing_to_the_end_of_float32(place, sigma):
    field = grid(max(raw_of(sigma), -1e30), device=place)
    drawn = draw(field, all_rays(place))
    gradients = check_finite((drawn.rgb, drawn.depth, drawn.opacity), field.values)
    assert ((drawn.opacity >= 0) & (drawn.opacity <= 1)).all()
    expected = -math.expm1(-sigma * 4)  # the second and third ray cross 3 and 4 units, in steps
    assert float(drawn.opacity[2].detach()) == pytest.approx(expected, rel=0.15, abs=1e-30)
    assert sigma in (0.0, 1e30) or gradients[0].abs().sum() > 0 or sigma == 1e4


@pytest.mark.parametrize("raw", [-1e30, -1e4, -100.0, 0.0, 100.0, 1e4, 1e30])
def test_raw_density_has_a_finite_opacity_and_slope(device, raw):
    values = torch.full((3,), raw, device=device, requires_grad=True)
    alpha = Activation(-4.6, 1.0).alpha(values, 1.0)
    check_finite(alpha, values)
    assert ((alpha >= 0) & (alpha <= 1)).all()


@pytest.mark.parametrize("x", [1e-30, 1e-12, 5e-7, 1e-3])
def test_thin_matter_keeps_its_digits(device, x):
    optical = torch.full((4,), x, device=device, requires_grad=True)
    weights, transmittance = render_weights(optical, torch.zeros(4, dtype=torch.int64, device=device), 1)
    check_finite((weights, transmittance), optical)
    exact = [-math.expm1(-x) * math.exp(-k * x) for k in range(4)]
    torch.testing.assert_close(weights.cpu(), torch.tensor(exact), rtol=1e-6, atol=0)


def test_opacity_zero_and_one_exactly(device):
    optical = torch.tensor([0.0, 0.0, math.inf, 1.0, 0.0], device=device, requires_grad=True)
    ids = torch.tensor([0, 0, 1, 1, 2], device=device)
    weights, transmittance = render_weights(optical, ids, 3)
    assert weights.tolist() == [0, 0, 1, pytest.approx(0, abs=1e-30), 0]
    assert [round(t, 30) for t in transmittance.tolist()] == [1, 0, 1]
    (slope,) = torch.autograd.grad(weights.sum(), optical)
    # At opacity 0 a weight has slope 1; at opacity 1 nothing is divided by zero.
    assert slope.tolist() == [1, 1, 0, pytest.approx(0, abs=1e-30), 1]


def test_rays_that_miss_graze_start_inside_and_run_along_an_axis(place):
    field = grid(2.0, device=place)
    drawn = draw(field, all_rays(place))
    check_finite((drawn.rgb, drawn.depth), field.values)
    assert drawn.opacity[MISSES].tolist() == [0, 0]
    assert drawn.depth[MISSES].tolist() == [0, 0]
    assert drawn.rgb[MISSES].tolist() == [[1, 1, 1]] * 2
    met = [i for i in range(len(ORIGINS)) if i not in MISSES]
    assert (drawn.opacity[met] > 0).all()
    assert float(drawn.depth[5].detach()) > 0  # from inside: matter begins at the camera


@pytest.mark.parametrize("occupancy", ["empty", "full", "one voxel"])
def test_occupancies(place, occupancy):
    present = torch.full(LATTICE.shape, occupancy == "full")
    if occupancy == "one voxel":
        present[1, 1, 2] = True
    field = grid(8.0, index=index_with(present), device=place)
    drawn = draw(field, all_rays(place))
    check_finite((drawn.rgb + 0 * field.values.sum(), drawn.depth), field.values)
    assert bool((drawn.opacity > 0.1).any()) == (occupancy != "empty")
    assert (drawn.samples == 0) == (occupancy == "empty")


@pytest.mark.parametrize("raw", [-16.0, -14.0, -11.0])
def test_depth_in_the_thinnest_fog_stays_on_the_ray(place, raw):
    """At an opacity of 1e-6, 1 - transmittance has no digits left; the sum of weights keeps them."""
    field = grid(raw, device=place)
    drawn = draw(field, rays([[0.0, 0.5, -5.0]], [[0.0, 0.0, 1.0]], device=place), color_threshold=0.0)
    exact = -torch.expm1(-field.activation.sigma(torch.tensor(raw, dtype=torch.float64)) * 4)
    assert float(drawn.opacity.detach()) == pytest.approx(float(exact), rel=0.05)
    if float(exact) > 1e-6:  # below, depth fades to 0
        assert 4.0 <= float(drawn.depth.detach()) <= 8.0
    check_finite((drawn.depth, drawn.opacity), field.values)


def test_a_camera_inside_the_box_and_inside_matter(place):
    pose = look_at(torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.0, 0.5, 1.0]), UP)
    camera = Camera(6, 5, 5.0, 5.0, 3.0, 2.5, pose, 0.0, 9.0)
    field = grid(20.0, device=place)
    drawn = draw(field, camera.rays().to(place))
    check_finite((drawn.rgb, drawn.depth), field.values)
    assert float(drawn.opacity.detach().min()) > 0.99
    assert float(drawn.depth.detach().max()) < 1.0


def test_a_scene_of_nothing_has_a_loss_and_no_pull(place):
    field = grid(0.0, index=index_with(torch.zeros(LATTICE.shape, dtype=torch.bool)), device=place)
    drawn = draw(field, all_rays(place))
    truth = torch.ones(len(ORIGINS), 3, device=place)
    loss = losses.photometric(drawn.rgb, truth) + losses.background_entropy(drawn.transmittance)
    loss = loss + losses.point_color(drawn.weights, drawn.colors, drawn.ray_ids, truth)
    loss = loss + losses.sample_entropy(drawn.weights)
    assert loss.isfinite()
    assert float(losses.photometric(drawn.rgb, truth).detach()) == 0  # white on white


@pytest.mark.parametrize("thin", [1e-2, 1e-6, 1e-12])
def test_a_flat_box_is_rendered(place, thin):
    lattice = Lattice(Box((-1, -1, 0), (1, 1, thin)), (5, 5, 4))
    field = grid(5.0, lattice=lattice, density_scale=lattice.voxel_size, device=place)
    view = rays([[0.1, 0.2, -3.0], [-3.0, 0.1, thin / 2]], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], device=place)
    drawn = draw(field, view)
    check_finite((drawn.rgb, drawn.depth), field.values)
    assert float(drawn.opacity.detach().max()) > 0.1


UP = torch.tensor([0.0, 0.0, 1.0])


@pytest.mark.parametrize("opacity", [0.0, 1e-9, 1.0])
def test_the_depth_term_of_empty_and_solid_patches(device, opacity):
    depth = torch.rand(2, 4, 4, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_()
    check_finite(losses.tv_depth(depth, torch.full((2, 4, 4), opacity, device=device)), depth)


def camera(center, target):
    return Camera(8, 8, 9.0, 9.0, 4.0, 4.0, look_at(torch.tensor(center), torch.tensor(target), UP), 1.0, 5.0)


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("kind", ["parallel", "one", "opposite", "coinciding", "upwards"])
def test_random_views_of_degenerate_rigs(kind, factor):
    rigs = {
        "parallel": [((0.0, 0, 0), (1.0, 0, 0)), ((0.0, 1, 0), (1.0, 1, 0))],
        "one": [((3.0, 0, 0), (0.0, 0, 0))],
        "opposite": [((3.0, 0, 0), (0.0, 0, 0)), ((-3.0, 0, 0), (0.0, 0, 0))],
        "coinciding": [((3.0, 0, 0), (0.0, 0, 0)), ((3.0, 0, 0), (0.0, 0, 0))],
        "upwards": [((0.0, 0, -3), (0.0, 0, 0)), ((0.0, 0, 3), (0.0, 0, 0))],
    }
    scaled = [[tuple(factor * v for v in point) for point in pair] for pair in rigs[kind]]
    cameras = [camera(*pair) for pair in scaled]
    patches, generator = RandomPatches(cameras, patches=2, size=4), torch.Generator().manual_seed(0)
    for _ in range(5):
        rays = patches.draw(generator)
        assert rays.origins.isfinite().all()
        torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(len(rays)))
    for view in orbit(cameras[0], focus_point(cameras), mean_up(cameras), torch.linspace(0, 1, 5)):
        assert view.camera_to_world.isfinite().all()


@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e6])
def test_depth_is_painted_alike_in_any_unit(factor):
    depth, opacity = torch.linspace(2.0, 2.001, 12).reshape(3, 4), torch.ones(3, 4)
    painted, wanted = depth_colors(factor * depth, opacity), depth_colors(depth, opacity)
    torch.testing.assert_close(painted, wanted, atol=2e-2, rtol=0)
    assert depth_colors(torch.full((3, 4), factor), opacity).isfinite().all()
    assert depth_colors(torch.zeros(3, 4), opacity).isfinite().all()
