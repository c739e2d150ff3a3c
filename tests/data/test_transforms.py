"""What any program may write into a transforms.json: read rightly, or refused with the key that mends it."""

import json
import math
import re
import shutil
from contextlib import nullcontext

import numpy as np
import pytest
import torch

from forewarp.data import dnerf, posed_video
from forewarp.data.cameras import FLIP
from forewarp.data.checks import check_seen
from forewarp.data.files import Entry, layout_of
from forewarp.data.module import DNeRFDataModule
from forewarp.data.transforms import camera_of, check_times, left_aside, pose_in, times_of, with_intrinsics
from forewarp.scene.camera import Camera
from tests.support.written_scenes import around, dnerf_shots, edit, refused, write_dnerf, write_video

EYE = torch.eye(4, dtype=torch.float64)
WIDE = 2 * math.atan(0.5)  # of images as wide as their focal length


def camera(stored=(80, 60), common=None, **own):
    return camera_of(Entry("t.json", own, "frames[0].", common or {}), stored, 1, "a.png", pose=EYE)


@pytest.mark.parametrize(
    ("keys", "fx", "fy", "cx"),
    [
        ({"camera_angle_x": WIDE}, 80, 80, 40),
        ({"camera_angle_x": WIDE, "fl_x": 80.5}, 80.5, 80.5, 40),
        ({"fl_x": 90, "fl_y": 70, "cx": 50}, 90, 70, 50),
        ({"fl_x": 90, "common": {"camera_angle_x": WIDE}}, 90, 90, 40),  # a frame's own number wins
        ({"camera_angle_x": WIDE, "common": {"fl_x": 90}}, 80, 80, 40),
        ({"camera_angle_x": WIDE, "common": {"fl_y": 90}}, 80, 80, 40),
        ({"camera_angle_x": WIDE, "common": {"fl_x": 90, "fl_y": 45}}, 80, 40, 40),  # pixels keep their shape
        ({"camera_angle_x": WIDE, "common": {"fl_x": 80.1}}, 80.1, 80.1, 40),  # the same, rounded
        ({"fl_x": 90, "common": {"fl_x": 60, "fl_y": 60}}, 90, 90, 40),
        ({"fl_x": 90, "common": {"fl_y": 70}}, 90, 70, 40),
        ({"camera_angle_y": 2 * math.atan(0.375)}, 80, 80, 40),  # of the height, where it stands alone
        ({"camera_angle_y": 2 * math.atan(0.375), "common": {"fl_x": 90}}, 80, 80, 40),
        ({"camera_angle_y": 2 * math.atan(0.375), "common": {"fl_x": 90, "fl_y": 45}}, 160, 80, 40),
        ({"camera_angle_y": 2 * math.atan(0.375), "common": {"camera_angle_x": 1.0}}, 80, 80, 40),
        ({"camera_angle_y": 41.0, "common": {"fl_x": 90}}, 90, 90, 40),  # no angle
    ],
)
def test_one_reading_of_intrinsics(keys, fx, fy, cx):
    made = camera(**keys)
    assert (made.fx, made.fy, made.cx) == pytest.approx((fx, fy, cx))


