"""Scans by Record3D: an archive of our own making, after public descriptions, becomes a scene with depth."""

import io
import json
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")
pytest.importorskip("lzfse", reason="no lzfse; make install adds it")

import lzfse

from forewarp.capture.record3d import capture_record3d, summary
from forewarp.data.files import SceneError
from forewarp.data.posed_video import read_scene
from tests.support.captures import step
from tests.support.room import shown, walk

SIZE, DEPTH = (36, 48), (9, 12)  # width, height


def poses(count):
    """Cameras 3 m from the origin that look at it along their -z, on a circle about y."""
    for i in range(count):
        half = 0.1 * i / 2
        turned = 3 * np.sin(2 * half), 0.2, 3 * np.cos(2 * half)
        yield [0.0, float(np.sin(half)), 0.0, float(np.cos(half)), *map(float, turned)]


def write_scan(path, count=9, **changes):
    """Write an archive; ``changes`` are of its metadata, or of its files by name, None: without."""
    about = {"w": SIZE[0], "h": SIZE[1], "dw": DEPTH[0], "dh": DEPTH[1], "fps": 30}
    about |= {"K": [50.0, 0, 0, 0, 51.0, 0, 17.0, 25.0, 1], "poses": list(poses(count))}
    rng, files = np.random.default_rng(0), {}
    for i in range(count):
        image, depth = io.BytesIO(), np.full(DEPTH[::-1], 3 + 0.1 * i, np.float32)
        pixels = rng.integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(image, "JPEG", quality=95)
        depth[0, :3] = [np.nan, 0, -1]
        trust = np.full(depth.shape, 2, np.uint8)
        trust[1, :2] = [0, 1]
        files[f"rgbd/{i}.jpg"] = image.getvalue()
        files[f"rgbd/{i}.depth"] = lzfse.compress(depth.tobytes())
        files[f"rgbd/{i}.conf"] = lzfse.compress(trust.tobytes())
    files |= {name: value for name, value in changes.items() if "/" in name}
    about |= {name: value for name, value in changes.items() if "/" not in name}
    files["metadata"] = json.dumps(about).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            if content is not None:
                archive.writestr(name, content)
    return path


def captured(scan, out, **options):
    return capture_record3d(scan, out, step, "capture.json", **options)


@pytest.mark.slow
def test_a_scan_becomes_a_scene_with_its_poses_and_depth(tmp_path):
    facts = captured(write_scan(tmp_path / "a.r3d"), tmp_path / "a")
    assert json.loads((tmp_path / "a" / "capture.json").read_text()) == facts
    assert summary(facts)[0] == "frames: 9 of 9, 36 x 48 pixels, 0.3 s"
    scene = read_scene(tmp_path, "a", normalise=False)
    assert scene.protocol["depth"] == f"axis, of {len(scene.train)} of {len(scene.train)} training frames"
    assert scene.protocol["seconds"] == pytest.approx(8 / 30)
    frame = scene.train[2]
    assert (frame.time, frame.name) == (pytest.approx(0.25), "images/000002")
    camera = frame.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 51, 17, 25)
    _, ahead = camera.project(torch.zeros(3, dtype=torch.float64))
    assert ahead.item() == pytest.approx(3, abs=0.05)  # what is filmed lies before it
    assert camera.camera_to_world[1, 1].item() == pytest.approx(-1, abs=1e-6)  # y points down
    depth, trust = frame.load_sensed()
    along = depth * (camera.rays().directions @ camera.camera_to_world[:3, 2].float()).reshape(depth.shape)
    assert not depth[:4, :12].any()
    assert along[20, 20].item() == pytest.approx(3.2, rel=1e-5)
    assert trust[5, 2::4].tolist()[:3] == [0, 0.5, 1]
    assert (0.7 * 3 < facts["near"] < 3, facts["far"] > 3.8) == (True, True)
    assert read_scene(tmp_path, "a", scale=2, normalise=False).train[0].load().shape == (24, 18, 4)


