"""Metrics and losses where they could divide by nothing (cases 14 and 23 to 26)."""

import pytest
import torch

from forewarp import losses
from forewarp.drawing.images import depth_colors
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.paths import RandomPatches, focus_point, mean_up, orbit
from tests.support.hard_cases import check_finite

pytestmark = pytest.mark.stability

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
    torch.testing.assert_close(
        depth_colors(factor * depth, opacity), depth_colors(depth, opacity), atol=2e-2, rtol=0
    )
    assert depth_colors(torch.full((3, 4), factor), opacity).isfinite().all()
    assert depth_colors(torch.zeros(3, 4), opacity).isfinite().all()
