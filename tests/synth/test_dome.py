import numpy as np
import pytest
import torch

from forewarp.data.nhr import read_scene
from forewarp.synth import rigs
from forewarp.synth.raycast import surface_points
from forewarp.synth.rigs import dome_cameras, synthesize_nhr
from forewarp.synth.scenes import centers_of, stream
from forewarp.synth.vehicle import MOTIONS
from forewarp.synth.world import World
from tests.support.lit_points import color_errors, lit_points

SMALL = {"size": 120, "frames": 2, "points": 300, "samples_per_pixel": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return synthesize_nhr(tmp_path_factory.mktemp("synth") / "scene", **SMALL)


@pytest.fixture(scope="module")
def scene(folder):
    return read_scene(folder.parent, folder.name, half_resolution=False)


def test_twenty_cameras_of_two_sizes(scene):
    frames = scene.train + scene.test
    assert len(frames) == 40
    assert {f.time for f in frames} == {0.0, 1.0}
    assert {(f.camera.width, f.camera.height) for f in frames} == {(120, 100), (100, 75)}
    assert scene.has_alpha


@pytest.mark.parametrize("motion", MOTIONS)
def test_no_picture_cuts_anything_off(motion):
    world = World(motion)
    for time in (0, 0.5, 1):
        placed = torch.from_numpy(world.place(time))
        for camera in dome_cameras(240, 0):
            pixel, _ = camera.project(placed)
            assert (pixel > 2).all()
            assert (pixel < torch.tensor([camera.width, camera.height]) - 2).all()


def test_true_points_have_the_colour_of_their_pixels_and_lie_in_the_masks(scene):
    world, centers = World("lift_tilt"), centers_of(dome_cameras(120, 0))
    faces, barycentric = surface_points(world, rigs.POINTS, centers, stream(0, rigs._POINTS))
    assert scene.truth.times.tolist() == [0, 1]
    for frame in (scene.train + scene.test)[::3]:
        points, rgba = scene.truth.points[:, int(frame.time)], frame.load()
        colors, visible = lit_points(world, faces, barycentric, frame.time, frame.camera.center.numpy())
        errors = color_errors(rgba, frame.camera, points[visible], colors[visible])
        assert len(errors) > 800
        assert np.median(errors) < 0.06
        pixel, _ = frame.camera.project(points.double())
        column, row = pixel.floor().long().unbind(-1)
        assert (rgba[row, column, 3] > 0).double().mean() > 0.95


def test_clouds_lie_on_what_moves_with_the_frame(folder):
    first, last = (np.load(folder / "pointclouds" / f"frame{f}.npy") for f in (1, 2))
    assert first.shape == last.shape == (300, 6)
    assert first[:, 3:].min() >= 0
    assert 100 < first[:, 3:].max() <= 255
    for cloud, time in ((first, 0.0), (last, 1.0)):
        placed = World("lift_tilt").place(time)
        assert (cloud[:, :3] >= placed.min(0) - 1e-5).all()
        assert (cloud[:, :3] <= placed.max(0) + 1e-5).all()
    assert not np.array_equal(first, last)
