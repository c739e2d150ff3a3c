"""What a camera projects it sees along the same ray, also behind a lens and with skew."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from forewarp.scene.camera import Camera, Lens, RandomPatches, focus_point, look_at, mean_up, orbit, swing
from tests.support import reference
from tests.support.tiny_scene import camera_at

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


@pytest.mark.parametrize("form", [np.array, list, torch.tensor], ids=["array", "list", "tensor of integers"])
def test_arrays_and_lists_are_taken(form):
    view, points = camera(lens=PHONE), [[0, 0, 0], [0, 1, 1]]
    for got, expected in zip(view.project(form(points)), view.project(torch.tensor(points).double())):
        assert got.dtype == torch.float64
        torch.testing.assert_close(got, expected)
    u, v = [3, 9], [4, 7]
    expected = view.directions(torch.tensor(u).double(), torch.tensor(v).double())
    torch.testing.assert_close(view.directions(form(u), form(v)), expected)
    assert torch.equal(view.rays(form(u)).directions, view.rays(torch.tensor(u)).directions)


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


Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def at(center, target):
    pose = look_at(torch.tensor(center), torch.tensor(target), Z)
    return Camera(20, 10, 20.0, 20.0, 10.0, 5.0, pose, 1.0, 6.0)


def test_focus_is_what_all_look_at():
    cameras = [at(c, [0.3, -0.2, 0.5]) for c in ([3.0, 0.0, 1.0], [0.0, 4.0, 0.0], [-2.0, -1.0, 3.0])]
    assert focus_point(cameras).tolist() == pytest.approx([0.3, -0.2, 0.5], abs=1e-6)


@pytest.mark.parametrize("places", [(-1.0, 1.0), (0.0,)])
def test_where_axes_leave_the_focus_open_it_lies_midway_between_near_and_far(places):
    focus = focus_point([at([x, -4.0, 0.0], [x, 0.0, 0.0]) for x in places])
    torch.testing.assert_close(focus, torch.tensor([0.0, -0.5, 0.0]).double(), atol=1e-6, rtol=0)


def farthest(a, b):
    """The largest distance of an ``a`` from its nearest ``b``."""
    return (a[:, None] - b).norm(dim=-1).amin(1).max().item()


def turning():
    """A tripod: cameras of one place that look different ways."""
    return [at([1.0, 2.0, 0.5], target) for target in ([0.0, 0.0, 0.0], [1.0, 0.0, 2.0], [-1.0, 1.0, 0.0])]


@pytest.mark.parametrize("cameras", [turning()[:1], turning()], ids=["one", "tripod"])
def test_cameras_of_one_place_look_their_own_ways(cameras):
    rays = RandomPatches(cameras, patches=3, size=4).draw(torch.Generator().manual_seed(0))
    torch.testing.assert_close(rays.origins, cameras[0].center.float().expand(48, 3))
    assert farthest(rays.directions, torch.cat([c.rays().directions for c in cameras])) < 1e-5
    for view in orbit(cameras[0], focus_point(cameras), mean_up(cameras), torch.tensor([0.0, 0.3])):
        assert view.camera_to_world.isfinite().all()


@pytest.mark.parametrize("size", [2, 8])
def test_patches_reach_every_pixel_of_an_image_that_may_be_smaller_than_they(size):
    camera = replace(turning()[0], width=3, height=5)
    patches = RandomPatches([camera], patches=200, size=size)
    assert patches.size == min(size, 3)
    drawn = patches.draw(torch.Generator().manual_seed(0)).directions
    assert farthest(camera.rays().directions, drawn) < 1e-5
    assert farthest(drawn, camera.rays().directions) < 1e-5


def test_patches_are_neighbouring_rays_on_the_sphere_that_look_inwards():
    cameras = [at([3.0, 0.0, 0.5], [0.0] * 3), at([0.0, 3.0, 0.5], [0.0] * 3)]
    patches = RandomPatches(cameras, patches=5, size=4)
    rays, again, other = (patches.draw(torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
    assert torch.equal(rays.directions, again.directions)
    assert not torch.equal(rays.directions, other.directions)
    assert (rays.origins == rays.origins[0]).all()
    assert rays.origins[0].norm().item() == pytest.approx(9.25**0.5, rel=1e-5)
    blocks = rays.directions.reshape(5, 4, 4, 3)
    steps = (blocks[:, :, 1:] - blocks[:, :, :-1]).norm(dim=-1)
    assert 0 < float(steps.min()) <= float(steps.max()) < 1.5 / 20
    assert (rays.directions @ rays.origins[0] < 0).all()


def test_upward_directions_that_cancel_give_z():
    upright = at([3.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    hanging = replace(upright, camera_to_world=look_at(upright.center, torch.zeros(3), -Z))
    torch.testing.assert_close(mean_up([upright, hanging]), Z)


def test_orbit_circles_at_the_same_height_and_distance():
    start = camera_at(0.2)
    views = orbit(start, torch.zeros(3).double(), Z, torch.tensor([0.0, 0.25, 0.5, 1.0]))
    torch.testing.assert_close(views[3].center, start.center)
    for view in views:
        assert view.center[2].item() == pytest.approx(start.center[2].item())
        assert view.project(torch.zeros(3).double())[0].tolist() == pytest.approx([12, 12])
    torch.testing.assert_close(views[2].center[:2], -start.center[:2])


@pytest.mark.slow
def test_a_swing_goes_as_far_as_cameras_stand_to_both_sides_and_comes_back():
    focus = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)

    def around(degrees):
        angle = torch.deg2rad(torch.tensor(float(degrees)))
        return at([0.5 + 4 * angle.cos().item(), 4 * angle.sin().item(), 1.0], focus.tolist())

    cameras = [around(degrees) for degrees in range(-20, 61)]
    path = swing(around(10), cameras, focus, Z, torch.arange(400, dtype=torch.float64) / 400)
    places = torch.stack([camera.center.double() for camera in path]) - focus
    angles = torch.rad2deg(torch.atan2(places[:, 1], places[:, 0]))
    assert [angles[i].item() for i in (0, 200)] == pytest.approx([10, 10], abs=1e-3)
    assert [angles.min().item(), angles.max().item()] == pytest.approx([-16, 56], abs=0.01)  # of 95 %
    torch.testing.assert_close(places[:, 2], torch.ones(400).double())
