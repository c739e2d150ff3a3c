"""HyperNeRF captures: what is written is read, and real ones are understood."""

import json
import re
import shutil
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from PIL import Image

from forewarp.data.checks import remarks
from forewarp.data.depth import SensedDepth
from forewarp.data.files import Entry, read_json
from forewarp.data.hypernerf import camera_of, read_scene, write_camera
from forewarp.data.images import write_image
from tests.support import reference
from tests.support.written_scenes import (
    CENTER,
    FAR,
    GONE,
    LENS,
    NEAR,
    RIG_TRUTH,
    SCALE,
    edit,
    film,
    hand,
    phone,
    real,
    refused,
    rig,
    write_rig,
)


def normalised(points):
    return (torch.as_tensor(points).double() - torch.tensor(CENTER, dtype=torch.float64)) * SCALE


def printed_formulas(content, point, ratio):
    """Where the format says that a point of the unscaled world lies in the image ``ratio`` times as large."""
    x, y, z = np.array(content["orientation"]) @ (point - np.array(content["position"]))
    xd, yd = reference.bend(x / z, y / z, content["radial_distortion"], content["tangential_distortion"])
    u = content["focal_length"] * xd + content["skew"] * yd + content["principal_point"][0]
    v = content["focal_length"] * content["pixel_aspect_ratio"] * yd + content["principal_point"][1]
    return (ratio * np.array([u, v])).tolist(), z


