"""Lego Complete scenes: three kinds of test view with depth, and what differs from the published counts."""

import json

import imageio.v3 as iio
import numpy as np
import pytest

from forewarp.data import lego_complete
from forewarp.data.lego_complete import read_scene, write_scene
from forewarp.data.module import LegoCompleteDataModule
from forewarp.scene.errors import SceneError
from tests.support.dnerf_scene import ANGLE, edit, shots, truth

FEW = {"space": 4, "time": 3, "canonical": 2}
TIMES = {"space": [0.0, 0.5, 0.5, 1.0], "time": [0.1, 0.3, 0.6], "canonical": [0.0, 0.0]}


def views(counts=FEW, times=TIMES, size=(6, 8)):
    """Shots of each ability at its times."""
    for seed, (ability, count) in enumerate(counts.items()):
        yield from shots(count, 10 + seed, size, ability, True, times[ability])


def write_tiny(folder, **changes):
    """3 training images and 9 test views."""
    splits = {"train": shots(3), "test": views()} | changes
    write_scene(folder, splits, camera_angle_x=ANGLE, trajectories=truth())
    return folder


def test_round_trip(tmp_path):
    write_tiny(tmp_path / "lift")
    scene = read_scene(tmp_path, "lift")
    assert (len(scene.train), scene.val, scene.canonical_time) == (3, (), 0.0)
    for frame, shot in zip(scene.test, views(), strict=True):
        assert (frame.ability, frame.time) == (shot.ability, shot.time)
        assert np.array_equal(frame.load(), shot.rgba)
        assert np.array_equal(frame.load_depth(), shot.depth)
        assert (frame.camera.camera_to_world - shot.pose).abs().max() < 1e-6
    assert scene.truth.points.shape == (2, 3, 3)
    expected = {"dataset": "lego_complete", "training_times": 3, "test_views": FEW}
    assert scene.protocol | expected == scene.protocol


def test_the_published_counts_need_no_note(tmp_path, monkeypatch):
    assert (lego_complete.TRAINING_TIMES, lego_complete.TEST_VIEWS) == (
        50,
        {"space": 200, "time": 197, "canonical": 50},
    )
    monkeypatch.setattr(lego_complete, "TRAINING_TIMES", 3)
    monkeypatch.setattr(lego_complete, "TEST_VIEWS", FEW)
    write_tiny(tmp_path / "lift")
    protocol = read_scene(tmp_path, "lift").protocol
    assert "note" not in protocol
    assert (protocol["training_times"], protocol["test_views"], protocol["test_frames"]) == (3, FEW, 9)


def test_what_differs_is_said_once_in_the_protocol(tmp_path):
    folder = write_tiny(tmp_path / "lift", train=shots(4, times=[0, 0, 0.5, 1]))
    edit(folder, "test_space", lambda c: c["frames"][0].update(time=0.25))
    edit(folder, "test_canonical", lambda c: c["frames"][0].update(time=0.5))
    edit(folder, "test_canonical", lambda c: c["frames"][1].pop("depth_file_path"))
    note = read_scene(tmp_path, "lift").protocol["note"]
    assert note == (
        "not the published protocol: 3 training times instead of 50; 4 training images at 3 times; "
        "4 space views instead of 200; 3 time views instead of 197; 2 canonical views instead of 50; "
        "1 space views not at a training time; 1 canonical views not at the canonical time; "
        "1 of 9 test views without a depth"
    )


@pytest.mark.parametrize("place", ["file", "frame"])
def test_depth_may_be_a_png_with_its_scale(tmp_path, place):
    folder = write_tiny(tmp_path / "lift")
    steps = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    iio.imwrite(folder / "test_time" / "r_1_depth.png", steps)

    def change(content):
        content["frames"][1]["depth_file_path"] = "test_time/r_1_depth.png"
        (content if place == "file" else content["frames"][1])["depth_scale"] = 1e-4

    edit(folder, "test_time", change)
    frame = next(f for f in read_scene(tmp_path, "lift").test if f.name == "test_time/r_1")
    np.testing.assert_allclose(frame.load_depth(), steps * 1e-4, rtol=1e-6)
    half = read_scene(tmp_path, "lift", half_resolution=True).test
    frame = next(f for f in half if f.name == "test_time/r_1")
    assert frame.load_depth()[0, 0] == pytest.approx((1000 + 8000 + 9000) / 3 * 1e-4)  # of the three met