MATRIX = [[80.0, 0, 40], [0, 81, 20], [0, 0, 1]]
TRANSPOSED = [list(column) for column in zip(*MATRIX)]
FOUR = [[80.0, 0, 40, 0], [0, 81, 20, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("own", "common", "focal", "told"),
    [
        ({"cam_K": MATRIX}, {"camera_angle_x": WIDE}, 80, ""),
        ({"K": FOUR}, {"fl_x": 90.0, "cx": 7.0}, 80, ""),
        ({"camera_angle_x": 2 * math.atan(0.25)}, {"K": MATRIX}, 160, ""),
        ({"camera_matrix": [80, 0, 40, 0, 81, 20, 0, 0, 1]}, {}, 80, ""),
        ({}, {"intrinsics": MATRIX}, 80, ""),
        ({"fl_x": 80.0, "K": MATRIX}, {}, 80, ""),
        ({"fl_x": 90.0, "K": MATRIX}, {}, 90, "K is left aside, as fl_x says another thing"),
        ({"calib": MATRIX, "turn": np.eye(3).tolist()}, {"fl_x": 90.0}, 90, "calib is not read, which seems"),
        ({"intrinsics": {"f": 80}}, {"fl_x": 90.0}, 90, "intrinsics is not read, which seems to be"),
        ({"K": "none"}, {"fl_x": 90.0, "applied_transform": np.eye(4)[:3].tolist()}, 90, ""),
    ],
)
def test_a_matrix_of_intrinsics_is_read_or_told(own, common, focal, told):
    (entry,), lines = with_intrinsics([Entry("t.json", own, common=common)], "t.json")
    read = camera_of(entry, (80, 40), 1, "a.png", pose=torch.eye(4))
    assert read.fx == focal
    assert (read.cx, read.cy) == (40, 20)
    assert told in " ".join(lines)
    assert bool(lines) == bool(told)


@pytest.mark.parametrize(
    ("model", "terms", "said"),
    [
        (
            "PINHOLE",
            {"k1": 0.1, "k2": 0},
            "camera_model: PINHOLE has no k1, which is 0.1 and is undone; write c",
        ),
        ("RADIAL", {"k1": 0.1, "k2": 0.1, "p2": 0.01}, "RADIAL has no p2, which is 0.01"),
        ("SIMPLE_RADIAL", {"k1": 0.1, "k2": 0.0}, None),
        ("OPENCV", {"k3": 0.1, "p1": 0.01}, None),
    ],
)
def test_a_lens_that_its_model_has_not_is_told(tmp_path, model, terms, said):
    nothing = dict.fromkeys(("k1", "k2", "k3", "p1", "p2"))
    edit(write_video(tmp_path / "toy") / posed_video.FILE, nothing | {"camera_model": model} | terms)
    lines = [
        line for line in posed_video.read_scene(tmp_path, "toy").protocol["assumed"] if " has no " in line
    ]
    assert len(lines) == (said is not None)
    assert (said or "") in "".join(lines)


def test_axes_of_mitsuba_are_named():
    pose = {"transform_matrix": np.eye(4).tolist()}
    assert pose_in(Entry("t.json", pose, common={"from_mitsuba": False}), None, False).shape == (4, 4)
    with refused("from_mitsuba: expected poses in OpenGL's axes.*negate the first and"):
        pose_in(Entry("t.json", pose, common={"from_mitsuba": True}), None, False)


def test_an_angle_of_upright_images_is_of_the_width_or_as_told():
    entry = Entry("t.json", {"camera_angle_x": WIDE})
    for longer, focal in ((False, 60), (True, 80)):
        assert camera_of(entry, (60, 80), 1, "a.png", pose=EYE, longer=longer).fx == pytest.approx(focal)
    assert camera((60, 80), fl_x=80, camera_angle_x=WIDE).fx == 80  # fl_x tells which side it is of


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"camera_angle_x": WIDE, "fl_x": 120}, "camera_angle_x: expected .* as fl_x says, but got .*remove"),
        ({"fl_x": 300, "cx": 160, "cy": 120}, r"cx: expected a principal point inside .*larger images"),
        ({"fl_x": 80, "is_fisheye": True}, "is_fisheye: expected a pinhole camera"),
        ({"fl_x": 160, "cx": 80, "cy": 60, "w": 80, "h": 60}, r"cx: expected .* images 2 times as large"),
        ({"fl_x": 107, "cx": 53.3, "cy": 40}, "cx: expected w and h .* if resized, multiply .* by 0.7505"),
        ({"fl_x": 60, "cx": 30, "cy": 22.5}, "cx: expected w and h .* if resized, multiply .* by 1.333"),
        (
            {"common": {"cameras": {"0": {"fl_x": 80}}}},
            "got cameras, which is not read; write fl_x, fl_y, cx",
        ),
        (
            {"common": {"cameras": [{"K": TRANSPOSED}]}},
            "got cameras, which is not read; write fl_x, fl_y, cx",
        ),
        ({"fl_x": 80, "k5": 0.1}, "k5: expected 0, but got 0.1; undistort"),
        ({"fl_x": 80, "distortion_params": [0.1, 0, 0, 0, 0, 0]}, "params: expected a lens as k1 k2"),
        ({}, "expected fl_x or camera_angle_x, but got neither"),
        ({"fl_x": 5, "k1": 0.105, "k2": -0.088}, "k1: .* lens .* images 166 degrees wide; if fl_x is in mil"),
        (
            {"intrinsics": TRANSPOSED},
            r"intrinsics: expected .* last row 0 0 1, but got \[\[80.*; transpose it",
        ),
        ({"camera_intrinsics": sum(TRANSPOSED, [])}, "camera_intrinsics: expected .*; transpose it"),
        ({"intrinsics": [80, 80, 40, 30]}, r"intrinsics: .*got \[80, 80, 40, 30\]; write it as fl_x, fl_y"),
        ({"K": {"fx": 80}}, "K: expected fl_x or camera_angle_x, .*; write it as fl_x, fl_y, cx and cy"),
        ({"fov_x": 50}, "fov_x: expected fl_x or camera_angle_x, .*; call it camera_angle_x, in radians"),
        ({"vfov": 50}, "vfov: .*; call it camera_angle_y, in radians"),
        ({"fx": 80}, "fx: expected fl_x or .*; call it fl_x, in pixels"),
        ({"camera_angle_x": 50}, "expected radians .*, but got 50; if it is in degrees, write 0.872665"),
        (
            {"fl_x": 0.5},
            "fl_x: expected a focal length in pixels, .* but got 0.5; if fl_x is in millim.* by w",
        ),
        ({"fl_x": 1.07, "cx": 0.5, "cy": 0.5}, "shares of the size: multiply cx and fl_x by the width"),
        ({"fl_x": "80"}, "fl_x: expected a number .*got '80'; write it without quotes"),
        ({"fl_x": 80, "w": 160, "h": 120}, "but got 80 x 60; multiply w, h, fl_x, fl_y, cx and cy by 0.5"),
        ({"fl_x": 80, "w": 100, "h": 60}, "but got 80 x 60; write w and h of the images"),
        ({"camera_angle_y": 0.0}, r"camera_angle_y: expected radians inside \(0, pi\)"),
        ({"fl_x": 80, "lens_model": "OPENCV_FISHEYE"}, "lens_model: expected a pinhole camera"),
        ({"fl_x": 80, "common": {"camera_type": "PANO"}}, r"camera_type: .*pinhole camera, but got 'PANO'"),
        ({"fl_x": 80, "type": "equirectangular"}, r"\.type: expected a pinhole camera"),
        ({"fl_x": 80, "projection": "ORTHO"}, "projection: expected a pinhole camera"),
        ({"fl_x": 80, "fisheye": True}, "fisheye: expected a pinhole camera"),
    ],
)
def test_intrinsics_that_cannot_be_right_are_named(keys, said):
    with refused(said):
        camera(**keys)


