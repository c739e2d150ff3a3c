import platform

import pytest
import torch

from forewarp.evaluation import evaluate
from forewarp.evaluation.evaluate import show, without
from forewarp.metrics.suite import LPIPS_METRICS


def test_seconds_of_a_picture_have_three_digits(capsys, tmp_path):
    seconds = {"train": 61.0, "fine": 61.0, "render_per_frame": 0.00277, "render_again_per_frame": 12.345}
    show({"protocol": {"scene": "x"}, "seconds": seconds}, tmp_path, {})
    said = capsys.readouterr().out
    assert "trained 1:01 (fine 1:01), 0.00277 s a frame, 12.3 s another at" in said
    assert "departures" not in said
    show({"protocol": {"scene": "x", "faults": "a; b", "departures": "c"}, "seconds": seconds}, tmp_path, {})
    assert "\ndepartures: c\nfaults: a; b\n" in capsys.readouterr().out


def test_what_is_left_out_fits_one_line():
    lpips = dict.fromkeys(LPIPS_METRICS, "no weights")
    small = dict.fromkeys(("ms_ssim", "ms_ssim_legacy"), "too small")
    assert without(lpips | small) == "without lpips (no weights), ms_ssim (too small)"
    lpips.pop("lpips_vgg")
    assert without(lpips) == f"without {list(lpips)[0]} (no weights), {list(lpips)[1]} (no weights)"


@pytest.mark.parametrize(
    ("lines", "name"),
    [("processor : 0\nmodel name\t: A Thing 9\n", "A Thing 9"), (None, "arm"), ("model name :\n", "arm")],
)
def test_a_machine_is_called_by_its_processor(lines, name, monkeypatch, tmp_path):
    monkeypatch.setattr(platform, "processor", lambda: "arm")
    monkeypatch.setattr(evaluate, "_PROCESSOR", tmp_path / "cpuinfo")
    if lines is not None:
        (tmp_path / "cpuinfo").write_text(lines)
    assert evaluate.device_name(torch.device("cpu")) == name
