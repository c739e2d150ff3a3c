"""A run is built on the device that its config names, or its methods belong on."""

import json
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf

from forewarp.cli.train import beginning
from forewarp.runs import build
from forewarp.runs.config import check_values, content_hash, plain
from forewarp.runs.devices import device_for, why_on_cpu
from tests.support.configs import composed


@pytest.fixture
def machine(monkeypatch):
    """Pretends to a machine with or without GPUs of NVIDIA's and Apple's."""

    def pretend(cuda=False, apple=False):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
        monkeypatch.setattr(torch.backends.mps, "is_available", lambda: apple)

    return pretend


def config_of(*more):
    return composed("data=synthetic", "data.scene=x", "logger=none", *more)


def on(accelerator, *targets):
    """A config of one stage for each model's ``_target_``."""
    stage = {str(i): {"model": {"_target_": target, "name": "x"}} for i, target in enumerate(targets)}
    model = {"_target_": "forewarp.methods.nerf.NeRF", "name": "nerf"}
    return OmegaConf.create({"trainer": {"accelerator": accelerator}, "stage": stage, "model": model})


PARTICLES, NERF = "forewarp.methods.particles.model.Particles", "forewarp.methods.nerf.NeRF"


@pytest.mark.parametrize(
    ("accelerator", "targets", "cuda", "device"),
    [
        ("auto", [NERF], False, "cpu"),
        ("auto", [NERF], True, "cuda"),
        ("auto", [NERF, PARTICLES], True, "cpu"),
        ("auto", [PARTICLES], False, "cpu"),
        ("gpu", [PARTICLES], True, "cuda"),
        ("cpu", [NERF], True, "cpu"),
        *(("auto", [target], True, "cuda") for target in ("no.such.package", "forewarp.nothing", None)),
    ],
)
def test_auto_takes_what_the_methods_belong_on(machine, accelerator, targets, cuda, device):
    machine(cuda=cuda, apple=True)
    config = on(accelerator, *targets)
    assert device_for(config) == torch.device(device)
    is_on_cpu = cuda and accelerator == "auto" and PARTICLES in targets
    assert (why_on_cpu(config) is not None) == is_on_cpu


@pytest.mark.parametrize(
    ("accelerator", "text"),
    [("gpu", "expected a GPU, but found none; use trainer=cpu"), ("mps", "got mps; Apple's GPUs have no")],
)
def test_a_device_that_is_not_there_is_refused(machine, accelerator, text):
    machine(apple=True)
    with pytest.raises(ValueError, match=text):
        device_for(on(accelerator))


@pytest.mark.slow
def test_training_and_evaluation_use_the_same_device(machine, tmp_path):
    machine(apple=True)  # which Lightning would take
    run = build.build_run(config_of("trainer=auto"))
    trainer = run.make_trainer(tmp_path, [], [])
    assert trainer.strategy.root_device == run.device == torch.device("cpu")


@pytest.mark.slow
def test_it_says_why_and_how_to_choose_the_gpu(machine):
    machine(cuda=True)
    config = config_of("model=particles", "trainer=auto")
    run = build.build_run(config)
    run.datamodule.scene = SimpleNamespace(name="x", train=(), test=(), protocol={})
    first, second, third = beginning(run, config).splitlines()
    assert first.endswith("on the CPU")
    assert second.startswith("model=particles runs on the CPU: it has no GPU kernels")
    assert second.endswith("; trainer=gpu runs it on the GPU")
    assert third == f"run: {run.folder}"
    config.trainer.accelerator = "cpu"
    assert len(beginning(run, config).splitlines()) == 2
    by_minutes = []
    for config.trainer.accelerator in ("auto", "cpu", "gpu"):
        by_minutes.append(content_hash(config))
    assert by_minutes[0] == by_minutes[1] != by_minutes[2]


