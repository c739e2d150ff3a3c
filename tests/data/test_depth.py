"""Depth that other programs give: of any size, metric or but for a scale and a shift."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from forewarp.data.depth import (
    SensedDepth,
    confidence_of,
    depths_beside,
    doubt_depths,
    line_through,
    read_depth,
)
from forewarp.data.posed_video import FILE, read_scene
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame
from tests.support.room import shown, walk
from tests.support.written_scenes import edit, refused, write_video


def camera_of(width=32, height=24):
    pose = torch.eye(4, dtype=torch.float64)
    return Camera(width, height, 30.0, 30.0, width / 2, height / 2, pose, 0.1, 9.0)


def wall(camera):
    """Depth (H, W) of a wall aslant, and points on it."""
    column = np.arange(camera.width) + 0.5
    depth = np.tile(2 + column / camera.width, (camera.height, 1))
    row, column = np.mgrid[1 : camera.height : 4, 1 : camera.width : 4]
    z = torch.from_numpy(depth[row, column])[..., None]
    u, v = (torch.from_numpy(n + 0.5)[..., None] for n in (column, row))
    points = torch.cat([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    return depth, points.reshape(-1, 3).float()


def along_axis(planes, camera):
    return planes[0] * camera.rays().directions[:, 2].reshape(planes[0].shape)


@pytest.mark.parametrize(("kind", "shift"), [("relative", -3.0), ("inverse", -0.2)])
def test_scale_and_shift_follow_from_known_points(tmp_path, kind, shift):
    camera = camera_of()
    depth, points = wall(camera)
    hidden = points[:14] * 1.5  # as many behind the wall, a third of the others
    values = 4.0 * (depth if kind == "relative" else 1 / depth) + shift
    values[3, 5] = np.nan
    np.save(tmp_path / "a.npy", values)
    given = {"kind": kind, "known": torch.cat([points, hidden, -points])}
    planes = SensedDepth(tmp_path / "a.npy", camera, **given)()
    expected = torch.from_numpy(depth).float()
    expected[3, 5] = 0
    torch.testing.assert_close(along_axis(planes, camera), expected, rtol=1e-4, atol=0)
    assert torch.equal(planes[1] > 0, expected > 0)
    for few in (points[:9], points * torch.linspace(0.2, 5, len(points))[torch.randperm(len(points)), None]):
        assert not SensedDepth(tmp_path / "a.npy", camera, **given | {"known": few})().any()


def test_the_largest_number_of_a_png_is_a_hole_and_one_channel_may_come_first(tmp_path):
    values = np.full((6, 8), 2000, np.uint16)
    values[:2] = 65535
    Image.fromarray(values).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", values[None])
    for name in ("a.png", "a.npy"):
        assert np.array_equal(read_depth(tmp_path / name), np.where(values == 2000, 2000.0, 0.0))
    np.save(tmp_path / "b.npy", values.astype(np.float32))
    assert read_depth(tmp_path / "b.npy").max() == 65535  # of other numbers far tells it
    assert read_depth(tmp_path / "a.png", signed=True).max() == 65535


def told_of(folder, depth, **options):
    """The folder's scene, with one depth for all images, and what is said of depths."""
    (folder / "lidar").mkdir(exist_ok=True)
    for i in range(1, 11):
        if depth.dtype == np.uint16:
            Image.fromarray(depth).save(folder / "lidar" / f"frame_{i}.png")
        else:
            np.save(folder / "lidar" / f"frame_{i}.npy", depth)
    scene = read_scene(folder.parent, folder.name, depth="lidar", **options)
    return scene, [line for line in scene.protocol["assumed"] if "depth" in line.partition(": ")[2]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("none", "why"),
    [
        (1000.0, "1000, beyond far, 120: taken for holes; set data.far if they are right"),
        (131.07, "131.07, beyond far, 120"),
        (1e10, "1e+10, beyond far, 120"),
        (np.finfo(np.float32).max, "3.40282e+38, the largest of their type"),
        (65504, "65504, beyond far, 120"),
    ],
)
def test_a_number_for_no_depth_is_a_hole_and_said(tmp_path, none, why):
    folder = write_video(tmp_path / "toy")
    depth = np.full((20, 30), 40.0, np.float32) + np.arange(30, dtype=np.float32) / 30
    depth[:15, :20] = none  # half of them
    scene, lines = told_of(folder, depth)
    assert re.search(f"50.00% of the depths looked at are {re.escape(why)}", "".join(lines))
    assert len(lines) == 1
    for frame in scene.train:
        distance, trust = frame.load_sensed()
        assert not distance[:15, :20].any()
        assert not trust[:15, :20].any()
        assert distance[15:].all()
    assert told_of(folder, np.where(depth > 100, 0, depth))[1] == []


