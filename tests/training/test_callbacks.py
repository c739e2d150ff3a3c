import re
from dataclasses import replace
from functools import partial

import lightning
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from forewarp.clock import Clock
from forewarp.data.module import SceneDataModule
from forewarp.evaluation.images import TrainingImages
from forewarp.progress import ProgressLine
from forewarp.training.callbacks import Scalars, StageProgress, gradient_norms
from forewarp.training.loggers import RunLoggers
from tests.support.tiny_scene import Interrupt, ball_data, ball_scene, make_run, same, stage

STEPS = 12


def watched_run(folder, *callbacks, steps=STEPS):
    """A run of one short stage over the ball, with a TensorBoard logger as the command has it."""
    logger = partial(TensorBoardLogger, name="tensorboard", version="", default_hp_metric=False)
    loggers = RunLoggers({"tensorboard": logger}, folder)
    return make_run(folder, [stage(iterations=steps)], callbacks=callbacks, loggers=loggers)


def all_watchers():
    return StageProgress(every=0), Scalars(every=5), TrainingImages(moments=(0.25, 0.5, 1.0))


class Record(lightning.Callback):
    """Note the loss of every step."""

    def __init__(self):
        self.losses = []

    def on_train_batch_end(self, trainer, module, *_):
        self.losses.append(module.last["loss"])


def events_of(folder):
    accumulator = EventAccumulator(str(folder / "tensorboard"))
    accumulator.Reload()
    return accumulator


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """Return the module, folder and losses of a finished stage with all callbacks."""
    folder, record = tmp_path_factory.mktemp("watched"), Record()
    return watched_run(folder, *all_watchers(), record).fit(), folder, record.losses


@pytest.mark.slow
def test_lines_where_there_is_no_terminal(tmp_path, capsys):
    progress = StageProgress(every=0)
    progress.later = 7200.0
    watched_run(tmp_path, progress).fit()
    lines = [line for line in capsys.readouterr().err.splitlines() if "compiling" not in line]
    assert len(lines) == STEPS + 1
    shape = r"coarse +(\d+)% \| (.*) \| train psnr -?[\d.]+ \| ([\d.]+ steps/s \| )?frames (\d+)/12 \| "
    shape += r"voxels [\d,]+ \| loss [\d.]+"
    shown = [re.fullmatch(shape, line) for line in lines]
    assert all(shown), lines
    assert all(re.fullmatch(r"2:\d\d:\d\d left", match[2]) for match in shown[:-1])  # of the run
    assert re.fullmatch(r"\d+:\d\d trained", shown[-1][2])
    percents = [int(match[1]) for match in shown]
    assert percents == sorted(percents)
    assert percents[-2:] == [100, 100]
    assert [shown[0][4], shown[-1][4]] == ["10", "12"]
    assert [bool(match[3]) for match in shown] == [False] + [True] * STEPS  # none is timed by the first step


@pytest.mark.slow
def test_every_named_curve_is_there_and_a_mean_over_the_steps_between(watched):
    module, folder, losses = watched
    events = events_of(folder)
    terms = {f"train/loss/{name}" for name in ("photo", "point_color", "tv_flow")}
    counts = {"frames_in_play", "occupied_voxels", "coverage", "dropped_voxels", "samples", "bases_in_play"}
    rates = {f"lr/{kind}" for kind in ("density", "color", "shading", "flow")}
    expected = {"train/loss", "train/psnr"} | terms | {f"train/{name}" for name in counts} | rates
    assert expected <= set(events.Tags()["scalars"])
    curve = events.Scalars("train/loss")
    assert [point.step for point in curve] == [5, 10, 12]
    assert curve[1].value == pytest.approx(sum(losses[5:10]) / 5, rel=1e-5)
    assert curve[2].value == pytest.approx(sum(losses[10:]) / 2, rel=1e-5)
    curve = events.Scalars("val/psnr")
    assert [point.step for point in curve] == [3, 6, 12]
    assert curve[2].value > curve[0].value
    target = ball_data().targets("val")[0]  # fewer pixels than psnr_rays: all of them
    assert curve[2].value == pytest.approx(float(module.psnr_of(target)), abs=1e-4)
    names = ("compare", "depth", "flow")
    files = sorted(path.name for path in (folder / "coarse" / "images").iterdir())
    assert files == sorted(f"{moment}_{name}.png" for moment in ("025", "050", "100") for name in names)
    for name in names:
        assert [image.step for image in events.Images(f"images/{name}")] == [3, 6, 12]


