"""Many cameras that share a time: it is warped once, in training and in evaluation."""

from dataclasses import replace

import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.evaluation.evaluate import evaluate
from forewarp.metrics.suite import ImageSuite
from forewarp.scene.camera import joined
from tests.support.tiny_scene import ball_scene, frame_at, make_run, stage

TIMES = (0.0, 0.5, 1.0)


def dome_scene(views=4):
    """The ball as all cameras of a dome see it, one of them held out."""
    frames = [frame_at(f"{t}/{k}", k / views, t, 12) for t in TIMES for k in range(views)]
    test = [frame_at(f"{t}/test{k}", 0.1 + k / 2, t, 12) for k in range(2) for t in TIMES]
    scene = replace(ball_scene(frames=2, size=12), train=tuple(frames), val=(), test=tuple(test))
    return replace(scene, protocol={"mask_box": True})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a few steps, each of which has rays of three cameras."""
    data = SceneDataModule(dome_scene, rays=60, views_per_step=3)
    return make_run(tmp_path_factory.mktemp("dome"), [stage(iterations=3)], data=data)


@pytest.fixture(scope="module")
def module(run):
    """What it fitted."""
    return run.fit()


@pytest.fixture
def warped(module, monkeypatch):
    """The times that were warped, as they come."""
    times, at = [], module.method.at
    monkeypatch.setattr(module.method, "at", lambda moment: times.append(moment.time) or at(moment))
    return times


def test_evaluation_warps_a_time_once_for_all_its_cameras(run, module, warped, tmp_path):
    metrics = evaluate(module, run.datamodule, tmp_path, ImageSuite(mask_box=True), sheets=0)
    assert warped == list(TIMES)
    assert len(run.datamodule.scene.test) == 6
    assert 0 < metrics["test"]["all"]["psnr_box"] < metrics["test"]["all"]["psnr"]


def test_training_warps_once_for_the_rays_of_several_cameras(run, module, warped, monkeypatch):
    batch = run.datamodule.batches.draw()
    assert len({one.moment.frame for one in batch.observations}) == 3
    rays = joined([one.view.rays() for one in batch.observations])
    assert (len(rays), len(rays.origins.unique(dim=0))) == (60, 3)
    assert torch.isfinite(module.loss_of(batch)[0])
    assert warped == [batch.time]
