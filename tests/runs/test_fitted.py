"""A fitted run is opened to look at it, and scored for whoever swept it."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

import forewarp
from forewarp import load
from forewarp.data.checks import blind_frames
from forewarp.data.images import composited
from forewarp.data.module import DNeRFDataModule, SceneDataModule
from forewarp.runs.config import saved_config
from forewarp.runs.fitted import doubts, measure_run, named, opened
from forewarp.scene.box import Box
from forewarp.scene.view import Moment, View
from forewarp.synth.scenes import synthesize
from forewarp.training.schedule import StageSettings
from tests.support.configs import ROOT
from tests.support.tiny_scene import ball_scene


@pytest.mark.slow
def test_a_run_is_opened_to_look_at_and_other_data_are_told(fitted, tmp_path, capsys):
    run = shutil.copytree(fitted, tmp_path / "run")
    config = saved_config(str(run), OmegaConf.create({"trust": []}))
    made, module = opened(config)
    assert made.folder == run
    assert not module.training
    assert capsys.readouterr().err == ""
    before = json.loads((run / "data.json").read_text())
    (run / "data.json").write_text(json.dumps(before | {"texts": {}}))
    for ways in (lambda: opened(config), lambda: load(run)):
        ways()
        said = capsys.readouterr().err
        assert f"warning: {run}/data.json: expected the data that the run was begun with" in said


@pytest.mark.slow
def test_the_script_of_the_docs_runs(fitted, in_tmp):
    page = ROOT / "docs" / "scripts.md"
    script = re.search(r"```python\n(.*?)```", page.read_text(), re.DOTALL)[1]
    shutil.copytree(fitted, in_tmp / re.search(r'load\("(.*?)"\)', script)[1])
    made = {}
    exec(compile(script, str(page), "exec"), made)
    shown = "Rendering(rgb=float32 (32, 32, 3), depth=float32 (32, 32), opacity=float32 (32, 32))"
    assert repr(made["drawn"]) == shown
    assert (in_tmp / "half.png").is_file()
    assert [picture.shape for picture in made["film"]] == [(64, 64, 3)] * 8
    assert made["paths"].shape[1:] == (5, 3)
    assert made["pixels"].shape == (len(made["paths"]), 2)


@pytest.mark.slow
@pytest.mark.parametrize("behind", ["white", "black"])
def test_a_frame_is_rendered_as_it_is_measured(fitted, tmp_path, behind):
    run = shutil.copytree(fitted, tmp_path / "run")
    config = OmegaConf.load(run / "config.yaml")
    config.data.eval_background = behind
    OmegaConf.save(config, run / "config.yaml")
    config = saved_config(str(run), OmegaConf.create({"trust": []}))
    measure_run(*opened(config), config)
    images = json.loads((run / "per_image.json").read_text())["images"]
    measured = {image["name"]: image["scores"]["psnr"] for image in images}
    scene = load(run)
    for number, frame in enumerate(scene.frames("test")):
        truth = composited(frame.load(), scene.background)
        drawn = scene.render(frame if number else frame.camera, None if number else frame.time).rgb
        error = (drawn * 255).round() / 255 - (truth * 255).round() / 255
        assert -10 * float(error.square().mean().log10()) == pytest.approx(measured[frame.name], abs=1e-3)
    over = [scene.render(frame, background=behind).rgb for behind in ("white", [0.0, 0.0, 0.0], np.ones(3))]
    assert torch.equal(over[0], over[2])
    clear = 1 - scene.render(frame).opacity[..., None]
    unclipped = (over[1] > 0) & (over[0] < 1)
    torch.testing.assert_close((over[0] - over[1])[unclipped], clear.expand(-1, -1, 3)[unclipped])


@pytest.mark.slow
def test_data_that_moved_are_named(fitted, tmp_path, monkeypatch):
    run = shutil.copytree(fitted, tmp_path / "run")
    shutil.copytree(fitted.parent / "scenes", tmp_path / "there")
    config = OmegaConf.load(run / "config.yaml")
    config.data.root = "nowhere"
    OmegaConf.save(config, run / "config.yaml")
    with pytest.raises(ValueError, match="nowhere"):
        load(run)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert len(load("~/run", data_root=tmp_path / "there").cameras) == 6


@pytest.mark.slow
def test_poses_and_points_may_be_arrays_and_lists(fitted):
    scene = load(fitted)
    camera, point = scene.cameras[0], [[0.0, 0.1, 0.2]]
    pose = camera.camera_to_world
    wanted = scene.render(camera, 0.5)
    for given in (pose, pose.float(), pose.numpy(), pose.tolist(), pose.numpy()[::-1][::-1]):
        torch.testing.assert_close(scene.render(given, 0.5).depth, wanted.depth, rtol=1e-3, atol=1e-3)
    assert float(wanted.depth[wanted.opacity > 0.9].min()) > camera.near
    paths = [scene.trajectories(p, t) for p, t in ((point, [0, 1]), (np.array(point), np.array([0.0, 1.0])))]
    assert torch.equal(*paths)
    assert paths[0].shape == (1, 2, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda scene: scene.render(scene.cameras[0]), "time: expected a number in [0, 1], but got None"),
        (lambda scene: scene.render(np.eye(3), 0), "no camera: expected finite numbers (4, 4), but got (3, "),
        (lambda scene: scene.render(np.diag([2, 2, 2, 1]), 0), "a 3x3 of determinant 8 above [0.0, 0.0, "),
        (lambda scene: scene.render(np.diag([1, -1, 1, 1]), 0), "a 3x3 of determinant -1 above"),
        (lambda scene: scene.render("front", 0), "but got str 'front'"),
        (lambda scene: scene.render(scene.cameras[0], 0, "pink"), "expected white, black or three numbers"),
        (lambda scene: scene.render(scene.cameras[0], 0, [1, 2]), "background: expected finite numbers (3,)"),
        (lambda scene: scene.trajectories([0, 0, 0], [0]), "points: expected finite numbers (N, 3), but got"),
        (lambda scene: scene.trajectories([[0, 0, np.nan]], [0]), "points: expected finite numbers (N, 3)"),
        (lambda scene: scene.trajectories([[0, 0, 0]], [2]), "times: expected numbers in [0, 1], but got [2"),
        (lambda scene: scene.render(scene.cameras[0], [0.5]), "time: expected a number in [0, 1], but got "),
        (lambda scene: forewarp.look_at([1, 2, 3], [1, 2, 3], [0, 0, 1]), "target: expected another place"),
        (lambda scene: load(scene.folder, device="gpu"), "device: expected cpu"),
        (lambda scene: scene.frames("tests"), "split: expected train, val, test or held"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_a_line(fitted, ask, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        ask(load(fitted))


@pytest.mark.slow
def test_what_a_prompt_shows_is_short(fitted):
    scene = load(fitted)
    frame, data = scene.frames("test")[0], opened(scene.config)[0].datamodule
    shown = [scene, scene.scene, frame, frame.camera, frame.camera.rays(), View(frame.camera), scene.matter()]
    shown += [scene.render(frame), scene.method.at(Moment(0.5)), scene.scene.truth]
    shown += [data.targets("test")[0], data.batches.draw()]
    texts = [repr(thing) for thing in shown]
    assert [text for text in texts if len(text) > 300 or "\n" in text or "tensor(" in text] == []


def test_the_door_offers_names_without_loading_torch():
    quick = "import sys, forewarp; assert forewarp.load; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", quick], check=True, capture_output=True)
    assert {"Camera", "__version__", "load", "look_at", "orbit"} == set(dir(forewarp))
    assert forewarp.__version__
    assert all(callable(getattr(forewarp, name)) for name in ("Camera", "look_at", "orbit"))
    with pytest.raises(AttributeError, match="module 'forewarp' has no attribute 'lod'"):
        _ = forewarp.lod


SMALL = [
    *("model=forward", "data=dnerf", "data.root=.", "data.scene=vehicle", "preset=demo", "trainer=cpu"),
    "data.rays=64",
    *("logger=none", "budget.minutes=null", "budget.iterations=4", "stage.coarse.num_voxels=[[0,800]]"),
    *("callbacks.pictures=null", "callbacks.accuracy=null", "callbacks.scalars=null", "threads=1"),
    *("~stage.fine", "evaluate=false"),
]
ABSENT = "no score: the scene has no validation views and none are held out; set data.held_out=8"


@pytest.fixture
def scene(in_tmp):
    """Makes the scene in the current folder, with so many validation views."""

    def make(val_views):
        views = {"test_views": (1, 0, 0), "val_views": val_views, "samples_per_pixel": 1}
        synthesize(in_tmp / "vehicle", size=16, frames=6, **views)
        return in_tmp

    return make


@pytest.fixture
def returned(monkeypatch):
    """What the jobs gave to Hydra, in order."""
    from hydra.core import utils

    values, before = [], utils.JobReturn.return_value

    def keep(job, value):
        values.append(value)
        before.fset(job, value)

    monkeypatch.setattr(utils.JobReturn, "return_value", property(before.fget, keep))
    return values


@pytest.mark.slow
def test_jobs_of_a_sweep_return_it_and_give_it_again(ok, scene, returned):
    folder = scene(2)
    sweep = ["--multirun", *SMALL, "seeds=2", "run=runs/${seed}", "evaluate=true", "sheets=0"]
    done = ok("train", *sweep)
    assert done.out.count("of 2 validation views") == 2
    files = [folder / "runs" / seed / "score.json" for seed in "01"]
    scores = [json.loads(file.read_text())["scores"] for file in files]
    assert returned == [one["psnr"] for one in scores]
    assert len(set(returned)) == 2
    times = [file.stat().st_mtime_ns for file in files]
    returned.clear()
    ok("train", *sweep, "score=ssim")  # measured with the other
    assert returned == [one["ssim"] for one in scores]
    assert [file.stat().st_mtime_ns for file in files] == times
    os.utime(folder / "runs" / "0" / "coarse" / "done.json")  # fitted anew since
    files[1].unlink()  # measured before: loaded for its score alone
    returned.clear()
    ok("train", *sweep)
    assert returned == [one["psnr"] for one in scores]
    assert files[0].stat().st_mtime_ns > times[0]


@pytest.mark.slow
def test_alone_it_is_computed_for_whoever_asks(forewarp, ok, scene, returned):
    folder = scene(1)
    ok("train", *SMALL, "run=run")
    assert not (folder / "run" / "score.json").exists()
    assert "score    ssim 0." in forewarp("train", *SMALL, "run=run", "score=ssim").out
    assert "score    psnr " in forewarp("train", "resume=run", "score=psnr").out
    assert returned[0] is None
    assert all(returned[1:])
    done = forewarp("train", *SMALL, "run=other", "score=psnr", "data.held_out=2")
    assert "of 2 held out views" in done.out, done.err


@pytest.mark.slow
def test_without_views_there_is_none(forewarp, ok, scene, returned):
    scene(0)
    done = ok("train", *SMALL, "run=run", "score=psnr")
    assert ABSENT in done.out
    done = forewarp("train", *SMALL, "run=other", "score=ms_ssim", "data.held_out=2")
    assert "no score: frame train/r_00" in done.out
    assert "a side must have" in done.out
    assert returned == [None, None]
    sweep = ["--multirun", "hydra/sweeper=one_at_a_time", "hydra.sweeper.changes=['seed=3']"]  # needs none
    ok("train", *sweep, *SMALL, "run=swept")


@pytest.mark.slow
@pytest.mark.parametrize("word", ["test/psnr", "3", "[psnr]"])
def test_another_metric_is_refused_with_a_list(refused, fitted, in_tmp, word):
    line = refused("train", *SMALL, f"data.root={fitted.parent / 'scenes'}", f"score={word}")
    assert line.startswith("score: expected a metric of validation views (psnr, psnr_box, ssim, ms_ssim, ")
    assert "lpips_squeeze" in line
    assert not list(in_tmp.iterdir())
    assert named(None) is None


SCENE = ball_scene(frames=3, size=8)


def run(steps=5000, iterations=None, suspects=SceneDataModule.suspects, scene=SCENE, **noted):
    """A finished run of one stage, ``fine``, which took 7.7 s."""
    data = SceneDataModule(lambda: scene)
    data.suspects = suspects
    settings = StageSettings("fine", {}, iterations=iterations, minutes=None if iterations else 0.05)
    stage, made = SimpleNamespace(settings=settings), {"fine": {"steps": steps, "seconds": 7.7, **noted}}
    place = {"clock": "wall", "device": torch.device("cpu")}
    return SimpleNamespace(stages=[stage], datamodule=data, finished=lambda: made, **place)


def reaching(psnr):
    """A module that shows training pixels so well."""
    return SimpleNamespace(psnr_of=lambda target, pixels: torch.tensor(float(psnr)))


def test_a_good_fit_is_not_doubted():
    assert doubts(run(), reaching(30), "fast") == []


def test_minutes_that_other_programs_took_are_told_with_the_steps_and_what_to_type():
    clocks = {"clocks": {"wall": 60.0, "processor": 24.0}}
    (line,) = doubts(run(**clocks), reaching(30), "fast")
    assert "in 1:00 of training this one had 0:24 of processor time, 5,000 steps" in line
    assert line.endswith("add budget.clock=processor")
    for calm in ({"wall": 60.0, "processor": 31.0}, {"wall": 15.0, "processor": 1.0}):
        assert doubts(run(clocks=calm), reaching(30), "fast") == []
    assert doubts(run(iterations=9000, **clocks), reaching(30), "fast") == []  # whatever the time


@pytest.mark.parametrize(("steps", "said"), [(1, "1 step in"), (49, "49 steps in"), (50, None)])
def test_a_stage_that_minutes_ended_after_few_steps_is_named(steps, said):
    lines = doubts(run(steps=steps), reaching(30), "fast")
    named = [f"stage.fine ended after {said} 7.7 s, too few to learn; raise budget.minutes"] if said else []
    assert [line.partition(",")[0] for line in lines] == [line.partition(",")[0] for line in named]
    assert doubts(run(steps=4, iterations=4), reaching(30), "fast") == []  # as many as were asked for


@pytest.mark.parametrize(("steps", "first"), [(5000, "poses in other axes"), (900, "too little training")])
def test_low_psnr_names_the_three_likeliest_causes_of_the_format(steps, first):
    line, *causes = doubts(run(steps, suspects=DNeRFDataModule.suspects), reaching(12.9), "fast")
    assert line.startswith("training images are reached to 12.9 dB; one color alone has")
    assert [cause[: len("  likely cause 1")] for cause in causes] == [f"  likely cause {i}" for i in "123"]
    assert first in causes[0]


def test_a_target_that_was_reached_is_no_reason_to_train_longer():
    reached = {"target": {"psnr": 20.0, "reached": "target.psnr"}}
    assert doubts(run(steps=9, **reached), reaching(30), "fast") == []
    _, *causes = doubts(run(steps=9, suspects=DNeRFDataModule.suspects, **reached), reaching(12.9), "fast")
    assert causes
    assert not [cause for cause in causes if "raise the budget" in cause]
    missed = {"target": {"psnr": 20.0, "reached": None}}
    assert "raise budget.minutes" in doubts(run(steps=9, **missed), reaching(30), "fast")[0]


@pytest.mark.parametrize("preset", ["demo", "fast", "faithful"])
def test_advice_fits_the_preset_and_is_given_once(preset):
    few, _, *causes = doubts(run(steps=9), reaching(12.9), preset)
    assert ("preset=demo" in few) == (preset != "demo")
    assert any("in place of preset=demo" in cause for cause in causes) == (preset == "demo")
    assert sum(cause.endswith("raise the budget") for cause in causes) == 1
    assert len({cause.rpartition(": ")[2] for cause in causes}) == len(causes)


def test_cameras_that_see_nothing_of_the_box_are_counted():
    camera = SCENE.train[0].camera
    turned = camera.camera_to_world @ torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64).diag()
    away = replace(camera, camera_to_world=turned)
    scene = replace(SCENE, train=(replace(SCENE.train[0], camera=away), *SCENE.train[1:]))
    assert (blind_frames(SCENE), blind_frames(scene)) == (0, 1)
    small = Box((0.2, 0.2, 0.2), (0.21, 0.21, 0.21))  # between the nine pixels that are asked first
    assert blind_frames(replace(SCENE, box=small)) == 0
    (line,) = doubts(run(scene=scene), reaching(30), "fast")
    assert line.startswith(f"1 of {len(scene.train)} training cameras see nothing of the box")
    in_file = {"normalisation": {"center": [10.0, 0.0, 0.0], "scale": 0.5}}  # remarks and data.box are of it
    (line,) = doubts(run(scene=replace(scene, protocol=in_file)), reaching(30), "fast")
    assert line.endswith("the box (8, -1.6, -1.4) to (12.4, 1.6, 1.4)")


def test_images_that_never_came_in_are_counted():
    (line,) = doubts(run(frames_in_play=2), reaching(30), "fast")
    assert line.startswith(f"{len(SCENE.train) - 2} of {len(SCENE.train)} training images were never trained")
