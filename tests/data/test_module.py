"""Data modules under a real Trainer; views held out and another canonical time."""

from dataclasses import replace

import pytest
import torch
from lightning import LightningModule, Trainer

from forewarp.data.dnerf import read_scene
from forewarp.data.files import fingerprint
from forewarp.data.module import DNeRFDataModule, SceneDataModule, hold_out, only, outline, with_canonical
from forewarp.scene.frame import Truth
from forewarp.scene.view import Batch, Target
from tests.support.tiny_scene import ball_scene
from tests.support.written_scenes import dnerf_shots, refused, write_dnerf


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
    off = ["logger", "enable_progress_bar", "enable_model_summary", "enable_checkpointing"]
    return Trainer(max_steps=steps, accelerator="cpu", **dict.fromkeys(off, False), **options)


@pytest.fixture
def make(tmp_path):
    write_dnerf(tmp_path / "toy")
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
    whole, half, rest = Recorder(), Recorder(), Recorder()
    trainer(6).fit(whole, datamodule=make(background="random"))
    first = trainer(3)
    first.fit(half, datamodule=make(background="random"))
    first.save_checkpoint(tmp_path / "half.ckpt")
    trainer(6).fit(rest, datamodule=make(background="random", seed=9), ckpt_path=tmp_path / "half.ckpt")
    for (frame, rgb), (expected_frame, expected_rgb) in zip(half.seen + rest.seen, whole.seen, strict=True):
        assert frame == expected_frame
        assert torch.equal(rgb, expected_rgb)


def test_a_scene_without_validation_trains_and_the_picker_is_asked_once_a_step(tmp_path):
    write_dnerf(tmp_path / "toy", val=())
    calls, model, data = [], Recorder(), DNeRFDataModule(tmp_path, "toy", rays=4)
    data.picker = lambda: calls.append(1) or 2
    trainer(4, val_check_interval=2, check_val_every_n_epoch=None).fit(model, datamodule=data)
    assert ([frame for frame, _ in model.seen], len(calls), model.targets) == ([2] * 4, 4, [])


def test_the_scene_is_read_once_and_its_files_are_known(make, tmp_path):
    calls = []
    data = SceneDataModule(lambda: calls.append(1) or read_scene(tmp_path, "toy"), eval_background="black")
    assert not calls
    data.setup("fit")
    data.setup("test")
    assert len(calls) == 1
    assert (data.scene.protocol["background"], data.fingerprint()) == ("black", None)
    assert make().fingerprint() == fingerprint(tmp_path / "toy")


OPAQUE = [
    ({"background": "black"}, 0.0),
    ({"background": "white"}, 1.0),
    ({"background": "random"}, 0.0),
    ({"background": "black", "eval_background": "white"}, 1.0),
]


@pytest.mark.parametrize(("options", "color"), OPAQUE)
def test_behind_opaque_images_is_what_was_there_in_training(options, color):
    data = SceneDataModule(lambda: replace(ball_scene(), has_alpha=False), **options)
    assert data.targets("test").background.tolist() == [color] * 3
    cut_out = SceneDataModule(ball_scene, background="black")  # white whatever training had
    assert cut_out.scene.protocol["background"] == "white"
    assert cut_out.targets("test").background.tolist() == [1] * 3


def test_targets_by_split(tmp_path):
    write_dnerf(tmp_path / "toy", test=dnerf_shots(2, ability="time", depth=True))
    data = DNeRFDataModule(tmp_path, "toy", eval_background="black")
    assert [len(data.targets(s)) for s in ("train", "val", "test")] == [4, 2, 2]
    target = data.targets("test")[1]
    assert (target.frame.ability, target.rgb.shape, target.depth.shape) == ("time", (6, 8, 3), (6, 8))
    assert torch.equal(target.to("cpu").depth, target.depth)
    with refused("split: expected train, val, test or held, but got 'all'"):
        data.targets("all")


BAD = [
    ({"background": "red"}, "data.background: expected"),
    ({"eval_background": "random"}, "data.eval_background: expected white or black"),
    ({"half_resolution": 3}, "data.half_resolution: expected"),
    ({"cache_bytes": -1}, "data.cache_bytes: expected a number in"),
]


@pytest.mark.parametrize(("options", "match"), BAD)
def test_bad_settings_are_refused_at_setup(make, options, match):
    with refused(match):
        make(**options).setup()


@pytest.mark.parametrize(("count", "watched"), [(1, [0]), (8, range(8)), (15, range(0, 15, 2))])
def test_eight_validation_views_are_spread_out(count, watched):
    scene = ball_scene(frames=8, size=8)
    val = (*scene.train, *scene.train)[:count]
    frames = SceneDataModule(lambda: replace(scene, val=val)).watched().frames
    assert [frame.name for frame in frames] == [val[i].name for i in watched]


