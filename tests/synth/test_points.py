import numpy as np
import pytest
import torch

pytest.importorskip("trimesh")
pytest.importorskip("embreex")

from forewarp.synth.cameras import orbit_camera, random_cameras
from forewarp.synth.motions import MOTIONS
from forewarp.synth.points import surface_points, trajectories
from forewarp.synth.raycast import render
from forewarp.synth.world import World

TIMES = np.linspace(0, 1, 41)


@pytest.fixture(scope="module", params=MOTIONS)
def sampled(request):
    world = World(request.param)
    centers = np.stack([np.asarray(c.center) for c in random_cameras(12, 8, np.random.default_rng(1))])
    faces, barycentric = surface_points(world, 1500, centers, np.random.default_rng(2))
    return world, faces, trajectories(world, faces, barycentric, TIMES).points.double().numpy()


@pytest.mark.parametrize("step", [0, 17, 40])
def test_points_meet_the_depth_map(sampled, step):
    """A point's distance is the depth at its pixel where nothing hides it, and never less than it."""
    world, _, points = sampled
    camera = orbit_camera(-0.8, 0.6, 240)
    depth = render(world, TIMES[step], camera, 1)[1]
    here = points[:, step]
    pixel, front = (np.asarray(v) for v in camera.project(torch.from_numpy(here)))
    distance = np.linalg.norm(here - np.asarray(camera.center), axis=-1)
    column, row = np.floor(pixel).astype(int).T
    around = np.stack([depth[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    around[around == 0] = np.inf
    assert (front > 0).all()
    # A pixel is 0.012 units wide here, and a slanted surface gains a few times that in depth.
    assert (distance > around.min(0) - 0.05).mean() > 0.99
    seen = np.abs(distance - around).min(0) < 0.01
    assert 0.4 < seen.mean() < 0.95
    moved = np.linalg.norm(here - points[:, 0], axis=-1) > 0.02
    assert step == 0 or seen[moved].mean() > 0.25


def test_points_are_on_the_outside_and_spread_by_area(sampled):
    world, faces, points = sampled
    assert points.shape == (1500, 41, 3)
    names = [world.parts[i].name for i in world.part_of_face[faces]]
    assert {"boom", "stick", "bucket", "cabin", "ball", "ground"} <= set(names)
    ground = points[[n == "ground" for n in names], 0]
    quarters = np.unique(ground[:, 0] > 0, return_counts=True)[1]
    assert quarters.min() / quarters.max() > 0.6
    assert ground[:, 2].min() > -0.57 + 1e-6  # nothing from below the slab


def test_motion_is_moderate_and_smooth(sampled):
    world, _, points = sampled
    way = np.linalg.norm(points - points[:, :1], axis=-1)
    moving = way.max(1) > 0
    assert 0.15 < way[moving].mean() < 0.4
    assert (points[~moving] == points[~moving][:, :1]).all()
    # A time between two is nearly their mean: bounded acceleration, no kink.
    bend = np.linalg.norm(points[:, 1::2] - 0.5 * (points[:, :-1:2] + points[:, 2::2]), axis=-1)
    assert bend.max() < 0.02
