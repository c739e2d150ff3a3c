import builtins
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from forewarp.synth import raycast
from forewarp.synth.raycast import Posed, camera_rays, render, render_all, surface_points
from forewarp.synth.scenes import orbit_camera, random_cameras
from forewarp.synth.vehicle import GROUND, MOTIONS
from forewarp.synth.world import LIGHT_AT, World

CAMERAS = random_cameras(9, 12, np.random.default_rng(0))


@pytest.fixture(scope="module")
def world():
    return World("lift_tilt")


@pytest.fixture(scope="module")
def shot(world):
    camera = orbit_camera(-0.9, 0.5, 40)
    return camera, *render(world, 0.4, camera, 4)


def test_the_background_is_nothing(shot):
    _, rgba, depth = shot
    empty = rgba[..., 3] == 0
    assert (rgba.dtype, depth.dtype) == (np.uint8, np.float32)
    assert empty[0].all()
    assert (rgba[empty] == 0).all()
    assert (depth[empty] == 0).all()
    assert (depth[rgba[..., 3] == 255] > 0).mean() > 0.99  # the centre misses only through a gap
    assert set(np.unique(rgba[..., 3])) == {0, 64, 128, 191, 255}


def test_a_hit_lies_on_its_ray_and_its_face(world, shot):
    camera, _, depth = shot
    posed = Posed(world, 0.4)
    origins, directions = camera_rays(camera)
    np.testing.assert_allclose(origins, camera.rays().origins.numpy(), atol=1e-6)
    np.testing.assert_allclose(directions, camera.rays().directions.numpy(), atol=1e-6)
    hits = posed.first_hits(origins, directions)
    on_face = np.einsum("nc,ncd->nd", hits.barycentric, posed.corners[hits.face])
    on_ray = origins[hits.ray] + hits.distance[:, None] * directions[hits.ray]
    assert np.linalg.norm(on_face - on_ray, axis=-1).max() < 1e-4
    np.testing.assert_allclose(depth.ravel()[hits.ray], hits.distance, rtol=1e-6)


def test_a_shadow_falls_behind_the_ball(world):
    """From the ground beside the ball, on the far side from the light, the ball hides the light."""
    ball = MOTIONS["lift_tilt"](0.0)["ball"][:3, 3]
    behind = ball + (ball - LIGHT_AT) * (ball[2] - GROUND - 1e-3) / (LIGHT_AT - ball)[2]
    ground = np.array([behind, [0.7, 0.7, GROUND + 1e-3]])
    assert Posed(world, 0.0).is_free(ground, LIGHT_AT - ground).tolist() == [False, True]


def test_without_the_packages_one_line_says_what_to_install(world, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("trimesh"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"install forewarp\[synth\]"):
        Posed(world, 0.0)


@pytest.mark.parametrize("motion", MOTIONS)
def test_points_are_on_the_outside_and_spread_by_area(motion):
    world = World(motion)
    cameras = random_cameras(12, 8, np.random.default_rng(1))
    faces, barycentric = surface_points(world, 1500, cameras, np.random.default_rng(2))
    points = world.trajectories(faces, barycentric, np.array([0, 1.0])).points.double().numpy()
    assert points.shape == (1500, 2, 3)
    names = [world.parts[i].name for i in world.part_of_face[faces]]
    assert {"boom", "stick", "bucket", "cabin", "ball", "ground"} <= set(names)
    ground = points[[n == "ground" for n in names], 0]
    quarters = np.unique(ground[:, 0] > 0, return_counts=True)[1]
    assert quarters.min() / quarters.max() > 0.6
    assert ground[:, 2].min() > -0.57 + 1e-6  # nothing from below the slab
    way = np.linalg.norm(points[:, 1] - points[:, 0], axis=-1)
    assert 0.15 < way[way > 0].mean() < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["threads", pytest.param("processes", marks=pytest.mark.slow)])
def test_the_number_of_processes_does_not_matter(monkeypatch, world, kind):
    """And an error in a process is the caller's. Threads take the processes' place, which start slowly."""
    if kind == "threads":
        monkeypatch.setattr(raycast, "ProcessPoolExecutor", lambda workers, *_: ThreadPoolExecutor(workers))
    views, seen = [(world, i / 8, camera) for i, camera in enumerate(CAMERAS)], {1: [], 2: []}
    alone, together = (list(render_all(views, 2, n, lambda *c, n=n: seen[n].append(c), 3)) for n in (1, 2))
    assert seen[1] == seen[2] == [(i, 9) for i in range(1, 10)]
    assert len(alone) == len(together) == len({rgba.tobytes() for rgba, _ in alone}) == 9
    for (rgba, depth), (same_rgba, same_depth) in zip(alone, together):
        np.testing.assert_array_equal(rgba, same_rgba)
        np.testing.assert_array_equal(depth, same_depth)
    with pytest.raises(TypeError):
        list(render_all([(world, "noon", CAMERAS[0])], workers=2))


@pytest.mark.parametrize(("samples", "expected"), [(1, []), (6, []), (9, [2]), (100, [3])])
def test_processes_are_for_much_work_and_never_more_than_processors(monkeypatch, world, samples, expected):
    begun = []
    pool = lambda workers, *_: begun.append(workers) or ThreadPoolExecutor(workers)  # noqa: E731
    monkeypatch.setattr(raycast, "ProcessPoolExecutor", pool)
    monkeypatch.setattr(raycast, "cores", lambda: 3)
    monkeypatch.setattr(raycast, "SAMPLES_A_PROCESS", 4 * 144)
    monkeypatch.setattr(raycast, "render", lambda *view: view[3])
    assert list(render_all([(world, 0.0, CAMERAS[0])], samples)) == [samples]
    assert begun == expected