@pytest.mark.slow
def test_few_depths_far_beyond_far_are_holes_and_those_just_beyond_it_are_kept(tmp_path):
    folder = write_video(tmp_path / "toy")
    depth = np.linspace(40, 150, 600, dtype=np.float32).reshape(20, 30)
    depth[0, 0] = 1300.0
    (frame, *_), (line,) = told_of(folder, depth)[0].train, told_of(folder, depth)[1]
    assert "0.17% of the depths looked at are 1300, beyond far" in line
    assert (frame.load_sensed()[0] == 0).sum() == 1


@pytest.mark.slow
def test_full_numbers_of_a_png_are_said_and_the_unit_that_fits_is_named(tmp_path):
    folder = write_video(tmp_path / "toy")
    depth = np.full((20, 30), 40_000, np.uint16)
    depth[:2] = 65535
    assert "10.00% of the depths looked at are 65535, the largest of their" in told_of(folder, depth)[1][0]
    scene, lines = told_of(folder, depth, depth_scale=1.0)
    assert lines[1].endswith(
        "depth is 4e+04 in the median, with near at 20 and far at 120; set data.depth_scale=0.001"
    )
    (folder / "lidar" / "frame_1.png").unlink()
    for value, unit in ((40_000.0, "0.001"), (20.5 * 256, "0.01 or 0.003906"), (0.7, "100")):
        lines = told_of(folder, np.full((20, 30), value))[1]
        assert [line.rpartition("=")[2] for line in lines] == [unit]
    assert "set data.depth_scale=4e+06 to" in told_of(folder, np.full((20, 30), 5e-6))[1][0]


def test_points_that_never_move_tell_the_unit_of_depth(tmp_path):
    camera = camera_of()
    depth, points = wall(camera)
    load = SensedDepth(tmp_path / "a.npy", camera, known=points)
    image = torch.zeros(24, 32, 4, dtype=torch.uint8)
    frame = Frame("a", 0.0, camera, lambda: image, load_sensed=load)
    np.save(tmp_path / "a.npy", depth * 37.0)
    (line,) = doubt_depths([frame], 1.0, None, "toy", "set data.depth_scale={}")
    assert "set data.depth_scale=0.02703, or data.depth_kind=inverse" in line
    np.save(tmp_path / "a.npy", depth)
    assert doubt_depths([frame], 1.0, None, "toy", "") == []


STRETCHED = {  # how depths of three images are changed, and what is said of them
    "to 16 bits": (
        lambda d, k: np.uint16(65535 * (d - d.min()) / np.ptp(d)),
        "of each is 65535, of few pixels",
    ),
    "to 1": (lambda d, k: d / d.max(), "of each is 1, of few pixels; do so"),
    "to ends of its own": (
        lambda d, k: (2 + k) * (d - 1),
        "points that never move fit each with another scale",
    ),
    "a number for none": (lambda d, k: np.uint16(np.where(d < d.max(), 1000 * d, 65535)), None),
    "one unit": (lambda d, k: np.uint16(1000 * d), None),
    "one moved point": (lambda d, k: d + 0.3 * (d > 2.9), None),
}


@pytest.mark.parametrize("how", STRETCHED)
def test_depths_that_were_stretched_each_by_itself_are_named(tmp_path, how):
    (change, said), camera, frames = STRETCHED[how], camera_of(), []
    depth, points = wall(camera)
    depth[5, -1] += 0.02  # alone the largest
    image = torch.zeros(24, 32, 4, dtype=torch.uint8)
    for k in range(3):
        np.save(tmp_path / f"{k}.npy", values := change(depth, k))
        known = points if "own" in how or "one" in how else None
        load = SensedDepth(
            tmp_path / f"{k}.npy", camera, 1e-3 if values.dtype == np.uint16 else 1.0, known=known
        )
        frames.append(Frame(str(k), k / 2, camera, lambda: image, load_sensed=load))
    lines = doubt_depths(frames, 1.0, None, "toy", "set data.depth_scale={}", stretched="do so")
    assert any("different images seem to have different units" in line for line in lines) == bool(said)
    assert (said or "") in lines[0] if said else True