@pytest.mark.slow
def test_gradients_are_measured_where_steps_are_logged_before_they_are_clipped(tmp_path, monkeypatch):
    measured, first = [], torch.nn.Parameter(torch.zeros(2))
    first.grad = torch.tensor([3.0, 4.0])
    second, third = torch.nn.Parameter(torch.zeros(1)), torch.nn.Parameter(torch.zeros(1))
    second.grad = torch.tensor([12.0])
    groups = [{"name": "a", "params": [first, second, third]}, {"name": "b", "params": [third]}]
    assert gradient_norms(groups) == {"a": 13.0}

    def note(groups):
        measured.append([group["name"] for group in groups])
        return {"density": 7.0}

    monkeypatch.setattr("forewarp.training.callbacks.gradient_norms", note)
    watched_run(tmp_path, Scalars(every=5, lr=False)).fit()
    events = events_of(tmp_path)
    assert len(measured) == STEPS // 5
    assert [(point.step, point.value) for point in events.Scalars("grad_norm/density")] == [
        (5, 7.0),
        (10, 7.0),
    ]
    assert not [name for name in events.Tags()["scalars"] if name.startswith("lr/")]
    Scalars(every=1, grad_norm=False).on_before_optimizer_step(None, None, None)
    assert len(measured) == STEPS // 5


@pytest.mark.slow
def test_without_validation_views_there_is_no_validation_curve(tmp_path):
    scene = replace(ball_scene(), val=())
    ours = watched_run(tmp_path, TrainingImages(moments=(1.0,)), steps=2)
    ours.datamodule = SceneDataModule(lambda: scene, rays=64)
    ours.fit()
    tags = events_of(tmp_path).Tags()
    assert tags["images"]
    assert "val/psnr" not in tags["scalars"]


@pytest.mark.slow
def test_an_interrupted_watched_run_ends_as_an_unwatched_one(tmp_path, tmp_path_factory, capsys):
    with pytest.raises(SystemExit):
        watched_run(tmp_path, *all_watchers(), Interrupt("coarse", 4)).fit()
    assert "33% | 0:0" in capsys.readouterr().err.splitlines()[-1]  # an error leaves the line closed
    before = sorted(path.name for path in (tmp_path / "coarse" / "images").iterdir())
    assert before[0] == "025_compare.png"
    (tmp_path / "coarse" / "images" / "025_compare.png").unlink()
    unwatched = watched_run(tmp_path_factory.mktemp("unwatched")).fit()
    assert same(watched_run(tmp_path, *all_watchers()).fit(), unwatched)
    after = {path.name for path in (tmp_path / "coarse" / "images").iterdir()}
    assert "100_compare.png" in after
    assert "025_compare.png" not in after  # that moment was past


@pytest.mark.slow
def test_the_clock_stands_still_while_something_is_shown(tmp_path, monkeypatch):
    clock, running = Clock(), []

    def note(owner, name):
        call = getattr(owner, name)

        def noted(self, *given, **options):
            running.append((name, clock._since is not None))
            return call(self, *given, **options)

        monkeypatch.setattr(owner, name, noted)

    note(ProgressLine, "show")
    note(TensorBoardLogger, "log_metrics")
    monkeypatch.setattr("forewarp.training.module.Clock", lambda: clock)
    watched_run(tmp_path, StageProgress(every=0), Scalars(every=5)).fit()
    assert set(running) == {("show", False), ("log_metrics", False)}


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Scalars(every=0), "scalars.every: expected a whole number >= 1, but got 0"),
        (lambda: TrainingImages(moments=(0.5, 1.5)), r"moments: expected a list of numbers in \[0, 1\], but"),
        (lambda: TrainingImages(moments="0.5"), r"moments: expected a list of numbers in .*, but got '0.5'"),
        (lambda: TrainingImages(psnr_rays=0), "expected psnr_views >= 0 and psnr_rays >= 1, but got"),
        (lambda: TrainingImages(moments=(0.1,), view=7), "pictures.view: expected 0 to 0, but got 7"),
    ],
)
def test_bad_settings_are_named(tmp_path, make, text):
    with pytest.raises(ValueError, match=text):
        watched_run(tmp_path, make()).fit()
