from dataclasses import replace
from functools import partial

import lightning
import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.evaluation.curves import COLUMNS, AccuracyCurve
from forewarp.files import read_rows
from forewarp.scene.frame import Truth
from forewarp.training.loggers import CsvLogger, RunLoggers
from forewarp.training.stages import Run
from forewarp.training.stopping import StopRule
from tests.support.tiny_scene import Interrupt, ball_scene, forward_model, stage, trainer

EXPECTED = [("coarse", 2), ("coarse", 4), ("coarse", 7)]


class Tick(lightning.Callback):
    """Lets a step last a thousand seconds, so that the real ones do not matter."""

    def on_train_batch_end(self, trainer, module, *_):
        module.clock._done["wall"] += 1000.0


class Crash(lightning.Callback):
    """Ends after a step without saving."""

    def __init__(self, step):
        self.step = step

    def on_train_batch_end(self, trainer, module, *_):
        if module.global_step == self.step:
            raise SystemExit


def scene_with_truth(views=0):
    """The ball with trajectories and some validation views."""
    scene = ball_scene(size=16)
    points = torch.rand(5, 1, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    moved = torch.cat([points, points + torch.tensor([0.5, 0.0, 0.0])], 1)
    return replace(scene, truth=Truth(moved, torch.tensor([0.0, 1.0])), val=scene.train[:views])


def run(folder, *more, curve=True, held_out=3, scene=scene_with_truth, stages=("coarse",)):
    """A run of 7 steps whose curve is due after 2, 4, 8, ... steps."""

    def make_trainer(where, own, loggers):
        return trainer(own, logger=loggers, default_root_dir=str(where))

    callbacks = [Tick(), *([AccuracyCurve(first=2000, ratio=2.0, rays=100)] if curve else []), *more]
    data = SceneDataModule(scene, rays=64, held_out=held_out)
    stages = [stage(name, iterations=7) for name in stages]
    loggers = RunLoggers({"csv": partial(CsvLogger, version="")}, folder)
    return Run(data, forward_model(), stages, folder, make_trainer, lambda *_: callbacks, loggers=loggers)


def steps(folder):
    return [(row["stage"], int(row["step"])) for row in read_rows(folder / "accuracy_time.csv")]


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    folder = tmp_path_factory.mktemp("watched")
    return folder, run(folder).fit()


def assert_same(a, b):
    a, b = a.state_dict(), b.state_dict()
    assert a.keys() == b.keys()
    assert all(torch.equal(value, b[key]) for key, value in a.items() if torch.is_tensor(value))


@pytest.mark.slow
def test_rows_of_the_held_out_views_lie_at_geometric_moments_and_at_the_end(watched):
    folder, module = watched
    rows = read_rows(folder / "accuracy_time.csv")
    assert tuple(rows[0]) == COLUMNS
    assert steps(folder) == EXPECTED
    assert [round(float(row["seconds"]), -3) for row in rows] == [2000, 4000, 7000]
    assert int(rows[-1]["size"]) == len(module.method.radiance.voxels)
    assert all(0 < float(row["psnr"]) < 60 and float(row["epe_moving"]) > 0 for row in rows)
    views = SceneDataModule(scene_with_truth, held_out=3).targets("held")
    pixels = torch.randperm(256, generator=torch.Generator().manual_seed(0))[:100]
    expected = sum(float(module.psnr_of(view, pixels)) for view in views) / 3
    assert float(rows[-1]["psnr"]) == pytest.approx(expected, abs=1e-3)
    logged = read_rows(folder / "csv" / "metrics.csv")
    assert [row["step"] for row in logged] == [row["step"] for row in rows]
    names = {"psnr": "held_out/psnr", "epe_moving": "epe_moving", "seconds": "seconds_wall"}
    for column, name in names.items():
        points = [float(row[f"curve/{name}"]) for row in logged]
        assert points == pytest.approx([float(row[column]) for row in rows], rel=1e-4)


@pytest.mark.slow
def test_it_changes_no_weight_and_its_seconds_do_not_count(watched, tmp_path, monkeypatch):
    seen = []

    def psnr(module, targets, rays):
        before = module.clock.seconds
        torch.ones(200, 200).matmul(torch.ones(200, 200))
        seen.append(module.clock.seconds - before)
        return 20.0

    monkeypatch.setattr("forewarp.evaluation.curves.validation_psnr", psnr)
    assert_same(run(tmp_path).fit(), watched[1])
    assert seen == [0.0] * 3
    assert_same(run(tmp_path / "without", curve=False).fit(), watched[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "ends", [[Interrupt("coarse", 3), Crash(5)], [Crash(5)]], ids=["work lost", "all lost"]
)
def test_a_continued_run_continues_its_rows(tmp_path, watched, ends):
    for end in ends:
        with pytest.raises(SystemExit):
            run(tmp_path, end).fit()
    assert_same(run(tmp_path).fit(), watched[1])
    assert steps(tmp_path) == EXPECTED


@pytest.mark.slow
def test_seconds_add_up_over_stages_and_a_stage_not_noted_gets_no_second_last_row(tmp_path):
    run(tmp_path, stages=("coarse", "fine")).fit()
    (tmp_path / "fine" / "done.json").unlink()
    run(tmp_path, stages=("coarse", "fine")).fit()
    assert steps(tmp_path) == [*EXPECTED, ("fine", 1), ("fine", 7)]
    seconds = [float(row["seconds"]) for row in read_rows(tmp_path / "accuracy_time.csv")]
    assert [round(s, -3) for s in seconds[-2:]] == [8000, 14000]


@pytest.mark.slow
@pytest.mark.parametrize("views", [0, 1])
def test_a_run_with_validation_views_has_a_curve_and_no_other(tmp_path, views):
    run(tmp_path, held_out=0, scene=lambda: replace(scene_with_truth(views), truth=None)).fit()
    logged = {name for row in read_rows(tmp_path / "csv" / "metrics.csv") for name in row}
    assert logged == ({"curve/val/psnr", "curve/seconds_wall", "step"} if views else set())
    assert not views or steps(tmp_path) == EXPECTED
    rows = read_rows(tmp_path / "accuracy_time.csv")
    assert [row["epe_moving"] for row in rows] == [""] * 3 * views  # there is no truth


@pytest.mark.parametrize("bad", [{"first": 0}, {"rays": 0}])
def test_bad_settings_are_named(bad):
    with pytest.raises(ValueError, match="callbacks.accuracy: expected first > 0, ratio > 1 and rays >= 1"):
        AccuracyCurve(**bad)


@pytest.mark.parametrize("content", [b"a,b\n1,2\n", b"seconds,stage\nmany,x\n", b"\xff\x00,\n1\n"])
def test_a_damaged_curve_is_named(content, tmp_path):
    (tmp_path / "accuracy_time.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"accuracy_time.csv: expected a table.*delete it"):
        run(tmp_path).fit()


def of_step(*values):
    """A PSNR of each step, in place of rendering."""
    return lambda module, targets, rays: values[module.global_step - 1]


THIRTY = StopRule(psnr=30)


@pytest.fixture
def each_step(monkeypatch):
    """Beside a target, a row after every step; ``each_step(20, 31, ...)`` are their PSNRs."""
    monkeypatch.setattr("forewarp.evaluation.curves._FIRST_STEP", 1)

    def psnr(*values):
        monkeypatch.setattr("forewarp.evaluation.curves.validation_psnr", of_step(*values))

    return psnr


def aimed(folder, *more, target=THIRTY, stages=("coarse",)):
    """A run whose last stage has a target."""
    made = run(folder, *more, stages=stages)
    made.target, callbacks = target, made.callbacks

    def with_target(name, where):
        found = callbacks(name, where)
        for curve in (each for each in found if isinstance(each, AccuracyCurve)):
            curve.target = target if name == stages[-1] else StopRule()
        return found

    made.callbacks = with_target
    return made


@pytest.mark.slow
@pytest.mark.parametrize("ends", [[], [Interrupt("coarse", 3)], [Interrupt("coarse", 5)], [Crash(4)]])
def test_two_rows_in_a_row_at_the_target_end_the_stage_also_of_a_continued_run(tmp_path, each_step, ends):
    each_step(20, 31, 29, 30, 32, 33, 34)
    said = []
    for end in ends:
        with pytest.raises(SystemExit):
            aimed(tmp_path, end).fit()
    made = aimed(tmp_path)
    made.tell = said.append
    module = made.fit()
    assert (module.global_step, steps(tmp_path)[-1]) == (5, ("coarse", 5))
    done = made.finished()["coarse"]
    target = {"psnr": 30, "plateau": None, "reached": "target.psnr", "step": 4, "held_out_psnr": 30.0}
    assert done["steps"] == 5
    assert done["target"] == target | {"seconds": pytest.approx(4000, abs=100)}
    assert said[-1].endswith("step 4 of the stage, with 30.00 dB of views not trained on (target.psnr=30)")


@pytest.mark.slow
def test_a_target_that_is_not_reached_is_said_and_the_budget_ends_training(tmp_path, each_step):
    each_step(20, 31, 29, 30, 29, 31, 29)
    made, said = aimed(tmp_path), []
    made.tell = said.append
    assert made.fit().global_step == 7
    assert made.finished()["coarse"]["target"]["reached"] is None
    assert said == ["coarse: target.psnr=30 not reached within the budget"]


@pytest.mark.slow
def test_only_the_last_stage_is_ended(tmp_path, each_step):
    each_step(31, 31, 31, 31, 31, 31, 31)
    made = aimed(tmp_path, stages=("coarse", "fine"))
    assert made.fit().global_step == 2
    assert {name: done["steps"] for name, done in made.finished().items()} == {"coarse": 7, "fine": 2}


@pytest.mark.slow
def test_a_plateau_is_two_doublings_in_a_row_that_gain_little(tmp_path, each_step):
    # Gains since half the steps: 2 of step 4 (from 22), 1.2 of 5 (from 22.8), 0.5 of 6 (from 23.5).
    each_step(20, 22, 23.5, 24, 24, 24, 24)
    made = aimed(tmp_path, target=StopRule(plateau=1.5))
    assert made.fit().global_step == 6
    done = made.finished()["coarse"]["target"]
    assert (done["reached"], done["step"], done["held_out_psnr"]) == ("target.plateau", 5, 24.0)


@pytest.mark.slow
def test_a_curve_that_is_flat_where_the_budget_ends_has_reached_no_plateau(tmp_path, each_step):
    # Gains since half the steps: 2.7 of step 5, 1.0 of 6 (from 23.5), 0.7 of 7, the last of the stage.
    each_step(20, 22, 23.5, 24, 25.5, 24.5, 24.5)
    made, said = aimed(tmp_path, target=StopRule(plateau=1.5)), []
    made.tell = said.append
    assert made.fit().global_step == 7
    assert made.finished()["coarse"]["target"]["reached"] is None
    assert said == ["coarse: target.plateau=1.5 not reached within the budget"]