@pytest.mark.parametrize(("angle", "said"), [(2 * math.atan(0.375), 0), (WIDE, 1)])
def test_a_vertical_angle_that_contradicts_is_told(angle, said, tmp_path):
    entry = Entry("t.json", {"fl_x": 80, "camera_angle_y": angle})
    lines = left_aside([(entry, camera(**entry.own))])
    assert len(lines) == said
    assert all("_y: 53.1 degrees left aside, as the other keys say 41.1" in line for line in lines)


@pytest.mark.parametrize("angle", [41.0, "41", True, [1], 0, 10**400])
def test_a_vertical_angle_that_is_none_is_told_and_never_refused(angle):
    entry = Entry("t.json", {"fl_x": 80}, common={"camera_angle_y": angle})
    assert left_aside([(entry, camera(**entry.own))]) == []  # a frame's own number wins
    entry = Entry("t.json", {}, common={"fl_x": 80, "camera_angle_y": angle})
    (line,) = left_aside([(entry, camera(fl_x=80))])
    assert ", no radians inside (0, pi), left aside, as the other keys say 41.1 degrees; write fl_y" in line


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["images/0001", "images/0002", "images/0005"], [0, 0.25, 1]),
        (["cam00/0003", "cam00/0007", "cam01/0003", "cam01/0007"], [0, 1, 0, 1]),
        (["f_001_cam0", "f_001_cam1", "f_002_cam0", "f_002_cam1"], [0, 0, 1, 1]),
        (["images_train/0001", "images_train/0005", "images_test/0003"], [0, 1, 0.5]),
        (["b", "a", "c"], [0.5, 0, 1]),
        (["a/1", "a/01", "b/7"], [0.0, 0.5, 1.0]),  # one number twice: no frame's
        (["rgb/1305031102.9", "rgb/1305031103.15", "rgb/1305031103.4"], [0, 0.5, 1]),  # seconds
        (["7.500000", "8.000000", "9.500000"], [0, 0.25, 1]),
        (["PXL_20240501_235959500", "PXL_20240502_000000500", "PXL_20240502_000003500"], [0, 0.25, 1]),
        (["frame_00001_0", "frame_00001_1", "frame_00003_0", "frame_00003_1"], [0, 0, 1, 1]),  # faces
    ],
)
def test_times_that_a_file_does_not_tell_are_in_the_names(names, times):
    found, told = times_of(names, [None] * len(names), "t.json")
    assert sorted(found) == pytest.approx(sorted(times))
    assert found == pytest.approx(times) or names[0] == "a/1"
    assert told.startswith("t.json: no time in the frames: ")
    assert times_of(names, times, "t.json") == (times, None)
    same, line = times_of(names, [7] * len(names), "t.json")
    assert (same, line) == ([0] * len(names), "t.json: all times lie from 7 to 7: taken as one moment")
    _, line = times_of(names, [0.1, *[0.102] * (len(names) - 1)], "t.json")
    assert "all times lie from 0.1 to 0.102" in line


