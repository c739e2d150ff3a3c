"""Scenes of one camera in LLFF's layout, as NSFF and DynamicNeRF have them."""

from dataclasses import replace

import pytest
import torch

from forewarp.data.images import write_image
from forewarp.data.llff import as_transforms
from forewarp.data.multicam import FILE, write_poses
from forewarp.data.multicam import read_scene as read_rig
from forewarp.data.posed_video import read_scene
from tests.support.written_scenes import fixed_cameras, placed, refused

CAMERAS = fixed_cameras(6)


@pytest.fixture
def folder(tmp_path):
    """Images half as large as the rows say."""
    for k, camera in enumerate(CAMERAS):
        pixels = torch.full((camera.height // 2, camera.width // 2, 3), 20 * k, dtype=torch.uint8)
        write_image(tmp_path / "toy" / "images" / f"{k:05d}.png", pixels)
    write_poses(tmp_path / "toy", CAMERAS, near=14.0, far=30.0)
    return tmp_path / "toy"


def test_a_row_of_poses_for_each_image_is_one_film(folder):
    scene = read_scene(folder.parent, "toy")
    frames = {frame.name: frame for frame in (*scene.train, *scene.test)}
    assert [frames[f"images/{k:05d}"].time for k in range(6)] == pytest.approx([k / 5 for k in range(6)])
    for k, camera in enumerate(CAMERAS):
        frame = frames[f"images/{k:05d}"]
        torch.testing.assert_close(frame.camera.camera_to_world, placed(scene, camera).camera_to_world)
        assert frame.camera.fx == pytest.approx(camera.fx / 2)
        assert int(frame.load()[0, 0, 0]) == 20 * k
    assert scene.protocol["near"] / scene.protocol["normalisation"]["scale"] == pytest.approx(14)


@pytest.mark.parametrize("option", [{"axes": "opencv"}, {"inverse": True}])
def test_axes_and_direction_of_rows_are_fixed(folder, option):
    with refused(f"data.{next(iter(option))}: expected none with poses_bounds.npy"):
        read_scene(folder.parent, "toy", **option)


def test_readers_send_to_each_other_in_no_circle(folder):
    with refused("neither; of images/ by one camera that moves: use experiment=video_with_poses"):
        read_rig(folder.parent, "toy")


def test_what_rows_contradict_is_refused(folder):
    write_image(folder / "images" / "00005.png", torch.zeros(16, 16, 3, dtype=torch.uint8))
    with refused("00005.png: expected the proportions of 48 x 32 pixels"):
        as_transforms(folder)
    (folder / "images" / "00005.png").unlink()
    with refused(f"{FILE}: expected a row for each of 5 .*, but got 6 rows"):
        as_transforms(folder)


@pytest.mark.slow
def test_images_as_texts_or_numbers_are_told_by_views(tmp_path):
    for k in range(12):
        write_image(tmp_path / "toy" / "images" / f"{k}.png", torch.zeros(32, 48, 3, dtype=torch.uint8))
    cameras = [replace(camera, near=8.0, far=40.0) for camera in fixed_cameras(12)]
    write_poses(tmp_path / "toy", cameras, near=14.0, far=30.0)
    with refused("images that do not tell; rename images with as many digits each"):
        as_transforms(tmp_path / "toy")
