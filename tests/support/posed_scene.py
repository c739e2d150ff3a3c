"""A tiny written capture with poses for tests."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from forewarp.data.posed_video import PosedShot, write_scene
from forewarp.scene.camera import Camera, Lens, look_at

# Of a world whose unit and origin mean nothing.
MIDDLE = torch.tensor([30.0, -20.0, 5.0], dtype=torch.float64)
UP = torch.tensor([0.0, 0.0, 1.0])
LENS = Lens((0.1, -0.08, 0.01), (-0.02, 0.004))


def cameras(count: int, size=(20, 30), distance=70.0, lens: Lens | None = LENS) -> list[Camera]:
    """Cameras on a quarter of a circle about ``MIDDLE``; ``size`` is (height, width)."""
    made = []
    for i in range(count):
        angle = 1.5 * i / max(count - 1, 1)
        offset = torch.tensor([np.cos(angle), np.sin(angle), 0.3 + 0.1 * (i % 3)], dtype=torch.float64)
        pose = look_at(MIDDLE + distance * offset / offset.norm(), MIDDLE, UP)
        h, w = size
        made.append(Camera(w, h, 1.1 * w, 1.2 * w, 0.52 * w, 0.47 * h, pose, 0.0, 1.0, lens=lens))
    return made


def shots(count=10, channels=3, times=None, suffix=".png", splits=None, views=None, seed=0):
    """Random images of ``cameras``."""
    rng = np.random.default_rng(seed)
    for i, camera in enumerate(views or cameras(count)):
        pixels = rng.integers(0, 256, (camera.height, camera.width, channels), dtype=np.uint8)
        time = None if times is None else times[i]
        yield PosedShot(f"frame_{i + 1}{suffix}", camera, pixels, time, splits[i] if splits else "")


def write_tiny(folder: Path, near=20.0, far=120.0, aabb=None, **options) -> Path:
    """Ten frames of 30 x 20 pixels whose range is known."""
    write_scene(folder, shots(**options), near=near, far=far, aabb=aabb)
    return folder


def placed(scene, camera: Camera) -> Camera:
    """A camera of the file in the scene's units, by hand."""
    known = scene.protocol["normalisation"]
    pose = camera.camera_to_world.clone()
    pose[:3, 3] = (pose[:3, 3] - torch.tensor(known["center"], dtype=torch.float64)) * known["scale"]
    return replace(camera, camera_to_world=pose)
