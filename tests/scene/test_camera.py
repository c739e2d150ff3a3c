"""What a camera projects it sees along the same ray, also behind a lens and with skew."""

from dataclasses import replace

import pytest
import torch

from forewarp.scene.camera import Camera, Lens, look_at
from tests.support import reference

PHONE = Lens((0.105, -0.088, 0.01), (-0.0537, 0.0037))
EYE = torch.eye(4, dtype=torch.float64)


def camera(center=(3.0, 1.0, 2.0), **changes):
    pose = look_at(torch.tensor(center), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return replace(Camera(64, 48, 55.0, 57.0, 30.5, 25.0, pose, 1.0, 9.0), **changes)


def test_rays_by_hand():
    rays = Camera(2, 2, 1.0, 2.0, 1.0, 1.0, EYE, 1.0, 2.0).rays()
    # Pixel centres at +0.5; x right, y down, z forward.
    expected = torch.tensor([[-0.5, -0.25, 1], [0.5, -0.25, 1], [-0.5, 0.25, 1], [0.5, 0.25, 1]])
    torch.testing.assert_close(rays.directions / rays.directions[:, 2:], expected)
    assert (rays.origins == 0).all()


@pytest.mark.parametrize("center", [(3.0, 1.0, 2.0), (0.0, 0.0, 4.0), (0.0, 0.0, -4.0)])
def test_look_at_is_a_rotation_that_sees_the_target_in_the_middle(center):
    view = camera(center)
    rotation = view.camera_to_world[:3, :3]
    torch.testing.assert_close(rotation.T @ rotation, EYE[:3, :3])
    assert torch.linalg.det(rotation).item() == pytest.approx(1)
    pixel, depth = view.project(torch.zeros(3, dtype=torch.float64))
    assert pixel.tolist() == pytest.approx([30.5, 25])
    assert depth.item() == pytest.approx(torch.tensor(center).norm().item())
    raised, _ = view.project(torch.tensor([0.0, 0.0, 0.5]))
    assert raised[1] <= 25 + 1e-4  # up is up


@pytest.mark.parametrize("skew", [0.0, 3.0])
@pytest.mark.parametrize("lens", [None, Lens(), PHONE, Lens((-0.25, 0.05, 0.0))])
def test_rays_project_back_to_their_pixels(lens, skew):
    view = camera(lens=lens, skew=skew)
    rays = view.rays(dtype=torch.float64)
    pixel, z = view.project(rays.origins + 2.5 * rays.directions)
    number = torch.arange(64 * 48)
    assert (pixel - torch.stack([number % 64, number // 64], -1) - 0.5).abs().max() < 1e-8
    assert ((z > 0) & (z <= 2.5)).all()
    assert (rays.directions.norm(dim=-1) - 1).abs().max() < 1e-12


def test_projection_by_hand():
    lens = Lens((0.1, 0.0, 0.0), (0.02, 0.0))
    view = camera(skew=2.0, lens=lens, camera_to_world=EYE)
    # The plane's point (0.5, 1): r^2 = 1.25, s = 1.125.
    x, y = 0.5 * 1.125 + 2 * 0.02 * 0.5, 1.125 + 0.02 * (1.25 + 2)
    assert (x, y) == pytest.approx(reference.bend(0.5, 1.0, lens.k, lens.p))
    pixel, z = view.project(torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64))
    assert pixel.tolist() == pytest.approx([55 * x + 2 * y + 30.5, 57 * y + 25])
    assert z.item() == 2


def test_resizing_keeps_the_view():
    small = camera(lens=PHONE, skew=3.0)
    point = torch.tensor([[0.3, -0.2, 0.1], [0.0, 0.4, 0.5]], dtype=torch.float64)
    doubled = small.project(point)[0] * torch.tensor([2.0, 3.0])
    torch.testing.assert_close(small.resized(128, 144).project(point)[0], doubled)


def test_beyond_the_fold_of_a_lens_nothing_is_seen():
    # r (1 + 0.3 r^2 - 0.1 r^4) is greatest, 1.780, at r = 1.605.
    lens, away = Lens((0.3, -0.1, 0.0)), torch.linspace(0, 8, 401, dtype=torch.float64)
    points = torch.stack([0.6 * away, 0.8 * away], -1).requires_grad_()
    bent, before = lens.bend(points), away < 1.605
    expected = away * (1 + 0.3 * away**2 - 0.1 * away**4)
    torch.testing.assert_close(bent.norm(dim=-1)[before], expected[before])
    assert bent.isfinite().all()
    assert (bent[~before].norm(dim=-1) > 1e6).all()
    assert (lens.straighten(bent[before]) - points[before]).abs().max() < 1e-8
    bent.sum().backward()
    assert points.grad.isfinite().all()
    # The polynomial x (1 - 0.25 x^2) is 0 again at x = 2, that is 63 degrees off the axis.
    barrel = camera(lens=Lens((-0.25, 0.0, 0.0)), camera_to_world=EYE)
    assert barrel.project(torch.tensor([2.0, 0.0, 1.0]).double())[0][0] > 64


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_beside_and_behind_are_finite(dtype):
    view = camera(lens=PHONE, skew=1.0)
    side = view.camera_to_world[:3, 0]
    points = torch.stack([view.center, view.center + side, view.center + 0.5 * view.center]).to(dtype)
    pixel, z = view.project(points)
    assert (bool(pixel.isfinite().all()), pixel.dtype, bool(z[2] < 0)) == (True, dtype, True)


@pytest.mark.parametrize(
    ("k", "p"), [((0.1, 0.2), (0, 0)), ((0, 0, float("nan")), (0, 0)), ((0, 0, 0), (1,))]
)
def test_a_lens_of_other_numbers_is_refused(k, p):
    with pytest.raises(ValueError, match="lens.[kp]: expected [32] finite numbers, but got"):
        Lens(k, p)
