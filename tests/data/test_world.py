"""Every reader says where its scene lies in the world of the file."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from forewarp.data import dnerf, hypernerf, multicam, nhr, posed_video
from tests.support.written_scenes import (
    edit,
    fixed_cameras,
    refused,
    write_dnerf,
    write_dome,
    write_lego,
    write_multicam,
    write_rig,
    write_video,
)


def back(scene):
    """The place of each training camera in the file's world, by name."""
    return {frame.name: scene.world.to_data(frame.camera.center).numpy() for frame in scene.train}


def test_of_a_users_own(tmp_path):
    content = json.loads((write_video(tmp_path / "toy") / "transforms.json").read_text())
    places = {frame["file_path"]: np.array(frame["transform_matrix"])[:3, 3] for frame in content["frames"]}
    found = back(posed_video.read_scene(tmp_path, "toy"))
    assert len(found) > 5
    for name, place in found.items():
        np.testing.assert_allclose(
            place, next(p for file, p in places.items() if file.startswith(f"{name}."))
        )


def test_of_nerfies_layout(tmp_path):
    folder = write_rig(tmp_path / "toy")
    found = back(hypernerf.read_scene(tmp_path, "toy", scale=1))
    for name, place in found.items():
        camera = json.loads((folder / "camera" / f"{name}.json").read_text())
        np.testing.assert_allclose(place, camera["position"])


@pytest.mark.slow
def test_of_a_rig(tmp_path):
    cameras = fixed_cameras()
    write_multicam(tmp_path / "toy", cameras)
    scene = multicam.read_scene(tmp_path, "toy", scale=1)
    for frame in scene.train:
        place = scene.world.to_data(frame.camera.camera_to_world)
        torch.testing.assert_close(place, cameras[frame.camera_id].camera_to_world.double())


def test_of_blenders_files_in_other_units(tmp_path):
    folder, wanted = write_dnerf(tmp_path / "toy"), {}

    def larger(content):
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] = 50 * matrix[:3, 3] + 7
            frame["transform_matrix"] = matrix.tolist()
            wanted[frame["file_path"].removeprefix("./")] = matrix[:3, 3]

    for split in ("train", "val", "test"):
        edit(folder / f"transforms_{split}.json", larger)
    found = back(dnerf.read_scene(tmp_path, "toy"))
    assert found
    for name, place in found.items():
        np.testing.assert_allclose(place, wanted[name], rtol=1e-9)


UTM = np.array([456_012.0, 4_650_123.0, 80.0])


def near(camera, other):
    """One camera of both, whose world's origin alone differs."""
    torch.testing.assert_close(camera.camera_to_world, other.camera_to_world, atol=1e-6, rtol=0)
    assert (camera.near, camera.far) == (pytest.approx(other.near), pytest.approx(other.far))


@pytest.mark.slow
def test_exact_scenes_far_from_the_origin_are_moved_to_it_in_their_unit(tmp_path):
    for name, move in (("here", 0.0), ("there", UTM)):
        folder = write_lego(tmp_path / name)
        for file in folder.glob("**/transforms*.json"):
            content = json.loads(file.read_text())
            for frame in content["frames"]:
                pose = np.array(frame["transform_matrix"])
                pose[:3, 3] = 2 * pose[:3, 3] + move  # of another unit than the published
                frame["transform_matrix"] = pose.tolist()
            file.write_text(json.dumps(content))
        with np.load(folder / "trajectories.npz") as stored:
            truth = {"points": 2.0 * stored["points"] + move, "times": stored["times"]}
        np.savez(folder / "trajectories.npz", **truth)
    here, there = (dnerf.read_scene(tmp_path, name, depth_kind="ray") for name in ("here", "there"))
    assert here.world.is_same
    assert there.world.scale == 1
    shift = np.array(there.world.center) - UTM  # what cameras look at, in whole units
    for frame, other in zip(there.train, here.train):
        moved = other.camera.camera_to_world.clone()
        moved[:3, 3] -= torch.from_numpy(shift)
        near(frame.camera, replace(other.camera, camera_to_world=moved))
    np.testing.assert_allclose(there.truth.points.numpy(), here.truth.points.numpy() - shift, atol=1e-4)
    assert torch.equal(there.test[0].load_depth(), here.test[0].load_depth())


def test_domes_far_from_the_origin_are_moved_to_it(tmp_path):
    for name, move in (("here", np.zeros(3)), ("there", UTM)):
        folder = write_dome(tmp_path / name)
        rows = [np.array(line.split(), float) for line in (folder / "CamPose.inf").read_text().splitlines()]
        text = "\n".join(" ".join(map(repr, (row + np.append(np.zeros(9), move)).tolist())) for row in rows)
        (folder / "CamPose.inf").write_text(text)
        for file in folder.glob("pointclouds/*.npy"):
            np.save(file, np.load(file).astype(float) + np.append(move, np.zeros(3)))
    here, there = (nhr.read_scene(tmp_path, name, half_resolution=False) for name in ("here", "there"))
    assert here.world.is_same
    assert np.abs(np.array(there.world.center) - UTM).max() <= 1
    for frame, other in zip(there.train, here.train):
        wanted = other.camera.camera_to_world.clone()
        wanted[:3, 3] += torch.from_numpy(UTM - there.world.center)
        near(frame.camera, replace(other.camera, camera_to_world=wanted))
    assert list(there.box.low) == pytest.approx(np.array(here.box.low) + UTM - there.world.center, abs=1e-6)


def test_a_capture_far_from_its_center_is_refused(tmp_path):
    folder = write_rig(tmp_path / "toy")
    for file in (folder / "camera").glob("*.json"):
        edit(file, lambda camera: camera.update(position=(np.array(camera["position"]) + UTM).tolist()))
    with refused(
        r"scene.json: center: expected the middle of what is filmed, but got .*\[45601.*; write that"
    ):
        hypernerf.read_scene(tmp_path, "toy")
    edit(folder / "scene.json", lambda c: c.update(center=(np.array(c["center"]) + UTM).tolist()))
    hypernerf.read_scene(tmp_path, "toy")
