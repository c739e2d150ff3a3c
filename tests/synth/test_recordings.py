"""A rig's films show what the truth says: frames, times, masks and sound; a phone's film has its depth."""

import json
import subprocess
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from filecmp import cmpfiles

import imageio_ffmpeg
import numpy as np
import pytest
import torch

from forewarp.data import hypernerf, multicam, posed_video
from forewarp.data.video import stamps_of
from forewarp.synth import raycast, recordings
from forewarp.synth.movers import SHADOW_RAYS, hall, moving_faces, placed_movers
from forewarp.synth.raycast import Posed, camera_rays, render
from forewarp.synth.recordings import FPS, HERTZ, lidar, rig, synthesize_iphone, synthesize_multicam
from tests.support.films import read_film

SIZE, FRAMES, CAMERAS = 64, 6, 3
LUMA = (0.299, 0.587, 0.114)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a tiny rig's films."""
    seen = []
    folder = tmp_path_factory.mktemp("rig") / "films"
    arguments = {"cameras": CAMERAS, "frames": FRAMES, "size": SIZE, "samples_per_pixel": 2, "workers": 1}
    synthesize_multicam(folder, **arguments, progress=lambda *counts: seen.append(counts))
    assert seen == [(done, CAMERAS * FRAMES) for done in range(1, CAMERAS * FRAMES + 1)]
    return folder


@pytest.fixture(scope="module")
def truth(made):
    """What its file says."""
    return json.loads((made / "truth.json").read_text())


@pytest.fixture(scope="module")
def scene(made):
    """Its true scene."""
    return posed_video.read_scene(made, "truth", normalise=False, test_cameras=["cam01"])


def heard(path):
    """The sound of a video, float64 at ``HERTZ``."""
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-f", "s16le", "-ar", str(HERTZ)]
    raw = subprocess.run([*call, "-"], capture_output=True, check=True).stdout
    return np.frombuffer(raw, "<i2") / 32768


