"""A user's own capture: what is written is read, in whatever units it was taken."""

import json
import logging
import re
import shutil
import unicodedata
from dataclasses import replace

import numpy as np
import pytest
import torch

from forewarp.data.batches import Sampler
from forewarp.data.checks import remarks
from forewarp.data.images import write_image
from forewarp.data.module import PosedVideoDataModule
from forewarp.data.posed_video import FILE, PosedShot, read_scene, write_scene
from forewarp.scene.box import Box
from forewarp.scene.camera import look_at
from forewarp.scene.view import Asks
from tests.support import reference
from tests.support.written_scenes import (
    GONE,
    LENS,
    MIDDLE,
    UP,
    edit,
    noise,
    placed,
    posed_cameras,
    posed_shots,
    refused,
    say_linear,
    write_video,
)


def frames_of(scene):
    return {f.name: f for split in (scene.train, scene.val, scene.test) for f in split}


@pytest.fixture
def made(tmp_path):
    """Write ``toy`` and read it."""

    def make(**options):
        write_video(tmp_path / "toy", **options)
        return read_scene(tmp_path, "toy")

    return make


def test_round_trip(made):
    scene = made()
    frames = frames_of(scene)
    assert len(frames) == 10
    for i, shot in enumerate(posed_shots()):
        frame, expected = frames[f"images/frame_{i + 1}"], placed(scene, shot.camera)
        assert frame.time == pytest.approx(i / 9)
        torch.testing.assert_close(frame.camera.camera_to_world, expected.camera_to_world, atol=1e-9, rtol=0)
        for key in ("width", "height", "fx", "fy", "cx", "cy", "lens"):
            assert getattr(frame.camera, key) == getattr(expected, key), key
        assert np.array_equal(frame.load()[..., :3], shot.pixels)
        assert (frame.load()[..., 3] == 255).all()
    assert [f.name for f in scene.test] == ["images/frame_5"]
    assert (scene.val, scene.has_alpha, scene.canonical_time) == ((), False, pytest.approx(5 / 9))
    said = scene.protocol
    assert (said["dataset"], said["resolution"], said["test_frames"]) == ("video_with_poses", [30, 20], 1)
    assert (said["split"], said["derived"]) == ("every 8th frame held out", ["box"])
    assert said["times"] == "from the images' names"


def test_known_points_project_by_the_formats_formulas(tmp_path, made):
    """By hand: x right, y up, looking along -z, OpenCV's lens; then moved into the scene."""
    scene = made()
    content = json.loads((tmp_path / "toy" / FILE).read_text())
    assert {"fl_x", "k1", "w", "camera_model"} <= content.keys()  # what all share stands at the top
    assert content["frames"][0].keys() == {"file_path", "transform_matrix"}
    point = MIDDLE.numpy() + [3.0, -4.0, 5.0]
    known = scene.protocol["normalisation"]
    moved = torch.from_numpy((point - known["center"]) * known["scale"])
    for i, entry in enumerate(content["frames"]):
        entry = {**content, **entry}
        matrix = np.array(entry["transform_matrix"])
        local = matrix[:3, :3].T @ (point - matrix[:3, 3])
        k, p = ([entry[f"{name}{i + 1}"] for i in range(n)] for name, n in (("k", 3), ("p", 2)))
        x, y = reference.bend(local[0] / -local[2], -local[1] / -local[2], k, p)
        expected = [entry["fl_x"] * x + entry["cx"], entry["fl_y"] * y + entry["cy"]]
        camera = frames_of(scene)[f"images/frame_{i + 1}"].camera
        pixel, depth = camera.project(moved)
        assert pixel.tolist() == pytest.approx(expected, abs=1e-6)
        assert depth.item() == pytest.approx(-local[2] * known["scale"])
        ray = camera.directions(pixel[0], pixel[1])
        torch.testing.assert_close(camera.center + (moved - camera.center).norm() * ray, moved)


def test_points_that_never_move_are_in_the_scenes_units(tmp_path):
    points = np.random.default_rng(0).uniform(-20, 20, (7, 3)) + MIDDLE.numpy()
    write_scene(tmp_path / "toy", posed_shots(), near=20.0, far=120.0, points=points)
    scene = read_scene(tmp_path, "toy")
    assert scene.still.dtype == torch.float32
    frame, camera = next(iter(frames_of(scene).values())), posed_cameras(10)[0]
    before, after = camera.project(torch.from_numpy(points)), frame.camera.project(scene.still.double())
    torch.testing.assert_close(before[0], after[0], atol=1e-3, rtol=0)


