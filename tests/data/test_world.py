"""Every reader says where its scene lies in the world of the file."""

import json

import numpy as np
import torch

from forewarp.data import dnerf, hypernerf, multicam, posed_video
from tests.support.written_scenes import (
    edit,
    fixed_cameras,
    write_dnerf,
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
