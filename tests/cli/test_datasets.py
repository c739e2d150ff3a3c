"""Every format from its writer to its numbers: synthesize, train, evaluate, and a PSNR to beat."""

import json
from dataclasses import replace

import numpy as np
import pytest

from forewarp.data.posed_video import PosedShot, write_scene
from forewarp.scene.box import Box
from forewarp.synth.cameras import random_cameras
from forewarp.synth.raycast import render
from forewarp.synth.world import World

pytestmark = pytest.mark.slow  # tests/contract trains on every dataset, too
COMMON = [
    "trainer=cpu",
    "logger=none",
    "callbacks.pictures=null",
    "seed=0",
    "budget.minutes=null",
    "budget.iterations=150",
    "preset.rays=512",
    "stage.coarse.num_voxels=[[0,15625]]",
    "stage.fine.num_voxels=[[0,27000]]",
    "stage.coarse.background_num_voxels=[[0,15625]]",
    "stage.fine.background_num_voxels=[[0,27000]]",
]

SMALL = ["data.synthesis.samples_per_pixel=1"]
# What 150 steps reach, less two decibels; a picture of one colour scores 11 to 15.
CASES = {
    "lego_complete": ([*SMALL, "data.synthesis.size=32", "data.synthesis.frames=6"], 17.0),
    "hypernerf": ([*SMALL, "data.synthesis.size=64", "data.synthesis.frames=9"], 18.0),
    "nhr": ([*SMALL, "data.synthesis.size=72", "data.synthesis.frames=4", "data.synthesis.points=300"], 20.0),
}


def psnr_of(folder):
    """The least mean PSNR of all kinds of test views."""
    content = json.loads((folder / "metrics.json").read_text())
    return min(scores["psnr"] for scores in content["test"].values())


@pytest.mark.parametrize("dataset", CASES)
def test_a_synthesised_scene_of_every_format_is_fitted(forewarp, tmp_path, dataset):
    options, enough = CASES[dataset]
    run = tmp_path / "run"
    done = forewarp(
        "train", f"experiment=demo_{dataset}", *COMMON, *options, f"paths.data={tmp_path}/data", f"run={run}"
    )
    assert done.status in (0, None), done.err
    assert psnr_of(run) > enough


def test_a_users_own_capture_is_fitted(forewarp, tmp_path):
    world = World("lift")
    cameras = [replace(c, near=0.0, far=1.0) for c in random_cameras(24, 32, np.random.default_rng(3))]
    times = [i / 23 for i in range(24)]
    shots = (
        PosedShot(f"frame_{i:03d}.png", camera, render(world, time, camera, 1)[0], time)
        for i, (camera, time) in enumerate(zip(cameras, times))
    )
    write_scene(tmp_path / "data" / "mine", shots, near=2.0, far=6.0, aabb=Box((-1, -1, -1), (1, 1, 1)))
    run, data = tmp_path / "run", [f"data.root={tmp_path}/data", "data.scene=mine"]
    done = forewarp("train", "data=video_with_poses", *data, *COMMON, f"run={run}")
    assert done.status in (0, None), done.err
    assert psnr_of(run) > 18.0
