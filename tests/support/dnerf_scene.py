"""A tiny written D-NeRF scene for tests, and the place of the real ones."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from forewarp.data.dnerf import Shot, write_scene
from forewarp.scene.camera import look_at
from forewarp.scene.frame import Truth
from tests.support.edits import edit as edit_file

ANGLE = 0.6911112
FEW = {"space": 4, "time": 3, "canonical": 2}
TIMES = {"space": [0.0, 0.5, 0.5, 1.0], "time": [0.1, 0.3, 0.6], "canonical": [0.0, 0.0]}
_REAL = Path(os.environ.get("FOREWARP_DATA", Path(__file__).parents[3] / "shared" / "data"))
REAL_SCENES = ("bouncingballs", "hellwarrior", "hook", "jumpingjacks", "lego", "mutant")


def real(folder: str) -> Path:
    """The root of real scenes, or a skip."""
    if not (_REAL / folder).is_dir():
        pytest.skip(f"no real data: {_REAL / folder} is absent; set FOREWARP_DATA")
    return _REAL / folder


def shots(count, seed=0, size=(6, 8), ability="all", depth=False, times=None):
    """Random images (H, W) from random places on the sphere of radius 4, looking at the origin."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        center = torch.from_numpy(rng.normal(size=3))
        pose = look_at(4.0311 * center / center.norm(), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        rgba = rng.integers(0, 256, (*size, 4), dtype=np.uint8)
        stored = rng.uniform(2, 6, size).astype(np.float32) if depth else None
        time = i / max(count - 1, 1) if times is None else times[i]
        yield Shot(f"r_{i}", time, pose, rgba, stored, ability)


def write_tiny(folder: Path, size=(6, 8), **changes) -> Path:
    """A stock scene with 4 training, 2 validation and 3 test frames of 8 x 6 pixels."""
    splits = {"train": shots(4, 0, size), "val": shots(2, 1, size), "test": shots(3, 2, size)} | changes
    write_scene(folder, splits, camera_angle_x=ANGLE)
    return folder


def write_kinds(folder: Path, **changes) -> Path:
    """A Lego Complete scene: 3 training images, 9 test views of three kinds with depth, trajectories."""
    splits = {"train": shots(3), "test": views()} | changes
    write_scene(folder, splits, camera_angle_x=ANGLE, trajectories=truth())
    return folder


def views(counts=FEW):
    """Shots of each ability at its times, with depth."""
    for seed, (ability, count) in enumerate(counts.items()):
        yield from shots(count, 10 + seed, ability=ability, depth=True, times=TIMES[ability])


def truth() -> Truth:
    """Two points at three times."""
    return Truth(torch.arange(18.0).reshape(2, 3, 3), torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64))


def edit(folder: Path, split: str, change) -> None:
    """Change what a transforms file holds."""
    edit_file(folder / f"transforms_{split}.json", change)