def test_a_scan_without_poses_is_said(tmp_path):
    still = write_scan(tmp_path / "still.r3d", 5, poses=[[0.0, 0, 0, 1, 1, 2, 3]] * 5)
    lines = summary(captured(still, tmp_path / "still"))
    assert lines[2].startswith("cameras all stand in one place, which tells nothing of depth; compare their")
    assert len(summary(captured(write_scan(tmp_path / "a.r3d", 5), tmp_path / "a"))) == 2


def test_frames_may_be_fewer_and_have_times_and_lenses_of_their_own(tmp_path):
    stamps, lenses = [0.0, 0.1, 0.3, 0.4, 1.0], [[40.0 + i, 41, 18, 24] for i in range(5)]
    own = {"frameTimestamps": stamps, "perFrameIntrinsicCoeffs": lenses, "rgbd/4.conf": None}
    captured(write_scan(tmp_path / "a.r3d", 5, **own), tmp_path / "a", frames=3)
    scene = read_scene(tmp_path, "a", normalise=False, test_every=100)
    frames = sorted((*scene.train, *scene.test), key=lambda frame: frame.time)
    assert [frame.time for frame in frames] == pytest.approx([0, 0.3, 1])
    assert [frame.camera.fx for frame in frames] == [40, 42, 44]
    assert frames[2].load_sensed()[1].max() == 1  # without confidences all are trusted


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": []}, r"metadata: poses: expected a pose of each frame, but got \[\]"),
        ({"rgbd/9.jpg": b"more"}, "metadata: poses: expected one of each of 10 images, but got 9"),
        ({"rgbd/8.jpg": None}, "got 1 of 9 without one, as rgbd/8.jpg; .*, remove its last 1 poses"),
        ({"poses": None}, "metadata: poses: expected a pose of each frame, but got None"),
        ({"perFrameIntrinsicCoeffs": [[9.0] * 4]}, "perFrameIntrinsicCoeffs: expected 9 rows of 4 numbers"),
        ({"poses": [[0.0] * 7] * 9}, r"poses\[0\]: expected a quaternion of length 1, but got 0"),
        ({"poses": [[0.0] * 6] * 9}, r"metadata: poses\[0\]: expected 7 numbers, but got"),
        ({"K": [0.0] * 9}, "metadata: focal length of frame 0: expected above 0, but got 0"),
        ({"K": [1.0]}, r"metadata: K: expected 9 numbers, but got \[1.0\]"),
        ({"dw": None}, "metadata: dw: expected the width and height"),
        ({"dw": 10**5}, r"metadata: dw: expected a number in \[1, 2048\], but got 100000"),
        ({"rgbd/4.depth": bytes(5000)}, "rgbd/4.depth: expected at most 4528 bytes, but got 5000"),
        ({"frameTimestamps": [1.0]}, "frameTimestamps: expected 9 numbers, but got"),
        ({"rgbd/4.depth": b"nothing"}, "rgbd/4.depth: expected data compressed by LZFSE, but got others"),
        ({"rgbd/4.depth": lzfse.compress(bytes(8))}, "4.depth: expected 9 x 12 numbers as dw and dh say"),
        ({"rgbd/4.jpg": None}, "poses: expected an image of each, .* rgbd/4.jpg; export the scan once more$"),
        (
            {"dw": 12, "dh": 9},
            "dw, dh: expected the proportions of w and h, 36 x 48, but got 12 x 9; exchange",
        ),
        ({"K": [100.0, 0, 0, 0, 102.0, 0, 36.0, 48.0, 1]}, "point of frame 0: expected .* 2 times as large"),
        ({"w": 37}, "000000.jpg: expected 37 x 48 pixels, but got 36 x 48"),
    ],
)
def test_what_is_wrong_in_a_scan_is_told_in_a_line(tmp_path, changes, message):
    with pytest.raises(SceneError, match=message) as caught:
        captured(write_scan(tmp_path / "a.r3d", **changes), tmp_path / "a")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
