import pytest
import torch
from omegaconf import OmegaConf

from forewarp.cli.train import beginning
from forewarp.runs.build import build_run
from forewarp.runs.config import content_hash
from forewarp.runs.device import device_for, why_on_cpu
from tests.support.configs import composed


@pytest.fixture
def gpu(monkeypatch):
    """Pretends that torch sees a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)


def config_of(*more):
    return composed("data=synthetic", "data.scene=x", "logger=none", *more)


@pytest.mark.parametrize(
    ("model", "trainer", "device"),
    [
        ("particles", "auto", "cpu"),
        ("particles", "gpu", "cuda"),
        ("particles", "cpu", "cpu"),
        ("forward", "auto", "cuda"),
        ("nerf", "auto", "cuda"),
        ("forward", "cpu", "cpu"),
    ],
)
def test_auto_takes_what_the_method_belongs_on(gpu, model, trainer, device):
    config = config_of(f"model={model}", f"trainer={trainer}")
    assert device_for(config) == build_run(config).device == torch.device(device)
    why = why_on_cpu(config)
    assert (why is None) == ((model, trainer) != ("particles", "auto"))


def test_without_a_gpu_there_is_nothing_to_say(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    config = config_of("model=particles", "trainer=auto")
    assert (device_for(config), why_on_cpu(config)) == (torch.device("cpu"), None)


def test_it_says_why_and_how_to_choose_the_gpu(gpu, data_run):
    config, run = data_run
    first, second, third = beginning(run, config).splitlines()
    assert first.endswith("on the CPU")
    assert second.startswith("model=particles leaves the GPU aside: its kernels are the CPU's")
    assert second.endswith("; trainer=gpu runs it there all the same")
    assert third == f"run: {run.folder}"
    config.trainer.accelerator = "cpu"
    assert len(beginning(run, config).splitlines()) == 2


@pytest.fixture
def data_run(gpu):
    """A run of particles, and its config; its scene has no pictures."""
    config = config_of("model=particles", "trainer=auto")
    run = build_run(config)
    run.datamodule.scene = type("Scene", (), {"name": "x", "train": (), "test": ()})
    return config, run


def test_one_stage_that_belongs_on_the_cpu_is_enough(gpu):
    config = config_of("model=forward", "trainer=auto")
    OmegaConf.set_struct(config.stage.fine, False)
    config.stage.fine.model = config_of("model=particles").model
    assert device_for(config) == torch.device("cpu")
    assert why_on_cpu(config).startswith("model=particles")


def test_what_was_trained_by_the_processor_clock_is_only_not_trained_on_a_gpu(gpu):
    run = build_run(config_of("model=forward", "trainer=gpu", "budget.clock=processor"))
    with pytest.raises(ValueError, match="budget.clock: expected wall, as processor time leaves out the GPU"):
        run.fit()


def test_what_is_no_method_is_not_named_here(gpu):
    for target in ("no.such.package", "forewarp.nothing", None):
        config = config_of("model=forward", "trainer=auto")
        OmegaConf.set_struct(config, False)
        config.model._target_ = target
        assert device_for(config) == torch.device("cuda")


def test_runs_of_minutes_on_auto_and_on_the_cpu_are_the_same_run(gpu):
    hashes = [
        content_hash(config_of("model=particles", f"trainer={trainer}", "budget.minutes=1"))
        for trainer in ("auto", "cpu", "gpu")
    ]
    assert hashes[0] == hashes[1] != hashes[2]
