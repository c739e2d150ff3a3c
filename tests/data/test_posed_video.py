"""A user's own capture: what is written is read, in whatever units it was taken."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from forewarp.data.images import write_png
from forewarp.data.posed_video import PosedShot, read_scene, write_scene
from forewarp.scene.box import Box
from tests.support.posed_scene import LENS, MIDDLE, cameras, edit, placed, shots, write_tiny


def frames_of(scene):
    return {f.name: f for split in (scene.train, scene.val, scene.test) for f in split}


def test_round_trip(tmp_path):
    write_tiny(tmp_path / "toy")
    scene = read_scene(tmp_path, "toy")
    frames = frames_of(scene)
    assert len(frames) == 10
    for i, shot in enumerate(shots()):
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


@pytest.mark.parametrize("channels", [3, 4])
def test_the_same_again_after_reading_and_writing(tmp_path, channels):
    write_tiny(tmp_path / "a", channels=channels, times=[i / 9 for i in range(10)])
    first = read_scene(tmp_path, "a", normalise=False)
    again = [
        PosedShot(f"{f.name.split('/')[1]}.png", f.camera, f.load()[..., :channels], f.time, split)
        for split in ("train", "test")
        for f in getattr(first, split)
    ]
    write_scene(tmp_path / "b", again, near=20, far=120)
    second = read_scene(tmp_path, "b", normalise=False)
    assert frames_of(first).keys() == frames_of(second).keys()
    for name, frame in frames_of(first).items():
        other = frames_of(second)[name]
        assert (frame.time, frame.camera.lens) == (other.time, other.camera.lens)
        assert torch.equal(frame.camera.camera_to_world, other.camera.camera_to_world)
        assert torch.equal(frame.load(), other.load())
    assert [f.name for f in first.test] == [f.name for f in second.test]
    assert first.box == second.box


def test_known_points_project_by_the_formats_formulas(tmp_path):
    """By hand: x right, y up, looking along -z, OpenCV's lens; then moved into the scene."""
    write_tiny(tmp_path / "toy")
    scene = read_scene(tmp_path, "toy")
    content = json.loads((tmp_path / "toy" / "transforms.json").read_text())
    point = MIDDLE.numpy() + [3.0, -4.0, 5.0]
    known = scene.protocol["normalisation"]
    moved = torch.from_numpy((point - known["center"]) * known["scale"])
    for i, entry in enumerate(content["frames"]):
        entry = {**content, **entry}
        matrix = np.array(entry["transform_matrix"])
        local = matrix[:3, :3].T @ (point - matrix[:3, 3])
        x, y = local[0] / -local[2], -local[1] / -local[2]
        r2 = x * x + y * y
        bend = 1 + entry["k1"] * r2 + entry["k2"] * r2**2 + entry["k3"] * r2**3
        xd = x * bend + 2 * entry["p1"] * x * y + entry["p2"] * (r2 + 2 * x * x)
        yd = y * bend + entry["p1"] * (r2 + 2 * y * y) + 2 * entry["p2"] * x * y
        expected = [entry["fl_x"] * xd + entry["cx"], entry["fl_y"] * yd + entry["cy"]]
        camera = frames_of(scene)[f"images/frame_{i + 1}"].camera
        pixel, depth = camera.project(moved)
        assert pixel.tolist() == pytest.approx(expected, abs=1e-6)
        assert depth.item() == pytest.approx(-local[2] * known["scale"])
        ray = camera.directions(pixel[0], pixel[1])
        torch.testing.assert_close(camera.center + (moved - camera.center).norm() * ray, moved)


def test_each_frame_may_have_its_own_camera(tmp_path):
    views = cameras(5) + cameras(5, size=(16, 12), lens=None)
    views[2] = replace(views[2], fx=50.0, cx=11.0)
    write_tiny(tmp_path / "toy", views=views)
    content = json.loads((tmp_path / "toy" / "transforms.json").read_text())
    assert "fl_x" in content["frames"][0]
    assert "fl_x" not in content
    scene = read_scene(tmp_path, "toy")
    for i, view in enumerate(views):
        frame = frames_of(scene)[f"images/frame_{i + 1}"]
        assert (frame.camera.fx, frame.camera.cx, frame.camera.lens) == (view.fx, view.cx, view.lens)
        assert tuple(frame.load().shape) == (view.height, view.width, 4)


