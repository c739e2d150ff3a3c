"""A capture of one's own from its files to its numbers; tests/contract trains on every dataset."""

import json
from dataclasses import replace

import numpy as np
import pytest

from forewarp.data.posed_video import PosedShot, write_scene
from forewarp.scene.box import Box
from forewarp.synth.raycast import render
from forewarp.synth.scenes import random_cameras
from forewarp.synth.world import World

COMMON = [
    *("trainer=cpu", "logger=none", "callbacks.pictures=null", "seed=0", "budget.minutes=null"),
]
PARTICLES = ["model=particles", "budget.iterations=1000"]  # each of one picture
VOXELS = [
    "model=forward",
    "budget.iterations=150",
    "preset.rays=512",
    "stage.coarse.num_voxels=[[0,15625]]",
    "stage.fine.num_voxels=[[0,27000]]",
]


@pytest.mark.slow
@pytest.mark.parametrize("model", [PARTICLES, VOXELS], ids=["particles", "forward"])
def test_a_users_own_capture_is_fitted(ok, tmp_path, model):
    world = World("lift")
    cameras = [replace(c, near=0.0, far=1.0) for c in random_cameras(24, 32, np.random.default_rng(3))]
    times = [i / 23 for i in range(24)]
    shots = (
        PosedShot(f"frame_{i:03d}.png", camera, render(world, time, camera, 1)[0], time)
        for i, (camera, time) in enumerate(zip(cameras, times))
    )
    write_scene(tmp_path / "data" / "mine", shots, near=2.0, far=6.0, aabb=Box((-1, -1, -1), (1, 1, 1)))
    run, data = tmp_path / "run", [f"data.root={tmp_path}/data", "data.scene=mine"]
    ok("train", "data=video_with_poses", *data, *COMMON, *model, f"run={run}")
    scores = json.loads((run / "metrics.json").read_text())["test"].values()
    assert min(one["psnr"] for one in scores) > 18.0  # voxels have 20; a picture of one colour: 11 to 15