@pytest.mark.parametrize("scale", [1, 2])
def test_round_trip_of_a_rig(tmp_path, scale):
    points = np.array([[1.0, 2, 3], [2.5, -1, 0.75]], np.float32)
    folder = write_rig(tmp_path / "toy", rig(size=(12, 8), skew=2.0), points=points, trajectories=RIG_TRUTH)
    scene, point = read_scene(tmp_path, "toy", scale=scale), np.array(CENTER) + [0.4, -0.3, 0.6]
    frames = {frame.name: frame for frame in (*scene.train, *scene.test)}
    for shot in rig(size=(12, 8), skew=2.0):
        frame = frames.pop(shot.name)
        camera, expected = frame.camera, shot.camera.camera_to_world.clone()
        expected[:3, 3] = normalised(expected[:3, 3])
        torch.testing.assert_close(camera.camera_to_world, expected, atol=1e-6, rtol=0)
        assert (camera.width, camera.height) == (12 // scale, 8 // scale)
        for key in ("fx", "fy", "cx", "cy", "skew"):
            assert getattr(camera, key) == pytest.approx(getattr(shot.camera, key) / scale, rel=1e-12)
        assert (frame.time, camera.lens) == (shot.time_id / 4, shot.camera.lens)
        assert (camera.near, camera.far) == (NEAR, FAR)
        blocks = shot.rgb.reshape(8 // scale, scale, 12 // scale, scale, 3).mean((1, 3))
        assert np.array_equal(frame.load()[..., :3], np.rint(blocks))
        assert (frame.load()[..., 3] == 255).all()
        content = json.loads((folder / "camera" / f"{frame.name}.json").read_text())
        pixel, z = printed_formulas(content, point, 1 / scale)
        projected, depth = camera.project(normalised(point))
        assert projected.tolist() == pytest.approx(pixel, abs=1e-9)
        assert depth.item() == pytest.approx(z * SCALE)
    assert (frames, scene.has_alpha, scene.val) == ({}, False, ())
    torch.testing.assert_close(scene.still.double(), normalised(points), atol=1e-6, rtol=0)
    torch.testing.assert_close(scene.truth.points.double(), normalised(RIG_TRUTH.points), atol=1e-6, rtol=0)
    assert torch.equal(scene.truth.times, RIG_TRUTH.times)


def test_a_rig_is_split_as_it_says(tmp_path):
    shots = [*rig()]
    write_rig(tmp_path / "toy", [*shots[:-1], replace(shots[-1], split="")])
    scene = read_scene(tmp_path, "toy")
    assert [f.name for f in scene.train] == [s.name for s in shots if s.split == "train"]
    assert [f.name for f in scene.test] == [s.name for s in shots[:-1] if s.split == "val"]
    assert (scene.times, scene.canonical_time) == ((0.0, 0.25, 0.5, 0.75, 1.0), 0.5)
    expected = {"dataset": "hypernerf", "scale": 2, "split": "vrig", "resolution": [6, 4]}
    assert scene.protocol == expected | {"train_frames": 5, "test_frames": 4}


def test_without_val_ids_every_fourth_is_trained_on(tmp_path):
    write_rig(tmp_path / "toy", hand(11))
    scene = read_scene(tmp_path, "toy")
    assert [f.name for f in scene.train] == ["000001", "000005", "000009"]
    assert [f.name for f in scene.test] == ["000003", "000007"]
    assert scene.times == pytest.approx((0.0, 0.4, 0.8))  # of all items the last is at 1
    assert (scene.canonical_time, scene.protocol["split"]) == (0.4, "interpolation")


def test_time_id_counts_before_warp_id_and_entries_of_no_item_not_at_all(tmp_path):
    file = write_rig(tmp_path / "toy", hand(5)) / "metadata.json"
    edit(file, lambda c: [e.update(warp_id=e["warp_id"] ** 2) for e in c.values()])
    assert read_scene(tmp_path, "toy").test[0].time == 0.5
    edit(file, lambda c: [e.pop("time_id") for e in c.values()])
    edit(file, {"ghost": {"time_id": 90, "warp_id": 90}, "other": 3})
    (tmp_path / "toy" / "camera" / "ghost.json").write_text("none")
    assert read_scene(tmp_path, "toy").test[0].time == 0.25


@pytest.mark.parametrize("told", [True, False])
def test_names_of_numbers_alone_tell_moments_where_camera_id_tells_cameras(tmp_path, told):
    shots = [replace(shot, name=f"{shot.camera_id}_{shot.time_id:05d}") for shot in rig()]
    file = write_rig(tmp_path / "toy", shots) / "metadata.json"
    numbers = {shot.name: shot.time_id for shot in shots}
    counted = {name: i for i, name in enumerate(sorted(numbers))}
    edit(file, lambda c: [(e.pop("time_id"), e.update(camera_id=e["camera_id"] * told)) for e in c.values()])
    assert "assumed" not in read_scene(tmp_path, "toy").protocol
    edit(file, lambda c: [e.update(warp_id=counted[name]) for name, e in c.items()])
    scene, used = read_scene(tmp_path, "toy"), numbers if told else counted
    times = {f.name: f.time for f in (*scene.train, *scene.test)}
    assert times == pytest.approx({name: used[name] / max(used.values()) for name in times})
    (line,) = scene.protocol["assumed"]
    assert ("times are these" if told else "give items of one moment one time_id") in line


def test_names_tell_the_moment_where_warp_id_counts_one_camera_after_the_other(tmp_path):
    file = write_rig(tmp_path / "toy", rig()) / "metadata.json"
    expected = {f.name: f.time for f in (lambda s: (*s.train, *s.test))(read_scene(tmp_path, "toy"))}

    def counted(order):
        for entry in (content := json.loads(file.read_text())).values():
            entry.pop("time_id", None)
        for number, item in enumerate(order(content)):
            content[item]["warp_id"] = number
        file.write_text(json.dumps(content))
        return read_scene(tmp_path, "toy")

    scene = counted(sorted)
    assert {f.name: f.time for f in (*scene.train, *scene.test)} == pytest.approx(expected)
    (line,) = scene.protocol["assumed"]
    assert "warp_id counts the items in another order than the numbers in their names: times are" in line
    edit(file, lambda c: [entry.update(camera_id=0) for entry in c.values()])  # names tell cameras, too
    scene = read_scene(tmp_path, "toy")
    assert {f.name: f.time for f in (*scene.train, *scene.test)} == pytest.approx(expected)
    assert {f.camera_id for f in (*scene.train, *scene.test)} == {0, 1}
    edit(file, lambda c: [entry.update(time_id=entry["warp_id"]) for entry in c.values()])
    (line,) = read_scene(tmp_path, "toy").protocol["assumed"]  # and what time_id says stays
    assert "time_id counts the items in another order than the numbers in their names; if" in line
    write_rig(tmp_path / "toy", rig())
    # In the order of the moments it may be right, as of cameras that take turns.
    assert "assumed" not in counted(lambda items: sorted(items, key=lambda i: i.split("_")[1])).protocol


@pytest.mark.slow
def test_time_ids_in_two_units_and_of_one_moment_are_named(tmp_path):
    folder = write_rig(tmp_path / "toy", rig(times=24))
    val = json.loads((folder / "dataset.json").read_text())["val_ids"]
    edit(folder / "metadata.json", lambda c: [c[i].update(time_id=100 * c[i]["time_id"]) for i in val])
    with refused(r"times of train frames: expected one unit .* 0 to 2300, but got 0 to"):
        read_scene(tmp_path, "toy")
    edit(folder / "metadata.json", lambda c: [entry.update(time_id=7) for entry in c.values()])
    (line,) = read_scene(tmp_path, "toy").protocol["assumed"]
    assert line.endswith("metadata.json: all items are of time 7: one moment")


def test_no_item_leaves_the_scene(tmp_path):
    folder = write_rig(tmp_path / "toy")
    edit(folder / "dataset.json", {"ids.0": "../x", "train_ids.0": "../x"})
    edit(folder / "metadata.json", lambda c: c.update({"../x": {"time_id": 0}}))
    with refused("dataset.json: ids: expected a path inside the scene"):
        read_scene(tmp_path, "toy")


def test_a_fisheye_is_named(tmp_path):
    folder = write_rig(tmp_path / "toy")
    edit(folder / "camera" / "left1_000000.json", {"camera_type": "fisheye"})
    with refused("000.json: camera_type: expected a pinhole camera, but got 'fisheye'"):
        read_scene(tmp_path, "toy")


def test_intrinsics_of_larger_images_are_named(tmp_path):
    folder = write_rig(tmp_path / "toy", rig())
    for file in (folder / "camera").iterdir():
        edit(file, lambda content: content.update(principal_point=content["image_size"]))
    with refused("principal_point: expected .* are of images 2 times as large"):
        read_scene(tmp_path, "toy", scale=1)


def _by_translation(content):
    content["position"] = (-np.array(content["orientation"]) @ content["position"]).tolist()


def _transposed(content):
    content["orientation"] = np.array(content["orientation"]).T.tolist()


def _of_opengl(content):
    content["orientation"] = (np.diag([1, -1, -1]) @ content["orientation"]).tolist()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([_by_translation], r"position is the translation t .* \(write -orientation\^T t\); if so"),
        ([_transposed], r"orientation is camera-to-world \(transpose it\); if so"),
        ([_of_opengl], r"if the axes are OpenGL's \(then negate the last two rows of orientation\); if so"),
        ([_of_opengl, _by_translation], r"translation t .* and the axes are OpenGL's"),
        ([_by_translation, _transposed], r"is camera-to-world .* and position is the translation t"),
        ([], None),
    ],
)
def test_camera_files_that_hold_another_pose_are_named(changes, said, tmp_path):
    folder = write_rig(tmp_path / "toy", rig(times=12))
    for file, change in product((folder / "camera").iterdir(), changes):
        edit(file, change)
    lines = read_scene(tmp_path, "toy").protocol.get("assumed", [])
    assert len(lines) == (said is not None)
    assert all(re.search(said, line) for line in lines)