PLACE = "property float x\nproperty float y\nproperty float z\n"
HEAD = "ply\nformat {} 1.0\nelement vertex {}\n" + PLACE + "end_header\n"


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_of_a_ply_are_those_of_points_npy(tmp_path, kind):
    points = np.random.default_rng(0).uniform(-20, 20, (5, 3)).astype(np.float32) + MIDDLE.numpy()
    write_scene(tmp_path / "npy", posed_shots(), near=20.0, far=120.0, points=points)
    write_scene(tmp_path / "ply", posed_shots(), near=20.0, far=120.0)
    folder, expected = tmp_path / "ply", read_scene(tmp_path, "npy").still
    order = ">" if kind == "binary_big_endian" else "<"
    table = np.zeros(5, [("red", "u1"), ("x", f"{order}f4"), ("z", f"{order}f8"), ("y", f"{order}f4")])
    for axis, values in zip("xyz", points.T):
        table[axis] = values
    head = f"ply\nformat {kind} 1.0\nelement vertex 5\nproperty uchar red\nproperty float x\n"
    head += "property double z\nproperty float y\nelement face 1\nproperty list uchar int i\nend_header\n"
    text = "\n".join(" ".join(map(str, row)) for row in table.tolist()) + "\n3 0 1 2\n"
    body = text.encode() if kind == "ascii" else table.tobytes()
    (folder / "sparse_pc.ply").write_bytes(head.encode() + body)
    torch.testing.assert_close(read_scene(tmp_path, "ply").still, expected)
    (folder / "sparse_pc.ply").rename(folder / "cloud.ply")
    edit(folder / FILE, {"ply_file_path": "cloud.ply"})
    torch.testing.assert_close(read_scene(tmp_path, "ply").still, expected)
    table["x"][3:] = np.nan
    text = "\n".join(" ".join(map(str, row)) for row in table.tolist())
    body = text.encode() if kind == "ascii" else table.tobytes()
    (folder / "cloud.ply").write_bytes(head.encode() + body)
    with refused(r"cloud.ply: expected finite numbers, but got \[nan, .* in row 3 and 2 such rows"):
        read_scene(tmp_path, "ply")
    (folder / "cloud.ply").unlink()
    scene = read_scene(tmp_path, "ply")
    assert scene.still is None
    assert any("ply_file_path names no file" in line for line in scene.protocol["assumed"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("solid\n", "whose first element is vertices, but got another file"),
        (HEAD.format("binary", 1) + "0 0 0\n", r"a PLY \(ascii, .*\) whose first .*, but got another file"),
        (HEAD.format("ascii", 1).replace("vertex", "face"), "is vertices, but got another file"),
        (HEAD.format("ascii", 1).replace(PLACE, ""), "vertices of plain numbers .*, but got none"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n",
            r"vertices of plain numbers .*, x, y, z too, but got \[\('x', 'f4'\)\]",
        ),
        (HEAD.format("binary_little_endian", 9) + "short", "expected 9 vertices, but got a file that ends"),
        (HEAD.format("ascii", 2) + "0 0 0\n1 1\n", "expected 2 vertices, but got a file that ends"),
        (HEAD.format("ascii", 2) + "0 0 0\n1 1 x\n", "vertex 1: expected 3 finite numbers, but got '1 1 x'"),
        (HEAD.format("ascii", 1).replace("float z", "list uchar int z") + "0", "vertices of plain numbers"),
    ],
)
def test_a_ply_that_cannot_be_read_is_refused(tmp_path, text, says):
    write_scene(tmp_path / "toy", posed_shots(), near=20.0, far=120.0)
    (tmp_path / "toy" / "sparse_pc.ply").write_text(text)
    with refused(says):
        read_scene(tmp_path, "toy")


def test_each_frame_may_have_its_own_camera(made):
    views = posed_cameras(5) + posed_cameras(5, size=(16, 12), lens=None)
    views[2] = replace(views[2], fx=50.0, cx=11.0)
    scene = made(views=views)
    for i, view in enumerate(views):
        frame = frames_of(scene)[f"images/frame_{i + 1}"]
        assert (frame.camera.fx, frame.camera.cx, frame.camera.lens) == (view.fx, view.cx, view.lens)
        assert tuple(frame.load().shape) == (view.height, view.width, 4)


def test_only_a_focal_length_is_needed_and_no_order(tmp_path):
    write_video(tmp_path / "toy")
    optional = ("fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2", "camera_model")
    edit(tmp_path / "toy" / FILE, dict.fromkeys(optional, GONE))
    edit(tmp_path / "toy" / FILE, lambda c: c["frames"].reverse())  # in the order of their names' numbers
    frames = frames_of(read_scene(tmp_path, "toy"))
    assert [frames[f"images/frame_{i + 1}"].time for i in range(10)] == pytest.approx(np.linspace(0, 1, 10))
    camera = frames["images/frame_1"].camera
    assert (camera.fy, camera.cx, camera.cy, camera.lens) == (camera.fx, 15, 10, None)


@pytest.mark.slow
def test_given_times_are_kept(tmp_path, made):
    times = [0.9, 0.1, 0.2, 0.3, 0.35, 0.5, 0.6, 0.7, 0.8, 0.0]
    scene = made(times=times)
    assert [frames_of(scene)[f"images/frame_{i + 1}"].time for i in range(10)] == times
    assert [f.time for f in scene.test] == [0.35]  # the fifth in time
    assert scene.protocol["times"] == "as given"
    for canonical, time in ((None, 0.5), ("middle", 0.5), ("first", 0.0), (0.85, 0.8)):
        read = PosedVideoDataModule(root=tmp_path, scene="toy", canonical=canonical).scene
        assert read.canonical_time == time
        assert read.protocol.get("canonical_time") == (None if time == 0.5 else time)  # that of the format


HELD = [(10, 2, [2, 4, 6, 8]), (10, 3, [2, 5, 8]), (13, 8, [5]), (21, 8, [5, 13]), (5, 8, [4]), (3, 8, [2])]


@pytest.mark.parametrize(("count", "every", "held"), HELD)
def test_every_nth_frame_is_held_out_but_never_the_first_or_the_last(tmp_path, count, every, held):
    write_video(tmp_path / "toy", count=count)
    scene = read_scene(tmp_path, "toy", test_every=every)
    assert [f.name for f in scene.test] == [f"images/frame_{i}" for i in held]
    assert {0.0, 1.0} <= {f.time for f in scene.train}
    assert len(scene.train) == count - len(held)


