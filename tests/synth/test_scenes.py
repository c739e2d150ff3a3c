"""What is written reads back, equal arguments give equal bytes, and images show what the truth says."""

import filecmp

import numpy as np
import pytest
import torch

from forewarp.data import hypernerf, nhr
from forewarp.data.dnerf import read_lego_complete, read_scene
from forewarp.data.files import SceneError
from forewarp.synth import scenes
from forewarp.synth.module import WRITERS, write_whole
from forewarp.synth.raycast import Hits, Posed, camera_rays, light_points, surface_points
from forewarp.synth.scenes import dome_cameras, rig_cameras, synthesize_lego_complete
from forewarp.synth.world import World

FEW = {"frames": 2, "test_views": (1, 1, 1), "val_views": 1}
TINY = {
    "dnerf": {"size": 8, **FEW},
    "lego_complete": {"size": 8, "motions": ["lift", "drive"], **FEW},
    "hypernerf": {"size": 16, "frames": 3},
    "nhr": {"size": 24, "frames": 2, "points": 30},
    "multicam": {"size": 16, "frames": 2, "cameras": 2},
    "iphone": {"size": 12, "frames": 2},
}
BAD = [
    ("dnerf", {"size": 7}, "size: expected a whole number of at least 8, but got 7"),
    ("dnerf", {"motion": "fly"}, "motion: expected one of lift, lift_tilt, drive, still, rigid, band, "),
    ("dnerf", {"test_views": (1, 2)}, "test_views: expected three numbers"),
    ("dnerf", {"test_views": (0, 0, 0)}, "not all 0, but got"),
    ("dnerf", {"test_views": 5}, "test_views: expected three numbers"),
    ("dnerf", {"test_views": (1, -2, 3)}, "test_views: expected a whole number of at least 0, but got -2"),
    ("lego_complete", {"motions": ["fly"]}, "motions: expected one of lift, lift_tilt, drive, but got 'fly'"),
    ("lego_complete", {"motions": []}, "motions: expected a list of"),
    ("lego_complete", {"motions": "lift"}, "motions: expected a list of"),
    ("lego_complete", {"motions": ["lift", "lift"]}, "motions: expected each once"),
    ("lego_complete", {"workers": 0}, "workers: expected a whole number of at least 1, but got 0"),
    ("hypernerf", {"size": 20}, "size: expected a multiple of 8 of at least 16, but got 20; set size"),
    ("hypernerf", {"frames": 4}, "frames: expected an odd number, one in the middle, but got 4; set frames"),
    ("hypernerf", {"motion": "still"}, "motion: expected one of lift, lift_tilt, drive, but got 'still'"),
    ("nhr", {"size": 100}, "size: expected a multiple of 24 of at least 24, but got 100; set size"),
    ("multicam", {"size": 65}, "size: expected a multiple of 2 of at least 16, but got 65; set size"),
    ("multicam", {"cameras": 1}, "cameras: expected a whole number of at least 2, but got 1; set cameras"),
    ("iphone", {"size": 32}, "size: expected a multiple of 6 of at least 12, but got 32; set size"),
    ("iphone", {"beside": 0}, "beside: expected a whole number of at least 1, but got 0; set beside"),
    ("multicam", {"synchronised": "yes"}, "synchronised: expected true or false, but got 'yes'"),
]


@pytest.mark.parametrize(("dataset", "change", "text"), BAD)
def test_bad_arguments_get_one_line(tmp_path, dataset, change, text):
    with pytest.raises(SceneError, match=text) as caught:
        WRITERS[dataset](tmp_path / "scene", **TINY[dataset] | change)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "scene").exists()


# Lego Complete is written as D-NeRF is, NHR with the same draws.
FILES = {"dnerf": 2 + 1 + 2 * 3 + 5 + 1, "hypernerf": 3 * 6 + 5}


@pytest.mark.slow
@pytest.mark.parametrize("dataset", FILES)
def test_equal_arguments_give_equal_bytes(tmp_path, monkeypatch, dataset):
    monkeypatch.setattr(scenes, "POINTS", 200)
    arguments = {**TINY[dataset], "samples_per_pixel": 1}
    first, again = (WRITERS[dataset](tmp_path / name, **arguments) for name in ("first", "again"))
    names = sorted(p.relative_to(first).as_posix() for p in first.rglob("*") if p.is_file())
    assert len(names) == FILES[dataset]
    assert filecmp.cmpfiles(first, again, names, shallow=False) == (names, [], [])


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match="scene: expected a folder to write to, but got"):
        write_whole(tmp_path / "file" / "scene", "dnerf", {**TINY["dnerf"], "samples_per_pixel": 1})