def test_a_line_needs_points_that_agree():
    given = np.arange(30.0)
    assert line_through(given[:9], given[:9] + 1) is None
    assert line_through(given, 40 - given) is None  # what falls is no depth
    assert line_through(np.ones(30), given + 1) is None
    a, b = line_through(1e11 * given, given + 2)
    assert (a, b) == (pytest.approx(1e-11), pytest.approx(2))  # of values of any size


@pytest.mark.slow
def test_depth_of_a_video_is_in_the_units_of_its_poses(tmp_path):
    folder = write_video(tmp_path / "toy")
    (tmp_path / "lidar").mkdir()
    (tmp_path / "confidence").mkdir()
    values = np.full((10, 15), 40_000, np.uint16)
    values[0] = 0
    for i in (1, 2):
        Image.fromarray(values).save(tmp_path / "lidar" / f"frame_{i}.png")
    Image.fromarray(np.full((10, 15), 2, np.uint8)).save(tmp_path / "confidence" / "frame_2.png")
    np.save(tmp_path / "lidar" / "frame_3.npy", np.full((10, 15, 1), 40.0, np.float32))
    scene = read_scene(tmp_path, "toy", depth=str(tmp_path / "lidar"))
    assert scene.protocol["depth"] == "axis, of 3 of 9 training frames"
    frames = {frame.name: frame for frame in (*scene.train, *scene.test)}
    units = scene.protocol["normalisation"]["scale"]
    for i in (1, 2, 3):
        frame = frames[f"images/frame_{i}"]
        axis = frame.camera.camera_to_world[:3, 2].float()
        along = (frame.load_sensed()[0].flatten() * (frame.camera.rays().directions @ axis)).reshape(20, 30)
        assert along[5, 7].item() == pytest.approx(40 * units, rel=1e-5)
        assert bool(along[:2].any()) == (i == 3)
    assert frames["images/frame_4"].load_sensed is None
    larger = read_scene(tmp_path, "toy", depth=str(tmp_path / "lidar"), depth_scale=2e-3).train[0]
    torch.testing.assert_close(larger.load_sensed()[0], 2 * frames[larger.name].load_sensed()[0])
    edit(folder / FILE, {"depth_unit_scale_factor": 2e-3})
    scaled = read_scene(tmp_path, "toy", depth=str(tmp_path / "lidar"))
    torch.testing.assert_close(scaled.train[0].load_sensed(), larger.load_sensed())
    assert not [line for line in scaled.protocol["assumed"] if "depth_unit" in line]
    edit(folder / FILE, {"depth_scale": 1e-3})
    with refused("depth_scale: expected the unit that depth_unit_scale_factor says, 0.002, but got 0.001"):
        read_scene(tmp_path, "toy", depth=str(tmp_path / "lidar"))
    edit(folder / FILE, {"depth_unit_scale_factor": None, "depth_scale": 2e-3})  # as RealSense writes it
    scaled = read_scene(tmp_path, "toy", depth=str(tmp_path / "lidar"))
    torch.testing.assert_close(scaled.train[0].load_sensed(), larger.load_sensed())
    edit(folder / FILE, {"depth_scale": None})
    edit(folder / FILE, {"frames.0.depth_file_path": "../lidar/frame_1.png"})
    with refused("depth_file_path"):
        read_scene(tmp_path, "toy")
    (tmp_path / "lidar").rename(folder / "lidar")
    edit(folder / FILE, {"frames.0.depth_file_path": "lidar/frame_1.png"})
    assert read_scene(tmp_path, "toy").protocol["depth"] == "axis, of 1 of 9 training frames"
    assert "depth" not in read_scene(tmp_path, "toy", depth="off").protocol
    edit(folder / FILE, {"frames.1.depth_file_path": "lidar/none.png"})
    scene = read_scene(tmp_path, "toy")
    assert scene.protocol["depth"] == "axis, of 1 of 9 training frames"
    (line,) = (line for line in scene.protocol["assumed"] if "depth" in line.rpartition("/")[2])
    assert line.endswith("lidar/none.png: 1 of 2 depths are not there: images go without")
    edit(folder / FILE, {"frames.1.depth_file_path": "lidar/2.exr"})
    with refused(r"2.exr: expected a depth in .npy or .png, but got .exr; .*=off"):
        read_scene(tmp_path, "toy")
    edit(folder / FILE, {"frames.0.depth_file_path": "2.npy", "frames.1.depth_file_path": "2.npy"})
    np.save(folder / "2.npy", np.full((10, 15), 40.0))
    assert read_scene(tmp_path, "toy").train[0].load_sensed()[1].min() == 1