def test_what_all_share_stands_at_the_top(tmp_path):
    write_tiny(tmp_path / "toy")
    content = json.loads((tmp_path / "toy" / "transforms.json").read_text())
    assert {"fl_x", "k1", "w", "camera_model"} <= content.keys()
    assert content["frames"][0].keys() == {"file_path", "transform_matrix"}


def test_only_a_focal_length_is_needed(tmp_path):
    write_tiny(tmp_path / "toy")

    def bare(content):
        for key in ("fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2", "camera_model"):
            content.pop(key)

    edit(tmp_path / "toy", bare)
    camera = read_scene(tmp_path, "toy").train[0].camera
    assert (camera.fy, camera.cx, camera.cy, camera.lens) == (camera.fx, 15, 10, None)


def test_files_come_in_the_order_of_their_numbers(tmp_path):
    write_tiny(tmp_path / "toy")
    edit(tmp_path / "toy", lambda c: c["frames"].reverse())
    frames = frames_of(read_scene(tmp_path, "toy"))
    assert [frames[f"images/frame_{i + 1}"].time for i in range(10)] == pytest.approx(np.linspace(0, 1, 10))


def test_given_times_are_kept(tmp_path):
    times = [0.9, 0.1, 0.2, 0.3, 0.35, 0.5, 0.6, 0.7, 0.8, 0.0]
    write_tiny(tmp_path / "toy", times=times)
    scene = read_scene(tmp_path, "toy")
    assert [frames_of(scene)[f"images/frame_{i + 1}"].time for i in range(10)] == times
    assert [f.time for f in scene.test] == [0.35]  # the fifth in time
    assert scene.canonical_time == 0.5
    assert read_scene(tmp_path, "toy", canonical="first").canonical_time == 0.0
    assert scene.protocol["times"] == "as given"


@pytest.mark.parametrize(
    ("count", "every", "held"),
    [(10, 2, [2, 4, 6, 8]), (10, 3, [2, 5, 8]), (6, 8, [5]), (13, 8, [5]), (21, 8, [5, 13]), (4, 2, [2])],
)
def test_every_nth_frame_is_held_out_but_never_the_first_or_the_last(tmp_path, count, every, held):
    write_tiny(tmp_path / "toy", count=count)
    scene = read_scene(tmp_path, "toy", test_every=every)
    assert [f.name for f in scene.test] == [f"images/frame_{i}" for i in held]
    assert {0.0, 1.0} <= {f.time for f in scene.train}
    assert len(scene.train) == count - len(held)


def test_lists_choose_the_splits(tmp_path):
    splits = ["train"] * 5 + ["val"] * 2 + ["test"] * 3
    write_tiny(tmp_path / "toy", splits=splits)
    scene = read_scene(tmp_path, "toy")
    assert [len(getattr(scene, split)) for split in ("train", "val", "test")] == [5, 2, 3]
    assert scene.protocol["split"] == "as listed in the file"
    edit(tmp_path / "toy", lambda c: c.pop("train_filenames"))
    assert len(read_scene(tmp_path, "toy").train) == 5  # what no list names
    edit(tmp_path / "toy", lambda c: (c.pop("val_filenames"), c.pop("test_filenames")))
    edit(tmp_path / "toy", lambda c: c.update(train_filenames=["./images/frame_1", "images/frame_2.png"]))
    assert [len(s) for s in (read_scene(tmp_path, "toy").train, read_scene(tmp_path, "toy").test)] == [2, 8]


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_nothing_depends_on_the_unit(tmp_path, unit):
    def scaled(camera):
        pose = camera.camera_to_world.clone()
        pose[:3, 3] *= unit
        return replace(camera, camera_to_world=pose)

    write_tiny(tmp_path / "a", near=None, far=None)
    write_tiny(tmp_path / "b", near=None, far=None, views=[scaled(c) for c in cameras(10)])
    a, b = read_scene(tmp_path, "a"), read_scene(tmp_path, "b")
    assert a.box.low == pytest.approx(b.box.low)
    assert a.box.high == pytest.approx(b.box.high)
    for one, two in zip(a.train, b.train, strict=True):
        torch.testing.assert_close(one.camera.camera_to_world, two.camera.camera_to_world)
        assert (one.camera.near, one.camera.far) == pytest.approx((two.camera.near, two.camera.far))
    assert max(float(f.camera.center.norm()) for f in a.train) <= 1 + 1e-9
    assert a.protocol["normalisation"]["scale"] == pytest.approx(unit * b.protocol["normalisation"]["scale"])