def test_lists_choose_the_splits(tmp_path, made):
    splits = ["train"] * 5 + ["val"] * 2 + ["test"] * 3
    scene = made(splits=splits)
    assert [len(getattr(scene, split)) for split in ("train", "val", "test")] == [5, 2, 3]
    assert scene.protocol["split"] == "as listed in the file"
    edit(tmp_path / "toy" / FILE, {"train_filenames": GONE})
    assert len(read_scene(tmp_path, "toy").train) == 5  # what no list names
    edit(tmp_path / "toy" / FILE, dict.fromkeys(["val_filenames", "test_filenames"], GONE))
    edit(tmp_path / "toy" / FILE, {"train_filenames": ["./images/frame_1", "images/frame_2.png"]})
    assert [len(s) for s in (read_scene(tmp_path, "toy").train, read_scene(tmp_path, "toy").test)] == [2, 8]


def test_a_list_of_validation_that_equals_the_test_list_is_both(tmp_path, made):
    made()
    listed = ["images/frame_3.png", "images/frame_4.png"]
    edit(tmp_path / "toy" / FILE, dict.fromkeys(["val_filenames", "test_filenames"], listed))
    scene = read_scene(tmp_path, "toy")
    assert [f.name for f in scene.val] == [f.name for f in scene.test] == ["images/frame_3", "images/frame_4"]
    assert len(scene.train) == 8
    assert any("validation is on the test frames" in line for line in scene.protocol["assumed"])


def test_lists_may_have_the_last_parts_of_paths_where_these_tell_one_frame(tmp_path, made):
    made()
    file = tmp_path / "toy" / FILE
    edit(file, {"test_filenames": ["frame_3.png", "frame_4"]})
    assert [f.name for f in read_scene(tmp_path, "toy").test] == ["images/frame_3", "images/frame_4"]
    shutil.copytree(tmp_path / "toy/images", tmp_path / "toy/more")
    edit(file, {"frames.0.file_path": "more/frame_3.png"})
    with refused("'frame_3', which is images/frame_3 or more/frame_3; write the whole path"):
        read_scene(tmp_path, "toy", name_pattern=r"(?P<part>\w+)/frame_(?P<frame>\d+)")


def test_paths_with_the_escapes_of_urls_are_read(tmp_path, made):
    made()
    (tmp_path / "toy/images").rename(tmp_path / "toy/my images")
    file = tmp_path / "toy" / FILE
    edit(
        file,
        lambda c: [f.update(file_path=f["file_path"].replace("images", "my%20images")) for f in c["frames"]],
    )
    assert all(f.name.startswith("my images/") for f in read_scene(tmp_path, "toy").train)


def test_which_of_two_images_of_one_name_is_read_is_said(tmp_path, made):
    made()
    file = tmp_path / "toy" / FILE
    edit(file, lambda c: [f.update(file_path=f["file_path"].removesuffix(".png")) for f in c["frames"]])
    assert not any("beside it" in line for line in read_scene(tmp_path, "toy").protocol["assumed"] or [])
    shutil.copy(tmp_path / "toy/images/frame_2.png", tmp_path / "toy/images/frame_2.jpg")
    lines = read_scene(tmp_path, "toy").protocol["assumed"]
    assert any("frame_2.png is read, not frame_2.jpg beside it" in line for line in lines)


def test_where_no_listed_test_image_was_rendered_training_images_are_held_out(tmp_path, made):
    made(splits=["train"] * 7 + ["test"] * 3)
    listed = json.loads((tmp_path / "toy" / FILE).read_text())["test_filenames"]
    for path in listed:
        (tmp_path / "toy" / path).unlink()
    scene = read_scene(tmp_path, "toy")
    assert (len(scene.train), len(scene.test)) == (6, 1)
    assert "every 8th training frame held out" in scene.protocol["split"]


def test_nothing_depends_on_the_unit(tmp_path):
    unit, views = 1e3, posed_cameras(10)
    for view in views:
        view.camera_to_world[:3, 3] *= unit
    write_video(tmp_path / "a", near=None, far=None)
    write_video(tmp_path / "b", near=None, far=None, views=views)
    a, b = read_scene(tmp_path, "a"), read_scene(tmp_path, "b")
    assert a.box.low == pytest.approx(b.box.low)
    assert a.box.high == pytest.approx(b.box.high)
    for camera, same in zip((f.camera for f in a.train), (f.camera for f in b.train), strict=True):
        torch.testing.assert_close(camera.camera_to_world, same.camera_to_world)
        assert (camera.near, camera.far) == pytest.approx((same.near, same.far))
    assert max(float(f.camera.center.norm()) for f in a.train) <= 1 + 1e-9
    assert a.protocol["normalisation"]["scale"] == pytest.approx(unit * b.protocol["normalisation"]["scale"])


def test_derived_ends_hold_what_is_looked_at_and_are_said(made, caplog):
    with caplog.at_level(logging.WARNING):
        scene = made(near=None, far=None)
    assert "toy/transforms.json: near and far derived from the cameras: near 14, far 175" in caplog.text
    assert scene.protocol["derived"] == ["near", "far", "box"]
    camera = scene.train[0].camera
    assert (camera.near, camera.far) == pytest.approx((0.2, 2.5), rel=1e-3)
    assert scene.protocol["normalisation"]["center"] == pytest.approx(MIDDLE.tolist())
    assert all(low < 0 < high for low, high in zip(scene.box.low, scene.box.high))


def test_the_kind_of_depth_that_older_runs_have_is_read(tmp_path, made):
    made()
    read_scene(tmp_path, "toy", depth_kind="metric")
    with refused("data.depth_kind: expected axis, ray, relative, inverse or null, but got 'metrik'"):
        read_scene(tmp_path, "toy", depth_kind="metrik")


