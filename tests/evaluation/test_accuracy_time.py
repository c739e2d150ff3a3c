from dataclasses import replace

import lightning
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from forewarp.data.module import SceneDataModule
from forewarp.evaluation.curves import COLUMNS, AccuracyCurve, seconds_before
from forewarp.files import read_rows
from forewarp.scene.frame import Truth
from forewarp.training.stages import Run
from tests.support.tiny_scene import Interrupt, ball_scene, forward_model, stage, trainer

STEPS = 12


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


def scene_with_truth():
    scene = ball_scene(size=16)
    points = torch.rand(5, 1, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    moved = torch.cat([points, points + torch.tensor([0.5, 0.0, 0.0])], 1)
    return replace(scene, truth=Truth(moved, torch.tensor([0.0, 1.0])))


def run(folder, *more, curve=True, held_out=3, scene=scene_with_truth, stages=("coarse",)):
    """A run whose curve is due after 2, 4, 8, ... steps."""

    def make_trainer(where, own):
        logger = TensorBoardLogger(save_dir=str(where), name="tensorboard", version="")
        return trainer(own, logger=logger, default_root_dir=str(where))

    watchers = [Tick(), *([AccuracyCurve(first=2000, ratio=2.0, rays=100)] if curve else []), *more]
    return Run(
        SceneDataModule(scene, rays=64, held_out=held_out),
        forward_model(),
        [stage(name, iterations=STEPS) for name in stages],
        folder,
        make_trainer,
        lambda name, where: watchers,
    )


def steps(folder):
    return [(row["stage"], int(row["step"])) for row in read_rows(folder / "accuracy_time.csv")]


EXPECTED = [("coarse", 2), ("coarse", 4), ("coarse", 8), ("coarse", 12)]


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    folder = tmp_path_factory.mktemp("watched")
    return folder, run(folder).fit()


def assert_same(one, other):
    one, other = one.state_dict(), other.state_dict()
    assert one.keys() == other.keys()
    assert all(torch.equal(v, other[k]) for k, v in one.items() if torch.is_tensor(v))


def test_rows_lie_at_geometric_moments_and_at_the_end(watched):
    folder, module = watched
    rows = read_rows(folder / "accuracy_time.csv")
    assert tuple(rows[0]) == COLUMNS
    assert steps(folder) == EXPECTED
    assert [round(float(row["seconds"]), -3) for row in rows] == [2000, 4000, 8000, 12000]
    assert int(rows[-1]["size"]) == len(module.method.radiance.voxels)
    assert all(0 < float(row["psnr"]) < 60 and float(row["epe_moving"]) > 0 for row in rows)
    assert not list(folder.glob("*.part"))


def test_the_views_are_those_set_aside_and_no_others(watched):
    folder, module = watched
    data = SceneDataModule(scene_with_truth, held_out=3)
    views = data.targets("held")
    assert len(views) == 3
    assert len(module.curriculum.order) == len(data.scene.train) == 9
    every = torch.arange(16 * 16)
    pixels = every[torch.randperm(256, generator=torch.Generator().manual_seed(0))[:100]]
    expected = sum(float(module.psnr_of(view, pixels)) for view in views) / 3
    assert float(read_rows(folder / "accuracy_time.csv")[-1]["psnr"]) == pytest.approx(expected, abs=1e-3)


def test_tensorboard_has_the_curve_against_milliseconds(watched):
    accumulator = EventAccumulator(str(watched[0] / "coarse" / "tensorboard"))
    accumulator.Reload()
    rows = read_rows(watched[0] / "accuracy_time.csv")
    for name, column in (("curve/psnr", "psnr"), ("curve/epe_moving", "epe_moving")):
        points = accumulator.Scalars(name)
        assert [p.step for p in points] == [round(1000 * float(row["seconds"])) for row in rows]
        assert [p.value for p in points] == pytest.approx([float(row[column]) for row in rows], rel=1e-4)


def test_it_changes_no_weight_and_its_seconds_do_not_count(watched, tmp_path, monkeypatch):
    seen = []

    def psnr(module, targets, rays):
        before = module.clock.seconds
        torch.ones(200, 200).matmul(torch.ones(200, 200))
        seen.append(module.clock.seconds - before)
        return 20.0

    monkeypatch.setattr("forewarp.evaluation.curves.validation_psnr", psnr)
    assert_same(run(tmp_path).fit(), watched[1])
    assert seen == [0.0] * 4
    assert_same(run(tmp_path / "without", curve=False).fit(), watched[1])


@pytest.mark.parametrize(
    "ends",
    [[Interrupt("coarse", 3), Crash(5)], [Interrupt("coarse", 8)], [Crash(5)]],
    ids=["work lost", "at a moment", "all lost"],
)
def test_a_continued_run_continues_its_rows(tmp_path, watched, ends):
    for end in ends:
        with pytest.raises(SystemExit):
            run(tmp_path, end).fit()
    assert_same(run(tmp_path).fit(), watched[1])
    assert steps(tmp_path) == EXPECTED


def test_seconds_add_up_over_stages_and_a_stage_not_noted_gets_no_second_last_row(tmp_path):
    run(tmp_path, stages=("coarse", "fine")).fit()
    (tmp_path / "fine" / "done.json").unlink()
    run(tmp_path, stages=("coarse", "fine")).fit()
    assert steps(tmp_path) == [*EXPECTED, ("fine", 4), ("fine", 12)]
    seconds = [float(row["seconds"]) for row in read_rows(tmp_path / "accuracy_time.csv")]
    assert [round(s, -3) for s in seconds[-2:]] == [16000, 24000]
    assert seconds_before(tmp_path / "fine") == pytest.approx(seconds[3], abs=5)


@pytest.mark.parametrize("views", [0, 1])
def test_a_run_with_validation_views_has_a_curve_and_no_other(tmp_path, views):
    run(tmp_path, held_out=0, scene=lambda: validated(scene_with_truth(), views)).fit()
    assert (tmp_path / "accuracy_time.csv").exists() == bool(views)
    assert not views or steps(tmp_path) == EXPECTED


def validated(scene, count):
    return replace(scene, val=(*scene.train, *scene.train)[:count])


@pytest.mark.parametrize(
    ("views", "watched"), [(1, [0]), (8, list(range(8))), (15, [0, 2, 4, 6, 8, 10, 12, 14])]
)
def test_eight_validation_views_are_spread_out(views, watched):
    scene = validated(ball_scene(frames=8, size=8), views)
    found = SceneDataModule(lambda: scene).watched().frames
    assert [frame.name for frame in found] == [scene.val[i].name for i in watched]


def test_an_unknown_truth_leaves_its_column_empty(tmp_path):
    with pytest.raises(SystemExit):
        run(tmp_path, Crash(3), scene=lambda: ball_scene(size=16)).fit()
    assert [row["epe_moving"] for row in read_rows(tmp_path / "accuracy_time.csv")] == [""]


@pytest.mark.parametrize("bad", [{"first": 0}, {"rays": 0}])
def test_bad_settings_are_named(bad):
    with pytest.raises(ValueError, match="callbacks.accuracy: expected first > 0, ratio > 1 and rays >= 1"):
        AccuracyCurve(**bad)
