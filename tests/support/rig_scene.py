"""A tiny written HyperNeRF capture for tests: two phones with lenses before a world of its own scale."""

from pathlib import Path

import numpy as np
import torch

from forewarp.data.hypernerf import RigShot, write_scene
from forewarp.scene.camera import Camera, Lens, look_at
from forewarp.scene.frame import Truth

CENTER, SCALE, NEAR, FAR = (2.5, -1.0, 0.75), 0.2, 0.3, 1.4
LENS = Lens((0.105, -0.088, 0.01), (-0.0537, 0.0037))


def phone(index, size=(12, 8), skew=0.0, lens=LENS):
    """One of the cameras (width, height) around CENTER, in the unscaled world."""
    angle = 0.3 * index
    offset = torch.tensor([4 * np.cos(angle), 4 * np.sin(angle), 1.0], dtype=torch.float64)
    middle = torch.tensor(CENTER, dtype=torch.float64)
    pose = look_at(middle + offset, middle, torch.tensor([0.0, 0.0, 1.0]))
    width, height = size
    inner = (1.1 * width, 1.026 * 1.1 * width, 0.52 * width, 0.47 * height)
    return Camera(*size, *inner, pose, NEAR, FAR, skew, lens if index % 2 else None)


def rig(times=5, **options):
    """Left and right at each time; one is trained on, the other held out, in turns."""
    rng = np.random.default_rng(0)
    for t in range(times):
        for k, side in enumerate(("left", "right")):
            camera = phone(2 * t + k, **options)
            rgb = rng.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
            yield RigShot(f"{side}1_{t:06d}", t, k, "train" if k == t % 2 else "val", camera, rgb)


def hand(count=11, **options):
    """One phone that moves; nothing is held out by name."""
    rng = np.random.default_rng(1)
    for t in range(count):
        camera = phone(2 * t + 1, **options)
        rgb = rng.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
        yield RigShot(f"{t + 1:06d}", t, 0, "train", camera, rgb)


def truth(canonical=0.5) -> Truth:
    """Two points at three times, unscaled world."""
    times = torch.tensor([canonical, 0.0, 1.0], dtype=torch.float64)
    return Truth(torch.arange(18.0).reshape(2, 3, 3), times)


def write_rig(folder: Path, shots=None, **changes) -> Path:
    """A rig of five times; what it stores differs from the normalised world."""
    options = {"center": CENTER, "scale": SCALE, "near": NEAR, "far": FAR} | changes
    write_scene(folder, rig() if shots is None else shots, **options)
    return folder
