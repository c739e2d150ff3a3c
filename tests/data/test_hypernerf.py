"""HyperNeRF captures: what is written is read, and real ones are understood."""

import json
import math
import shutil

import numpy as np
import pytest
import torch

from forewarp.data.hypernerf import read_camera, read_scene, reduced, write_camera
from forewarp.data.images import write_png
from forewarp.data.module import HyperNeRFDataModule
from tests.support.dnerf_scene import real
from tests.support.rig_scene import CENTER, FAR, LENS, NEAR, SCALE, edit, hand, phone, rig, truth, write_rig

MIDDLE = torch.tensor(CENTER, dtype=torch.float64)


def normalised(points):
    return (torch.as_tensor(points).double() - MIDDLE) * SCALE


def by_name(scene):
    return {frame.name: frame for frame in (*scene.train, *scene.test)}


@pytest.mark.parametrize("scale", [1, 2])
def test_round_trip_of_a_rig(tmp_path, scale):
    write_rig(tmp_path / "toy", rig(size=(12, 8), skew=2.0))
    scene = read_scene(tmp_path, "toy", scale=scale)
    frames, shots = by_name(scene), list(rig(size=(12, 8), skew=2.0))
    assert len(frames) == len(shots) == 10
    for shot in shots:
        frame, camera = frames[shot.name], frames[shot.name].camera
        assert frame.time == shot.time_id / 4
        expected = shot.camera.camera_to_world.clone()
        expected[:3, 3] = normalised(expected[:3, 3])
        torch.testing.assert_close(camera.camera_to_world, expected, atol=1e-6, rtol=0)
        assert (camera.width, camera.height) == (12 // scale, 8 // scale)
        for key in ("fx", "fy", "cx", "cy", "skew"):
            assert getattr(camera, key) == pytest.approx(getattr(shot.camera, key) / scale, rel=1e-12)
        assert camera.lens == shot.camera.lens
        assert (camera.near, camera.far) == (NEAR, FAR)
        blocks = shot.rgb.reshape(8 // scale, scale, 12 // scale, scale, 3).mean((1, 3))
        assert np.array_equal(frame.load()[..., :3], np.rint(blocks))
        assert (frame.load()[..., 3] == 255).all()
    assert (scene.has_alpha, scene.val, scene.truth, scene.still) == (False, (), None, None)


def test_a_rig_is_split_as_it_says(tmp_path):
    shots = [*rig()]
    write_rig(tmp_path / "toy", [*shots[:-1], shots[-1].__class__(**{**vars(shots[-1]), "split": ""})])
    scene = read_scene(tmp_path, "toy")
    assert [f.name for f in scene.train] == [s.name for s in shots if s.split == "train"]
    assert [f.name for f in scene.test] == [s.name for s in shots[:-1] if s.split == "val"]
    assert {f.ability for f in scene.test} == {"all"}
    assert scene.times == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert scene.canonical_time == 0.5
    assert scene.protocol == {
        "dataset": "hypernerf",
        "scale": 2,
        "split": "vrig",
        "resolution": [6, 4],
        "train_frames": 5,
        "test_frames": 4,
    }


def test_without_val_ids_every_fourth_is_trained_on(tmp_path):
    write_rig(tmp_path / "toy", hand(11))
    scene = read_scene(tmp_path, "toy")
    assert [f.name for f in scene.train] == ["000001", "000005", "000009"]
    assert [f.name for f in scene.test] == ["000003", "000007"]
    assert scene.times == pytest.approx((0.0, 0.4, 0.8))  # of all items the last is at 1
    assert scene.canonical_time == 0.4
    assert scene.protocol["split"] == "interpolation"


@pytest.mark.parametrize("write_time_id", [True, False])
def test_time_id_counts_before_warp_id(tmp_path, write_time_id):
    folder = write_rig(tmp_path / "toy", hand(5), write_time_id=write_time_id)
    edit(folder, "metadata", lambda c: [entry.update(warp_id=entry["warp_id"] ** 2) for entry in c.values()])
    scene = read_scene(tmp_path, "toy")
    assert scene.test[0].time == (0.5 if write_time_id else 0.25)


def test_entries_that_no_item_has_decide_nothing(tmp_path):
    folder = write_rig(tmp_path / "toy", hand(5), write_time_id=False)
    expected = read_scene(tmp_path, "toy").test[0].time
    edit(folder, "metadata", lambda c: c.update(ghost={"time_id": 90, "warp_id": 90}, other=3))
    (folder / "camera" / "ghost.json").write_text("none")
    assert read_scene(tmp_path, "toy").test[0].time == expected


def test_points_and_trajectories_are_normalised(tmp_path):
    points = np.array([[1.0, 2, 3], [2.5, -1, 0.75]], np.float32)
    write_rig(tmp_path / "toy", points=points, trajectories=truth())
    scene = read_scene(tmp_path, "toy")
    assert scene.still.dtype == scene.truth.points.dtype == torch.float32
    torch.testing.assert_close(scene.still.double(), normalised(points), atol=1e-6, rtol=0)
    torch.testing.assert_close(scene.truth.points.double(), normalised(truth().points), atol=1e-6, rtol=0)
    assert torch.equal(scene.truth.times, truth().times)


def test_a_rewritten_capture_keeps_nothing_of_the_old_one(tmp_path):
    write_rig(tmp_path / "toy", points=np.zeros((1, 3)), trajectories=truth(), scales=(1, 2, 4))
    folder = write_rig(tmp_path / "toy", hand(5))
    scene = read_scene(tmp_path, "toy")
    assert (scene.still, scene.truth) == (None, None)
    assert len(list(folder.rglob("*.png"))) == 10
    assert not list(folder.rglob("*.partial"))


def test_a_run_cut_short_leaves_no_readable_capture(tmp_path):
    folder = write_rig(tmp_path / "toy")

    def broken():
        yield from hand(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_rig(folder, broken())
    assert not (folder / "dataset.json").exists()


def printed_formulas(content, point, ratio):
    """Where FORMATS says that a point of the unscaled world lies in the image ``ratio`` times as large."""
    x, y, z = np.array(content["orientation"]) @ (point - np.array(content["position"]))
    x, y = x / z, y / z
    (k1, k2, k3), (p1, p2) = content["radial_distortion"], content["tangential_distortion"]
    r2 = x * x + y * y
    s = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * s + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * s + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    u = content["focal_length"] * xd + content["skew"] * yd + content["principal_point"][0]
    v = content["focal_length"] * content["pixel_aspect_ratio"] * yd + content["principal_point"][1]
    return ratio * np.array([u, v]), z


@pytest.mark.parametrize("scale", [1, 2])
def test_a_point_projects_where_the_files_say(tmp_path, scale):
    folder = write_rig(tmp_path / "toy", rig(size=(480, 320), times=2, skew=7.0))
    point = np.array(CENTER) + [0.4, -0.3, 0.6]
    for frame in by_name(read_scene(tmp_path, "toy", scale=scale)).values():
        content = json.loads((folder / "camera" / f"{frame.name}.json").read_text())
        expected, z = printed_formulas(content, point, 1 / scale)
        pixel, depth = frame.camera.project(normalised(point))
        assert pixel.tolist() == pytest.approx(expected.tolist(), abs=1e-9)
        assert depth.item() == pytest.approx(z * SCALE)


def test_a_painted_point_is_where_it_was_painted(tmp_path):
    """Spots drawn by hand-made projection; the reader's cameras must find them in the pixels, sub-pixel."""
    points = np.array(CENTER) + np.array([[0.5, 0.4, 0.3], [-0.6, 0.2, -0.4], [0.1, -0.7, 0.5]])

    def painted():
        for shot in rig(size=(240, 160), times=2, skew=9.0):
            write_camera(tmp_path / "camera.json", shot.camera)
            content = json.loads((tmp_path / "camera.json").read_text())
            row, column = np.mgrid[0.5:160, 0.5:240]
            rgb = np.zeros((160, 240, 3))
            for channel, point in enumerate(points):
                (u, v), _ = printed_formulas(content, point, 1)
                rgb[..., channel] = 255 * np.exp(-((column - u) ** 2 + (row - v) ** 2) / (2 * 3.0**2))
            yield shot.__class__(**{**vars(shot), "rgb": np.rint(rgb).astype(np.uint8)})

    write_rig(tmp_path / "toy", painted())
    for frame in by_name(read_scene(tmp_path, "toy", scale=2)).values():
        image = frame.load()[..., :3].double()
        row, column = torch.meshgrid(torch.arange(80) + 0.5, torch.arange(120) + 0.5, indexing="ij")
        for channel, point in enumerate(points):
            weight = image[..., channel] / image[..., channel].sum()
            seen = torch.stack([(weight * column).sum(), (weight * row).sum()])
            assert (frame.camera.project(normalised(point))[0] - seen).norm() < 0.1


def test_without_a_box_all_training_rays_are_bounded(tmp_path):
    write_rig(tmp_path / "toy")
    scene = read_scene(tmp_path, "toy")
    low, high = torch.tensor(scene.box.low), torch.tensor(scene.box.high)
    for frame in scene.train:
        rays = frame.camera.rays()
        for distance in (NEAR, FAR):
            points = rays.origins + distance * rays.directions
            assert ((points > low - 0.05) & (points < high + 0.05)).all()
    assert read_scene(tmp_path, "toy", box=[-1, -2, -3, 1, 2, 3]).box.high == (1, 2, 3)


def test_the_module_reads_the_scale_it_is_told(tmp_path):
    write_rig(tmp_path / "toy")
    module = HyperNeRFDataModule(
        tmp_path, "toy", scale=1, rays=7, background="random", eval_background="black"
    )
    module.setup()
    batch = module.batches.draw()
    assert (len(batch), batch.observations[0].background.shape) == (7, (7, 3))
    assert module.scene.protocol["background"] == "none"
    target = module.targets("test")[0]
    assert (target.rgb.shape, target.foreground) == ((8, 12, 3), None)


def test_sizes_are_rounded_and_the_lens_stays():
    small = reduced(phone(1, size=(1073, 719)), 4)
    assert (small.width, small.height) == (268, 180)
    assert small.fx == pytest.approx(1.1 * 1073 / 4)
    assert small.lens == LENS


def test_both_spellings_of_the_tangential_distortion(tmp_path):
    path = tmp_path / "camera.json"
    write_camera(path, phone(1))
    assert read_camera(path, 1, 2).lens == LENS
    edit(tmp_path, "camera", lambda c: c.update(tangential=[0.001, 0.002]))
    assert read_camera(path, 1, 2).lens.p == (0.001, 0.002)
    edit(tmp_path, "camera", lambda c: [c.pop(k) for k in ("tangential_distortion", "tangential")])
    assert read_camera(path, 1, 2).lens.p == (0, 0)


def test_a_genuine_lens_is_undone():
    path = real("hypernerf") / "camera-with-distortion" / "camera.json"
    content = json.loads(path.read_text())
    camera = read_camera(path, 0.1, 2.0)
    assert camera.lens.p == tuple(content["tangential"])
    assert (camera.width, camera.height, camera.skew) == (2448, 3264, 0)
    assert camera.fy == pytest.approx(camera.fx * 1.0010612377729717)
    pixels = torch.arange(0, 2448 * 3264, 4999)
    rays = camera.rays(pixels, dtype=torch.float64)
    again, depth = camera.project(rays.origins + 1.7 * rays.directions)
    expected = torch.stack([pixels % 2448, pixels // 2448], -1) + 0.5
    assert (again - expected).abs().max() < 1e-3  # its orientation has the digits of float32
    assert (depth > 0).all()
    # The lens matters: the picture's corner moves by some pixels.
    x, y = (0.5 - camera.cx) / camera.fx, (0.5 - camera.cy) / camera.fy
    bent = camera.lens.bend(torch.tensor([x, y], dtype=torch.float64))
    assert math.hypot(bent[0] - x, bent[1] - y) * camera.fx > 3


def test_a_genuine_capture_by_three_phones_is_understood(tmp_path):
    source = real("hypernerf") / "paper-windmill-no-images"
    folder = tmp_path / "windmill"
    (folder / "rgb" / "2x").mkdir(parents=True)
    for name in ("dataset.json", "metadata.json", "scene.json"):
        shutil.copy(source / name, folder)
    (folder / "camera").symlink_to(source / "camera")
    ids = json.loads((source / "dataset.json").read_text())["ids"]
    write_png(tmp_path / "blank.png", np.zeros((480, 360, 3), np.uint8))
    for item in ids:
        (folder / "rgb" / "2x" / f"{item}.png").symlink_to(tmp_path / "blank.png")
    scene = read_scene(tmp_path, "windmill")
    assert (len(scene.train), len(scene.test), scene.protocol["split"]) == (277, 419, "vrig")
    assert (scene.canonical_time, scene.times[-1]) == (0.5, 1.0)
    assert scene.train[0].camera.near == pytest.approx(0.10891095985144743)
    assert scene.train[0].camera.lens is None
    for frame in scene.train:  # the phone is carried around what it looks at
        assert frame.camera.center.norm() < 2
    left, right = {f.name: f for f in scene.train}["0_00000"], {f.name: f for f in scene.test}["1_00000"]
    assert left.time == right.time == 0


def test_a_genuine_hand_held_video_is_understood():
    scene = read_scene(real("hypernerf"), "moving-hand")
    assert (len(scene.train), len(scene.test)) == (22, 21)
    assert scene.protocol["resolution"] == [256, 192]
    assert scene.train[0].load().shape == (192, 256, 4)
    assert scene.canonical_time == pytest.approx(40 / 85)
    assert scene.train[0].time < scene.test[0].time < scene.train[1].time
    assert scene.still is None
