"""D-NeRF and Lego Complete scenes: what is written is read and real scenes are understood."""

import json
import math

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from forewarp.data import dnerf
from forewarp.data.dnerf import Shot, read_lego_complete, read_scene
from forewarp.data.images import write_image
from forewarp.scene.camera import look_at
from tests.support.written_scenes import (
    ANGLE,
    FEW,
    LEGO_TRUTH,
    UP,
    dnerf_shots,
    edit,
    lego_views,
    real,
    refused,
    write_dnerf,
    write_lego,
)


def test_round_trip_of_a_stock_scene(tmp_path):
    write_dnerf(tmp_path / "toy")
    scene = read_scene(tmp_path, "toy")
    written = {"train": dnerf_shots(4), "val": dnerf_shots(2, 1), "test": dnerf_shots(3, 2)}
    for split, expected in written.items():
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


def test_a_frame_may_name_its_ability_and_missing_times_are_in_the_names(tmp_path):
    write_dnerf(tmp_path / "toy", train=dnerf_shots(4, times=[0.7, 0.2, 0.9, 0.5]))
    assert read_scene(tmp_path, "toy").canonical_time == 0.2  # the smallest training time
    changes = {"frames.1.ability": "time", "frames.1.file_path": "test/r_1.png"}
    edit(tmp_path / "toy" / "transforms_test.json", changes)
    for split in ("train", "val", "test"):
        edit(tmp_path / "toy" / f"transforms_{split}.json", lambda c: [f.pop("time", 0) for f in c["frames"]])
    (tmp_path / "toy" / "train" / "transforms.json").write_text("broken")  # stray files are ignored
    (tmp_path / "toy" / "train" / "r_900.png").write_bytes(b"")
    with refused("one numbering of all images, 0 to 3, but got 0 to 1 for 'val/r_0' .* data.name_pattern"):
        read_scene(tmp_path, "toy")
    scene = read_scene(tmp_path, "toy", name_pattern=r"(?P<camera>\w+)/r_(?P<frame>\d+)")
    assert [f.ability for f in scene.test] == ["all", "time", "all"]
    assert scene.times == pytest.approx((0, 1 / 3, 2 / 3, 1))


@pytest.mark.parametrize(("value", "expected"), [("auto", (8, 6)), (False, (8, 6)), (True, (4, 3))])
def test_half_resolution_of_a_small_scene(tmp_path, value, expected):
    write_dnerf(tmp_path / "toy", test=dnerf_shots(2, depth=True))
    scene = read_scene(tmp_path, "toy", half_resolution=value)
    frame, camera = scene.test[0], scene.test[0].camera
    assert (camera.width, camera.height) == (2 * camera.cx, 2 * camera.cy) == expected
    assert camera.fx == pytest.approx(expected[0] / 2 / np.tan(ANGLE / 2))
    assert frame.load().shape == (*expected[::-1], 4)
    assert frame.load_depth().shape == expected[::-1]
    assert scene.protocol["half_resolution"] is (value is True)


@pytest.mark.parametrize("at_top", [False, True])
def test_a_mask_path_cuts_an_image_out(tmp_path, at_top):
    mask = np.zeros((6, 8), np.uint8)
    mask[2:4, 3:6] = 255
    write_dnerf(tmp_path / "toy")
    write_image(tmp_path / "toy" / "m.jpg", mask)
    for split in ("train", "val", "test"):
        path = tmp_path / "toy" / f"transforms_{split}.json"
        edit(path, lambda c: [d.update(mask_path="m.jpg") for d in ([c] if at_top else c["frames"])])
    scene, bare = read_scene(tmp_path, "toy"), next(dnerf_shots(4)).rgba
    assert scene.has_alpha
    assert np.array_equal(scene.train[0].load()[..., 3], bare[..., 3] * (mask > 0))


def test_a_known_point_projects_where_it_was_painted(tmp_path):
    """The formulas of the format, by hand: x right, y up, looking along -z."""
    write_dnerf(tmp_path / "toy", size=(60, 80))
    content = json.loads((tmp_path / "toy" / "transforms_train.json").read_text())
    matrix, point = np.array(content["frames"][0]["transform_matrix"]), np.array([0.3, -0.2, 0.5])
    local = matrix[:3, :3].T @ (point - matrix[:3, 3])
    focal = 40 / np.tan(ANGLE / 2)
    expected = [focal * local[0] / -local[2] + 40, -focal * local[1] / -local[2] + 30]
    camera = read_scene(tmp_path, "toy", half_resolution=False).train[0].camera
    pixel, depth = camera.project(torch.from_numpy(point))
    assert pixel.tolist() == pytest.approx(expected)
    assert depth.item() == pytest.approx(-local[2])


