"""Data modules under a real Trainer: no warnings, one reading, exact continuation."""

from dataclasses import replace

import pytest
import torch
from lightning import LightningModule, Trainer

from forewarp.data.dnerf import read_scene
from forewarp.data.files import SceneError
from forewarp.data.module import DNeRFDataModule, SceneDataModule
from forewarp.scene.view import Batch, Target
from tests.support.dnerf_scene import shots, write_tiny
from tests.support.tiny_scene import ball_scene


class Recorder(LightningModule):
    """Fits one number and keeps what it was shown."""

    def __init__(self):
        super().__init__()
        self.level = torch.nn.Parameter(torch.zeros(()))
        self.seen, self.targets = [], []

    def training_step(self, batch: Batch, index: int):
        rgb = batch.observations[0].rgb
        self.seen.append((batch.frame, rgb))
        return (self.level - rgb).square().mean()

    def validation_step(self, target: Target, index: int):
        self.targets.append(target.frame.name)

    test_step = validation_step

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters())


def trainer(steps, **options) -> Trainer:
    off = dict.fromkeys(
        ["logger", "enable_progress_bar", "enable_model_summary", "enable_checkpointing"], False
    )
    return Trainer(max_steps=steps, accelerator="cpu", **off, **options)


@pytest.fixture
def make(tmp_path):
    write_tiny(tmp_path / "toy")
    return lambda **options: DNeRFDataModule(tmp_path, "toy", rays=16, **options)


def test_a_run_validates_and_tests(make):
    model, data = Recorder(), make(background="random")
    loop = trainer(5, val_check_interval=2, check_val_every_n_epoch=None, num_sanity_val_steps=0)
    loop.fit(model, datamodule=data)
    assert len(model.seen) == 5
    assert model.targets == ["val/r_0", "val/r_1"] * 2
    model.targets.clear()
    loop.test(model, datamodule=data, verbose=False)
    assert model.targets == ["test/r_0", "test/r_1", "test/r_2"]


def test_an_interrupted_run_sees_what_an_unbroken_one_sees(make, tmp_path):
    whole = Recorder()
    trainer(6).fit(whole, datamodule=make(background="random"))
    half, rest = Recorder(), Recorder()
    first = trainer(3)
    first.fit(half, datamodule=make(background="random"))
    first.save_checkpoint(tmp_path / "half.ckpt")
    trainer(6).fit(rest, datamodule=make(background="random", seed=9), ckpt_path=tmp_path / "half.ckpt")
    both = half.seen + rest.seen
    assert [frame for frame, _ in both] == [frame for frame, _ in whole.seen]
    assert all(torch.equal(a, b) for (_, a), (_, b) in zip(both, whole.seen, strict=True))


def test_a_scene_without_validation_trains_and_the_picker_is_asked_once_a_step(tmp_path):
    write_tiny(tmp_path / "toy", val=())
    calls, model, data = [], Recorder(), DNeRFDataModule(tmp_path, "toy", rays=4)
    data.picker = lambda: calls.append(1) or 2
    trainer(4, val_check_interval=2, check_val_every_n_epoch=None).fit(model, datamodule=data)
    assert ([frame for frame, _ in model.seen], len(calls), model.targets) == ([2] * 4, 4, [])


def test_the_scene_is_read_once(tmp_path):
    write_tiny(tmp_path / "toy")
    calls = []

    def read():
        calls.append(1)
        return read_scene(tmp_path, "toy")

    data = SceneDataModule(read, eval_background="black")
    assert not calls
    data.setup("fit")
    data.setup("test")
    assert len(calls) == 1
    assert data.scene.protocol["background"] == "black"
    assert data.scene.protocol["dataset"] == "dnerf"


OPAQUE = [
    ({"background": "black"}, 0.0),
    ({"background": "white"}, 1.0),
    ({"background": "random"}, 0.0),
    ({"background": "black", "eval_background": "white"}, 1.0),
]


@pytest.mark.parametrize(("options", "behind"), OPAQUE)
def test_behind_opaque_pictures_is_what_was_there_in_training(options, behind):
    data = SceneDataModule(lambda: replace(ball_scene(), has_alpha=False), **options)
    assert data.targets("test").background.tolist() == [behind] * 3


def test_behind_cut_out_pictures_is_white_whatever_training_had():
    data = SceneDataModule(ball_scene, background="black")
    assert data.targets("test").background.tolist() == [1.0] * 3
    assert data.scene.protocol["background"] == "white"


def test_targets_by_split(tmp_path):
    write_tiny(tmp_path / "toy", test=shots(2, ability="time", depth=True))
    data = DNeRFDataModule(tmp_path, "toy", eval_background="black")
    assert [len(data.targets(s)) for s in ("train", "val", "test")] == [4, 2, 2]
    target = data.targets("test")[1]
    assert (target.frame.ability, target.rgb.shape, target.depth.shape) == ("time", (6, 8, 3), (6, 8))
    assert torch.equal(target.to("cpu").rgb, target.rgb)
    with pytest.raises(SceneError, match="split: expected train, val, test or held, but got 'all'"):
        data.targets("all")


BAD = [
    ({"background": "red"}, "data.background: expected"),
    ({"eval_background": "random"}, "data.eval_background: expected white or black"),
    ({"half_resolution": 3}, "data.half_resolution: expected"),
]


@pytest.mark.parametrize(("options", "match"), BAD)
def test_bad_settings_are_refused_at_setup(make, options, match):
    with pytest.raises(SceneError, match=match):
        make(**options).setup()
