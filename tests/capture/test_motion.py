"""Tell what moves from what only the camera makes move."""

import numpy as np
import pytest
import torch

pytest.importorskip("cv2")

from forewarp.capture.frames import frames_for  # noqa: E402
from forewarp.capture.motion import moving_masks  # noqa: E402
from forewarp.data.images import write_image  # noqa: E402
from forewarp.scene.camera import Camera  # noqa: E402

WIDTH, HEIGHT, FOCAL, COUNT = 160, 120, 160.0, 9


def film(folder, patch_speed):
    """Write a film of a wall at distance 1, before which a camera goes 3 pixels a frame to the right; a patch
    of the wall goes down. Return paths, cameras and the patch's true masks.
    """
    draw = np.random.default_rng(0)
    texture = [
        draw.integers(0, 255, (60, 90, 3)).astype(np.uint8).repeat(4, 0).repeat(4, 1) for _ in range(2)
    ]
    paths, cameras, truth = [], [], []
    for i in range(COUNT):
        image = texture[0][40 : 40 + HEIGHT, 3 * i : 3 * i + WIDTH].copy()
        top, left = 20 + round(patch_speed * i), 60 - 3 * i + 24
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[top : top + 40, left : left + 50] = True
        image[mask] = texture[1][:40, :50].reshape(-1, 3)
        paths.append(folder / f"{i:02d}.png")
        write_image(paths[-1], image)
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = 3 * i / FOCAL
        cameras.append(Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose, 0.1, 10.0))
        truth.append(mask)
    return paths, cameras, truth


def test_what_goes_another_way_than_the_camera_makes_it_go_is_found(tmp_path):
    paths, cameras, truth = film(tmp_path, 2.0)
    masks = list(moving_masks(paths, cameras))
    assert [mask.shape for mask in masks] == [(HEIGHT, WIDTH)] * COUNT
    for mask, true in list(zip(masks, truth))[2:-2]:
        assert (mask & true).sum() > 0.8 * true.sum()
        assert (mask & ~true).sum() < 0.1 * (~true).sum()


def test_a_film_in_which_only_the_camera_moves_has_no_movers(tmp_path):
    paths, cameras, _ = film(tmp_path, 0.0)
    assert not any(mask.any() for mask in moving_masks(paths, cameras))


def test_fast_films_give_more_frames():
    slow, fast, faster = (frames_for(np.full(600, speed))[0] for speed in (0.1, 3.0, 30.0))
    assert (slow, fast, faster) == (120, 225, 300)