@pytest.mark.slow
def test_what_is_written_reads_back(tmp_path):
    seen, few = [], {"size": 16, "frames": 4, "test_views": (3, 2, 2), "val_views": 2, "samples_per_pixel": 1}
    scenes.synthesize(tmp_path / "toy", **few, progress=lambda *n: seen.append(n))
    assert seen == [(i, 13) for i in range(1, 14)]
    scene = read_scene(tmp_path, "toy")
    other = scenes.views_at("lift_tilt", (1,), 16, np.zeros(4), (), ())["train"]  # of another seed
    assert all((a.camera.center != b.camera.center).any() for a, b in zip(scene.train, other, strict=True))
    assert [f.time for f in scene.train] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [f.ability for f in scene.test] == ["space"] * 3 + ["time"] * 2 + ["canonical"] * 2
    assert [f.time for f in scene.test] == pytest.approx([0, 2 / 3, 1, 1 / 6, 5 / 6, 0, 0])
    assert (len(scene.val), scene.has_alpha, scene.canonical_time) == (2, True, 0)
    assert scene.truth.times.tolist() == pytest.approx(np.linspace(0, 1, 7))
    assert scene.truth.points.shape == (4000, 7, 3)
    for frame in scene.test:
        assert frame.load().shape == (16, 16, 4)
        assert frame.load_depth().max() > 2
        assert frame.camera.center[2] > 0
        pixel, depth = frame.camera.project(frame.camera.center.new_zeros(3))
        assert [*pixel.tolist(), float(depth)] == pytest.approx([8, 8, 4.0311])
        assert frame.camera.camera_to_world[2, 1] < 0  # the image's down points to the ground


@pytest.mark.slow
def test_the_default_counts_of_lego_complete_are_the_published_ones(monkeypatch, tmp_path):
    written = {}
    monkeypatch.setattr(scenes, "write_worlds", lambda worlds, *_: written.update(worlds))
    synthesize_lego_complete(tmp_path)
    assert [folder.name for folder in written] == ["lift", "lift_tilt", "drive"]
    for _, views, _ in written.values():
        counts = {a: sum(v.ability == a for v in views["test"]) for a in ("space", "time", "canonical")}
        assert counts == {"space": 200, "time": 197, "canonical": 50}
        assert len(views["train"]) == len({v.time for v in views["train"]}) == 50
        assert {v.time for v in views["train"]} <= {v.time for v in views["test"] if v.ability == "time"}


