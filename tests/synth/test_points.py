import numpy as np
import pytest

from forewarp.synth.raycast import surface_points, trajectories
from forewarp.synth.scenes import centers_of, random_cameras
from forewarp.synth.vehicle import MOTIONS
from forewarp.synth.world import World

TIMES = np.linspace(0, 1, 41)


@pytest.fixture(scope="module", params=MOTIONS)
def sampled(request):
    world = World(request.param)
    centers = centers_of(random_cameras(12, 8, np.random.default_rng(1)))
    faces, barycentric = surface_points(world, 1500, centers, np.random.default_rng(2))
    return world, faces, trajectories(world, faces, barycentric, TIMES).points.double().numpy()


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
