"""D-NeRF scenes: what is written is read and real scenes are understood."""

import json

import numpy as np
import pytest
import torch

from forewarp.data.dnerf import read_scene
from tests.support.dnerf_scene import ANGLE, REAL_SCENES, edit, real, shots, write_tiny


def test_round_trip_of_a_stock_scene(tmp_path):
    write_tiny(tmp_path / "toy")
    scene = read_scene(tmp_path, "toy")
    for split, expected in (("train", shots(4)), ("val", shots(2, 1)), ("test", shots(3, 2))):
        for frame, shot in zip(getattr(scene, split), expected, strict=True):
            assert frame.name == f"{split}/{shot.name}"
            assert (frame.time, frame.ability, frame.load_depth) == (shot.time, "all", None)
            torch.testing.assert_close(frame.camera.camera_to_world, shot.pose, atol=1e-6, rtol=0)
            assert np.array_equal(frame.load(), shot.rgba)
    camera = scene.train[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy, camera.near, camera.far) == (8, 6, 4, 3, 2, 6)
    assert camera.fx == camera.fy == pytest.approx(4 / np.tan(ANGLE / 2))
    assert (scene.canonical_time, scene.has_alpha, scene.truth) == (0.0, True, None)
    expected = {"dataset": "dnerf", "resolution": [8, 6], "half_resolution": False, "test_frames": 3}
    assert scene.protocol == expected


def test_a_frame_may_name_its_ability_and_missing_times_are_spread(tmp_path):
    write_tiny(tmp_path / "toy")
    edit(tmp_path / "toy", "test", lambda c: c["frames"][1].update(ability="time"))
    edit(tmp_path / "toy", "train", lambda c: [f.pop("time") for f in c["frames"]])
    (tmp_path / "toy" / "train" / "transforms.json").write_text("broken")  # stray files are ignored
    (tmp_path / "toy" / "train" / "r_900.png").write_bytes(b"")
    scene = read_scene(tmp_path, "toy")
    assert [f.ability for f in scene.test] == ["all", "time", "all"]
    assert scene.times == pytest.approx((0, 1 / 3, 2 / 3, 1))


def test_canonical_is_the_smallest_training_time(tmp_path):
    write_tiny(tmp_path / "toy", train=shots(3, times=[0.7, 0.2, 0.9]))
    assert read_scene(tmp_path, "toy").canonical_time == 0.2


@pytest.mark.parametrize(("value", "expected"), [("auto", (8, 6)), (False, (8, 6)), (True, (4, 3))])
def test_half_resolution_of_a_small_scene(tmp_path, value, expected):
    write_tiny(tmp_path / "toy", test=shots(2, depth=True))
    scene = read_scene(tmp_path, "toy", half_resolution=value)
    frame, camera = scene.test[0], scene.test[0].camera
    assert (camera.width, camera.height) == (2 * camera.cx, 2 * camera.cy) == expected
    assert camera.fx == pytest.approx(expected[0] / 2 / np.tan(ANGLE / 2))
    assert tuple(frame.load().shape) == (expected[1], expected[0], 4)
    assert tuple(frame.load_depth().shape) == (expected[1], expected[0])
    assert scene.protocol["half_resolution"] is (value is True)


def test_a_known_point_projects_where_it_was_painted(tmp_path):
    """The formulas of the format, by hand: x right, y up, looking along -z."""
    write_tiny(tmp_path / "toy", size=(60, 80))
    content = json.loads((tmp_path / "toy" / "transforms_train.json").read_text())
    matrix = np.array(content["frames"][0]["transform_matrix"])
    point = np.array([0.3, -0.2, 0.5])
    local = matrix[:3, :3].T @ (point - matrix[:3, 3])
    focal = 40 / np.tan(ANGLE / 2)
    expected = [focal * local[0] / -local[2] + 40, -focal * local[1] / -local[2] + 30]
    camera = read_scene(tmp_path, "toy", half_resolution=False).train[0].camera
    pixel, depth = camera.project(torch.from_numpy(point))
    assert pixel.tolist() == pytest.approx(expected)
    assert depth.item() == pytest.approx(-local[2])


@pytest.mark.parametrize("name", REAL_SCENES)
def test_real_scenes_read(name):
    scene = read_scene(real("dnerf"), name, box=[-1.5] * 3 + [1.5] * 3)
    counts = dict(zip(REAL_SCENES, (150, 100, 100, 200, 50, 150)))
    assert (len(scene.train), len(scene.test)) == (counts[name], 20)
    assert len(scene.val) == (11 if name == "lego" else 20)
    assert (scene.canonical_time, scene.times[-1], scene.has_alpha) == (0.0, 1.0, True)
    assert scene.train[0].camera.fx == pytest.approx(555.5555, abs=1e-3)
    assert scene.train[-1].load().shape == (400, 400, 4)


def test_real_silhouettes_agree_on_where_the_object_is():
    """Voxels that project into the silhouettes of an almost still while must fill them again."""
    frames = [f for f in read_scene(real("dnerf"), "lego").train if f.time < 0.15]
    axis = torch.linspace(-1.5, 1.5, 72)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    votes, views = torch.zeros(len(points)), []
    for frame in frames:
        mask = frame.load()[..., 3] > 127
        pixel, depth = frame.camera.project(points)
        seen = ((pixel >= 0) & (pixel < 400)).all(-1) & (depth > 0)
        column, row = pixel.long().clamp(0, 399).unbind(-1)
        votes += (seen & mask[row, column]).float()
        views.append((mask, row, column))
    hull = votes >= 0.9 * len(frames)
    overlaps = []
    for mask, row, column in views:
        hit = torch.zeros(400, 400)
        hit[row[hull], column[hull]] = 1
        # A voxel is about 6 pixels wide.
        hit = torch.nn.functional.max_pool2d(hit[None, None], 9, 1, 4)[0, 0] > 0
        overlaps.append(((hit & mask).sum() / (hit | mask).sum()).item())
    assert len(overlaps) == 8
    assert min(overlaps) > 0.8
    assert sum(overlaps) / 8 > 0.88  # any other signs of the axes stay below 0.83


def test_the_released_size_halves_to_the_published_one():
    full = read_scene(real("dnerf_800"), "hellwarrior")
    half = read_scene(real("dnerf"), "hellwarrior")
    assert (full.protocol["half_resolution"], half.protocol["half_resolution"]) == (True, False)
    pairs = [(*scene.train[::25], *scene.test[::10]) for scene in (full, half)]
    for a, b in zip(*pairs, strict=True):
        assert a.camera.fx == pytest.approx(b.camera.fx)
        assert (a.load().int() - b.load().int()).abs().max() <= 1