REAL = {"bouncingballs": 150, "hellwarrior": 100, "hook": 100, "jumpingjacks": 200, "lego": 50, "mutant": 150}


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_real_scenes_read(name):
    scene = read_scene(real("dnerf"), name, box=[-1.5] * 3 + [1.5] * 3)
    assert (len(scene.train), len(scene.test)) == (REAL[name], 20)
    assert len(scene.val) == (11 if name == "lego" else 20)
    assert (scene.canonical_time, scene.times[-1], scene.has_alpha) == (0.0, 1.0, True)
    assert scene.train[0].camera.fx == pytest.approx(555.5555, abs=1e-3)
    assert scene.train[-1].load().shape == (400, 400, 4)


@pytest.mark.slow
def test_the_released_size_halves_to_the_published_one():
    full, half = read_scene(real("dnerf_800"), "hellwarrior"), read_scene(real("dnerf"), "hellwarrior")
    assert (full.protocol["half_resolution"], half.protocol["half_resolution"]) == (True, False)
    pairs = [(*scene.train[::50], *scene.test[::10]) for scene in (full, half)]
    for a, b in zip(*pairs, strict=True):
        assert a.camera.fx == pytest.approx(b.camera.fx)
        assert (a.load().int() - b.load().int()).abs().max() <= 1


@pytest.mark.slow
def test_round_trip_of_three_kinds_of_test_view(tmp_path):
    write_lego(tmp_path / "lift")
    scene = read_lego_complete(tmp_path, "lift")
    assert (len(scene.train), scene.val, scene.canonical_time) == (3, (), 0.0)
    for frame, shot in zip(scene.test, lego_views(), strict=True):
        assert (frame.ability, frame.time) == (shot.ability, shot.time)
        assert np.array_equal(frame.load(), shot.rgba)
        assert np.array_equal(frame.load_depth(), shot.depth)
    assert len({frame.name for frame in scene.test}) == 9
    assert torch.equal(scene.truth.points, LEGO_TRUTH.points)
    assert torch.equal(scene.truth.times, LEGO_TRUTH.times)
    expected = {"dataset": "lego_complete", "training_times": 3, "test_views": FEW}
    assert scene.protocol | expected == scene.protocol


@pytest.mark.slow
def test_what_differs_from_the_published_counts_is_said_once(tmp_path, monkeypatch):
    folder = write_lego(tmp_path / "lift", train=dnerf_shots(4, times=[0, 0, 0.5, 1]))
    edit(folder / "transforms_test_space.json", {"frames.0.time": 0.25})
    edit(folder / "transforms_test_canonical.json", {"frames.0.time": 0.5})
    edit(folder / "transforms_test_canonical.json", lambda c: c["frames"][1].pop("depth_file_path"))
    assert read_lego_complete(tmp_path, "lift").protocol["note"] == (
        "not the published protocol: 3 training times instead of 50; 4 training images at 3 times; "
        "4 space views instead of 200; 3 time views instead of 197; 2 canonical views instead of 50; "
        "1 space views not at a training time; 1 canonical views not at the canonical time; "
        "1 of 9 test views without a depth"
    )
    monkeypatch.setattr(dnerf, "TRAINING_TIMES", 3)
    monkeypatch.setattr(dnerf, "TEST_VIEWS", FEW)
    write_lego(tmp_path / "lift")
    assert "note" not in read_lego_complete(tmp_path, "lift").protocol


@pytest.mark.slow
@pytest.mark.parametrize("place", ["", "frames.1."])
def test_depth_may_be_a_png_with_its_scale(tmp_path, place):
    folder = write_lego(tmp_path / "lift")
    steps = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    iio.imwrite(folder / "d.png", steps)
    changes = {"frames.1.depth_file_path": "d.png", f"{place}depth_scale": 1e-4}
    edit(folder / "transforms_test_time.json", changes)

    def depth(**options):
        frames = read_scene(tmp_path, "lift", **options).test
        return next(f for f in frames if f.name == "test_time/r_1").load_depth()

    np.testing.assert_allclose(depth(), steps * 1e-4, rtol=1e-6)
    halved = depth(half_resolution=True)[0, 0]
    assert halved == pytest.approx((1000 + 8000 + 9000) / 3 * 1e-4)  # of the three met