def test_derived_ends_hold_what_is_looked_at_and_are_said(tmp_path, caplog):
    write_tiny(tmp_path / "toy", near=None, far=None)
    with caplog.at_level(logging.WARNING):
        scene = read_scene(tmp_path, "toy")
    assert "toy/transforms.json: near and far derived from the cameras: near 14, far 175" in caplog.text
    assert scene.protocol["derived"] == ["near", "far", "box"]
    camera = scene.train[0].camera
    assert (camera.near, camera.far) == pytest.approx((0.2, 2.5), rel=1e-3)
    assert scene.protocol["normalisation"]["center"] == pytest.approx(MIDDLE.tolist())
    assert all(low < 0 < high for low, high in zip(scene.box.low, scene.box.high))


def test_ends_come_from_the_config_then_from_the_file(tmp_path):
    write_tiny(tmp_path / "toy")
    scale = read_scene(tmp_path, "toy").protocol["normalisation"]["scale"]
    for options, expected in (({}, (20, 120)), ({"near": 30}, (30, 120)), ({"near": 5, "far": 60}, (5, 60))):
        camera = read_scene(tmp_path, "toy", **options).train[0].camera
        assert (camera.near / scale, camera.far / scale) == pytest.approx(expected)
    camera = read_scene(tmp_path, "toy", normalise=False).train[0].camera
    assert (camera.near, camera.far) == (20, 120)


def test_a_box_is_in_the_files_units(tmp_path):
    box = Box((0, -50, -10), (60, 10, 20))
    write_tiny(tmp_path / "toy", aabb=box)
    scene = read_scene(tmp_path, "toy")
    known = scene.protocol["normalisation"]
    for end, expected in ((scene.box.low, box.low), (scene.box.high, box.high)):
        assert [v / known["scale"] + c for v, c in zip(end, known["center"])] == pytest.approx(expected)
    assert scene.protocol["derived"] == []
    assert read_scene(tmp_path, "toy", normalise=False).box == box
    other = read_scene(tmp_path, "toy", normalise=False, box=[0, 0, 0, 1, 1, 1]).box
    assert other == Box((0, 0, 0), (1, 1, 1))


def test_cameras_in_a_row_look_ahead(tmp_path):
    """Parallel axes meet nowhere: what is looked at lies before them."""
    views = [replace(c, camera_to_world=c.camera_to_world.clone()) for c in cameras(10)]
    for i, view in enumerate(views):
        view.camera_to_world[:3, :3] = views[0].camera_to_world[:3, :3]
        view.camera_to_world[:3, 3] = MIDDLE + i * views[0].camera_to_world[:3, 0]
    write_tiny(tmp_path / "toy", near=None, far=None, views=views)
    scene = read_scene(tmp_path, "toy")
    for frame in scene.train:
        assert float(-frame.camera.center @ frame.camera.camera_to_world[:3, 2]) > frame.camera.near > 0


def test_a_camera_that_stands_still_needs_its_ends(tmp_path):
    write_tiny(tmp_path / "toy", views=[cameras(1)[0]] * 10)
    scene = read_scene(tmp_path, "toy")
    assert scene.train[0].camera.far == pytest.approx(120 / 70)  # what is looked at is midway


def masked(folder, count=10):
    write_tiny(folder)
    mask = np.zeros((20, 30, 3), np.uint8)
    mask[5:12, 8:20] = 255
    for i in range(count):
        write_png(folder / "masks" / f"m_{i}.png", mask)

    def change(content):
        for i, entry in enumerate(content["frames"][:count]):
            entry["mask_path"] = f"masks/m_{i}"

    edit(folder, change)
    return mask[..., 0] > 0