def test_positions_that_miss_about_one_point_are_named(tmp_path):
    """Around a subject beside the origin, translations of world-to-camera miss a point by a third."""
    folder = write_rig(tmp_path / "toy", rig(times=12))
    for file in (folder / "camera").iterdir():
        edit(file, lambda c: c.update(position=(np.array(c["position"]) - CENTER + [1.0, 0.4, 0.2]).tolist()))
    edit(folder / "scene.json", {"center": [1.0, 0.4, 0.2]})
    assert "assumed" not in read_scene(tmp_path, "toy").protocol
    for file in (folder / "camera").iterdir():
        edit(file, _by_translation)
    edit(folder / "scene.json", {"center": [0.0, 0.0, 4.0]})
    (line,) = read_scene(tmp_path, "toy").protocol["assumed"]
    assert re.search(r"position is the translation t .* \(write -orientation\^T t\); if so", line)


def test_both_spellings_of_the_tangential_distortion(tmp_path):
    path = tmp_path / "camera.json"
    write_camera(path, phone(1, size=(1073, 719)))
    small = camera_of(Entry(path, read_json(path)), 1, 2).smaller(4)
    assert (small.width, small.height, small.lens) == (268, 180, LENS)  # rounded
    edit(path, {"tangential": [0.001, 0.002]})
    assert camera_of(Entry(path, read_json(path)), 1, 2).lens.p == (0.001, 0.002)
    edit(path, dict.fromkeys(["tangential_distortion", "tangential"], GONE))
    assert camera_of(Entry(path, read_json(path)), 1, 2).lens.p == (0, 0)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"radial_distortion": GONE, "radial": [0.1, 0, 0]}, "radial"),
        ({"distortion": [0.1, 0.2]}, "distortion"),
        ({"k1": 0.1, "k2": 0}, "k1"),
        ({"focal_length_y": 99.0}, "focal_length_y"),
        ({"tangential": [0.0, 0.0], "tangential_distortion": [0.01, 0.0]}, "tangential_distortion"),
        ({"k1": 0.0, "distortion": None, "exposure": 3}, None),
    ],
)
def test_keys_of_lenses_that_are_not_read_are_named(tmp_path, keys, said):
    folder = write_rig(tmp_path / "toy", rig())
    for file in (folder / "camera").glob("*.json"):
        edit(file, keys | {"fy": json.loads(file.read_text())["focal_length"]})  # the same twice
    lines = [
        line for line in read_scene(tmp_path, "toy").protocol.get("assumed", []) if "of the lens" in line
    ]
    assert [line.split(": ")[1] for line in lines] == ([said] if said else [])