@pytest.mark.slow
def test_an_ability_may_have_its_file_in_its_folder(tmp_path):
    folder = write_lego(tmp_path / "lift")
    text = (folder / "transforms_test_space.json").read_text()
    (folder / "transforms_test_space.json").unlink()
    (folder / "test_space" / "transforms.json").write_text(text.replace("./test_space/", "./"))
    scene = read_lego_complete(tmp_path, "lift")
    assert scene.protocol["test_views"] == FEW
    assert scene.test[0].name == "test_space/r_0"
    assert scene.test[0].load_depth().shape == (6, 8)


def ball_shots(kind, none=0.0, unit=1.0, radius=1.0):
    """A ball from places near each other, its depth along the ray or the axis."""
    pixel = (torch.arange(64) + 0.5 - 32) / (32 / math.tan(0.5 * ANGLE))
    along = torch.stack([*torch.meshgrid(pixel, pixel, indexing="xy"), torch.ones(64, 64)], -1).double()
    rays = along / along.norm(dim=-1, keepdim=True)
    for i in range(10):
        center = 4.0311 * torch.tensor([math.cos(0.2 * i), math.sin(0.2 * i), 0.0], dtype=torch.float64)
        pose = look_at(center, torch.zeros(3, dtype=torch.float64), UP).double()
        b = (rays @ pose[:3, :3].T) @ center
        depth = -b - (b * b - center @ center + radius**2).clamp(min=0).sqrt()
        depth = depth if kind == "ray" else depth * rays[..., 2]
        depth = torch.where(b * b > center @ center - radius**2, depth * unit, none)
        rgba = torch.full((64, 64, 4), 100 + i, dtype=torch.uint8)
        yield Shot(f"r_{i}", i / 9, pose, rgba, depth.float())


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "other"), [("ray", "axis"), ("axis", "ray")])
def test_which_kind_exact_depth_is_follows_from_near_views(tmp_path, kind, other):
    exact = [shot.depth for shot in ball_shots("ray", radius=1.8)]
    write_dnerf(tmp_path / "toy", (64, 64), test=ball_shots(kind, radius=1.8))
    scene = read_scene(tmp_path, "toy", depth_kind=kind)
    assert not [line for line in scene.protocol.get("assumed", []) if "depth" in line]
    for frame, depth in zip(scene.test, exact):
        torch.testing.assert_close(frame.load_depth(), depth, rtol=1e-5, atol=1e-6)
    (line,) = read_scene(tmp_path, "toy", depth_kind=other).protocol["assumed"]
    assert line.endswith(f"unless data.depth_kind={other} is right, set data.depth_kind={kind}")
    if kind == "axis":
        with refused("expected depths along the pixels' rays, but got .* set data.depth_kind=axis, or"):
            read_scene(tmp_path, "toy")
    else:
        (line,) = read_scene(tmp_path, "toy").protocol["assumed"]
        assert "taken for depth along the pixels' rays; if it is along the optical axis, set" in line


@pytest.mark.slow
@pytest.mark.parametrize("none", [1e10, 65504.0, 1000.0, 5.0])
def test_a_renderers_number_for_no_depth_is_background_and_said(tmp_path, none):
    write_dnerf(tmp_path / "toy", (64, 64), test=ball_shots("ray", none))
    scene = read_scene(tmp_path, "toy", depth_kind="ray")
    for frame, shot in zip(scene.test, ball_shots("ray")):
        assert torch.equal(frame.load_depth(), shot.depth)
    why = "beyond far, 6" if none > 6 else "the largest of their image, where other views do not see it"
    assert f"are {none:.6g}, {why}: taken for holes" in scene.protocol["assumed"][0]


@pytest.mark.slow
def test_depth_in_another_unit_is_told_with_its_scale(tmp_path):
    folder = write_dnerf(tmp_path / "toy", (64, 64), test=ball_shots("ray", unit=1000.0))
    (line, _) = read_scene(tmp_path, "toy").protocol["assumed"]
    assert line.endswith("with near at 2 and far at 6; write depth_scale: 0.001 beside the frames")
    edit(folder / "transforms_test.json", {"depth_scale": 1e-3})
    assert not [line for line in read_scene(tmp_path, "toy").protocol["assumed"] if "in the median" in line]