def test_points_far_from_the_origin_are_as_exact_as_the_cameras(tmp_path):
    shift, random = np.array([456_012.0, 4_650_123.0, 80.0]), np.random.default_rng(0)
    points = MIDDLE.numpy() + random.uniform(-3, 3, (40, 3))
    scenes = []
    for name, by in (("near", np.zeros(3)), ("far", shift)):
        views = list(posed_cameras(10))
        for view in views:
            view.camera_to_world[:3, 3] += torch.from_numpy(by)
        write_scene(tmp_path / name, posed_shots(views=views), near=20.0, far=120.0, points=points + by)
        scenes.append(read_scene(tmp_path, name))
        (tmp_path / name / "points.npy").unlink()
        head = ["ply", "format ascii 1.0", "element vertex 40", *(f"property double {c}" for c in "xyz")]
        rows = (" ".join(map(repr, row)) for row in (points + by).tolist())
        (tmp_path / name / "sparse_pc.ply").write_text("\n".join([*head, "end_header", *rows]))
        scenes.append(read_scene(tmp_path, name))
    for scene in scenes[1:]:
        torch.testing.assert_close(scene.still, scenes[0].still, atol=1e-6, rtol=0)
    with refused(
        r"within 1.2e\+06 units of the origin .* but got 4.672e\+06, too far .* data.normalise=true"
    ):
        read_scene(tmp_path, "far", normalise=False)
    there = scenes[-1].world
    torch.testing.assert_close(
        there.to_data(scenes[-1].still), torch.from_numpy(points + shift), atol=1e-4, rtol=0
    )


def test_ends_come_from_the_config_then_from_the_file(tmp_path, made):
    scale = made().protocol["normalisation"]["scale"]
    for options, expected in (({}, (20, 120)), ({"near": 30}, (30, 120)), ({"near": 5, "far": 60}, (5, 60))):
        camera = read_scene(tmp_path, "toy", **options).train[0].camera
        assert (camera.near / scale, camera.far / scale) == pytest.approx(expected)


def test_a_box_is_in_the_files_units(tmp_path, made):
    box = Box((0, -50, -10), (60, 10, 20))
    scene = made(aabb=box)
    known = scene.protocol["normalisation"]
    for end, expected in ((scene.box.low, box.low), (scene.box.high, box.high)):
        assert [v / known["scale"] + c for v, c in zip(end, known["center"])] == pytest.approx(expected)
    assert scene.protocol["derived"] == []
    assert read_scene(tmp_path, "toy", normalise=False).box == box
    unit = read_scene(tmp_path, "toy", normalise=False, box=[0, 0, 0, 1, 1, 1]).box
    assert unit == Box((0, 0, 0), (1, 1, 1))


def looking_out(span):
    """Cameras on a part of a circle that look away from its middle."""
    for i, camera in enumerate(posed_cameras(10)):
        angle = torch.tensor(span * i / 10)
        offset = torch.stack([angle.cos(), angle.sin(), torch.tensor(0.0)])
        yield replace(camera, camera_to_world=look_at(MIDDLE + offset, MIDDLE + 2 * offset, UP))


def in_a_row():
    """Cameras beside one another whose parallel axes meet nowhere."""
    for i, camera in enumerate([posed_cameras(1)[0]] * 10):
        pose = camera.camera_to_world.clone()
        pose[:3, 3] = MIDDLE + i * pose[:3, 0]
        yield replace(camera, camera_to_world=pose)


@pytest.mark.parametrize("views", [in_a_row(), looking_out(1.0)], ids=["row", "out"])
def test_cameras_whose_axes_do_not_meet_look_at_what_lies_before_them(tmp_path, views):
    write_video(tmp_path / "toy", near=None, far=None, views=[*views])
    for frame in read_scene(tmp_path, "toy", axes="opengl").train:
        assert float(-frame.camera.center @ frame.camera.camera_to_world[:3, 2]) > frame.camera.near > 0


def test_cameras_that_look_in_all_directions_are_refused(tmp_path):
    write_video(tmp_path / "out", views=[*looking_out(2 * np.pi)])
    with refused("cameras that look at something in common, but got views in"):
        read_scene(tmp_path, "out", axes="opengl")


@pytest.mark.parametrize("turn", [False, True])
def test_a_camera_in_one_place_needs_an_end(tmp_path, turn):
    targets = [MIDDLE + torch.tensor([20.0, 3.0 * i * turn, 0.0]) for i in range(10)]
    views = [replace(posed_cameras(1)[0], camera_to_world=look_at(MIDDLE, at, UP)) for at in targets]
    write_video(tmp_path / "toy", views=views, near=None)
    with refused(r"expected cameras that move, but got one place; set data.near and"):
        read_scene(tmp_path, "toy")
    for f in read_scene(tmp_path, "toy", near=1).train:
        assert f.camera.near < float(-f.camera.center @ f.camera.camera_to_world[:3, 2]) < f.camera.far


@pytest.fixture
def masked(tmp_path, made):
    """Write ``toy`` with a mask of the same brightness and place in all frames; return where it is bright."""
    made()

    def mask(brightness=255):
        pixels = np.zeros((20, 30, 3), np.uint8)
        pixels[5:12, 8:20] = brightness
        for i in range(10):
            write_image(tmp_path / "toy" / "masks" / f"m_{i}.png", pixels)
        edit(tmp_path / "toy" / FILE, {f"frames.{i}.mask_path": f"masks/m_{i}" for i in range(10)})
        return pixels[..., 0] > 0

    return mask


def test_masks_at_the_top_are_of_all_frames(tmp_path, masked):
    mask = torch.from_numpy(masked())
    edit(tmp_path / "toy" / FILE, lambda c: [frame.pop("mask_path") for frame in c["frames"]])
    edit(tmp_path / "toy" / FILE, {"mask_path": "masks/m_0.png", "moving_path": "masks/m_1.png"})
    for frame in read_scene(tmp_path, "toy").train:
        assert torch.equal(frame.load_valid(), mask)
        assert torch.equal(frame.load_moving(), mask)


