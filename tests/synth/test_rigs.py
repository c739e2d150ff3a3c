import numpy as np
import pytest
import torch

from forewarp.data import hypernerf, nhr
from forewarp.synth import rigs
from forewarp.synth.raycast import Hits, Posed, camera_rays, light_points, surface_points
from forewarp.synth.rigs import dome_cameras, rig_cameras, synthesize_hypernerf, synthesize_nhr
from forewarp.synth.world import World


def lit_points(world, faces, barycentric, time, center):
    """Return colours (N, 3) in [0, 1] at ``time``, and whether each is visible from ``center`` (3,)."""
    posed = Posed(world, time)
    hits = Hits(np.arange(len(faces)), faces, barycentric, np.zeros(len(faces)))
    points = world.points(faces, barycentric, time)
    away = points - center
    distance = np.linalg.norm(away, axis=-1)
    first = posed.first_hits(np.broadcast_to(center, points.shape), away / distance[:, None])
    visible = np.zeros(len(faces), dtype=bool)
    visible[first.ray] = np.abs(first.distance - distance[first.ray]) < 1e-3
    return posed.color(hits, light_points(24)), visible


def color_errors(rgb, camera, points, colors):
    """Return the colour errors (M,) of the pixels that show the points (N, 3) inside the image."""
    pixel, depth = camera.project(points.double())
    size = torch.tensor([camera.width, camera.height])
    inside = ((pixel > 0) & (pixel < size)).all(-1) & (depth > 0)
    column, row = pixel[inside].floor().long().unbind(-1)
    seen = rgb[row, column, :3].double().numpy() / 255
    return np.abs(seen - colors[inside.numpy()]).mean(-1)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    root = tmp_path_factory.mktemp("rig")
    synthesize_hypernerf(root / "scene", size=192, frames=5, samples_per_pixel=1)
    return root, hypernerf.read_scene(root, "scene", scale=1)


def in_vehicle_units(points):
    """Normalised points (..., 3) in the vehicle's units."""
    unscaled = np.asarray(points, np.float64) / rigs.SCENE_SCALE + np.array(rigs.SCENE_CENTER)
    return (unscaled - np.array(rigs.WORLD_AT)) / rigs.WORLD_SCALE


def test_the_phones_take_turns(rig):
    root, scene = rig
    for split, sides in ((scene.train, "lrlrl"), (scene.test, "rlrlr")):
        assert [f.time for f in split] == pytest.approx([0, 0.25, 0.5, 0.75, 1])
        assert "".join(f.name[0] for f in split) == sides
        assert split[0].camera.lens is not None
        assert split[0].camera.fx != split[0].camera.fy
        assert split[0].load().shape == (144, 192, 4)
    assert (scene.canonical_time, scene.has_alpha) == (0.5, False)
    assert hypernerf.read_scene(root, "scene", scale=2).train[0].load().shape == (72, 96, 4)


def test_all_that_is_seen_lies_between_near_and_far(rig):
    world, pairs = World("lift_tilt", has_room=True), rig_cameras(192, np.linspace(0, 1, 5), 0)
    unit = rigs.WORLD_SCALE * rigs.SCENE_SCALE
    for pair, frame in list(zip(pairs, rig[1].train))[::2]:
        for camera in pair:
            distance = unit * Posed(world, frame.time).first_hits(*camera_rays(camera)).distance
            assert len(distance) == 192 * 144
            assert frame.camera.near < distance.min()
            assert distance.max() < frame.camera.far < 1.2 * distance.max() + 0.5


def test_true_points_have_the_colour_of_their_pixels(rig):
    scene, times, world = rig[1], np.linspace(0, 1, 5), World("lift_tilt", has_room=True)
    assert scene.truth.times.tolist() == pytest.approx([0.5, 0, 0.25, 0.75, 1])
    cameras = [camera for pair in rig_cameras(192, times, 0) for camera in pair]
    rng = np.random.default_rng([0, rigs._POINTS])
    drawn = surface_points(world, rigs.POINTS, cameras, rng, 0.5, world.casts)
    for frame in scene.train[::2] + scene.test[1::2]:
        points = scene.truth.points[:, int((scene.truth.times - frame.time).abs().argmin())]
        colors, visible = lit_points(world, *drawn, frame.time, in_vehicle_units(frame.camera.center))
        errors = color_errors(frame.load(), frame.camera, points[visible], colors[visible])
        assert len(errors) > 800
        # Half a pixel off an edge is another colour; a swapped axis gives a median above 0.2.
        assert np.median(errors) < 0.01
        assert (errors < 0.15).mean() > 0.8


def test_still_points_lie_on_what_never_moves(rig):
    still = in_vehicle_units(rig[1].still)
    assert len(still) > 1000
    walls = [np.abs(still[:, 0]) > 2.29, still[:, 1] > 1.74, still[:, 2] < -0.57]
    slab = (np.abs(still[:, :2]) < 0.7801).all(-1) & (still[:, 2] < -0.4999)
    assert (np.any(walls, axis=0) | slab).all()
    assert slab.sum() > 50
    for frame in rig[1].train[2:3] + rig[1].test[2:3]:
        pixel, depth = frame.camera.project(rig[1].still.double())
        assert (depth > 0).all()
        assert ((pixel > 0) & (pixel < torch.tensor([192, 144]))).all()


def test_what_the_dome_sees_is_where_its_points_and_clouds_are(tmp_path):
    synthesize_nhr(tmp_path / "scene", size=120, frames=2, points=300, samples_per_pixel=1)
    scene, world = nhr.read_scene(tmp_path, "scene", half_resolution=False), World("lift_tilt")
    frames = scene.train + scene.test
    assert (len(frames), {f.time for f in frames}, scene.has_alpha) == (40, {0.0, 1.0}, True)
    assert {(f.camera.width, f.camera.height) for f in frames} == {(120, 100), (100, 75)}
    assert scene.truth.times.tolist() == [0, 1]
    rng = np.random.default_rng([0, rigs._POINTS])
    drawn = surface_points(world, rigs.POINTS, dome_cameras(120, 0), rng)
    for frame in frames[::7]:
        points, rgba = scene.truth.points[:, int(frame.time)], frame.load()
        colors, visible = lit_points(world, *drawn, frame.time, frame.camera.center.numpy())
        errors = color_errors(rgba, frame.camera, points[visible], colors[visible])
        assert len(errors) > 800
        assert np.median(errors) < 0.06
        column, row = frame.camera.project(points.double())[0].floor().long().unbind(-1)
        assert (rgba[row, column, 3] > 0).double().mean() > 0.95
    first, last = (np.load(tmp_path / "scene" / "pointclouds" / f"frame{f}.npy") for f in (1, 2))
    assert first.shape == last.shape == (300, 6)
    assert first[:, 3:].min() >= 0
    assert 100 < first[:, 3:].max() <= 255
    for cloud, time in ((first, 0.0), (last, 1.0)):
        placed = world.place(time)
        assert (cloud[:, :3] >= placed.min(0) - 1e-5).all()
        assert (cloud[:, :3] <= placed.max(0) + 1e-5).all()
    assert not np.array_equal(first, last)