def test_confidences_lie_as_depths_do_and_a_depth_is_of_one_image(tmp_path):
    for kind in ("depth", "confidence"):
        for camera in ("cam0", "cam1"):
            (tmp_path / kind / camera).mkdir(parents=True)
            np.save(tmp_path / kind / camera / "1.npy", np.ones((2, 3)))
    np.save(tmp_path / "confidence/cam1/1.npy", np.full((1, 2, 3), 0.5))  # one channel may come first
    names = ["images/cam0/1", "images/cam1/1"]
    found = depths_beside(tmp_path / "depth", names)
    places = [confidence_of(found[name], tmp_path / "depth") for name in names]
    assert places == [tmp_path / "confidence" / camera / "1.npy" for camera in ("cam0", "cam1")]
    depth = tmp_path / "depth/cam1/1.npy"
    assert (SensedDepth(depth, camera_of(3, 2), confidence=places[1])()[1] == 0.5).all()
    np.save(tmp_path / "1.npy", np.ones((2, 3)))
    with refused("1.npy: expected a depth for each image, but got one for images/c"):
        depths_beside(tmp_path, names)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"depth": "nowhere"}, "data.depth: expected a folder of depths, but got .*nowhere; set data.depth="),
        ({"depth": "images"}, "images: expected depths|expected a grey PNG of 16 bits"),
        (
            {"depth_kind": "deep"},
            "data.depth_kind: expected axis, ray, relative, inverse or null, but",
        ),
        ({"depth": "some", "depth_kind": "inverse"}, "data.depth_kind: expected points that never move, to"),
        ({"depth": "some", "depth_scale": 0}, "data.depth_scale: expected"),
        ({"depth": False}, "data.depth: expected a folder, off or null, but got False"),
        ({"depth": "other"}, "other: expected depths named as images, frame_1.npy or .png, but got none of"),
    ],
)
def test_bad_depth_of_a_video_is_refused_in_a_line(tmp_path, options, message):
    folder = write_video(tmp_path / "toy")
    for name, file in (("some", "frame_1"), ("other", "a")):
        (folder / name).mkdir()
        np.save(folder / name / f"{file}.npy", np.ones((20, 30)))
    with refused(message) as caught:
        [frame.load_sensed() for frame in read_scene(tmp_path, "toy", **options).train if frame.load_sensed]
    assert "\n" not in str(caught.value)


def test_a_nan_of_the_signalling_kind_is_a_hole(tmp_path):
    values = np.full((2, 3), 2.0, np.float32)
    values.view(np.uint32)[0, 0] = 0x7F800001
    np.save(tmp_path / "a.npy", values)
    assert read_depth(tmp_path / "a.npy").tolist() == [[0, 2, 2], [2, 2, 2]]


# What views show of depths


@pytest.fixture(scope="module")
def room():
    return [(camera, *shown(camera)) for camera in walk()]


def read_room(folder, room, change, **options):
    """Frames of the room whose files of depth are changed, and what is said of these."""
    frames = []
    for k, (camera, image, depth) in enumerate(room):
        np.save(folder / f"{k}.npy", change(depth.copy()))
        pixels = torch.from_numpy(np.concatenate([image, np.full((*depth.shape, 1), 255, np.uint8)], 2))
        load = SensedDepth(folder / f"{k}.npy", camera, **options)
        frames.append(Frame(str(k), k / 7, camera, lambda pixels=pixels: pixels, load_sensed=load))
    return frames, doubt_depths(frames, 1.0, None, "toy", "set data.depth_scale={}")


