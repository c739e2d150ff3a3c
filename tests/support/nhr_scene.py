"""A tiny written NHR scene for tests: a dome of cameras of two sizes around a few coloured balls."""

import math
from pathlib import Path

import numpy as np
import torch

from forewarp.data.nhr import DomeFrame, write_scene
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Truth

BALLS = np.array([[0.3, -0.2, 0.9], [-0.25, 0.15, 1.3], [0.05, 0.3, 0.6]])
COLORS = np.array([[230, 40, 40], [40, 220, 60], [50, 70, 230]])
STEP = np.array([0.1, 0.05, 0.0])  # that the balls go from frame to frame
SIZES = ((60, 48), (48, 60))
STUDIO = (20, 160, 40)


def dome(views=4, sizes=SIZES, skew=0.7):
    """Cameras on a circle; no two lenses are equal."""
    cameras = []
    for k in range(views):
        angle = 2 * math.pi * k / views + 0.1
        center = torch.tensor([3 * math.cos(angle), 3 * math.sin(angle), 1.0 + 0.3 * (k % 3)])
        pose = look_at(center, torch.tensor([0.1, 0.05, 0.9]), torch.tensor([0.0, 0.0, 1.0]))
        w, h = sizes[k % len(sizes)]
        cameras.append(Camera(w, h, 70.0 + k, 71.5, w / 2 + 1.3, h / 2 - 0.8, pose, 1.0, 6.0, skew=skew))
    return cameras


def place(camera, point):
    """Where a point is seen (2,), written out anew: X = R x + T, u = fx x + s y + cx, v = fy y + cy."""
    pose = camera.camera_to_world.numpy()
    x, y, z = pose[:3, :3].T @ (point - pose[:3, 3])
    return np.array([camera.fx * x / z + camera.skew * y / z + camera.cx, camera.fy * y / z + camera.cy])


def photograph(camera, balls):
    """Soft discs of 4 pixels' radius about the balls in front of the studio: image and mask."""
    image = np.broadcast_to(np.array(STUDIO, np.uint8), (camera.height, camera.width, 3)).copy()
    mask = np.zeros((camera.height, camera.width), np.uint8)
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    for ball, color in zip(balls, COLORS):
        u, v = place(camera, ball)
        on = (column - u) ** 2 + (row - v) ** 2 < 16
        image[on], mask[on] = color, 255
    return image, mask


def dome_frames(cameras, count=3):
    """What the cameras see while the balls move."""
    for f in range(count):
        balls = BALLS + f * STEP
        images, masks = zip(*(photograph(camera, balls) for camera in cameras))
        yield DomeFrame(images, masks, np.concatenate([balls, COLORS], 1).astype(np.float32))


def truth(count=3):
    """How the balls move."""
    points = np.stack([BALLS + f * STEP for f in range(count)], 1).astype(np.float32)
    return Truth(torch.from_numpy(points), torch.linspace(0, 1, count, dtype=torch.float64))


def write_dome(folder: Path, cameras=None, count=3, **options) -> Path:
    """Write the scene."""
    cameras = cameras or dome()
    write_scene(folder, cameras, dome_frames(cameras, count), **options)
    return folder