def test_of_masks_those_of_the_scale_are_read_or_else_those_of_full_size(tmp_path, masked):
    shares = torch.from_numpy(masked()).float().reshape(10, 2, 15, 2).mean((1, 3))
    for i in range(10):
        write_image(tmp_path / "toy" / "images_2" / f"frame_{i}.png", np.full((10, 15, 3), 90, np.uint8))
    for frame in read_scene(tmp_path, "toy", scale=2).train:
        assert torch.equal(frame.load_valid(), shares >= 0.5)
    assert read_scene(tmp_path, "toy", scale=2, masks="alpha").train[0].load()[..., 3].sum() == 255 * 24
    for i in range(10):
        write_image(tmp_path / "toy" / "masks_2" / f"m_{i}.png", np.full((10, 15), 255 * (i > 0), np.uint8))
    assert read_scene(tmp_path, "toy", scale=2).train[0].load_valid().all()


@pytest.mark.slow
@pytest.mark.parametrize("brightness", [255, 1, 38])
def test_masks_of_nerfstudio_tell_where_to_train_and_measure(tmp_path, masked, brightness):
    mask = torch.from_numpy(masked(brightness))
    data = PosedVideoDataModule(tmp_path, "toy", rays=2000)
    scene = data.scene
    assert not scene.has_alpha
    assert bool((scene.train[0].load()[..., 3] == 255).all())
    assert "data.masks=alpha" in scene.protocol["assumed"][0]
    assert scene.protocol["masks"].startswith("ignore: PSNR is of the pixels that count")
    drawn = next(iter(data.train_dataloader())).observations[0].view.pixels
    assert set(drawn.tolist()) == set(mask.flatten().nonzero()[:, 0].tolist())
    assert torch.equal(data.targets("test")[0].valid, mask)
    smaller = data.targets("test").reduced(2)[0].valid  # none of whose pixels was dark
    assert torch.equal(smaller, mask.reshape(10, 2, 15, 2).all(3).all(1))
    data.batches.asks = Asks(kind="pictures")
    assert torch.equal(next(iter(data.train_dataloader())).observations[0].valid, mask.flatten())
    assert len(read_scene(tmp_path, "toy", masks="ignore").protocol["assumed"]) == 1  # the times alone
    assert read_scene(tmp_path, "toy", masks="off").train[0].load_valid is None