def unseen(depth, number):
    depth[3:16, 6:26] = depth[::7, ::5] = number
    return depth


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda depth: depth, None),
        (lambda depth: np.round(depth, 3), None),
        (lambda depth: unseen(depth, 8.0), "are 8, the largest of their image, where other views do not see"),
        (lambda depth: np.minimum(depth, 3.0), "are 3, the largest of their image, where other views do not"),
        (lambda depth: unseen(depth, depth.max()), "and the like, the largest of their image, where other"),
        (lambda depth: depth[::-1], "agree much better if depths are upside down; turn them as their images"),
        (
            lambda depth: np.median(depth) ** 2 / depth,
            "if depths are disparities, 1 / depth; set data.depth_kind=",
        ),
        (lambda depth: depth[:, ::-1], "agree much better if depths are mirrored; turn them"),
        (lambda depth: depth[::-1, ::-1], "agree much better if depths are turned by half; turn them"),
        (lambda depth: 1.4 * depth, "if depths are about 0.7 times as far; set data.depth_scale=0.7"),
        (lambda depth: 0.5 * depth, "if depths are about 2 times as far; set data.depth_scale=2"),
    ],
)
def test_what_views_contradict_in_depths_is_a_hole_or_named(tmp_path, room, change, line):
    frames, lines = read_room(tmp_path, room, change)
    assert len(lines) == (line is not None)
    assert (line or "") in "".join(lines)
    is_hole = "taken for holes" in "".join(lines)
    for frame, (*_, depth) in zip(frames, room):
        file = change(depth.copy())
        expected = file < file.max() if is_hole else file > 0
        assert np.array_equal(frame.load_sensed()[0].numpy() > 0, expected)


@pytest.mark.slow
def test_transposed_depths_of_square_images_are_named(tmp_path):
    square = [(camera, *shown(camera)) for camera in walk(size=(48, 48))]
    assert "if depths are transposed; turn them" in "".join(read_room(tmp_path, square, lambda d: d.T)[1])
    assert read_room(tmp_path, square, lambda depth: depth)[1] == []


def test_a_limit_that_views_do_not_contradict_is_kept_and_said(tmp_path):
    cameras = walk(1) * 4  # a camera that stands still
    frames, (line,) = read_room(
        tmp_path, [(c, *shown(c)) for c in cameras], lambda depth: np.minimum(depth, 3)
    )
    assert line.endswith("are 3, the largest of their image; write 0 there if that is a sensor's limit")
    assert frames[0].load_sensed()[0].min() > 0


@pytest.mark.slow
def test_levels_of_confidence_are_told_by_all_files(tmp_path, room):
    for most, trust in ((2, [0, 0.5, 1]), (255, [0, 1 / 255, 2 / 255])):
        for k in range(8):
            levels = np.tile(np.array([0, 1, 2], np.uint8), (48, 1))
            levels = np.pad(levels, ((0, 0), (0, 61)), constant_values=most if k == 3 else 2)
            np.save(tmp_path / f"trust{k}.npy", levels)
        frames = [Frame("a", 0.0, c, None, load_sensed=None) for c, *_ in room]
        for k, (camera, _, depth) in enumerate(room):
            np.save(tmp_path / f"{k}.npy", depth)
            load = SensedDepth(tmp_path / f"{k}.npy", camera, confidence=tmp_path / f"trust{k}.npy")
            frames[k] = Frame(str(k), k / 7, camera, lambda: torch.zeros(48, 64, 4), load_sensed=load)
        doubt_depths(frames, 1.0, None, "toy", "")
        for frame in frames:
            assert frame.load_sensed()[1, 0, :3].tolist() == pytest.approx(trust)
    np.save(tmp_path / "trust5.npy", np.full((48, 64), 77, np.uint8))
    frames[5].load_sensed.levels = True
    with refused("trust5.npy: expected confidences from 0 to 1, .* but got .* write them alike in all files"):
        replace(frames[5].load_sensed)()