def test_masks_become_alpha(tmp_path):
    mask = masked(tmp_path / "toy")
    scene = read_scene(tmp_path, "toy")
    assert scene.has_alpha
    assert np.array_equal(scene.train[0].load()[..., 3] > 0, mask)
    without = read_scene(tmp_path, "toy", near=20, far=120)
    write_tiny(tmp_path / "bare")
    assert without.box.diagonal < read_scene(tmp_path, "bare").box.diagonal


def test_alpha_counts_where_it_says_something(tmp_path):
    write_tiny(tmp_path / "toy", channels=4)
    scene = read_scene(tmp_path, "toy")
    assert scene.has_alpha
    assert np.array_equal(scene.train[0].load(), next(shots(channels=4)).pixels)
    opaque = [
        replace(s, pixels=np.where([0, 0, 0, 1], 255, s.pixels).astype("u1")) for s in shots(channels=4)
    ]
    write_scene(tmp_path / "opaque", opaque, near=20, far=120)
    assert not read_scene(tmp_path, "opaque").has_alpha


def test_one_image_that_is_cut_out_is_enough(tmp_path):
    *solid, last = shots(channels=4)
    first = [replace(s, pixels=np.where([0, 0, 0, 1], 255, s.pixels).astype("u1")) for s in solid]
    write_scene(tmp_path / "toy", [*first, last], near=20, far=120)
    assert read_scene(tmp_path, "toy").has_alpha


def test_masks_and_alpha_count_together(tmp_path):
    mask = masked(tmp_path / "toy")
    shot = next(shots(channels=4))
    for i in range(10):
        write_png(tmp_path / "toy" / "images" / f"frame_{i + 1}.png", shot.pixels)
    rgba = read_scene(tmp_path, "toy").train[0].load().numpy()
    assert np.array_equal(rgba[..., 3], shot.pixels[..., 3] * mask)
    on = rgba[..., 3] > 0
    assert np.array_equal(rgba[on], shot.pixels[on])
    assert (rgba[~on] == 0).all()


@pytest.mark.parametrize("name", ["frame.PNG", "frame.jpeg"])
def test_a_suffix_says_what_is_written(tmp_path, name):
    pixels = next(shots()).pixels
    written = [replace(s, name=f"{i}_{name}", pixels=pixels) for i, s in enumerate(shots())]
    write_scene(tmp_path / "toy", written, near=20, far=120)
    content = (tmp_path / "toy" / "images" / f"0_{name}").read_bytes()
    assert content.startswith(b"\x89PNG" if name.endswith("PNG") else b"\xff\xd8")
    assert len(read_scene(tmp_path, "toy").train) == 9


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".JPG"])
def test_jpegs_are_read_with_and_without_their_suffix(tmp_path, suffix):
    smooth = np.full((20, 30, 3), 0, np.uint8) + np.arange(30, dtype=np.uint8)[:, None] * 8
    same = [replace(s, pixels=smooth) for s in shots(suffix=suffix)]
    write_scene(tmp_path / "toy", same, near=20, far=120)
    edit(tmp_path / "toy", lambda c: c["frames"][0].update(file_path="images/frame_1"))
    scene = read_scene(tmp_path, "toy")
    assert (np.abs(scene.train[0].load()[..., :3].int().numpy() - smooth) <= 6).all()


def test_smaller_images_beside_the_others(tmp_path):
    write_tiny(tmp_path / "toy")
    for shot in shots():
        write_png(tmp_path / "toy" / "images_4" / shot.name, shot.pixels[::4, ::4][:, :7])
    scene = read_scene(tmp_path, "toy", scale=4)
    camera, full = scene.train[0].camera, read_scene(tmp_path, "toy").train[0].camera
    assert (camera.width, camera.height) == (7, 5)  # of 7.5
    assert (camera.fx, camera.cy) == pytest.approx((full.fx * 7 / 30, full.cy / 4))
    assert (camera.lens, scene.train[0].name) == (LENS, "images/frame_1")
    assert scene.train[0].load().shape == (5, 7, 4)


def test_a_rewritten_capture_keeps_nothing_of_the_old_one(tmp_path):
    write_tiny(tmp_path / "toy", splits=["train"] * 5 + ["test"] * 5)

    def broken():
        yield from shots(1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_scene(tmp_path / "toy", broken())
    assert not (tmp_path / "toy" / "transforms.json").exists()
