from dataclasses import replace

import pytest
import torch

from forewarp.methods.method import Start
from forewarp.methods.particles.start import (
    _in_holes,
    anywhere,
    covered_pixels,
    first_points,
    first_values,
    hull_surface,
    seen_colors,
    swept,
    widths,
)
from forewarp.scene.cloud import Cloud, Handover
from tests.contract.scenes import DATASETS, RADIUS, ball_center, data_of


@pytest.fixture(scope="module")
def scene_of(tmp_path_factory):
    """``scene_of(dataset)``: a ball that slides along x."""
    root, known = tmp_path_factory.mktemp("scenes"), {}

    def read(dataset):
        if dataset not in known:
            DATASETS[dataset][0](root / dataset)
            known[dataset] = data_of(dataset, root).scene
        return known[dataset]

    return read


def test_the_hull_is_around_the_ball(scene_of):
    scene = scene_of("nhr")  # several cameras a time
    cloud = hull_surface(scene, [i for i, f in enumerate(scene.train) if f.time == 0.0], 400)
    away = (cloud.points - ball_center(0.0)).norm(dim=-1)
    assert len(cloud) == 400
    assert 0.8 * RADIUS < float(away.median()) < 1.5 * RADIUS
    assert bool(((cloud.colors >= 0) & (cloud.colors <= 1)).all())
    assert cloud.size > 0


def test_points_are_where_neighbouring_views_agree(scene_of):
    scene = scene_of("hypernerf")
    cloud = swept(scene, [], 400)
    low, high = torch.tensor(scene.box.low), torch.tensor(scene.box.high)
    assert len(cloud) > 16
    assert bool(((cloud.points >= low) & (cloud.points <= high)).all())
    assert bool(cloud.points.isfinite().all())


def test_of_several_cameras_those_of_the_same_time_are_a_sweeps_neighbours(scene_of):
    scene = scene_of("hypernerf")

    def unread():
        raise AssertionError("a picture of another time was read")

    around = [scene.train[i % len(scene.train)] for i in range(10)]
    now = [replace(frame, time=0.5, camera_id=i) for i, frame in enumerate(around)]
    other = [replace(frame, time=t, camera_id=0, load=unread) for frame in around for t in (0.4, 0.6)]
    several = replace(scene, train=(*other, *now))
    cloud = swept(several, list(range(len(other), len(several.train))), 400)
    assert len(cloud) > 16
    with pytest.raises(AssertionError, match="another time"):
        swept(replace(scene, train=(*other, *now[:8])), list(range(len(other), len(other) + 8)), 400)


def test_a_picture_of_a_sweep_fills_only_its_holes(scene_of):
    camera = scene_of("hypernerf").train[0].camera  # 20 x 16 pixels; cells of 4 x 4
    rays = camera.rays()
    column = torch.arange(320) % 20
    there = (rays.origins + 3.0 * rays.directions)[column < 12]
    for depth in (1.0, 5.0):  # before what is there, and behind it
        fresh = _in_holes(there, rays.origins + depth * rays.directions, camera, 5)
        assert torch.equal(fresh, column >= 12)
    assert bool(_in_holes(torch.zeros(0, 3), there, camera, 5).all())


def test_known_points_have_the_colour_that_pictures_show(scene_of):
    scene = scene_of("hypernerf")
    known = swept(scene, [], 400).points[:50]
    cloud = swept(replace(scene, still=known), [], 400)
    cameras, pictures = [f.camera for f in scene.train], [f.load() for f in scene.train]
    assert torch.equal(cloud.points[:50], known)
    torch.testing.assert_close(cloud.colors[:50], seen_colors(known, cameras, pictures))
    assert float((cloud.colors[:50] - 0.5).abs().max()) > 0.05


def test_what_a_stage_left_comes_first(scene_of):
    left = Cloud(torch.rand(100, 3), torch.rand(100, 3), torch.ones(100), 0.1)
    handover = Handover(scene_of("dnerf").box, True, 6, left)
    cloud = first_points(Start(scene_of("dnerf"), "fine", {}, [0, 1], handover), 1000)
    assert torch.equal(cloud.points, left.points)
    assert len(first_points(Start(scene_of("dnerf"), "fine", {}, [0, 1], handover), 30)) == 30


def test_random_points_lie_in_the_box(scene_of):
    box = scene_of("dnerf").box
    points = anywhere(box, 50).points
    assert bool(((points >= torch.tensor(box.low)) & (points <= torch.tensor(box.high))).all())


def test_pixels_that_show_anything_are_counted(scene_of):
    scene = scene_of("dnerf")
    shown = [int((frame.load()[..., 3] > 127).sum()) for frame in scene.train[:2]]
    assert covered_pixels(scene, [0, 1]) == pytest.approx(sum(shown) / 2)
    assert covered_pixels(scene_of("hypernerf"), [0]) == 20 * 16


def test_first_values_are_round_and_as_large_as_points_are_apart():
    axis = torch.arange(4.0)
    points = torch.cartesian_prod(axis, axis, axis)
    first = first_values(Cloud(points, torch.full_like(points, 0.75), torch.ones(64), 1.0))
    torch.testing.assert_close(first["log_scales"], torch.zeros(64, 3), atol=1e-3, rtol=0)
    torch.testing.assert_close(0.5 + 0.28209479 * first["color"], torch.full((64, 1, 3), 0.75))


def test_particles_begin_no_larger_than_they_are_apart_in_a_picture(scene_of):
    scene = scene_of("hypernerf")
    camera = scene.train[0].camera
    ahead = camera.center.float() - 2.0 * camera.camera_to_world[:3, 2].float()
    points = ahead + 0.1 * torch.rand(50, 3)
    away = torch.stack([(points - f.camera.center.float()).norm(dim=-1) for f in scene.train]).amin(0)
    widest = widths(scene, points, 200.0)
    torch.testing.assert_close(widest, away / camera.fx * 2.0)  # 200 pixels for 50 points: 2 pixels apart
    cloud = Cloud(points * 100, torch.rand(50, 3), torch.ones(50), 1.0)
    first = first_values(cloud, widest)
    torch.testing.assert_close(first["log_scales"].exp(), widest[:, None].expand(-1, 3))
    near = first_values(Cloud(points * 1e-3, cloud.colors, cloud.opacity, 1.0), widest)
    assert bool((near["log_scales"].exp() < widest[:, None]).all())


def test_points_that_coincide_and_a_single_one_are_finite():
    for points in (torch.zeros(9, 3), torch.zeros(1, 3)):
        first = first_values(Cloud(points, torch.zeros_like(points), torch.ones(len(points)), 0.3))
        assert bool(first["log_scales"].isfinite().all())