@pytest.mark.slow
def test_what_was_trained_by_the_processor_clock_is_only_not_trained_on_a_gpu(machine):
    machine(cuda=True)
    run = build.build_run(config_of("model=forward", "trainer=gpu", "budget.clock=processor"))
    with pytest.raises(ValueError, match="budget.clock: expected wall, as processor time leaves out the GPU"):
        run.fit()


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["16-mixed", 16, "transformer-engine-float16"])
def test_float16_is_refused(precision):
    text = f"trainer.precision: expected 32-true or bf16-mixed, .* but got {precision}; use"
    with pytest.raises(ValueError, match=text):
        build.build_run(config_of(f"trainer.precision={precision}"))


@pytest.mark.parametrize(
    ("devices", "nodes", "got"),
    [(1, 1, None), ("1", 1, None), ([0], 1, None), ([3], 1, None), (2, 1, "2"), ("auto", 1, "auto")]
    + [
        (-1, 1, "-1"),
        ([0, 1], 1, r"\[0, 1\]"),
        (1, 2, "1 on 2 nodes"),
        (1.5, 1, "1.5"),
        ({"a": 1}, 1, "{'a': 1}"),
    ],
)
def test_one_process_trains_a_run(devices, nodes, got):
    trainer = OmegaConf.create({"devices": devices, "num_nodes": nodes})
    if got is None:
        build.check_trainer(trainer)
    else:
        with pytest.raises(ValueError, match=f"trainer.devices: expected 1, .* but got {got}; one process"):
            build.check_trainer(trainer)


@pytest.mark.parametrize("precision", ["64-true", 64, "bf16-true"])
def test_only_precisions_that_are_tested_are_taken(precision):
    text = f"trainer.precision: expected 32-true or bf16-mixed.*, but got {precision}; use trainer.precision="
    with pytest.raises(ValueError, match=text):
        build.check_trainer(OmegaConf.create({"precision": precision}))
    for known in (None, 32, "32-true", "bf16-mixed"):
        build.check_trainer(OmegaConf.create({"precision": known}))


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("max_steps", 5, "trainer.max_steps: expected one of accelerator, .*; use budget.iterations=N"),
        ("gradient_clip_val", 1.0, "trainer.gradient_clip_val: expected one of .*; leave it out"),
        (
            "strategy",
            "ddp",
            "trainer.devices: expected 1, .* but got 1 with strategy=ddp; one process",
        ),
    ],
)
def test_an_argument_of_the_trainer_that_would_be_overruled_is_refused(key, value, says):
    with pytest.raises(ValueError, match=says):
        build.check_trainer(OmegaConf.create({"_target_": "lightning.Trainer", key: value}))


@pytest.mark.slow
def test_a_profiler_of_another_name_is_refused():
    with pytest.raises(ValueError, match="profiler: expected simple, advanced or null, but got 'slow'"):
        build.build_run(config_of("+trainer.profiler=slow"))


@pytest.mark.slow
@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("model", ["forward", "particles"])
def test_hyperparameters_are_keys_and_values_as_they_are_typed_each_once(model, stored):
    words = ["experiment=demo", f"model={model}", "objective.fine.weights.photo=0.5"]
    as_made = composed(*words)
    config = OmegaConf.create(plain(as_made)) if stored else as_made
    config.command = f"forewarp-train experiment=demo data.root=/home/me/scenes run=/tmp/run model={model}"
    found = build.hyperparameters(config)
    assert found.pop("command") == f"forewarp-train experiment=demo data.root=scenes run=run model={model}"
    assert found["objective.fine.weights.photo"] == 0.5
    assert not any("/" in str(value) or "root" in name for name, value in found.items())
    assert not any(".objective." in name for name in found)
    rays = {
        "preset.rays",
        "data.rays",
    } & found.keys()  # one follows the other, which a stored config has lost
    assert rays == {"preset.rays"} or stored
    typed = [f"{name}={json.dumps(v) if isinstance(v, bool) else v}" for name, v in found.items()]
    again = composed(*words[:2], *typed)
    config.command = None
    assert plain(again) == plain(config)