def test_held_out_frames_are_spread_and_leave_the_training_set():
    scene = hold_out(ball_scene(frames=14, size=8), 3)
    assert [frame.name for frame in scene.held] == ["r_3", "r_7", "r_11"]
    assert len({frame.name for frame in (*scene.train, *scene.held)}) == 14
    assert (len(scene.train), scene.protocol["held_out"]) == (11, 3)
    assert hold_out(scene, 0) is scene
    data = SceneDataModule(lambda: ball_scene(frames=8, size=8), rays=4, held_out=2)
    times = {frame.time for frame in data.scene.held}
    assert len(data.targets("held")) == len(times) == 2
    assert data.watched().frames == data.targets("held").frames
    assert not {data.batches.draw().time for _ in range(200)} & times


@pytest.mark.parametrize("canonical", [0.0, 5 / 11])
def test_the_ends_and_the_canonical_time_keep_their_frames(canonical):
    times = sorted([i / 11 for i in range(12)] * 2)  # two cameras a time
    scene = ball_scene(times=times, canonical_time=canonical, size=8)
    most = (24 - 2 * len({0.0, 1.0, canonical})) // 2
    assert not {frame.time for frame in hold_out(scene, most).held} & {0.0, 1.0, canonical}
    with refused("data.held_out: expected a whole number of at least 0, but got -1"):
        hold_out(scene, -1)
    with refused(f"data.held_out: expected at most {most} of the 24 training frames"):
        hold_out(scene, most + 1)


def moving(*times):
    """A scene that begins at 0, with trajectories at ``times``."""
    truth = Truth(torch.rand(3, len(times), 3), torch.tensor(times, dtype=torch.float64))
    return replace(ball_scene(frames=5, size=8), truth=truth)


def test_the_middle_training_time_becomes_canonical_and_leads_the_trajectories():
    scene = moving(0.0, 0.25, 0.5, 1.0)
    moved = with_canonical(scene, "middle")
    assert moved.canonical_time == moved.protocol["canonical_time"] == 0.5
    assert moved.truth.times.tolist() == [0.5, 0.0, 0.25, 1.0]
    assert torch.equal(moved.truth.points, scene.truth.points[:, [2, 0, 1, 3]])
    assert with_canonical(moving(0.0, 1.0), "middle").truth is None
    assert with_canonical(scene, None) is with_canonical(scene, "first") is scene  # as it was
    for choice, time in (("first", 0.0), (0.0, 0.0), (0.3, 0.25), (0.45, 0.5), (1, 1.0)):  # the nearest
        assert with_canonical(scene, choice).canonical_time == time


@pytest.mark.parametrize("word", ["last", 1.5, -0.1, True, float("nan")])
def test_another_canonical_time_is_refused(word):
    with refused("data.canonical: expected first, middle, spread, a time in .0, 1. or"):
        with_canonical(moving(0.0), word)


def posing(*apart, alpha=True):
    """A scene of two bars that are so many pixels apart in each frame; 0: they touch."""
    images = []
    for gap in apart:
        rgba = torch.zeros(24, 24, 4, dtype=torch.uint8)
        rgba[4:20, 8:12, 3] = rgba[4:20, 12 + gap : 16 + gap, 3] = 255
        images.append(rgba)
    scene = ball_scene(frames=len(apart), size=24)
    train = tuple(replace(f, load=lambda i=i: i) for f, i in zip(scene.train, images, strict=True))
    return replace(scene, train=train, has_alpha=alpha)


@pytest.mark.parametrize(
    ("apart", "time"),
    [
        ((4, 4, 0, 0, 0), 0.25),  # two parts that touch later on
        ((0, 0, 0, 0, 4), 1.0),
        ((4, 4, 4, 4, 0), 0.5),  # of much the same, the middle
    ],
)
def test_the_canonical_time_is_one_at_which_parts_do_not_touch(apart, time):
    assert with_canonical(posing(*apart), "spread").canonical_time == time
    assert with_canonical(posing(*apart, alpha=False), "spread").canonical_time == 0.5
    assert outline(torch.zeros(4, 4, dtype=torch.bool)) == 0


def test_few_training_views_are_spread_and_keep_the_canonical_time():
    scene = ball_scene(frames=9, size=8)
    few = only(scene, 3)
    times = [frame.time for frame in few.train]
    assert (len(times), few.canonical_time in times, few.protocol["train_views"]) == (3, True, 3)
    assert {max(scene.times), scene.canonical_time} <= set(times)
    assert (few.val, few.test) == (scene.val, scene.test)
    assert only(scene, None) is only(scene, 9) is scene
    assert len(SceneDataModule(lambda: scene, train_views=1).scene.train) == 1
    with refused("data.train_views: expected"):
        only(scene, 0)
