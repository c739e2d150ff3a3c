import gc
import os
import platform
import re
import resource
import sys
from pathlib import Path

import pytest
import torch

from forewarp.training import device
from forewarp.training.device import check_processes, peak_memory_bytes, reset_peak_memory

CLEARED = Path("/proc/self/clear_refs")


@pytest.fixture
def on_the_cpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.mark.skipif(not os.access(CLEARED, os.W_OK), reason=f"{CLEARED} cannot be written: not Linux")
def test_the_peak_counts_from_the_reset(on_the_cpu):
    reset_peak_memory()
    before = peak_memory_bytes()
    block = torch.ones(50_000_000)  # 200 MB, touched
    during = peak_memory_bytes()
    del block
    assert peak_memory_bytes() > during - 10e6  # the kernel counts in batches of pages
    assert during > before + 190e6
    reset_peak_memory()
    assert peak_memory_bytes() < during - 150e6


@pytest.mark.skipif(not os.access(CLEARED, os.W_OK), reason=f"{CLEARED} cannot be written: not Linux")
def test_what_earlier_runs_left_in_a_circle_does_not_count(on_the_cpu):
    gc.collect()
    gc.disable()
    try:
        circle = [torch.ones(50_000_000)]  # 200 MB
        circle.append(circle)
        before = peak_memory_bytes()
        del circle
        reset_peak_memory()
        assert peak_memory_bytes() < before - 150e6
    finally:
        gc.enable()


def test_elsewhere_it_is_that_of_the_process(on_the_cpu, monkeypatch, tmp_path):
    monkeypatch.setattr(device, "_PROCESS", tmp_path / "nowhere")
    reset_peak_memory()  # does nothing, and says nothing
    unit = 1 if sys.platform == "darwin" else 1024
    assert peak_memory_bytes() == resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


NAMES = [("processor : 0\nmodel name\t: A Thing 9\n", "A Thing 9"), (None, "arm"), ("model name :\n", "arm")]


@pytest.mark.parametrize(("lines", "name"), NAMES)
def test_a_machine_is_called_by_its_processor(lines, name, monkeypatch, tmp_path):
    monkeypatch.setattr(platform, "processor", lambda: "arm")
    monkeypatch.setattr(device, "_PROCESSOR", tmp_path / "cpuinfo")
    if lines is not None:
        (tmp_path / "cpuinfo").write_text(lines)
    assert device.device_name(torch.device("cpu")) == name


def test_the_commit_of_the_code_is_known_in_its_checkout_alone(monkeypatch, tmp_path):
    found = device.commit.__wrapped__()
    assert found is None or re.fullmatch(r"[0-9a-f]{9,}\+?", found)
    monkeypatch.setattr(device, "__file__", str(tmp_path / "training" / "device.py"))
    assert device.commit.__wrapped__() is None


@pytest.mark.parametrize("devices", [1, "1", [0], [3]])
def test_one_process_trains_a_run(devices):
    check_processes(devices)


@pytest.mark.parametrize(
    ("devices", "nodes", "got"),
    [(2, 1, "2"), ("auto", 1, "auto"), (-1, 1, "-1"), ([0, 1], 1, r"\[0, 1\]"), (1, 2, "1 on 2 nodes")],
)
def test_more_processes_for_a_run_are_refused(devices, nodes, got):
    with pytest.raises(ValueError, match=f"trainer.devices: expected 1, .* but got {got}; one process"):
        check_processes(devices, nodes)