@pytest.mark.slow
def test_hyperparameters_tell_apart_runs_of_another_target_or_start():
    typed = ["target.psnr=31", "start=/home/me/runs/still", "+preset.bases=4", "+preset.mine=${.bases}"]
    found, plainly = (build.hyperparameters(config_of(*words)) for words in (typed, []))
    assert {key: found[key] for key in found.keys() - plainly} == {
        **{"target.psnr": 31, "target.plateau": "null", "start": "still"},
        **{"preset.bases": 4, "preset.mine": 4},  # a relative key is resolved in place
    }


@pytest.mark.slow
def test_runs_of_a_folder_share_decoded_frames(tmp_path, monkeypatch):
    def folder(run, runs="runs"):
        return build.frames_folder(OmegaConf.create({"run": str(run), "paths": {"runs": str(runs)}}))

    monkeypatch.chdir(tmp_path)
    ours = tmp_path / "runs" / ".frames"
    assert folder("runs/toy/particles") == folder("runs/toy/plan/trials/0") == ours
    assert folder("elsewhere/particles") == tmp_path / "elsewhere" / ".frames"
    ours.mkdir(parents=True)
    assert folder(tmp_path / "runs/toy/particles", "of another folder") == ours
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / ".frames").symlink_to(ours)
    assert folder("theirs/a/particles") == tmp_path / "theirs" / "a" / ".frames"  # no link is followed
    assert content_hash(config_of()) == content_hash(config_of("+data.disk_cache_bytes=1"))


@pytest.mark.slow
def test_a_target_that_cannot_end_anything_is_refused():
    assert not build.target_of(config_of()).is_set
    config = config_of("target.psnr=30")
    config.callbacks = {}  # as ``saved_config`` opens a run to look at it
    assert build.build_run(config).target.psnr == 30
    for words, line in {
        ("target.psnr=-1",): "target.psnr: expected a number of dB above 0, or null, but got -1",
        ("+target.pnsr=30",): "target: expected psnr and plateau, but got pnsr",
    }.items():
        with pytest.raises(ValueError, match=f"^{line}"):
            build.target_of(config_of(*words))


def test_a_target_makes_another_run_and_none_is_as_before():
    config = config_of()
    before = OmegaConf.masked_copy(config, [key for key in config if key != "target"])
    assert content_hash(before) == content_hash(config) != content_hash(config_of("target.psnr=30"))


@pytest.mark.slow
def test_a_key_of_the_data_that_is_new_and_null_changes_no_hash():
    """Finished jobs are found again by the digits that they were named by before the key was there."""
    before = {
        "data": {"root": "/scenes", "scene": "x", "box": None, "canonical": None},
        "model": {"name": "nerf"},
    }
    before |= {"stage": {}, "preset": {"name": "fast"}, "budget": {"minutes": None}, "seed": 0, "trainer": {}}
    now = before | {"data": before["data"] | {"name_pattern": None}}
    another = before | {"data": before["data"] | {"name_pattern": r"(?P<frame>\d+)"}}
    digits = [content_hash(OmegaConf.create(config)) for config in (before, now, another)]
    assert digits[0] == digits[1] == "0d348e6b6c" != digits[2]
    config = config_of("data=dnerf")
    assert "name_pattern" in config.data
    stored = OmegaConf.create(plain(config))
    del stored.data["name_pattern"]
    assert content_hash(stored) == content_hash(config)


def test_a_stage_of_another_class_is_refused():
    config = {"_target_": "forewarp.training.objective.Objective", "weights": {"photo": 1.0}}
    with pytest.raises(ValueError, match=r"stage.fine: expected a stage \(StagePlan\), but got Objective"):
        build.stage_of("fine", OmegaConf.create(config))


def test_data_without_a_layout_are_refused():
    with pytest.raises(ValueError, match="data: expected a layout, but got none"):
        check_values(OmegaConf.create({"data": {"scene": "a"}, "callbacks": {}}))
