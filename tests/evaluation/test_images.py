import pytest
import torch

from forewarp.drawing.images import error_colors
from forewarp.evaluation.images import image_flow, images_of, sized, validation_psnr, within
from forewarp.scene.view import Target
from tests.support.tiny_scene import RADIUS, TRAVEL, ball_center, ball_data, ball_scene, camera_at, known_ball


@pytest.fixture(scope="module")
def module():
    return known_ball()


def test_flow_is_the_projected_displacement_of_the_canonical_surface(module):
    camera, time = camera_at(0.6, size=40), 0.7
    flow, opacity = image_flow(module, camera, time)
    assert flow.shape == (40, 40, 2)
    rays = camera.rays()
    offset = rays.origins - ball_center(0.0)
    along = (offset * rays.directions).sum(-1)
    inside = along**2 - (offset**2).sum(-1) + RADIUS**2
    surface = rays.origins + (-along - inside.clamp(min=0).sqrt())[:, None] * rays.directions
    moved = camera.project(surface + time * torch.tensor(TRAVEL))[0] - camera.project(surface)[0]
    well = (inside > 0.08).reshape(40, 40)  # away from the silhouette
    assert int(well.sum()) > 40
    assert float(opacity[well].min()) > 0.95
    assert float(moved.norm(dim=-1)[well.flatten()].min()) > 2
    assert float((flow - moved.reshape(40, 40, 2)).norm(dim=-1)[well].max()) < 0.35
    block = (opacity > 0.95) & (inside < -0.1).reshape(40, 40)
    assert int(block.sum()) > 5
    assert float(flow.norm(dim=-1)[block].max()) < 0.05


def test_images_are_reduced_and_compare_with_the_truth(module):
    frame, truth = ball_scene(frames=2, size=32).train[0], torch.full((32, 32, 3), 0.25)
    images = images_of(module, Target(frame, truth, torch.ones(3)), size=16)
    shapes = {"compare": (16, 3 * 16 + 8, 3), "depth": (16, 16, 3), "flow": (16, 16, 3)}
    assert {name: tuple(image.shape) for name, image in images.items()} == shapes
    assert all(0 <= float(i.min()) <= float(i.max()) <= 1 and float(i.std()) > 0 for i in images.values())
    left, middle, right = (images["compare"][:, i : i + 16] for i in (0, 20, 40))
    torch.testing.assert_close(left, truth[:16, :16])
    torch.testing.assert_close(right, error_colors(left, middle))


def test_the_validation_psnr_is_a_mean_over_images_that_draws_nothing_global(module):
    targets = ball_data(frames=2, size=32).targets("test")
    whole = validation_psnr(module, targets, rays=32 * 32)
    assert whole == pytest.approx(sum(float(module.psnr_of(t)) for t in targets) / 3, abs=1e-4)
    before = torch.get_rng_state()
    some = validation_psnr(module, targets, rays=400)
    assert torch.equal(torch.get_rng_state(), before)
    assert some == validation_psnr(module, targets, rays=400)
    assert 0 < abs(some - whole) < 2


def test_sizes_follow_the_longer_side():
    camera = camera_at(0.0, size=40).resized(80, 40)
    cameras = within(camera, 60), within(camera, 90), within(camera, None), sized(camera, 160)
    assert [(c.width, c.height) for c in cameras] == [(60, 30), (80, 40), (80, 40), (160, 80)]