@pytest.mark.slow
def test_films_hold_the_true_frames_at_the_true_rates(made, truth, scene):
    frames = {frame.name: frame for frame in (*scene.train, *scene.test)}
    assert len(frames) == CAMERAS * FRAMES
    assert [camera["fps"] for camera in truth["cameras"]] == [29.97, 30, 29.97]
    offsets = [camera["offset"] for camera in truth["cameras"]]
    assert min(offsets) == 0 < max(offsets) < recordings.LATEST
    for camera in truth["cameras"]:
        path = made / f"{camera['name']}.mp4"
        np.testing.assert_allclose(stamps_of(path), np.arange(FRAMES) / camera["fps"], atol=1e-4)
        film = read_film(path, SIZE * 3 // 4, SIZE)
        of_camera = [frames[f"images/{camera['name']}_{number:04d}"] for number in range(FRAMES)]
        true = np.stack([frame.load()[..., :3].numpy() for frame in of_camera])
        away = np.abs((film[:, None] @ LUMA) - (true @ LUMA)).mean((2, 3))  # colours are coarser in a film
        assert away.argmin(1).tolist() == [*range(FRAMES)]
        assert away.diagonal().max() < 3
        for number, frame in enumerate(of_camera):
            seconds = camera["offset"] + number / camera["fps"]
            assert frame.time * truth["seconds"] == pytest.approx(seconds)
            np.testing.assert_allclose(frame.camera.camera_to_world, camera["camera_to_world"], atol=1e-9)
    assert {frame.name[7:12] for frame in scene.test} == {"cam01"}


@pytest.mark.slow
def test_a_frame_of_which_only_what_moves_is_rendered_is_the_whole_image(truth, scene):
    frame, world = scene.train[-1], hall(truth["seconds"])
    whole, _ = render(world, frame.time, frame.camera, 2, SHADOW_RAYS)
    away = np.abs(whole[..., :3].astype(float) - frame.load()[..., :3].numpy())
    assert away.mean() < 3
    assert away.max() < 30  # a JPEG's error


def test_masks_mark_the_movers_alone(truth, scene):
    for frame in scene.test:
        mask = frame.load_moving().numpy()
        assert 0.01 < mask.mean() < 0.1
        for vertices in placed_movers(hall(truth["seconds"]), frame.time).values():
            column, row = frame.camera.project(vertices.mean(0))[0].long().tolist()
            assert mask[row, column]


def test_all_cameras_hear_one_clap_at_its_true_time(made, truth):
    for camera in truth["cameras"]:
        sound = heard(made / f"{camera['name']}.mp4")
        assert len(sound) == pytest.approx(FRAMES / camera["fps"] * HERTZ, abs=1100)
        loud = np.flatnonzero(np.abs(sound) > 0.2)
        assert loud[0] / HERTZ + camera["offset"] == pytest.approx(truth["clap"], abs=2e-3)
        assert (loud[-1] - loud[0]) / HERTZ < 0.05
        before = sound[: loud[0] - HERTZ // 100]
        assert 0.003 < before.std() < 0.03


@pytest.mark.slow
def test_a_synchronised_rig_is_in_the_layout_of_dynerf(tmp_path):
    arguments = {"cameras": 2, "frames": 2, "size": 32, "samples_per_pixel": 1, "workers": 1}
    synthesize_multicam(tmp_path / "rig", **arguments, synchronised=True)
    scene = multicam.read_scene(tmp_path, "rig", scale=1, normalise=False)
    same = posed_video.read_scene(tmp_path / "rig", "truth", normalise=False, test_cameras=["cam00"])
    assert (len(scene.train), len(scene.test)) == (len(same.train), len(same.test)) == (2, 2)
    for frame, true in zip(scene.train + scene.test, same.train + same.test):
        assert (frame.time, frame.camera_id) == (true.time, true.camera_id)
        torch.testing.assert_close(frame.camera.camera_to_world, true.camera.camera_to_world)
        assert frame.camera.fx == pytest.approx(true.camera.fx)
        gray, true_gray = (image.load()[..., :3].numpy() @ LUMA for image in (frame, true))
        assert np.abs(gray - true_gray).mean() < 3


BOTH = [(synthesize_multicam, {"cameras": 2, "size": 16}), (synthesize_iphone, {"size": 12})]


@pytest.mark.slow
@pytest.mark.parametrize(("write", "arguments"), BOTH)
def test_images_do_not_depend_on_the_number_of_processes(tmp_path, monkeypatch, write, arguments):
    """Threads take the processes' place, which start slowly."""
    monkeypatch.setattr(raycast, "ProcessPoolExecutor", lambda workers, *_: ThreadPoolExecutor(workers))
    for workers in (1, 2):
        write(tmp_path / str(workers), **arguments, frames=2, samples_per_pixel=1, workers=workers)
    names = [path.relative_to(tmp_path / "1") for path in (tmp_path / "1").rglob("*.*g")]
    assert len(names) >= 8
    assert cmpfiles(tmp_path / "1", tmp_path / "2", names, shallow=False) == (names, [], [])


def test_cameras_surround_the_movers_and_neighbours_see_alike():
    cameras = rig(12, 676, seed=3)
    assert {(c.width, c.height) for c in cameras} == {(676, 506)}
    axes = np.stack([c.camera_to_world[:3, 2].numpy() for c in cameras])
    apart = np.degrees(np.arccos((axes[1:] * axes[:-1]).sum(-1)))
    assert apart.max() < 15.5
    around = np.degrees(np.unwrap(np.arctan2(axes[:, 1], axes[:, 0])))
    assert 120 < abs(around[-1] - around[0]) < 180
    for time in np.linspace(0, 1, 7):
        for vertices in placed_movers(hall(4.0), time).values():
            for camera in cameras:
                distance = np.linalg.norm(vertices - camera.center.numpy(), axis=-1)
                assert 1.9 < distance.min() <= distance.max() < 4
                pixels, depth = camera.project(vertices)
                assert ((pixels > 0) & (pixels < torch.tensor([676, 506]))).all()
                assert (depth > 0).all()


# A phone with a LiDAR --------------------------------------------------------------------------------------

FILMED, WIDE = 12, 48


@pytest.fixture(scope="module")
def phone(tmp_path_factory):
    """The folder of a tiny film by a phone."""
    root, seen = tmp_path_factory.mktemp("phone"), []
    arguments = {"frames": FILMED, "size": WIDE, "beside": 4, "samples_per_pixel": 1, "workers": 1}
    synthesize_iphone(root / "film", **arguments, progress=lambda *counts: seen.append(counts))
    assert seen == [(done, FILMED + 2 * 3) for done in range(1, FILMED + 2 * 3 + 1)]
    return root / "film"


@pytest.fixture(scope="module")
def capture(phone):
    """What is read of it."""
    return hypernerf.read_scene(phone.parent, phone.name, scale=1, depth="depth")


def in_metres(phone, camera):
    """A camera in the file's unit, and the reader's units for one of that."""
    world = json.loads((phone / "scene.json").read_text())
    pose = camera.camera_to_world.clone()
    pose[:3, 3] = pose[:3, 3] / world["scale"] + torch.tensor(world["center"])
    return replace(camera, camera_to_world=pose), world["scale"]


@pytest.mark.slow
def test_a_film_by_a_phone_reads_as_the_layout_says(phone, capture):
    assert (len(capture.train), len(capture.test)) == (FILMED, 6)
    assert [frame.camera_id for frame in capture.test] == [1, 1, 1, 2, 2, 2]
    assert capture.protocol["seconds"] == pytest.approx((FILMED - 1) / FPS)
    val = json.loads((phone / "splits" / "val.json").read_text())
    names = [f"{k}_{t:05d}" for k in (1, 2) for t in (0, 4, 8)]
    assert val == {"frame_names": names, "time_ids": [0, 4, 8] * 2, "camera_ids": [1] * 3 + [2] * 3}
    extra = json.loads((phone / "extra.json").read_text())
    assert {"factor", "fps", "bbox", "lookat", "up"} == {*extra}
    assert (np.abs(extra["bbox"]) <= 0.5).all()
    for points in (capture.still, capture.truth.points[:, 0]):
        assert len(points) > 500
        assert (points.abs() < 1).all()
    paths = capture.truth.points[:, [1, -1]]
    assert 0.02 < float((paths[:, 0] - paths[:, 1]).norm(dim=-1).max()) < 0.2


@pytest.mark.slow
def test_its_depth_is_true_within_the_error_but_for_the_holes(phone, capture):
    errors = []
    for frame in capture.train:
        camera, scale = in_metres(phone, frame.camera)
        _, true = render(hall((FILMED - 1) / FPS), frame.time, camera, 1, 1)
        depth = frame.load_sensed()[0].numpy() / scale
        there = depth > 0
        assert 0.6 < there.mean() < 0.95
        assert true[there].max() < recordings.REACH
        errors.append((depth[there] / true[there] - 1).ravel())
    assert np.concatenate(errors).std() == pytest.approx(recordings.DEPTH_ERROR, rel=0.05)
    assert np.abs(np.concatenate(errors).mean()) < 5e-4


def test_a_lidar_has_holes_at_edges_and_beyond_its_reach():
    camera = rig(2, 64, 0)[0]
    distance = np.full((camera.height, camera.width), 2.0)
    distance[:, 40:] = 3.0
    distance[:8] = recordings.REACH + 0.1
    depth = lidar(camera, distance, np.random.default_rng(0))
    assert not depth[:8].any()
    assert not depth[:, 39:41].any()
    assert 0.9 < (depth[10:] > 0).mean() < 1


@pytest.mark.slow
def test_covisible_pixels_are_those_that_enough_images_show(phone, capture):
    """By the images' true depth maps, another way than rays to the points."""
    world = hall((FILMED - 1) / FPS)
    train = [(frame.time, in_metres(phone, frame.camera)[0]) for frame in capture.train]
    maps = [render(world, time, camera, 1, 1)[1] for time, camera in train]
    for frame in capture.test[1::3]:
        camera, _ = in_metres(phone, frame.camera)
        hits = Posed(world, frame.time).first_hits(*camera_rays(camera))
        counts = np.zeros(len(hits.face))
        for (time, taker), depth in zip(train, maps):
            points = torch.from_numpy(world.points(hits.face, hits.barycentric, time))
            pixel, along = taker.project(points)
            column, row = pixel.floor().long().unbind(-1)
            inside = (column >= 0) & (column < WIDE) & (row >= 0) & (row < depth.shape[0]) & (along > 0)
            rows = np.flatnonzero(inside)
            distance = (points[rows] - taker.center).norm(dim=-1).numpy()
            counts[rows] += np.abs(depth[row[rows], column[rows]] - distance) < 0.05 * distance
        covisible = frame.load_covisible().numpy().ravel()
        assert 0.4 < covisible.mean() < 0.95
        assert (covisible == (counts > 5)).mean() > 0.97
        assert moving_faces(world)[hits.face[covisible]].any()


@pytest.mark.slow
def test_keypoints_follow_the_movers(phone, capture):
    marked = [frame for frame in capture.train if frame.keypoints is not None]
    moments = np.linspace(0, FILMED, 10, endpoint=False).astype(int)
    assert [frame.name for frame in marked] == [f"0_{moment:05d}" for moment in moments]
    world = hall((FILMED - 1) / FPS)
    for frame in marked:
        assert len(frame.keypoints) == recordings.KEYPOINTS
        seen = frame.keypoints[:, 2] == 1
        assert seen.sum() > recordings.KEYPOINTS / 2
        assert not frame.keypoints[~seen].any()
        camera, _ = in_metres(phone, frame.camera)
        hits = Posed(world, frame.time).first_hits(*camera_rays(camera))
        moving = moving_faces(world)[hits.face].reshape(camera.height, camera.width)
        centers = np.argwhere(moving)[:, ::-1] + 0.5
        away = np.abs(frame.keypoints[seen, None, :2].numpy() - centers).max(-1).min(1)
        assert away.max() < 1  # a pixel's centre may lie beside a point that it shows