def test_splits_that_disagree_or_overlap_are_named(tmp_path):
    folder = write_dnerf(tmp_path / "toy", test=dnerf_shots(5, 2, (6, 8)))
    files = [folder / f"transforms_{split}.json" for split in ("test", "train")]
    test, train = (json.loads(file.read_text()) for file in files)
    (folder / "transforms_test.json").write_text(json.dumps(train))
    (line,) = dnerf.read_scene(tmp_path, "toy").protocol["assumed"]
    assert line.startswith(f"{folder}: 4 test images are trained on, too")
    twice = test | {"frames": [*test["frames"], test["frames"][0]]}
    (folder / "transforms_test.json").write_text(json.dumps(twice))
    with refused("test: expected each image once, but got r_0.png twice"):
        dnerf.read_scene(tmp_path, "toy")
    for frame, pose in zip(test["frames"], around(5)):  # OpenCV's axes
        frame["transform_matrix"] = pose.tolist()
    (folder / "transforms_test.json").write_text(json.dumps(test))
    as_in = "{} images: .* look away from one point; write them as in transforms_{}.json"
    with refused(as_in.format("test", "train")):
        dnerf.read_scene(tmp_path, "toy")
    for frame, pose in zip(test["frames"], around(5)):
        frame["transform_matrix"] = (pose @ torch.from_numpy(FLIP)).tolist()
    for frame, pose in zip(train["frames"], around(7)):
        frame["transform_matrix"] = pose.tolist()
    for file, content in zip(files, (test, train)):
        file.write_text(json.dumps(content))
    with refused(as_in.format("train", "test")):
        dnerf.read_scene(tmp_path, "toy")


@pytest.mark.parametrize("axes", ["opencv", "opengl"])
def test_keys_mend_poses_written_in_another_way(axes, tmp_path):
    write_dnerf(tmp_path / "toy")
    expected = dnerf.read_scene(tmp_path, "toy")

    def rewrite(content):
        for frame in content["frames"]:
            pose = np.array(frame["transform_matrix"])
            frame["transform_matrix"] = np.linalg.inv(pose @ FLIP if axes == "opencv" else pose).tolist()

    for split in ("train", "val", "test"):
        edit(tmp_path / "toy" / f"transforms_{split}.json", rewrite)
    scene = dnerf.read_scene(tmp_path, "toy", axes=axes, inverse=True)
    for frame, other in zip(scene.train, expected.train):
        torch.testing.assert_close(frame.camera.camera_to_world, other.camera.camera_to_world)


