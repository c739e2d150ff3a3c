"""What neighbouring views show decides between two readings of files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from forewarp.data.agreement import leaning, photo_error
from forewarp.data.images import write_image
from forewarp.data.multicam import read_scene as read_rig
from forewarp.data.multicam import write_poses
from forewarp.data.posed_video import FILE, read_scene
from forewarp.scene.camera import Camera, look_at
from tests.support.written_scenes import (
    MIDDLE,
    UP,
    edit,
    fixed_cameras,
    placed,
    posed_cameras,
    refused,
    write_video,
)

CAMERAS = fixed_cameras(12)


def hits(camera):
    """Where rays of a camera meet an upright wall: points (H, W, 3) about its middle, distances (H, W)."""
    rays = camera.rays(dtype=torch.float64)
    away = (MIDDLE[0] - rays.origins[:, 0]) / rays.directions[:, 0]
    points = rays.origins + away[:, None] * rays.directions - MIDDLE
    return points.reshape(camera.height, camera.width, 3), away.reshape(camera.height, camera.width)


def painted(camera):
    """An image (H, W, 3) of a wall with a pattern that is nowhere the same."""
    _, y, z = hits(camera)[0].unbind(-1)
    waves = [torch.sin(0.9 * y + 0.06 * z * z), torch.sin(1.1 * z + 0.05 * y * y), torch.cos(0.2 * y * z)]
    return 0.5 + 0.4 * torch.stack(waves, -1)


def write_rig(folder, order, paint=painted):
    """Cameras cam1 to cam12, with rows in another order."""
    for k, camera in enumerate(CAMERAS):
        write_image(folder / f"cam{k + 1}" / "0.png", (255 * paint(camera)).byte().numpy())
    write_poses(folder, [CAMERAS[k] for k in order], near=8.0, far=40.0)


@pytest.mark.slow
@pytest.mark.parametrize("by", ["number", "text"])
def test_rows_of_a_rig_are_in_the_order_in_which_views_agree(tmp_path, by):
    texts = sorted(range(12), key=lambda k: f"cam{k + 1}")
    write_rig(tmp_path / "toy", range(12) if by == "number" else texts)
    scene = read_rig(tmp_path, "toy", scale=1)
    assert [line for line in scene.protocol["assumed"] if f"order of names by {by}" in line]
    for frame in (*scene.train, *scene.test):
        expected = placed(scene, CAMERAS[int(frame.name[3:].split("/")[0]) - 1]).camera_to_world
        torch.testing.assert_close(frame.camera.camera_to_world, expected)
    told = read_rig(tmp_path, "toy", scale=1, camera_order=by)
    assert "assumed" not in told.protocol
    torch.testing.assert_close(told.train[5].camera.camera_to_world, scene.train[5].camera.camera_to_world)


@pytest.mark.slow
def test_images_that_do_not_tell_the_order_are_refused(tmp_path):
    write_rig(tmp_path / "toy", range(12), lambda camera: torch.full((camera.height, camera.width, 3), 0.5))
    with refused("cam1, cam2, cam3 by number, cam1, cam10, cam11 as texts.*data.camera_order=number or"):
        read_rig(tmp_path, "toy", scale=1)


def test_views_of_one_place_or_without_texture_tell_nothing():
    cameras = [replace(camera, near=8.0, far=40.0) for camera in CAMERAS[:2]]
    assert photo_error(cameras, [torch.ones(camera.height, camera.width, 3) for camera in cameras]) == np.inf
    nothing = [torch.zeros(camera.height, camera.width) for camera in cameras]
    assert leaning(cameras, [nothing, nothing]) is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["axis", "ray"])
def test_depth_along_rays_is_told_from_depth_along_the_axis(tmp_path, kind):
    folder = write_video(tmp_path / "toy")
    views = posed_cameras(10)
    for i, camera in enumerate(views):
        away = hits(camera)[1]
        axis = camera.rays(dtype=torch.float64).directions @ camera.camera_to_world[:3, 2]
        away = away if kind == "ray" else away * axis.reshape(away.shape)
        away[away < 0] = 0
        (folder / "depth").mkdir(exist_ok=True)
        np.save(folder / "depth" / f"{i}.npy", away.numpy())
    edit(folder / FILE, {f"frames.{i}.depth_file_path": f"depth/{i}.npy" for i in range(len(views))})
    told = read_scene(tmp_path, "toy", depth_kind=kind)
    other = "axis" if kind == "ray" else "ray"
    doubts = [
        [line for line in read_scene(tmp_path, "toy", depth_kind=k).protocol["assumed"] if "unless" in line]
        for k in (kind, other)
    ]
    assert doubts[0] == []
    assert len(doubts[1]) == 1
    assert doubts[1][0].endswith(f"unless data.depth_kind={other} is right, set data.depth_kind={kind}")
    assert told.protocol["depth"].startswith(kind)
    if kind == "ray":
        with refused(r"differ by [\d.]+%, and by .*; set data.depth_kind=ray, or data.depth_kind=axis"):
            read_scene(tmp_path, "toy")
    else:
        torch.testing.assert_close(
            read_scene(tmp_path, "toy").train[0].load_sensed(), told.train[0].load_sensed()
        )


@pytest.mark.parametrize("degrees", [4, 60])
def test_readings_are_told_apart_beside_noise_of_any_baseline(degrees):
    """Distances in a room of 3 units a side, of cameras of a short walk in it, with an error of 2 %."""
    rng, cameras, rays_of, axis_of = np.random.default_rng(0), [], [], []
    for angle in np.radians(degrees) * np.linspace(0, 1, 5):
        place = torch.tensor([1.3 * np.cos(angle), 1.3 * np.sin(angle), 0.3], dtype=torch.float64)
        pose = look_at(place, torch.zeros(3, dtype=torch.float64), UP).double()
        cameras.append(camera := Camera(48, 36, 48.0, 48.0, 24.0, 18.0, pose, 0.1, 9.0))
        rays = camera.rays(dtype=torch.float64)
        away = torch.maximum((1.5 - rays.origins) / rays.directions, (-1.5 - rays.origins) / rays.directions)
        away = (away.amin(-1) * torch.from_numpy(rng.normal(1, 0.02, away.shape[0]))).reshape(36, 48)
        cosine = (rays.directions @ pose[:3, 2]).reshape(36, 48)
        rays_of.append((away / cosine, away))  # read as along the axis, and right
        axis_of.append((away, away * cosine))  # right, and read as along the rays
    wrong, right = (leaning(cameras, [*zip(*both)]) for both in (rays_of, axis_of))
    assert wrong[0] > 0.75 > 0.35 > right[0]
    assert wrong[1] > wrong[2]


@pytest.mark.parametrize("color", [0, 255])
def test_the_alpha_of_a_mask_of_one_colour_is_the_mask(tmp_path, color):
    folder = write_video(tmp_path / "toy")
    pixels = np.full((20, 30, 4), color, np.uint8)
    pixels[..., 3] = 0
    pixels[5:12, 8:20, 3] = 255
    (folder / "masks").mkdir()
    Image.fromarray(pixels).save(folder / "masks" / "m.png")
    edit(folder / FILE, {f"frames.{i}.mask_path": "masks/m.png" for i in range(10)})
    assert torch.equal(
        read_scene(tmp_path, "toy").train[0].load_valid(), torch.from_numpy(pixels[..., 3] > 0)
    )