@pytest.mark.slow
def test_what_moves_is_written_and_read_at_every_scale(tmp_path, made):
    made()
    file, (width, height), moving = tmp_path / "toy" / FILE, (30, 20), np.zeros((20, 30), bool)
    moving[5:12, 8:19] = True
    assert read_scene(tmp_path, "toy").test[0].load_moving is None
    for i in range(10):
        mask = moving if i != 3 else np.zeros_like(moving)  # nothing moves in one
        write_image(tmp_path / "toy" / "moving" / f"m_{i}.png", np.uint8(255) * mask)
        small = np.full((height // 2, width // 2, 3), 90, np.uint8)
        write_image(tmp_path / "toy" / "images_2" / f"frame_{i}.png", small)
    edit(file, {f"frames.{i}.moving_path": f"moving/m_{i}.png" for i in range(10)})
    edit(file, {"moving_from": "a friend", "seconds": 4.5})
    data = PosedVideoDataModule(tmp_path, "toy", rays=2000)
    assert (data.scene.protocol["moving"], data.scene.protocol["seconds"]) == ("a friend", 4.5)
    assert torch.equal(data.targets("test")[0].moving, torch.from_numpy(moving))
    frames = (*data.scene.train, *data.scene.test)
    assert [bool(f.load_moving().any()) for f in frames].count(False) == 1
    shares = torch.from_numpy(moving).float().reshape(10, 2, 15, 2).mean((1, 3))
    assert torch.equal(data.targets("test").reduced(2)[0].moving, shares >= 0.5)
    smaller = read_scene(tmp_path, "toy", scale=2)  # from the same files
    assert torch.equal(smaller.train[0].load_moving(), shares >= 0.5)
    shots = [
        PosedShot(f"a_{i}.jpg", f.camera, f.load()[..., :3], f.time, moving=f.load_moving().numpy())
        for i, f in enumerate(data.scene.train)
    ]
    shots[4] = replace(shots[4], resting=moving)
    write_scene(tmp_path / "again", shots, near=0.1, far=9.0, seconds=4.5, moving_from="a friend")
    again = read_scene(tmp_path, "again")
    assert again.protocol["moving"] == "a friend"
    assert torch.equal(again.test[0].load_moving(), torch.from_numpy(moving))
    rests = [f.load_resting() for f in (*again.train, *again.test) if f.load_resting is not None]
    assert len(rests) == 1  # a mask of what rests need not be in all frames
    assert torch.equal(rests[0], torch.from_numpy(moving))


def test_masks_of_what_moves_are_of_all_frames_and_of_the_images_size(tmp_path, made):
    made()
    write_image(tmp_path / "toy" / "moving.png", np.zeros((20, 30), np.uint8))
    edit(tmp_path / "toy" / FILE, {"frames.0.moving_path": "moving.png"})
    with refused(r"moving_path: expected one in all frames or in none, but got 1 of 10"):
        read_scene(tmp_path, "toy")
    write_image(tmp_path / "toy" / "moving.png", np.zeros((10, 15), np.uint8))
    with refused(r"moving.png: expected 30 x 20 pixels as frame_\d.png, but got 15 x 10"):
        read_scene(tmp_path, "toy")


def test_a_key_that_is_null_is_absent(tmp_path, made):
    made()
    expected = read_scene(tmp_path, "toy").protocol
    top = ("seconds", "moving_from", "ply_file_path", "camera_angle_y", "test_filenames", "aabb", "k4")
    own = [f"frames.{i}.{key}" for i in range(10) for key in ("moving_path", "mask_path", "fl_x", "time")]
    edit(tmp_path / "toy" / FILE, dict.fromkeys([*top, *own]))
    assert read_scene(tmp_path, "toy").protocol == expected


def test_an_empty_path_of_a_mask_is_absent(tmp_path, made):
    made()
    edit(tmp_path / "toy" / FILE, {f"frames.{i}.mask_path": "" for i in range(10)})
    assert read_scene(tmp_path, "toy").train[0].load_valid is None


def test_images_of_which_some_are_linear_are_told(tmp_path, made):
    made()
    say_linear(tmp_path / "toy/images/frame_2.png")
    said = "\n".join(read_scene(tmp_path, "toy").protocol["assumed"])
    assert (
        "1 of 10 images say that they are linear (gAMA 1; frame_2.png, ..), and all are read as sRGB" in said
    )


def test_copies_of_images_are_told(tmp_path):
    """A film at half its rate: each image comes twice."""
    images = write_video(tmp_path / "toy", count=16) / "images"
    for i in range(1, 16, 2):
        shutil.copy(images / f"frame_{i}.png", images / f"frame_{i + 1}.png")
    line = "8 of 16 images are the same file as others (frame_1.png and frame_2.png, ..); "
    leaked = "{} to test on are trained on, too: their scores say little; "
    advice = "leave copies out, unless nothing moved meanwhile"
    for tested, said in (((3, 4), ""), ((3, 4, 6), leaked.format(1))):
        edit(tmp_path / "toy" / FILE, {"test_filenames": [f"images/frame_{i}.png" for i in tested]})
        assert line + said + advice in [*remarks(read_scene(tmp_path, "toy"))]


def test_masks_that_cannot_be_meant_are_refused(tmp_path, masked):
    mask = masked()
    for i in range(10):  # which of two is the subject's?
        write_image(tmp_path / "toy" / "masks" / f"m_{i}.png", np.where(mask, 24, 11).astype(np.uint8))
    with refused(r"m_\d.png: expected a mask with a bright pixel.*nor labels beside 0; write"):
        read_scene(tmp_path, "toy")
    with refused("data.masks: expected alpha, ignore, off or null, but got 'x'"):
        read_scene(tmp_path, "toy", masks="x")


def test_frames_whose_mask_is_dark_are_left_out_and_counted(tmp_path, masked):
    mask = masked()
    for i in (0, 4):
        write_image(tmp_path / "toy" / "masks" / f"m_{i}.png", np.zeros((20, 30), np.uint8))
    scene = read_scene(tmp_path, "toy")
    frames = (*scene.train, *scene.test)
    assert len(frames) == 8
    assert all(np.array_equal(frame.load_valid(), mask) for frame in frames)
    (line,) = (line for line in scene.protocol["assumed"] if "dark everywhere" in line)
    assert "2 masks are dark everywhere (m_0.png, ..)" in line
    write_image(tmp_path / "toy" / "masks" / "m_0.png", np.zeros((10, 15), np.uint8))
    with refused("m_0.png: expected 30 x 20 pixels as .*, but got 15 x 10; resize it to 30 x 20"):
        read_scene(tmp_path, "toy")


def test_alpha_over_an_image_is_not_taken_for_a_cut_out_unasked(tmp_path):
    """As dycheck's, whose alpha of 0 means that depth is missing there."""
    shots = [replace(s, pixels=s.pixels | np.uint8([0, 0, 0, 255])) for s in posed_shots(channels=4)]
    for shot in shots:
        shot.pixels[:10, :20, 3] = 0
    write_scene(tmp_path / "toy", shots, near=20, far=120)
    with refused(r"frame_1.png: expected one colour where .*an image beneath.*masks=off"):
        read_scene(tmp_path, "toy")
    alpha, off, ignore = (read_scene(tmp_path, "toy", masks=m) for m in ("alpha", "off", "ignore"))
    assert [scene.has_alpha for scene in (alpha, off, ignore)] == [True, False, False]
    assert bool((off.train[0].load()[..., 3] == 255).all())
    assert off.train[0].load_valid is None
    assert torch.equal(~ignore.train[0].load_valid(), alpha.train[0].load()[..., 3] == 0)


def test_masks_become_alpha_where_they_are_told_to(tmp_path, made, masked):
    bare, mask = made(), masked()
    scene = read_scene(tmp_path, "toy", masks="alpha")
    assert scene.has_alpha
    assert np.array_equal(scene.train[0].load()[..., 3] > 0, mask)
    assert scene.box.diagonal < bare.box.diagonal
    pixels = next(posed_shots(channels=4)).pixels
    for i in range(10):
        write_image(tmp_path / "toy" / "images" / f"frame_{i + 1}.png", pixels)
    rgba = read_scene(tmp_path, "toy", masks="alpha").train[0].load()
    together = pixels[..., 3:] * mask[..., None]  # masks and alpha count together
    assert np.array_equal(rgba, np.concatenate([pixels[..., :3] * (together > 0), together], -1))


def test_alpha_counts_where_it_says_something(tmp_path, made):
    scene = made(channels=4)
    assert scene.has_alpha
    assert np.array_equal(scene.train[0].load(), next(posed_shots(channels=4)).pixels)
    solid = [replace(s, pixels=s.pixels | np.uint8([0, 0, 0, 255])) for s in posed_shots(channels=4)]
    write_scene(tmp_path / "solid", solid, near=20, far=120)
    assert not read_scene(tmp_path, "solid").has_alpha
    solid[-1] = [*posed_shots(channels=4)][-1]  # one image that is cut out is enough
    write_scene(tmp_path / "solid", solid, near=20, far=120)
    assert read_scene(tmp_path, "solid").has_alpha


def test_a_frame_without_a_path_and_a_shot_without_a_split_are_refused(tmp_path):
    write_video(tmp_path / "toy")
    edit(tmp_path / "toy" / FILE, {"file_path": "images/frame_1.png", "frames.0.file_path": GONE})
    with refused("file_path: expected a path inside the scene folder, but got None"):
        read_scene(tmp_path, "toy")
    with refused("split: expected train, val or test, but got None"):
        write_scene(tmp_path / "new", [replace(next(posed_shots()), split=None)], near=20, far=120)


@pytest.mark.parametrize("suffix", [".jpeg", ".JPG", ".PNG"])
def test_images_are_written_and_read_with_and_without_their_suffix(tmp_path, suffix):
    smooth = np.full((20, 30, 3), 0, np.uint8) + np.arange(30, dtype=np.uint8)[:, None] * 8
    same = [replace(s, pixels=smooth) for s in posed_shots(suffix=suffix)]
    write_scene(tmp_path / "toy", same, near=20, far=120)
    edit(tmp_path / "toy" / FILE, lambda c: c["frames"][0].update(file_path="images/frame_1"))
    content = (tmp_path / "toy" / "images" / f"frame_1{suffix}").read_bytes()
    assert content.startswith(b"\x89PNG" if suffix == ".PNG" else b"\xff\xd8")
    scene = read_scene(tmp_path, "toy")
    assert (np.abs(scene.train[0].load()[..., :3].int().numpy() - smooth) <= 6).all()


def test_smaller_images_beside_the_others(tmp_path):
    write_video(tmp_path / "toy")
    for shot in posed_shots():
        write_image(tmp_path / "toy" / "images_4" / shot.name, shot.pixels[::4, ::4][:, :7])
    scene = read_scene(tmp_path, "toy", scale=4)
    camera, full = scene.train[0].camera, read_scene(tmp_path, "toy").train[0].camera
    assert (camera.width, camera.height) == (7, 5)  # of 7.5
    assert (camera.fx, camera.cy) == pytest.approx((full.fx * 7 / 30, full.cy / 4))
    assert (camera.lens, scene.train[0].name) == (LENS, "images/frame_1")
    assert scene.train[0].load().shape == (5, 7, 4)


def rig(folder, count=4):
    """Two cameras, left and right, at each of some times."""
    cameras = posed_cameras(2)
    images = [(f"{side}_{t}.png", k, t) for t in range(count) for k, side in enumerate(("left", "right"))]
    rng = np.random.default_rng(0)
    shots = [
        PosedShot(name, cameras[k], noise(rng, cameras[k]), t / (count - 1), taken_by=name[:-6])
        for name, k, t in images
    ]
    write_scene(folder, shots, near=20.0, far=120.0)
    return folder


def test_cameras_of_a_rig_are_told_apart_and_held_out_by_name(tmp_path):
    rig(tmp_path / "toy")
    scene = read_scene(tmp_path, "toy")
    assert {(f.name[7:-2], f.camera_id) for f in scene.train} == {("left", 0), ("right", 1)}
    assert (scene.protocol["views"], {f.ability for f in scene.test}) == (2, {"all"})
    scene = read_scene(tmp_path, "toy", test_cameras=["right"], test_moments=[2])
    assert [f.name for f in scene.train] == [f"images/left_{t}" for t in (0, 1, 3)]
    assert {f.name: f.ability for f in scene.test} == {
        **{f"images/right_{t}": "space" for t in (0, 1, 3)},
        "images/left_2": "time",
        "images/right_2": "space_time",
    }
    assert scene.protocol["test_cameras"] == ["right"]
    assert scene.protocol["test_moments"] == [2]
    data = PosedVideoDataModule(tmp_path, "toy", test_moments=[2], views_per_step=2, rays=8)
    assert {o.moment.camera for o in data.batches.draw().observations} == {0, 1}


def test_cameras_may_be_whole_floats(tmp_path):
    rig(tmp_path / "toy")
    edit(tmp_path / "toy" / FILE, lambda c: [f.update(camera=float("r" in f["camera"])) for f in c["frames"]])
    scene = read_scene(tmp_path, "toy", test_cameras=[1])
    assert {f.name[7:12] for f in scene.train} == {"left_"}
    assert scene.protocol["test_cameras"] == ["1"]


def test_cameras_without_names_are_not_held_out_by_name(tmp_path, made):
    made()
    for options in ({"test_cameras": ["left"]}, {"test_moments": [1]}):
        with refused("data.test_cameras: expected a camera in the frames of .* got none"):
            read_scene(tmp_path, "toy", **options)
    rig(tmp_path / "rig")
    edit(tmp_path / "rig" / FILE, {"frames.1.camera": GONE})
    with refused(r"frames: camera: expected one in all frames or in none, but got 7 of 8"):
        read_scene(tmp_path, "rig")


def test_moments_number_instants_of_cameras_with_times_of_their_own(tmp_path):
    """Frames of one moment have other times, and all are held out together."""
    cameras, black = posed_cameras(2), np.zeros((20, 30, 3), np.uint8)
    shots = []
    for n in range(6):
        by = {"taken_by": f"cam{n % 2}", "moment": n // 2}
        shots.append(PosedShot(f"{n}.png", cameras[n % 2], black, n / 5, **by))
    write_scene(tmp_path / "toy", shots, near=20.0, far=120.0)
    scene = read_scene(tmp_path, "toy", test_moments=[1])
    assert [frame.time for frame in scene.test] == pytest.approx([0.4, 0.6])
    assert [frame.ability for frame in scene.test] == ["time", "time"]
    assert scene.times == pytest.approx((0.0, 0.2, 0.8, 1.0))
    assert scene.instants == pytest.approx((0.1, 0.9))  # what comes into play together, and is counted
    sampler = Sampler(scene, rays=4, views_per_step=2, picker=lambda: 0)
    assert {seen.moment.frame for seen in sampler.draw().observations} == {0, 1}
    with refused(r"data.test_moments: expected numbers of 0 to 2, not all"):
        read_scene(tmp_path, "toy", test_moments=[3])


def test_a_pattern_reads_times_and_cameras_in_names(tmp_path):
    black = np.zeros((20, 30, 3), np.uint8)
    shots = [PosedShot(f"{n % 2}_{n // 2}.png", posed_cameras(2)[n % 2], black) for n in range(8)]
    write_scene(tmp_path / "toy", shots, near=20.0, far=120.0)
    options = {"name_pattern": r"(?P<camera>\d)_(?P<frame>\d)$", "test_cameras": ["1"]}
    scene = read_scene(tmp_path, "toy", **options)
    assert [frame.time for frame in scene.test] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert all("1_" in frame.name for frame in scene.test)
    assert scene.protocol["times"] == "from the images' names"


def test_names_in_another_unicode_form_are_found(tmp_path):
    folder = write_video(tmp_path / unicodedata.normalize("NFD", "Größe"))
    content = json.loads((folder / FILE).read_text())
    (folder / "masks").mkdir()
    for i, frame in enumerate(content["frames"]):
        name = f"Größe_{i:03d}.png"
        (folder / frame["file_path"]).rename(folder / "images" / unicodedata.normalize("NFD", name))
        write_image(folder / "masks" / name, np.full((20, 30), 255, np.uint8))
        frame |= {
            "file_path": f"images/{name[:-4]}",
            "mask_path": unicodedata.normalize("NFD", f"masks/{name}"),
        }
    (folder / FILE).write_text(json.dumps(content))
    scene = read_scene(tmp_path, unicodedata.normalize("NFC", "Größe"))
    assert len(scene.train) + len(scene.test) == 10
    assert bool(scene.train[0].load_valid().all())


def test_absolute_paths_are_read_inside_the_scene_or_what_is_there_is_named(tmp_path):
    folder = write_video(tmp_path / "toy")
    name = json.loads((folder / FILE).read_text())["frames"][3]["file_path"]
    edit(folder / FILE, {"frames.3.file_path": str(folder / name)})
    assert len(read_scene(tmp_path, "toy").train) == 9
    for path in (rf"C:\Users\me\toy\{name}", f"/data/toy/{name}", f"../../toy/{name}"):
        edit(folder / FILE, {"frames.3.file_path": path.replace("/", "\\") if path[0] == "C" else path})
        with refused(
            f"path inside the scene folder, but got .*; {name} is there: write paths from the scene"
        ):
            read_scene(tmp_path, "toy")
    edit(folder / FILE, {"frames.3.file_path": "/etc/passwd"})
    with refused("a path inside the scene folder, but got '/etc/passwd'$"):
        read_scene(tmp_path, "toy")


@pytest.mark.slow
def test_what_looks_like_masks_depth_or_a_lens_and_is_not_read_is_named(tmp_path):
    folder = write_video(tmp_path / "toy")
    assert len(read_scene(tmp_path, "toy").protocol["assumed"]) == 1  # the times alone
    for i in range(3):
        write_image(folder / "images" / f"dynamic_mask_frame_{i}.png", np.zeros((20, 30), np.uint8))
    (folder / "depths").mkdir()
    (folder / "masks_2").mkdir()
    change = {"frames.0.mask_filename": "a.png", "frames.1.depth_path": "b.exr", "integer_depth_scale": 0.1}
    edit(folder / FILE, change | {"k4": 0, "rolling_shutter": [0, 0, 1, 0], "frames.0.masked": None})
    said = "\n".join(read_scene(tmp_path, "toy").protocol["assumed"])
    assert "images: dynamic_mask_frame_0.png and 2 more are not read" in said
    assert "depths/ is not read" in said
    assert "masks_2/ is not read" in said
    assert re.search("json: integer_depth_scale, rolling_shutter, mask_filename, depth_path: not read", said)
    unread = {"principal_point": [9, 9], "ppx": 9.0, "c_x": 9.0, "shift_x": 0.1, "K1": 0.2, "k_1": 0.2}
    for key, value in (unread | {"radial": [0.2, 0], "lens": {"k1": 0.2}}).items():
        edit(folder / FILE, {"integer_depth_scale": None, "rolling_shutter": None, key: value})
        said = "\n".join(read_scene(tmp_path, "toy").protocol["assumed"])
        assert re.search(rf"json: [^:]*\b{key}\b[^:]*: not read, which seem", said)
        edit(folder / FILE, {key: None})
    edit(folder / FILE, {"frames.0.mask_path": "masks/a.png"})
    assert "masks_2/" not in "\n".join(read_scene(tmp_path, "toy", masks="off").protocol["assumed"])


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_images_are_refused(tmp_path, count):
    write_video(tmp_path / "toy", count=count)
    with refused(f"at least 3 images, one of them to test on, but got {count}; take more images"):
        read_scene(tmp_path, "toy")