def test_times_in_any_unit_and_matrices_of_three_rows(tmp_path):
    folder = write_dnerf(tmp_path / "toy")
    expected = dnerf.read_scene(tmp_path, "toy")

    def rewrite(content):
        for frame in content["frames"]:
            frame["time"] = 3000 + 40 * frame["time"]
            del frame["transform_matrix"][3]

    for split in ("train", "val", "test"):
        edit(folder / f"transforms_{split}.json", rewrite)
    scene = dnerf.read_scene(tmp_path, "toy")
    assert scene.times == pytest.approx(expected.times)
    assert scene.protocol["assumed"] == [f"{folder}: all times lie from 3000 to 3040: taken as 0 to 1"]
    for frame, other in zip(scene.train, expected.train):
        assert torch.equal(frame.camera.camera_to_world, other.camera.camera_to_world)


def test_times_that_miss_0_and_1_by_rounding_are_not_scaled():
    names = ["a", "b", "c"]
    assert times_of(names, [-1e-17, 0.5, 1.0000000000000002], "t.json") == ([0, 0.5, 1], None)
    assert "0 to 1.01: taken as" in times_of(names, [0, 0.5, 1.01], "t.json")[1]


@pytest.mark.parametrize(
    ("train", "test", "said"),
    [
        ([0, 0.5, 33.3, 0.7], [1], r"time of train/2: expected a time near all others, 0 to 1, .* 33.3;"),
        ([0, *(1000 + i for i in range(19))], [1000.5], "time of train/0: expected .* 1000 to 101., .* 0;"),
        ([i / 18 for i in range(19)], [44.0, 55.0], "time of test/1: expected .* 0 to 1, but got 55"),
        ([0, 0.5, 1], [0, 50, 100], r"times of train frames: expected one .* 0 to 100, .* 0 to 1 \(train/0"),
        ([0, 50, 100], [0, 0.5, 1], "times of test frames: expected one unit .* write all times in one unit"),
        ([i / 9 for i in range(10)], range(16), r"train frames: expected one unit .* 0 to 15, .* 0 to 1 \("),
        ([0, 0.2, -1, 0.6, 0.8], [0.5, 1], "train/2: expected a time near all others, 0 to 1, .* -1;"),
        ([*range(20), -99], [20], "time of train/20: expected a time near all others, 0 to 20, but got -99;"),
        ([*[-1] * 10, *(i / 20 for i in range(20))], [1], "train/0: expected .* 0 to 1, but got -1;"),
        ([*(i / 20 for i in range(20)), 5], [1], "time of train/20: expected .* 0 to 1, but got 5;"),
    ],
)
def test_times_in_two_units_are_refused(train, test, said):
    times = {"train": train, "test": test}
    with refused(said):
        check_times({k: {f"{k}/{i}": t for i, t in enumerate(of)} for k, of in times.items()}, "t.json")


@pytest.mark.parametrize(
    ("train", "test"),
    [
        ([0, 0.01, 0.02, 1], [0.5]),  # as they are
        ([0, 1000], [0, 1]),
        ([None, None], [None]),
        (range(0, 3000, 33), [2901, 2934, 2967]),  # the last moments are tested on
        ([7, 7, 7], [0, 100]),
        ([0, 0.5, 1, 1.5, 3], [2]),
        ([0, 0.4, 0.8, 1], [1.1, 1.2]),  # seconds
        ([i / 30 for i in range(32)], [32 / 30]),
        (range(-1, 99), [50]),
        ([*(i / 25 for i in range(26)), 1.2, 1.24], [0.5]),  # a pause
        ([-0.5, *(i / 10 for i in range(30))], [0.5]),
    ],
)
def test_times_in_one_unit_are_not_refused(train, test):
    times = {"train": train, "test": test}
    check_times({k: {f"{k}/{i}": t for i, t in enumerate(of)} for k, of in times.items()}, "t.json")


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([*range(9), 0, *range(10, 20)], "time 0 of f/0009 is out of the order of the images' names; mend"),
        ([*range(9), -1, *range(10, 20)], "time -1 of f/0009 is out of the order"),
        ([0, 0.1, 0.2, 33.0, 0.4, 0.5, 0.6, 0.7], "time 33 of f/0003 is out of the order"),
        ([0.0] * 19 + [1.0], r"19 of 20 images have one time, 0 \(f/0000, f/0001, ..\); mend it"),
        ([*range(9), 8, *range(10, 20)], r"2 of 20 images have one time, 8 \(f/0008, f/0009, ..\); mend it"),
        ([*range(10), *range(10)], None),
        ([i // 2 for i in range(20)], None),
        ([*range(20)][::-1], None),
        ([3, 0, 2, 1], None),  # in no order
    ],
)
def test_an_odd_time_among_those_of_a_film_is_said(times, said):
    _, line = times_of([f"f/{i:04d}" for i in range(len(times))], times, "t.json")
    assert re.search(said, line) if said else "mend it" not in (line or "")