@pytest.mark.slow
def test_every_motion_is_a_scene_of_three_kinds_of_view_whose_depth_true_points_meet(tmp_path):
    few = {"frames": 3, "motions": ["lift", "drive"], "test_views": (1, 4, 1), "val_views": 1}
    synthesize_lego_complete(tmp_path, size=64, samples_per_pixel=1, **few)
    places, shares = [], []
    for name in few["motions"]:
        scene = read_lego_complete(tmp_path, name)
        assert [f.time for f in scene.train] == pytest.approx([0, 0.5, 1])
        times = {a: [f.time for f in scene.test if f.ability == a] for a in ("space", "time", "canonical")}
        assert times["space"] == pytest.approx([0, 0.5, 1])
        assert times["time"] == scene.truth.times.tolist() == pytest.approx(np.linspace(0, 1, 9))
        assert times["canonical"] == [0]
        places += [f.camera.center for f in scene.train + scene.test]
        for frame in scene.test:
            step = int((scene.truth.times - frame.time).abs().argmin())
            points, depth = scene.truth.points[:, step].double(), frame.load_depth()
            column, row = frame.camera.project(points)[0].floor().long().clamp(1, 62).unbind(-1)
            around = [depth[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
            around = torch.stack(around).double()
            distance = (points - frame.camera.center).norm(dim=-1)
            shares.append(float(((distance - around).abs().amin(0) < 0.02).double().mean()))
            around[around == 0] = torch.inf
            assert (distance > around.amin(0) - 0.15).double().mean() > 0.98, frame.name
    assert len(torch.unique(torch.stack(places), dim=0)) == len(places)
    # A pixel is 0.05 units wide here, and on a slab seen from low down a multiple of that deep.
    assert min(shares) > 0.2
    assert np.mean(shares) > 0.38


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


SIDE = 128  # pixels across the rig's images


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    root = tmp_path_factory.mktemp("rig")
    scenes.synthesize_hypernerf(root / "scene", size=SIDE, frames=3, samples_per_pixel=1)
    return root, hypernerf.read_scene(root, "scene", scale=1)


def in_vehicle_units(points):
    """Normalised points (..., 3) in the vehicle's units."""
    unscaled = np.asarray(points, np.float64) / scenes.SCENE_SCALE + np.array(scenes.SCENE_CENTER)
    return (unscaled - np.array(scenes.WORLD_AT)) / scenes.WORLD_SCALE


@pytest.mark.slow
def test_the_phones_take_turns(rig):
    root, scene = rig
    for split, sides in ((scene.train, "lrl"), (scene.test, "rlr")):
        assert [f.time for f in split] == [0, 0.5, 1]
        assert "".join(f.name[0] for f in split) == sides
        assert split[0].camera.lens is not None
        assert split[0].camera.fx != split[0].camera.fy
        assert split[0].load().shape == (SIDE * 3 // 4, SIDE, 4)
    assert (scene.canonical_time, scene.has_alpha) == (0.5, False)
    assert hypernerf.read_scene(root, "scene", scale=2).train[0].load().shape == (SIDE * 3 // 8, SIDE // 2, 4)


@pytest.mark.slow
def test_all_that_is_seen_lies_between_near_and_far(rig):
    world, pairs = World("lift_tilt", has_room=True), rig_cameras(SIDE, np.linspace(0, 1, 3), 0)
    unit = scenes.WORLD_SCALE * scenes.SCENE_SCALE
    for pair, frame in zip(pairs[:2], rig[1].train):
        for camera in pair:
            distance = unit * Posed(world, frame.time).first_hits(*camera_rays(camera)).distance
            assert len(distance) == SIDE * SIDE * 3 // 4
            assert frame.camera.near < distance.min()
            assert distance.max() < frame.camera.far < 1.2 * distance.max() + 0.5


@pytest.mark.slow
def test_true_points_have_the_colour_of_their_pixels(rig):
    scene, times, world = rig[1], np.linspace(0, 1, 3), World("lift_tilt", has_room=True)
    assert scene.truth.times.tolist() == [0.5, 0, 1]
    cameras = [camera for pair in rig_cameras(SIDE, times, 0) for camera in pair]
    rng = np.random.default_rng([0, scenes._TRACKS])
    drawn = surface_points(world, scenes.POINTS, cameras, rng, 0.5, world.casts)
    for frame in scene.train[:2] + scene.test[1:2]:
        points = scene.truth.points[:, int((scene.truth.times - frame.time).abs().argmin())]
        colors, visible = lit_points(world, *drawn, frame.time, in_vehicle_units(frame.camera.center))
        errors = color_errors(frame.load(), frame.camera, points[visible], colors[visible])
        assert len(errors) > 800
        # Half a pixel off an edge is another colour; a swapped axis gives a median above 0.2.
        assert np.median(errors) < 0.01
        assert (errors < 0.15).mean() > 0.8


@pytest.mark.slow
def test_still_points_lie_on_what_never_moves(rig):
    still = in_vehicle_units(rig[1].still)
    assert len(still) > 1000
    walls = [np.abs(still[:, 0]) > 2.29, still[:, 1] > 1.74, still[:, 2] < -0.57]
    slab = (np.abs(still[:, :2]) < 0.7801).all(-1) & (still[:, 2] < -0.4999)
    assert (np.any(walls, axis=0) | slab).all()
    assert slab.sum() > 50
    for frame in rig[1].train[1:2] + rig[1].test[1:2]:
        pixel, depth = frame.camera.project(rig[1].still.double())
        assert (depth > 0).all()
        assert ((pixel > 0) & (pixel < torch.tensor([SIDE, SIDE * 3 // 4]))).all()


@pytest.mark.slow
def test_what_the_dome_sees_is_where_its_points_and_clouds_are(tmp_path):
    scenes.synthesize_nhr(tmp_path / "scene", size=96, frames=2, points=300, samples_per_pixel=1)
    scene, world = nhr.read_scene(tmp_path, "scene", half_resolution=False), World("lift_tilt")
    frames = scene.train + scene.test
    assert (len(frames), {f.time for f in frames}, scene.has_alpha) == (40, {0.0, 1.0}, True)
    assert {(f.camera.width, f.camera.height) for f in frames} == {(96, 80), (80, 60)}
    assert scene.truth.times.tolist() == [0, 1]
    rng = np.random.default_rng([0, scenes._TRACKS])
    drawn = surface_points(world, scenes.POINTS, dome_cameras(96, 0), rng)
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
