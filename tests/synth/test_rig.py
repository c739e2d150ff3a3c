import numpy as np
import pytest
import torch

from forewarp.data.hypernerf import read_scene
from forewarp.synth import rigs
from forewarp.synth.raycast import Posed, camera_rays, surface_points
from forewarp.synth.rigs import rig_cameras, synthesize_hypernerf
from forewarp.synth.scenes import centers_of, stream
from forewarp.synth.world import World
from tests.support.lit_points import color_errors, lit_points

SMALL = {"size": 192, "frames": 5, "samples_per_pixel": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return synthesize_hypernerf(tmp_path_factory.mktemp("synth") / "scene", **SMALL)


@pytest.fixture(scope="module")
def scene(folder):
    return read_scene(folder.parent, folder.name, scale=1)


def in_vehicle_units(points):
    """Normalised points (..., 3) in the vehicle's units."""
    unscaled = np.asarray(points, np.float64) / rigs.SCENE_SCALE + np.array(rigs.SCENE_CENTER)
    return (unscaled - np.array(rigs.WORLD_AT)) / rigs.WORLD_SCALE


def test_the_phones_take_turns(scene, folder):
    times = ([f.time for f in split] for split in (scene.train, scene.test))
    assert next(times) == next(times) == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    assert [f.name[:4] for f in scene.train] == ["left", "righ", "left", "righ", "left"]
    assert [f.name[:4] for f in scene.test] == ["righ", "left", "righ", "left", "righ"]
    assert scene.canonical_time == 0.5
    assert not scene.has_alpha
    for frame in (scene.train[0], scene.test[0]):
        assert frame.camera.lens is not None
        assert frame.camera.fx != frame.camera.fy
        assert frame.load().shape == (144, 192, 4)
    halved = read_scene(folder.parent, folder.name, scale=2).train[0]
    assert halved.load().shape == (72, 96, 4)


def test_all_that_is_seen_lies_between_near_and_far(scene):
    world, pairs = World("lift_tilt", has_room=True), rig_cameras(192, np.linspace(0, 1, 5), 0)
    unit = rigs.WORLD_SCALE * rigs.SCENE_SCALE
    for pair, frame in zip(pairs, scene.train):
        for camera in pair:
            distance = unit * Posed(world, frame.time).first_hits(*camera_rays(camera)).distance
            assert len(distance) == 192 * 144
            assert frame.camera.near < distance.min()
            assert distance.max() < frame.camera.far < 1.2 * distance.max() + 0.5


def test_true_points_have_the_colour_of_their_pixels(scene):
    times, world = np.linspace(0, 1, 5), World("lift_tilt", has_room=True)
    assert scene.truth.times.tolist() == pytest.approx([0.5, 0, 0.25, 0.75, 1])
    centers = centers_of([c for pair in rig_cameras(192, times, 0) for c in pair])
    faces, barycentric = surface_points(
        world, rigs.POINTS, centers, stream(0, rigs._POINTS), 0.5, world.casts
    )
    for frame in scene.train + scene.test:
        points = scene.truth.points[:, int((scene.truth.times - frame.time).abs().argmin())]
        place = in_vehicle_units(frame.camera.center)
        colors, visible = lit_points(world, faces, barycentric, frame.time, place)
        errors = color_errors(frame.load(), frame.camera, points[visible], colors[visible])
        assert len(errors) > 800
        # Half a pixel off an edge is another colour; a swapped axis gives a median above 0.2.
        assert np.median(errors) < 0.01
        assert (errors < 0.15).mean() > 0.8


def test_still_points_lie_on_what_never_moves(scene):
    still = in_vehicle_units(scene.still)
    assert len(still) > 1000
    walls = [np.abs(still[:, 0]) > 2.29, still[:, 1] > 1.74, still[:, 2] < -0.57]
    slab = (np.abs(still[:, :2]) < 0.7801).all(-1) & (still[:, 2] < -0.4999)
    assert (np.any(walls, axis=0) | slab).all()
    assert slab.sum() > 50
    for frame in scene.train[2:3] + scene.test[2:3]:
        pixel, depth = frame.camera.project(scene.still.double())
        assert (depth > 0).all()
        assert ((pixel > 0) & (pixel < torch.tensor([192, 144]))).all()