@pytest.mark.parametrize(
    ("test", "is_refused"), [(range(20), True), (range(0, 160, 8), False), (range(40), False)]
)
def test_a_split_that_counts_its_own_images_is_refused(test, is_refused):
    """Of a film of 160 images every 8th is tested on; of a list of 40 the first are."""
    shown = [8 * n for n in test] if is_refused else [*test]
    at = {"train": [n for n in range(160) if n not in shown], "test": shown}
    times = {"train": at["train"], "test": test}
    names = {split: [f"{split}/{i}" for i in range(len(of))] for split, of in times.items()}
    pose = [torch.eye(4, dtype=torch.float64) for _ in range(160)]
    for n in range(160):
        pose[n][0, 3] = 0.1 * n
    cameras = {}
    for split, of in at.items():
        for name, n in zip(names[split], of):
            cameras[name] = Camera(8, 8, 9.0, 9.0, 4.0, 4.0, pose[n], 0.0, 1.0)
    given = {split: dict(zip(names[split], of)) for split, of in times.items()}
    with (
        refused(
            "times of test frames: expected one numbering of all images, 0 to 159, but got 0 to 19, where"
        )
        if is_refused
        else nullcontext()
    ):
        check_times(given, "t.json", cameras)


@pytest.mark.parametrize("unit", [1, 1 / 40])
def test_times_of_splits_numbered_together_that_count_themselves_are_refused(unit):
    def given(train, test, of=None):
        splits, length = {"train": train, "test": test}, {"train": 40, "test": of}
        scaled = {k: 40 * unit / (length[k] or 40) for k in splits}
        return {
            k: {f"{k}/r_{n:03d}": scaled[k] * (n if of is None else i) for i, n in enumerate(ns)}
            for k, ns in splits.items()
        }

    between, after = [n for n in range(40) if n % 8 != 4], range(40, 50)
    with refused(
        r"times of test frames: expected \S+ to \S+ by their numbers, .*; count all images together"
    ):
        check_times(given(between, range(4, 40, 8), 5), "t.json")
    (line,) = check_times(given(range(40), after, 10), "t.json")
    assert re.search("as of images counted by themselves, .*; if all are of one film, count all", line)
    for train, test, of in (
        (range(40), range(10), 10),
        (between, range(4, 40, 8), None),
        (range(40), after, None),
    ):
        assert check_times(given(train, test, of), "t.json") == []  # each from 0, and all together


def test_times_under_another_key_are_named(tmp_path):
    folder = write_dnerf(tmp_path / "toy")
    for file in folder.glob("*.json"):
        edit(file, lambda c: [f.update(timestamp=f.pop("time")) for f in c["frames"]])
    pattern = r"(?P<camera>\w+)/r_(?P<frame>\d+)"
    lines = dnerf.read_scene(tmp_path, "toy", name_pattern=pattern).protocol["assumed"]
    assert f"{folder}/transforms_train.json: timestamp of the frames is not read; call it" in lines[0]
    assert "taken from the images' names by data.name_pattern" in lines[-1]