def test_a_small_scan_asks_for_no_more_than_is_said(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.r3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", "[" + "[]," * 30_000_000 + "[]]")
    assert (tmp_path / "a.r3d").stat().st_size < 200_000
    with pytest.raises(SceneError, match="metadata: expected at most 16777216 bytes, but got 90000004"):
        captured(tmp_path / "a.r3d", tmp_path / "a")


@pytest.mark.slow
def test_a_plane_that_unpacks_to_gigabytes_is_refused_before_it_does(tmp_path):
    block = lzfse.compress(bytes(1 << 20))[:-4]  # without the mark of the end
    bomb = block * 3000 + lzfse.compress(b"")[-4:]
    changes = {"dw": 900, "dh": 1200, "rgbd/4.depth": bomb, "rgbd/0.depth": bomb}
    with pytest.raises(SceneError, match="expected 4320000 bytes as dw and dh say, but got many times"):
        captured(write_scan(tmp_path / "a.r3d", **changes), tmp_path / "a")


def test_another_file_is_no_scan(tmp_path):
    with zipfile.ZipFile(tmp_path / "nested.r3d", "w") as archive:
        archive.writestr("metadata", "[" * 100_000)
    with pytest.raises(SceneError, match="metadata: expected JSON, but got"):
        captured(tmp_path / "nested.r3d", tmp_path / "a")
    (tmp_path / "a.r3d").write_bytes(b"text")
    with pytest.raises(SceneError, match="expected a scan of Record3D, a ZIP archive, but got another file"):
        captured(tmp_path / "a.r3d", tmp_path / "a")


def test_times_may_be_of_1970_and_must_grow(tmp_path):
    stamps = [1.7e9 + 0.1 * i**2 for i in range(9)]
    facts = captured(write_scan(tmp_path / "a.r3d", frameTimestamps=stamps), tmp_path / "a")
    assert facts["seconds"] == pytest.approx(6.4)
    with pytest.raises(
        SceneError, match="frameTimestamps: expected seconds that grow, but got .* of frame 4"
    ):
        captured(write_scan(tmp_path / "b.r3d", frameTimestamps=[0, 1, 2, 3, 3, 4, 5, 6, 7]), tmp_path / "b")


def quaternion(pose):
    """x, y, z, w of a rotation (3, 3) with OpenGL's axes."""
    axis = np.array([pose[2, 1] - pose[1, 2], pose[0, 2] - pose[2, 0], pose[1, 0] - pose[0, 1]])
    w = np.sqrt(1 + np.trace(pose)) / 2
    return [*(axis / (4 * w)).tolist(), float(w)]


@pytest.mark.slow
@pytest.mark.parametrize("w_first", [False, True])
def test_the_orders_of_quaternions_and_of_the_matrix_are_told(tmp_path, w_first):
    files, rows, cameras = {}, [], walk(10, (48, 64))
    for i, camera in enumerate(cameras):
        pixels, depth = shown(camera)
        image = io.BytesIO()
        Image.fromarray(pixels).save(image, "JPEG", quality=95)
        files |= {f"rgbd/{i}.jpg": image.getvalue(), f"rgbd/{i}.depth": lzfse.compress(depth.tobytes())}
        files[f"rgbd/{i}.conf"] = None
        x, y, z, w = quaternion((camera.camera_to_world[:3, :3] * torch.tensor([1, -1, -1])).numpy())
        rows.append([*((w, x, y, z) if w_first else (x, y, z, w)), *camera.center.tolist()])
    focal = cameras[0].fx
    about = {"w": 48, "h": 64, "dw": 48, "dh": 64, "K": [focal, 0, 24, 0, focal, 32, 0, 0, 1], "poses": rows}
    facts = captured(write_scan(tmp_path / "a.r3d", 10, **files, **about), tmp_path / "a")
    assert ("w, x, y, z, as neighbouring" in summary(facts)[1]) == w_first
    scene = read_scene(tmp_path, "a", normalise=False)
    assert not [line for line in scene.protocol.get("assumed", []) if "colours" in line]
    for frame in scene.train:
        expected = cameras[int(frame.name[-6:])]
        assert (frame.camera.fx, frame.camera.cx, frame.camera.cy) == (focal, 24, 32)
        torch.testing.assert_close(frame.camera.camera_to_world, expected.camera_to_world, atol=1e-6, rtol=0)
