"""Lego Complete scenes: three kinds of test view with depth, and what differs from the published counts."""

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from forewarp.data import dnerf
from forewarp.data.dnerf import read_lego_complete as read_scene
from tests.support.dnerf_scene import FEW, edit, shots, truth, views, write_kinds


def test_round_trip(tmp_path):
    write_kinds(tmp_path / "lift")
    scene = read_scene(tmp_path, "lift")
    assert (len(scene.train), scene.val, scene.canonical_time) == (3, (), 0.0)
    for frame, shot in zip(scene.test, views(), strict=True):
        assert (frame.ability, frame.time) == (shot.ability, shot.time)
        assert np.array_equal(frame.load(), shot.rgba)
        assert np.array_equal(frame.load_depth(), shot.depth)
        assert (frame.camera.camera_to_world - shot.pose).abs().max() < 1e-6
    assert len({frame.name for frame in scene.test}) == 9
    assert torch.equal(scene.truth.points, truth().points)
    assert torch.equal(scene.truth.times, truth().times)
    expected = {"dataset": "lego_complete", "training_times": 3, "test_views": FEW}
    assert scene.protocol | expected == scene.protocol


def test_the_published_counts_need_no_note(tmp_path, monkeypatch):
    published = {"space": 200, "time": 197, "canonical": 50}
    assert (50, published) == (dnerf.TRAINING_TIMES, dnerf.TEST_VIEWS)
    monkeypatch.setattr(dnerf, "TRAINING_TIMES", 3)
    monkeypatch.setattr(dnerf, "TEST_VIEWS", FEW)
    write_kinds(tmp_path / "lift")
    protocol = read_scene(tmp_path, "lift").protocol
    assert "note" not in protocol
    assert (protocol["training_times"], protocol["test_views"], protocol["test_frames"]) == (3, FEW, 9)


def test_what_differs_is_said_once_in_the_protocol(tmp_path):
    folder = write_kinds(tmp_path / "lift", train=shots(4, times=[0, 0, 0.5, 1]))
    edit(folder, "test_space", {"frames.0.time": 0.25})
    edit(folder, "test_canonical", {"frames.0.time": 0.5})
    edit(folder, "test_canonical", lambda c: c["frames"][1].pop("depth_file_path"))
    note = read_scene(tmp_path, "lift").protocol["note"]
    assert note == (
        "not the published protocol: 3 training times instead of 50; 4 training images at 3 times; "
        "4 space views instead of 200; 3 time views instead of 197; 2 canonical views instead of 50; "
        "1 space views not at a training time; 1 canonical views not at the canonical time; "
        "1 of 9 test views without a depth"
    )


@pytest.mark.parametrize("place", ["", "frames.1."])
def test_depth_may_be_a_png_with_its_scale(tmp_path, place):
    folder = write_kinds(tmp_path / "lift")
    steps = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    iio.imwrite(folder / "d.png", steps)
    edit(folder, "test_time", {"frames.1.depth_file_path": "d.png", f"{place}depth_scale": 1e-4})
    frame = next(f for f in read_scene(tmp_path, "lift").test if f.name == "test_time/r_1")
    np.testing.assert_allclose(frame.load_depth(), steps * 1e-4, rtol=1e-6)
    half = read_scene(tmp_path, "lift", half_resolution=True).test
    frame = next(f for f in half if f.name == "test_time/r_1")
    assert frame.load_depth()[0, 0] == pytest.approx((1000 + 8000 + 9000) / 3 * 1e-4)  # of the three met


def test_an_ability_may_have_its_file_in_its_folder(tmp_path):
    folder = write_kinds(tmp_path / "lift")
    text = (folder / "transforms_test_space.json").read_text()
    (folder / "transforms_test_space.json").unlink()
    (folder / "test_space" / "transforms.json").write_text(text.replace("./test_space/", "./"))
    scene = read_scene(tmp_path, "lift")
    assert scene.protocol["test_views"] == FEW
    assert scene.test[0].name == "test_space/r_0"
    assert scene.test[0].load_depth().shape == (6, 8)
    write_kinds(folder, test=views({"time": 3}))
    assert {f.ability for f in read_scene(tmp_path, "lift").test} == {"time"}
