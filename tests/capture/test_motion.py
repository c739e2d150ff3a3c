"""Tell what moves from what only the camera makes move."""

import numpy as np
import pytest
import torch

pytest.importorskip("cv2")

from forewarp.capture.frames import speed  # noqa: E402
from forewarp.capture.motion import moving_masks, resting_masks  # noqa: E402
from forewarp.data.images import write_image  # noqa: E402
from forewarp.scene.camera import Camera  # noqa: E402

WIDTH, HEIGHT, FOCAL, COUNT = 160, 120, 160.0, 9


def film(folder, patch_speed, count=COUNT, rests_until=0):
    """Write a film of a wall at distance 1, before which a camera goes 3 pixels a frame to the right; a patch
    of the wall goes down, from a frame on. Return paths, cameras and the patch's true masks.
    """
    draw = np.random.default_rng(0)
    texture = draw.integers(0, 255, (2, 60, 90, 3)).astype(np.uint8).repeat(4, 1).repeat(4, 2)
    paths, cameras, truth = [], [], []
    for i in range(count):
        image = texture[0][40 : 40 + HEIGHT, 3 * i : 3 * i + WIDTH].copy()
        top, left = 20 + round(patch_speed * max(0, i - rests_until)), 60 - 3 * i + 24
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[top : top + 40, left : left + 50] = True
        image[mask] = texture[1][:40, :50].reshape(-1, 3)
        paths.append(folder / f"{i:02d}.png")
        write_image(paths[-1], image)
        cameras.append(pinhole(3 * i / FOCAL))
        truth.append(mask)
    return paths, cameras, truth


def pinhole(x=0.0):
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = x
    return Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose, 0.1, 10.0)


def test_what_goes_another_way_than_the_camera_makes_it_go_is_found(tmp_path):
    paths, cameras, truth = film(tmp_path, 2.0)
    masks = moving_masks(paths, cameras)
    assert [mask.shape for mask in masks] == [(HEIGHT, WIDTH)] * COUNT
    for mask, true in list(zip(masks, truth))[2:-2]:
        assert (mask & true).sum() > 0.8 * true.sum()
        assert (mask & ~true).sum() < 0.1 * (~true).sum()


def test_a_film_in_which_only_the_camera_moves_has_no_movers(tmp_path):
    paths, cameras, _ = film(tmp_path, 0.0)
    assert not any(mask.any() for mask in moving_masks(paths, cameras))


@pytest.mark.slow
def test_what_moves_at_any_time_does_not_rest(tmp_path):
    paths, cameras, truth = film(tmp_path, 2.0, count=18, rests_until=10)
    assert (moving_masks(paths, cameras)[0] & truth[0]).sum() < 0.1 * truth[0].sum()  # not yet
    (rests,) = resting_masks(paths, cameras, [2])
    assert (rests & truth[2]).sum() < 0.2 * truth[2].sum()
    assert (rests & ~truth[2]).sum() > 0.9 * (~truth[2]).sum()


@pytest.mark.parametrize("step", [0.0, 3.0])
def test_what_is_far_away_and_what_a_resting_camera_sees_rest(tmp_path, step):
    """The upper half is so far away that it does not shift; poses are off by noise."""
    draw = np.random.default_rng(1)
    wall = draw.integers(0, 255, (30, 90, 3)).astype(np.uint8).repeat(4, 0).repeat(4, 1)
    paths, cameras = [], []
    for i in range(COUNT):
        at = round(step * i)
        paths.append(tmp_path / f"{i:02d}.png")
        write_image(paths[-1], np.concatenate([wall[:60, :WIDTH], wall[60:, at : at + WIDTH]]))
        cameras.append(pinhole(step * i / FOCAL + 1e-3 * draw.standard_normal()))
    assert max(mask.mean() for mask in moving_masks(paths, cameras)) < 0.02


def test_of_images_that_cannot_be_followed_nothing_is_told(tmp_path):
    draw, paths = np.random.default_rng(2), [tmp_path / f"{i}.png" for i in range(6)]
    for path in paths:
        write_image(path, draw.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8))
    assert moving_masks(paths, [pinhole()] * 6) is None
    assert resting_masks(paths, [pinhole()] * 6, [3]) == [None]


def test_the_motion_of_very_wide_images_is_measured():
    image = np.random.default_rng(0).integers(0, 255, (10, 160)).astype(np.uint8).repeat(4, 0).repeat(4, 1)
    assert np.isfinite(speed(image, np.roll(image, 4, 1)))
