import builtins

import numpy as np
import pytest

from forewarp.synth.raycast import LIGHT_AT, Posed, camera_rays, render
from forewarp.synth.scenes import orbit_camera
from forewarp.synth.vehicle import GROUND, joints
from forewarp.synth.world import World


@pytest.fixture(scope="module")
def world():
    return World("lift_tilt")


@pytest.fixture(scope="module")
def shot(world):
    camera = orbit_camera(-0.9, 0.5, 60)
    return camera, *render(world, 0.4, camera, 4)


def test_the_background_is_nothing(shot):
    _, rgba, depth = shot
    empty = rgba[..., 3] == 0
    assert rgba.dtype == np.uint8
    assert depth.dtype == np.float32
    assert empty[0].all()
    assert (rgba[empty] == 0).all()
    assert (depth[empty] == 0).all()
    assert 0.2 < empty.mean() < 0.8
    assert (depth[rgba[..., 3] == 255] > 0).mean() > 0.99  # the centre misses only through a gap
    assert set(np.unique(rgba[..., 3])) == {0, 64, 128, 191, 255}


def test_depth_is_where_the_ray_meets_the_ground(world):
    """A ray from straight above the free corner of the slab, against the plane's equation."""
    start = np.array([[0.1, 0.7, 3.0], [0.12, 0.7, 3.0]])
    slant = np.array([[0, 0, -1.0], [0.1, 0.0, -1.0]])
    slant /= np.linalg.norm(slant, axis=-1, keepdims=True)
    hits = Posed(world, 0.0).first_hits(start, slant)
    np.testing.assert_allclose(hits.distance, (GROUND - 3.0) / slant[:, 2], rtol=1e-12)
    assert all(world.parts[world.part_of_face[f]].name == "ground" for f in hits.face)


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
    ball = joints("lift_tilt", 0.0)["ball"][:3, 3]
    behind = ball + (ball - LIGHT_AT) * (ball[2] - GROUND - 1e-3) / (LIGHT_AT - ball)[2]
    ground = np.array([behind, [0.7, 0.7, GROUND + 1e-3]])
    towards = LIGHT_AT - ground
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    assert Posed(world, 0.0).is_free(ground, towards).tolist() == [False, True]


def test_without_the_packages_one_line_says_what_to_install(world, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("trimesh"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"install forewarp\[synth\]"):
        Posed(world, 0.0)