def test_what_is_not_there_is_left_out_and_told(tmp_path):
    folder = write_dnerf(tmp_path / "toy", size=(6, 8))
    (folder / "train" / "r_1.png").unlink()
    shutil.rmtree(folder / "test")
    scene = dnerf.read_scene(tmp_path, "toy")
    assert len(scene.train) + len(scene.test) == 3
    assert len(scene.test) == 1
    first, second, third = scene.protocol["assumed"]
    assert "1 of 4 images are not there and left out (r_1.png" in first
    assert "transforms_test.json: none of its 3 images is there" in second
    assert "every 8th training image is tested on instead (1; data.test_every)" in third
    (folder / "transforms_test.json").unlink()
    assert len(dnerf.read_scene(tmp_path, "toy").test) == 1
    shutil.rmtree(folder / "train")
    with refused("expected the images that it lists, as .*r_0.png, but got none of them"):
        dnerf.read_scene(tmp_path, "toy")


def moved(folder, shift, factor):
    def change(content):
        for frame in content["frames"]:
            for row, by in zip(frame["transform_matrix"], shift):
                row[3] = factor * row[3] + by

    for file in folder.glob("transforms_*.json"):
        edit(file, change)


@pytest.mark.parametrize(
    ("shift", "factor"), [((7, -3, 1), 1), *(((0, 0, 0), by) for by in (3.5, 1e6, 1e-6))]
)
def test_a_scene_of_other_units_is_moved_to_where_the_published_ones_are(shift, factor, tmp_path):
    folder, grey = tmp_path / "toy", np.full((8, 8, 4), 200, np.uint8)
    shots = [dnerf.Shot(f"r_{i}", i / 11, pose, grey) for i, pose in enumerate(around(12))]
    dnerf.write_scene(folder, {"train": shots, "test": shots[:2]}, camera_angle_x=0.7)
    as_is = dnerf.read_scene(tmp_path, "toy", box="auto")
    assert (as_is.train[0].camera.near, as_is.train[0].camera.far) == (2, 6)
    assert as_is.box.high == (1.5, 1.5, 1.5)
    moved(folder, shift, factor)
    scene = dnerf.read_scene(tmp_path, "toy", box="auto")
    check_seen(scene)
    distances = [float(frame.camera.center.norm()) for frame in scene.train]
    assert distances == pytest.approx([4.0] * 12, rel=1e-4)
    assert max(map(abs, (*scene.box.low, *scene.box.high))) < 8
    with refused(r"expected a box that cameras see .*cameras look at \("):
        _ = DNeRFDataModule(tmp_path, "toy", box=[v * factor for v in (30, 30, 30, 31, 31, 31)]).scene


def test_images_with_and_without_alpha_are_not_mixed(tmp_path):
    from forewarp.data.images import write_image

    write_dnerf(tmp_path / "toy")
    write_image(tmp_path / "toy" / "train" / "r_2.png", np.zeros((6, 8, 3), np.uint8))
    with refused(r"in all images or in none, but got 1 of 9 without, as .*r_2.png"):
        dnerf.read_scene(tmp_path, "toy")


@pytest.mark.parametrize(
    ("there", "said"),
    [
        ("R_1.PNG", r"left out \(r_1.png, ..\); train/R_1.PNG is there$"),
        ("r_0001.png", "; train/r_0001.png is there$"),
        ("r_1.webp", "; train/r_1.webp is there: convert it to PNG or JPEG$"),
        ("r_12.png", r"left out \(r_1.png, ..\)$"),
    ],
)
def test_a_missing_image_of_nearly_that_name_is_named(there, said, tmp_path):
    folder = write_dnerf(tmp_path / "toy")
    (folder / "train" / "r_1.png").rename(folder / "train" / there)
    (line,) = dnerf.read_scene(tmp_path, "toy").protocol["assumed"]
    assert re.search(said, line)


def test_a_missing_folder_of_nearly_that_name_is_named(tmp_path):
    folder = write_dnerf(tmp_path / "toy")
    (folder / "train").rename(folder / "Train")
    with refused("got none of them; toy/Train is there"):
        dnerf.read_scene(tmp_path, "toy")
    (folder / "transforms_train.json").rename(folder / "Transforms_Train.json")
    with refused("with transforms_train.json, but got none; toy/Transforms_Train.json is"):
        dnerf.read_scene(tmp_path, "toy")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32", "utf-8-sig"])
