import pytest
import torch

from forewarp.evaluation.evaluate import show, without
from forewarp.metrics.suite import LPIPS_METRICS
from forewarp.runs.build import build_run
from forewarp.training.device import device_of
from tests.support.configs import composed


@pytest.fixture
def machine(monkeypatch):
    """Pretends to a machine with or without GPUs of NVIDIA's and Apple's."""

    def pretend(cuda=False, apple=False):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
        monkeypatch.setattr(torch.backends.mps, "is_available", lambda: apple)

    return pretend


def test_seconds_of_a_picture_have_three_digits(capsys, tmp_path):
    seconds = {"train": 61.0, "fine": 61.0, "render_per_frame": 0.00277, "render_again_per_frame": 12.345}
    show({"protocol": {"scene": "x"}, "seconds": seconds}, tmp_path, {})
    said = capsys.readouterr().out
    assert "trained 1:01 (fine 1:01), 0.00277 s a frame, 12.3 s another at" in said
    assert "departures" not in said
    show({"protocol": {"scene": "x", "faults": "a; b", "departures": "c"}, "seconds": seconds}, tmp_path, {})
    assert "\ndepartures: c\nfaults: a; b\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("accelerator", "cuda", "device"),
    [("auto", False, "cpu"), ("auto", True, "cuda"), ("gpu", True, "cuda"), ("cpu", True, "cpu")],
)
def test_device_of_an_accelerator(machine, accelerator, cuda, device):
    machine(cuda=cuda, apple=True)
    assert device_of(accelerator) == torch.device(device)


@pytest.mark.parametrize(
    ("accelerator", "text"),
    [("gpu", "expected a GPU, but found none; use trainer=cpu"), ("mps", "cpu, gpu or cuda, but got mps")],
)
def test_refuses_what_is_not_there(machine, accelerator, text):
    machine(apple=True)
    with pytest.raises(ValueError, match=text):
        device_of(accelerator)


def test_training_and_evaluation_use_the_same_device(machine, tmp_path):
    machine(apple=True)  # which Lightning would take
    run = build_run(composed("data.scene=x", "trainer=auto", "logger=none"))
    trainer = run.make_trainer(tmp_path, [])
    assert trainer.strategy.root_device == device_of("auto") == torch.device("cpu")


def test_what_is_left_out_fits_one_line():
    lpips = dict.fromkeys(LPIPS_METRICS, "no weights")
    small = dict.fromkeys(("ms_ssim", "ms_ssim_legacy"), "too small")
    assert without(lpips | small) == "without lpips (no weights), ms_ssim (too small)"
    lpips.pop("lpips_vgg")
    assert without(lpips) == f"without {list(lpips)[0]} (no weights), {list(lpips)[1]} (no weights)"


@pytest.mark.parametrize("precision", ["16-mixed", 16, "transformer-engine-float16"])
def test_float16_is_refused(precision):
    text = f"trainer.precision: expected 32-true or bf16-mixed, but got {precision}; "
    with pytest.raises(ValueError, match=text):
        build_run(composed(f"trainer.precision={precision}"))
