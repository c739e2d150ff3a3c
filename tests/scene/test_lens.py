"""Cameras behind a lens and with skew: what is projected is seen along the same ray."""

from dataclasses import replace

import pytest
import torch

from forewarp.scene.camera import Camera, Lens, look_at
from tests.support import reference

PHONE = Lens((0.105, -0.088, 0.01), (-0.0537, 0.0037))


def camera(**changes):
    pose = look_at(torch.tensor([3.0, 1.0, 2.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    plain = Camera(64, 48, 55.0, 57.0, 30.5, 25.0, pose, 1.0, 9.0)
    return replace(plain, **changes)


@pytest.mark.parametrize("skew", [0.0, 3.0])
@pytest.mark.parametrize("lens", [None, Lens(), PHONE, Lens((-0.25, 0.05, 0.0))])
def test_rays_project_back_to_their_pixels(lens, skew):
    view = camera(lens=lens, skew=skew)
    rays = view.rays(dtype=torch.float64)
    pixel, z = view.project(rays.origins + 2.5 * rays.directions)
    number = torch.arange(64 * 48)
    expected = torch.stack([number % 64, number // 64], -1) + 0.5
    assert (pixel - expected).abs().max() < 1e-8
    assert ((z > 0) & (z <= 2.5)).all()
    assert (rays.directions.norm(dim=-1) - 1).abs().max() < 1e-12


def test_projection_by_hand():
    lens = Lens((0.1, 0.0, 0.0), (0.02, 0.0))
    view = camera(skew=2.0, lens=lens, camera_to_world=torch.eye(4, dtype=torch.float64))
    # The plane's point (0.5, 1): r^2 = 1.25, s = 1.125.
    x, y = 0.5 * 1.125 + 2 * 0.02 * 0.5, 1.125 + 0.02 * (1.25 + 2)
    assert (x, y) == pytest.approx(reference.bend(0.5, 1.0, lens.k, lens.p))
    pixel, z = view.project(torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64))
    assert pixel.tolist() == pytest.approx([55 * x + 2 * y + 30.5, 57 * y + 25])
    assert z.item() == 2


def test_directions_take_any_shape_and_place_in_the_pixel():
    view = camera(lens=PHONE, skew=1.0)
    u = torch.tensor([[0.0, 10.25, 64.0]], dtype=torch.float64)
    v = torch.tensor([[48.0, 7.75, 0.0]], dtype=torch.float64)
    directions = view.directions(u, v)
    assert (directions.shape, directions.dtype) == ((1, 3, 3), torch.float64)
    torch.testing.assert_close(view.project(view.center + 3 * directions)[0], torch.stack([u, v], -1))


def test_resizing_keeps_the_view():
    small, large = (camera(lens=PHONE, skew=3.0), camera(lens=PHONE, skew=3.0).resized(128, 144))
    point = torch.tensor([[0.3, -0.2, 0.1], [0.0, 0.4, 0.5]], dtype=torch.float64)
    scale = torch.tensor([2.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(large.project(point)[0], small.project(point)[0] * scale)
    assert large.lens == small.lens


def test_what_lies_beyond_the_fold_does_not_come_back_into_the_picture():
    # The polynomial x (1 - 0.25 x^2) is 0 again at x = 2, that is 63 degrees off the axis.
    view = camera(lens=Lens((-0.25, 0.0, 0.0)), camera_to_world=torch.eye(4, dtype=torch.float64))
    pixel, z = view.project(torch.tensor([[2.0, 0.0, 1.0], [1.0, 0.0, 1.0]], dtype=torch.float64))
    assert (z > 0).all()
    assert pixel[0, 0] > 64
    assert pixel[1, 0].item() == pytest.approx(30.5 + 55 * 0.75)


def test_beyond_the_fold_of_a_cushion_nothing_is_seen():
    # r (1 + 0.3 r^2 - 0.1 r^4) is greatest, 1.780, at r = 1.605.
    lens = Lens((0.3, -0.1, 0.0))
    away = torch.linspace(0, 8, 401, dtype=torch.float64)
    points = torch.stack([0.6 * away, 0.8 * away], -1)
    bent = lens.bend(points)
    before = away < 1.605
    expected = away * (1 + 0.3 * away**2 - 0.1 * away**4)
    torch.testing.assert_close(bent.norm(dim=-1)[before], expected[before])
    assert bent.isfinite().all()
    assert (bent[~before].norm(dim=-1) > 1e6).all()
    assert (torch.nn.functional.cosine_similarity(bent[1:], points[1:]) > 0.999).all()
    assert (lens.straighten(bent[before]) - points[before]).abs().max() < 1e-8


def test_bending_has_finite_gradients_everywhere():
    points = torch.tensor([[0.0, 0.0], [0.5, 0.2], [3.0, 0.0], [1e7, -1e7]], requires_grad=True)
    Lens((0.3, -0.1, 0.0)).bend(points).sum().backward()
    assert points.grad.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_beside_and_behind_are_finite(dtype):
    view = camera(lens=PHONE, skew=1.0)
    side = view.camera_to_world[:3, 0]
    points = torch.stack([view.center, view.center + side, view.center + 0.5 * view.center]).to(dtype)
    pixel, z = view.project(points)
    assert pixel.isfinite().all()
    assert pixel.dtype == dtype
    assert z[2] < 0


BAD = [
    ((0.1, 0.2), (0.0, 0.0), r"lens.k: expected 3 finite numbers, but got \(0.1, 0.2\)"),
    ((0.1, 0.2, float("nan")), (0.0, 0.0), "lens.k: expected 3 finite"),
    ((0.0, 0.0, 0.0), (1.0,), r"lens.p: expected 2 finite numbers, but got \(1.0,\)"),
]


@pytest.mark.parametrize(("k", "p", "match"), BAD)
def test_a_lens_of_other_numbers_is_refused(k, p, match):
    with pytest.raises(ValueError, match=match):
        Lens(k, p)