def test_files_of_other_encodings_are_read_or_named(encoding, tmp_path):
    file = write_dnerf(tmp_path / "toy") / "transforms_train.json"
    text = file.read_text().replace("{", '{\n"author": "José", ', 1)
    file.write_bytes(text.encode(encoding))
    assert len(dnerf.read_scene(tmp_path, "toy").train) == 4
    file.write_bytes(text.encode("latin-1"))
    with refused("train.json: line 2: expected text in UTF-8, .* 0xe9, as of Latin-1; sav"):
        dnerf.read_scene(tmp_path, "toy")


def test_files_of_windows_and_images_of_any_suffix(tmp_path):
    folder = write_dnerf(tmp_path / "toy")
    (folder / "train" / "r_0.png").rename(folder / "train" / "r_0.PNG")
    edit(folder / "transforms_train.json", {"frames.1.file_path": "train\\r_1.png"})
    file = folder / "transforms_train.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert [frame.name for frame in dnerf.read_scene(tmp_path, "toy").train][:2] == ["train/r_0", "train/r_1"]


def test_another_layout_is_named(tmp_path):
    write_dnerf(tmp_path / "toy")
    assert layout_of(tmp_path / "toy") == "D-NeRF"
    with refused("this is a scene in the layout of D-NeRF: use experiment=dnerf"):
        posed_video.read_scene(tmp_path, "toy")


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("toy/keyframes/images/1.jpg", "keyframes is of Polycam's raw data: ns-process-data polycam"),
        ("toy/EXR_RGBD/rgb/0.png", "EXR_RGBD is of Record3D's EXR export: export .r3d instead"),
        ("toy/x_droid.npz", "of MegaSaM: write its cameras and images as transforms.json"),
        ("toy_sgd_cvd_hr.npz", "of MegaSaM: write"),
        ("toy/train_meta.json", "CMU Panoptic"),
    ],
)
def test_what_other_programs_leave_names_the_way(tmp_path, file, said):
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).touch()
    for reader in (dnerf, posed_video):
        with refused(said):
            reader.read_scene(tmp_path, "toy")


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (np.eye(4).flatten().tolist(), "write it as four rows of four numbers"),
        (np.eye(4)[:3].flatten().tolist(), "write it as three rows of four numbers"),
        (np.eye(4).astype(str).tolist(), "write its numbers without quotes"),
    ],
)
def test_poses_written_in_another_way_are_refused_with_the_mend(matrix, said):
    with refused(f"transform_matrix: expected 4 x 4 or 3 x 4 finite numbers, but got .*; {said}"):
        pose_in(Entry("t.json", {"transform_matrix": matrix}), None, False)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"cameras": {"0": {"fl_x": 80}}}, "cameras: not read, which seems to be of each camera; write fl_x"),
        ({"sensors": [{"id": 0, "focal_length": 80}]}, "sensors: not read, which seems to be of each camera"),
        (
            {"frames.3.fx": 40.0},
            "frames: fx: not read, which seems to be of the camera; call a focal length in",
        ),
        (
            {"frames.0.fov": 60},
            "frames: fov: not read, which seems to be of the camera; call a focal length in",
        ),
        ({"white_transparent": True}, "white_transparent: not read; where images show their background, cut"),
        ({"white_transparent": False, "cameras": [{"id": 0, "place": [0, 0, 0]}]}, None),
        (
            {"test_frames": [{"file_path": "a.png"}]},
            "test_frames: not read, which seem to say what is trained",
        ),
        ({"frames.0.split": "val"}, "split: not read, which seem to say what is trained and tested on; name"),
        ({"frames.0.is_bad": True}, "and remove frames that are bad"),
        ({f"frames.{i}.is_bad": False for i in range(10)} | {"splits": {}}, None),
        ({"depth_file_path": "a.npy"}, "depth_file_path at the top is not read; write that of each frame"),
    ],
)
def test_keys_of_cameras_and_of_backgrounds_that_are_not_read_are_named(tmp_path, keys, said):
    edit(write_video(tmp_path / "toy") / posed_video.FILE, keys)
    lines = [
        line for line in posed_video.read_scene(tmp_path, "toy").protocol["assumed"] if "not read" in line
    ]
    assert len(lines) == (said is not None)
    assert (said or "") in "".join(lines)
