import json
from dataclasses import replace

import imageio.v3 as iio
import pytest
import torch

from forewarp.data.batches import Targets
from forewarp.evaluation.evaluate import draw, evaluate, flow_error
from forewarp.methods.voxel.model import VoxelSnapshot
from forewarp.metrics.suite import ImageSuite
from forewarp.scene.frame import Truth
from tests.support.tiny_scene import ball_data, make_run, stage


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a few steps over the ball."""
    return make_run(tmp_path_factory.mktemp("run"), [stage(iterations=4)])


@pytest.fixture(scope="module")
def module(run):
    """What it fitted."""
    return run.fit()


def test_fewer_views_are_evenly_spread_and_named(run, module, tmp_path):
    evaluate(module, run.datamodule, tmp_path, ImageSuite())
    (tmp_path / "images" / "mine.png").touch()
    metrics = evaluate(module, run.datamodule, tmp_path, ImageSuite(), sheets=6, views=2)
    rows = json.loads((tmp_path / "per_image.json").read_text())["images"]
    assert [row["name"] for row in rows] == ["t_0", "t_2"]
    assert {path.stem for path in (tmp_path / "images" / "sheets").glob("*.png")} == {"t_0", "t_2"}
    assert {path.stem for path in (tmp_path / "images").glob("*.png")} == {"t_0", "t_2", "mine"}
    assert metrics["protocol"]["measured"] == "2 of 3 test views, evenly spread"
    assert metrics["test"]["all"]["psnr"] == pytest.approx(sum(row["scores"]["psnr"] for row in rows) / 2)


def test_scores_every_image_and_saves_it(run, module, tmp_path):
    seen = []
    more = {"finished": run.finished(), "sheets": 2, "progress": lambda *done: seen.append(done)}
    metrics = evaluate(module, run.datamodule, tmp_path, ImageSuite(), protocol={"seed": 5}, **more)
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    rows = json.loads((tmp_path / "per_image.json").read_text())["images"]
    assert [row["name"] for row in rows] == ["t_0", "t_1", "t_2"]
    assert metrics["test"]["all"]["psnr"] == pytest.approx(sum(row["scores"]["psnr"] for row in rows) / 3)
    assert {path.stem for path in (tmp_path / "images").glob("*.png")} == {"t_0", "t_1", "t_2"}
    assert len(list((tmp_path / "images" / "sheets").glob("*.png"))) == 2
    sheet = iio.imread(tmp_path / "images" / "sheets" / "t_0.png")
    assert sheet.shape == (312, 3 * 312 + 2 * 4, 3)  # 24 pixels, each 13 times
    assert metrics["steps"] == {"coarse": 4}
    assert "flow" not in metrics  # the scene has no truth
    assert metrics["protocol"]["seed"] == 5
    seconds = metrics["seconds"]
    assert seconds["train"] == seconds["coarse"] > 0
    assert 0 < seconds["render_again_per_frame"] < seconds["render_per_frame"]
    assert seconds["render_again_per_frame"] == pytest.approx(sum(row["seconds_again"] for row in rows) / 3)


def test_the_same_scene_gives_the_same_numbers(run, module, tmp_path):
    first, second = (evaluate(module, run.datamodule, tmp_path, ImageSuite(), sheets=0) for _ in range(2))
    assert first["test"] == second["test"]
    assert not (tmp_path / "images" / "sheets").exists()


def test_warps_once_a_time(module, monkeypatch):
    targets = ball_data().targets("test")
    times, at, render, clock = [], module.method.at, VoxelSnapshot.render, [0.0]

    def warped(moment):
        times.append(moment.time)
        clock[0] += 10
        return at(moment)

    def drawn(*arguments):
        clock[0] += 1
        return render(*arguments)

    monkeypatch.setattr(module.method, "at", warped)
    monkeypatch.setattr(VoxelSnapshot, "render", drawn)
    monkeypatch.setattr("forewarp.evaluation.evaluate.now", lambda: clock[0])
    frames = [targets.frames[i] for i in (2, 0, 2, 0)]
    shown = list(draw(module, Targets(frames, targets.background, targets.has_alpha)))
    assert times == [0.0, 1.0]
    assert [one.number for one in shown] == [1, 3, 0, 2]
    assert [(one.seconds, one.seconds_again) for one in shown] == [(11, 1), (1, 1)] * 2


def test_flow_is_measured_against_the_truth(run, module):
    scene = run.datamodule.scene
    points = torch.rand(5, 1, 3)
    drifting = torch.cat([points, points + torch.tensor([0.5, 0.0, 0.0])], 1)
    truth = Truth(drifting, torch.tensor([0.0, 1.0], dtype=torch.float64))
    flow = flow_error(module, replace(scene, truth=truth))
    predicted = module.method.trajectories(points[:, 0], torch.tensor([0.0, 1.0])).detach()
    assert flow["epe_moving"] == pytest.approx(
        float((predicted - drifting)[:, 1].norm(dim=-1).mean()), rel=1e-5
    )
    assert flow["motion_mean"] == pytest.approx(0.5)