def test_ids_in_another_order_are_split_in_that_of_time(tmp_path):
    folder = write_rig(tmp_path / "toy", hand(13))
    before = read_scene(tmp_path, "toy")
    edit(folder / "dataset.json", lambda c: c["ids"].sort(key=lambda name: str(int(name))))
    after = read_scene(tmp_path, "toy")
    names = [[f.name for f in part] for part in (before.train, before.test)]
    assert [[f.name for f in part] for part in (after.train, after.test)] == names
    assert "dataset.json: ids are not in the order of time" in after.protocol["assumed"][0]


def test_which_of_two_images_of_one_id_is_read_is_said(tmp_path):
    folder = write_rig(tmp_path / "toy", rig())
    path = next((folder / "rgb/2x").glob("*.png"))
    write_image(path.with_suffix(".jpg"), np.zeros((2, 2, 3), np.uint8))
    (line,) = read_scene(tmp_path, "toy").protocol["assumed"]
    assert f"{path.name} is read, not {path.stem}.jpg beside it; remove those that are not meant" in line


def test_a_genuine_lens_is_undone():
    path = real("hypernerf") / "camera-with-distortion" / "camera.json"
    camera = camera_of(Entry(path, read_json(path)), 0.1, 2.0)
    assert camera.lens.p == tuple(json.loads(path.read_text())["tangential"])
    assert (camera.width, camera.height, camera.skew) == (2448, 3264, 0)
    pixels = torch.arange(0, 2448 * 3264, 4999)
    rays = camera.rays(pixels, dtype=torch.float64)
    again, depth = camera.project(rays.origins + 1.7 * rays.directions)
    expected = torch.stack([pixels % 2448, pixels // 2448], -1) + 0.5
    assert (again - expected).abs().max() < 1e-3  # its orientation has the digits of float32
    assert (depth > 0).all()


@pytest.mark.slow
def test_a_genuine_capture_by_three_phones_is_understood(tmp_path):
    source, folder = real("hypernerf") / "paper-windmill-no-images", tmp_path / "windmill"
    (folder / "rgb" / "2x").mkdir(parents=True)
    for name in ("dataset.json", "metadata.json", "scene.json"):
        shutil.copy(source / name, folder)
    (folder / "camera").symlink_to(source / "camera")
    write_image(tmp_path / "blank.png", np.zeros((480, 360, 3), np.uint8))
    for item in json.loads((source / "dataset.json").read_text())["ids"]:
        (folder / "rgb" / "2x" / f"{item}.png").symlink_to(tmp_path / "blank.png")
    scene = read_scene(tmp_path, "windmill")
    assert (len(scene.train), len(scene.test), scene.protocol["split"]) == (277, 419, "vrig")
    assert (scene.canonical_time, scene.times[-1]) == (0.5, 1.0)
    assert scene.train[0].camera.near == pytest.approx(0.10891095985144743)
    for frame in scene.train:  # the phone is carried around what it looks at
        assert frame.camera.center.norm() < 2


def test_a_genuine_hand_held_video_is_understood():
    scene = read_scene(real("hypernerf"), "moving-hand")
    assert (len(scene.train), len(scene.test)) == (22, 21)
    assert scene.train[0].load().shape == (192, 256, 4)
    assert scene.canonical_time == pytest.approx(40 / 85)
    assert scene.train[0].time < scene.test[0].time < scene.train[1].time
    assert scene.still is None


def test_images_that_are_missing_are_left_out_and_jpeg_is_read(tmp_path):
    folder = write_rig(tmp_path / "toy", rig(size=(12, 8)))
    before = read_scene(tmp_path, "toy", scale=1)
    gone, other = before.train[0].name, before.train[1].name
    (folder / "rgb" / "1x" / f"{gone}.png").unlink()
    stored = folder / "rgb" / "1x" / f"{other}.png"
    write_image(stored.with_suffix(".jpg"), before.train[1].load().numpy()[..., :3])
    stored.unlink()
    after = read_scene(tmp_path, "toy", scale=1)
    assert [frame.name for frame in after.train] == [frame.name for frame in before.train[1:]]
    assert f"images are not there and left out ({gone}.png, ..)" in after.protocol["assumed"][0]


# A phone that measures depth -------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1, 2])
def test_round_trip_of_a_film_with_depth(tmp_path, scale):
    write_rig(tmp_path / "toy", film(), fps=10.0)
    scene, middle = read_scene(tmp_path, "toy", scale=scale, depth="depth"), slice(scale // 2, None, scale)
    for frame, shot in zip(scene.train, [shot for shot in film() if shot.split == "train"], strict=True):
        depth, trust = frame.load_sensed()
        rays, axis = frame.camera.rays(dtype=torch.float64), frame.camera.camera_to_world[:3, 2]
        along = depth.double() * (rays.directions @ axis).reshape(depth.shape)
        stored, sure = (values[middle, middle] for values in (shot.depth, shot.confidence))
        np.testing.assert_allclose(along, SCALE * stored, rtol=1e-6)
        np.testing.assert_allclose(trust, np.where(stored > 0, sure, 0))
        assert torch.equal(frame.keypoints, torch.tensor(shot.keypoints / (scale, scale, 1)).float())
    for frame in scene.test:
        assert (frame.load_sensed, frame.keypoints) == (None, None)
        assert torch.equal(frame.load_covisible().float().mean(0), torch.arange(12 // scale) < 6 // scale)
    expected = {"dataset": "iphone", "depth": "depth, of 4 of 4 training frames", "seconds": 0.3}
    assert expected.items() <= scene.protocol.items()
    assert read_scene(tmp_path, "toy").train[0].load_sensed is None


@pytest.mark.slow
def test_depths_may_be_millimetres(tmp_path):
    metres, folder = write_rig(tmp_path / "a", film()), write_rig(tmp_path / "b", film(unit=1000.0))
    expected, scene = (read_scene(f.parent, f.name, depth="depth") for f in (metres, folder))
    torch.testing.assert_close(scene.train[1].load_sensed(), expected.train[1].load_sensed())
    assert "thousandths" in scene.protocol["assumed"][0]
    write_rig(folder, film(unit=50.0))
    with refused("expected depths between near and far, 1.5 and 7 in the cameras'"):
        read_scene(tmp_path, "b", depth="depth")


def test_splits_take_the_place_of_the_lists(tmp_path):
    folder = write_rig(tmp_path / "toy", film())
    (folder / "splits").mkdir()
    for name, items in (("train", [0, 1]), ("val", [3]), ("train_mono", [2]), ("val_mono", [0, 1])):
        names = [f"{int(name[:3] == 'val')}_{item:05d}" for item in items]
        (folder / "splits" / f"{name}.json").write_text(json.dumps({"frame_names": names}))
    for split, train, test in ((None, ["0_00000", "0_00001"], ["1_00003"]), ("mono", ["0_00002"], None)):
        scene = read_scene(tmp_path, "toy", split=split)
        assert [f.name for f in scene.train] == train
        assert [f.name for f in scene.test] == (test or ["1_00000", "1_00001"])
    edit(folder / "splits" / "val.json", {"frame_names.0": "0_00001"})
    with refused("val.json: frame_names: expected none of the items to train on, but got '0_000"):
        read_scene(tmp_path, "toy")
    edit(folder / "splits" / "val.json", {"frame_names.0": "none"})
    with refused("val.json: frame_names: expected items of dataset.json's ids, but got"):
        read_scene(tmp_path, "toy")


def test_pixels_of_alpha_0_are_unknown(tmp_path):
    folder = write_rig(tmp_path / "toy", film())
    rgba = np.full((4, 6, 4), 255, np.uint8)
    rgba[0, :3, 3] = 0
    write_image(folder / "rgb" / "2x" / "0_00001.png", rgba)
    masks = [frame.load_valid for frame in read_scene(tmp_path, "toy").train]
    assert [mask is not None for mask in masks] == [False, True, False, False]
    assert torch.equal(masks[1](), torch.tensor(rgba[..., 3] > 0))
    rgba[..., 3] = 0
    write_image(folder / "rgb" / "2x" / "0_00001.png", rgba)
    scene = read_scene(tmp_path, "toy")
    assert [frame.name for frame in scene.train] == ["0_00000", "0_00002", "0_00003"]
    line = (
        "alpha is 0 everywhere in 1 images, which are left out (0_00001, ..); if alpha is of other use, set"
    )
    assert line in str(scene.protocol["assumed"])
    for name in ("0_00000", "0_00002", "0_00003"):
        write_image(folder / "rgb" / "2x" / f"{name}.png", rgba)
    with refused("0_0000.*png: expected a mask with a bright pixel.*set data.masks=off"):
        read_scene(tmp_path, "toy")
    scene = read_scene(tmp_path, "toy", masks="off")
    assert [frame.load_valid for frame in scene.train] == [None] * 4


BAD = {
    "depth/2x/0_00001.npy": (np.zeros((4, 6, 2)), "expected depths \\(H, W\\), but got shape \\(4, 6, 2\\)"),
    "depth/2x/0_00002.npy": (-np.ones((4, 6)), "expected depths >= 0, but got -1; write 0 where"),
    "confidence/2x/0_00001.npy": (np.ones((4, 5)), "expected 6 x 4 .* 0_00001.npy, but got 5 x 4"),
    "confidence/2x/0_00002.npy": (np.full((4, 6), 1.5), "expected confidences from 0 to 1, or levels"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_depth_is_refused_in_a_line(tmp_path, name):
    array, message = BAD[name]
    folder = write_rig(tmp_path / "toy", film())
    np.save(folder / name, array)
    with refused(f"{name.split('/')[-1]}: {message}"):
        [frame.load_sensed() for frame in read_scene(tmp_path, "toy", depth="depth").train]


def test_absent_depth_is_refused_in_a_line(tmp_path):
    folder = write_rig(tmp_path / "toy", rig())
    with refused("data.depth: expected a folder of depths, but got .*/depth/2x; set"):
        read_scene(tmp_path, "toy", depth="depth")
    (folder / "keypoint" / "2x" / "train").mkdir(parents=True)
    (folder / "keypoint" / "2x" / "train" / "left1_000000.json").write_text("[[1, 2]]")
    with refused(r"000000.json: expected a list of \[x, y, seen\], but got"):
        read_scene(tmp_path, "toy")


def test_depth_of_another_size_is_taken_at_the_nearest_pixel(tmp_path):
    camera = phone(0, (12, 8))
    values = np.arange(1, 7, dtype=np.uint8).reshape(2, 3)
    np.save(tmp_path / "a.npy", values)
    np.save(tmp_path / "trust.npy", np.array([[0, 1, 2], [2, 2, 0]], np.uint8))
    depth, trust = SensedDepth(tmp_path / "a.npy", camera, 2.0, tmp_path / "trust.npy")()
    along = camera.rays().directions @ camera.camera_to_world[:3, 2].float()
    expected = torch.tensor(2.0 * values).repeat_interleave(4, 0).repeat_interleave(4, 1)
    torch.testing.assert_close((depth * along.reshape(8, 12)).double(), expected, rtol=1e-5, atol=0)
    assert trust[::4, ::4].tolist() == [[0, 0.5, 1], [1, 1, 0]]
    np.save(tmp_path / "a.npy", np.ones((4, 4)))
    with refused("expected depths of the proportions of its image, 12 x 8 pixels, but"):
        SensedDepth(tmp_path / "a.npy", camera, 1.0)()


def evidence(folder, **changes):
    """What is said of a phone's scene whose stored evidence is changed by functions, by a folder's name."""
    write_rig(folder, film())
    for kind, change in changes.items():
        for path in sorted((folder / kind).rglob("*.*")):
            if path.suffix == ".npy":
                np.save(path, change(np.load(path)))
            elif path.suffix == ".png":
                write_image(path, change(np.array(Image.open(path))))
            else:
                path.write_text(json.dumps([change(row) for row in json.loads(path.read_text())]))
    scene = read_scene(folder.parent, folder.name, depth="depth")
    return "; ".join([*scene.protocol.get("assumed", []), *remarks(scene)])


@pytest.mark.slow
def test_evidence_that_says_little_or_other_things_is_told(tmp_path):
    for number, (kind, change, said) in enumerate(
        [
            ("confidence", lambda values: values, ""),
            ("confidence", lambda values: values > 0.9, ""),
            (
                "confidence",
                lambda values: (100 * values).astype(np.uint8),
                "confidence is at most 0.39, of 1",
            ),
            ("confidence", lambda values: 0 * values, "confidence is at most 0, of 1"),
            ("covisible", lambda mask: 255 - mask, ""),  # half of them in either case
            ("covisible", lambda mask: 0 * mask, "co-visible masks leave 0% of the test images"),
            (
                "keypoint",
                lambda row: [row[0] / 12, row[1] / 8, row[2]],
                "all lie in their first pixel; write x",
            ),
            (
                "keypoint",
                lambda row: [9 * row[0], 9 * row[1], row[2]],
                "lie outside the images; write x and y",
            ),
            (
                "depth",
                lambda depth: np.where(depth == 0, 1000, depth),
                "for holes; mend far in scene.json if",
            ),
        ]
    ):
        told = evidence(tmp_path / str(number), **{kind: change})
        assert said in told
        assert said or not told


def test_evidence_elsewhere_and_cameras_counted_apart_are_told(tmp_path):
    folder = write_rig(tmp_path / "toy", film())
    masks = sorted((folder / "covisible" / "2x" / "val").iterdir())
    masks[0].rename(aside := tmp_path / masks[0].name)
    told = str(read_scene(tmp_path, "toy").protocol["assumed"])
    assert f"covisible: masks of {len(masks) - 1} of {len(masks)} test images; {masks[0].name} is" in told
    aside.rename(masks[0])
    (folder / "covisible" / "2x" / "val").rename(folder / "covisible" / "2x" / "test")
    assert "covisible: none is read, as covisible/2x/test/" in str(
        read_scene(tmp_path, "toy").protocol["assumed"]
    )
    write_rig(tmp_path / "rig")
    for apart, said in ((0, []), (100, ["camera 0 films from time 0 to 0.0385, camera 1 from 0.962 to 1"])):
        edit(
            tmp_path / "rig" / "metadata.json",
            lambda items, by=apart: [
                e.update(time_id=e["time_id"] + by * e["camera_id"]) for e in items.values()
            ],
        )
        lines = [line for line in remarks(read_scene(tmp_path, "rig")) if "films from" in line]
        assert [line.partition(";")[0] for line in lines] == said


def test_points_that_are_normalised_already_are_named(tmp_path):
    points = np.random.default_rng(0).normal(CENTER, 2.0, (50, 3))
    for cloud, is_named in ((points, False), (normalised(points).numpy(), True)):
        write_rig(tmp_path / "toy", rig(size=(12, 8)), points=cloud)
        told = "".join(read_scene(tmp_path, "toy").protocol.get("assumed", []))
        assert ("points lie where the cameras look if they are normalised already" in told) == is_named


def test_a_range_of_the_unscaled_world_is_named(tmp_path):
    folder = write_rig(tmp_path / "toy", rig(size=(12, 8)))
    poses = [frame.camera.camera_to_world[:3, 3] for frame in read_scene(tmp_path, "toy").train]
    away = max(float(place.norm()) for place in poses)
    for far, is_named in ((2 * away, False), (2 * away / SCALE, True)):
        edit(folder / "scene.json", {"near": 0.1 * far, "far": far})
        told = "".join(read_scene(tmp_path, "toy").protocol.get("assumed", []))
        line = f"as if it were not multiplied by scale; if so, write {0.1 * SCALE * far:.4g}"
        assert (line in told) == is_named