def test_an_ability_may_have_its_file_in_its_folder(tmp_path):
    folder = write_tiny(tmp_path / "lift")
    content = json.loads((folder / "transforms_test_space.json").read_text())
    for entry in content["frames"]:
        for key in ("file_path", "depth_file_path"):
            entry[key] = entry[key].replace("./test_space/", "./")
    (folder / "transforms_test_space.json").unlink()
    (folder / "test_space" / "transforms.json").write_text(json.dumps(content))
    scene = read_scene(tmp_path, "lift")
    assert scene.protocol["test_views"] == FEW
    assert scene.test[0].name == "test_space/r_0"
    assert scene.test[0].load_depth().shape == (6, 8)
    write_tiny(folder, test=views({"time": 3}))
    assert {f.ability for f in read_scene(tmp_path, "lift").test} == {"time"}


BAD = {
    "no scale": ({"depth_file_path": "d.png"}, r"d.png: expected depth_scale in the transforms file"),
    "scale 0": (
        {"depth_file_path": "d.png", "depth_scale": 0},
        r"frames\[0\].depth_scale: expected a number in \[1e-12, 1e\+06\], but got 0",
    ),
    "scale word": ({"depth_scale": "1"}, r"frames\[0\].depth_scale: expected a number"),
    "no file": ({"depth_file_path": "e.npy"}, r"frames\[0\].depth_file_path: expected an existing file"),
    "long": ({"depth_file_path": "e" * 999}, r"frames\[0\].depth_file_path: expected an existing file"),
    "lines": ({"depth_file_path": "e\n"}, r"frames\[0\].depth_file_path: expected a path inside"),
    "ability": ({"ability": "all"}, r"got test_time/r_0 without an ability; use data=dnerf"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_entries_are_one_clear_line(tmp_path, case):
    entries, match = BAD[case]
    folder = write_tiny(tmp_path / "lift")
    iio.imwrite(folder / "d.png", np.zeros((6, 8), np.uint16))
    edit(folder, "test_time", lambda c: c["frames"][0].update(entries))
    with pytest.raises(SceneError, match=match) as caught:
        read_scene(tmp_path, "lift")
    assert len(str(caught.value).splitlines()) == 1


def eight_bits(path):
    iio.imwrite(path, np.zeros((6, 8), np.uint8))


def other_size(path):
    iio.imwrite(path, np.zeros((6, 9), np.uint16))


DEPTHS = [
    (eight_bits, "expected a grey PNG of 16 bits a pixel, but got mode L"),
    (other_size, r"expected finite depths >= 0 of shape \(6, 8\), but got shape \(6, 9\)"),
]


@pytest.mark.parametrize(("change", "match"), DEPTHS)
def test_bad_depths_are_found_when_loaded(tmp_path, change, match):
    folder = write_tiny(tmp_path / "lift")
    iio.imwrite(folder / "d.png", np.zeros((6, 8), np.uint16))
    change(folder / "d.png")
    edit(folder, "test_time", lambda c: c["frames"][0].update(depth_file_path="d.png", depth_scale=1))
    frame = next(f for f in read_scene(tmp_path, "lift").test if f.ability == "time")
    with pytest.raises(SceneError, match=match):
        frame.load_depth()


def test_depths_beyond_single_precision_are_refused(tmp_path):
    folder = write_tiny(tmp_path / "lift")
    np.save(folder / "test_time" / "r_0_depth.npy", np.full((6, 8), 1e300))
    frame = next(f for f in read_scene(tmp_path, "lift").test if f.ability == "time")
    with pytest.raises(SceneError, match="expected finite depths"):
        frame.load_depth()


def test_a_stock_scene_is_refused(tmp_path):
    from tests.support.dnerf_scene import write_tiny as write_stock

    write_stock(tmp_path / "lego")
    with pytest.raises(
        SceneError, match=r"lego: expected transforms_test_<ability>.json for space, time, can"
    ):
        read_scene(tmp_path, "lego")


@pytest.mark.parametrize(
    ("test", "match"),
    [
        (
            lambda: shots(1, depth=True),
            "r_0: expected a test shot with an ability and a depth, but got no ability",
        ),
        (lambda: shots(1, ability="time"), "r_0: expected a test shot with .* but got no depth"),
    ],
)
def test_the_writer_wants_abilities_and_depths(tmp_path, test, match):
    with pytest.raises(ValueError, match=match):
        write_tiny(tmp_path / "lift", test=test())


def test_the_data_module_serves_depth(tmp_path):
    write_tiny(tmp_path / "lift")
    data = LegoCompleteDataModule(tmp_path, "lift", rays=4)
    target = data.targets("test")[0]
    assert (target.frame.ability, tuple(target.depth.shape)) == ("space", (6, 8))
    assert data.scene.protocol["dataset"] == "lego_complete"
