"""Kernels that are compiled ahead are those that a step calls."""

import os
import subprocess
import sys

import pytest

from forewarp.methods.particles import start as warmup
from forewarp.ops.backend import numba_installed

COMMAND = [
    sys.executable,
    "-c",
    "from forewarp.methods.particles.start import compile_backward; compile_backward()",
]
pytestmark = pytest.mark.skipif(not numba_installed(), reason="needs Numba")


def _signatures() -> dict[str, list]:
    from forewarp.ops.kernels import backward, rasterize

    kernels = (rasterize.compare, backward.rank_rows, backward.splat_gradients, backward.chain)
    return {kernel.py_func.__name__: list(kernel.signatures) for kernel in kernels}


@pytest.mark.slow
def test_the_process_beside_compiles_for_the_numbers_that_a_step_has():
    script = (
        "import json, types, torch\n"
        "from forewarp.methods.particles import start as warmup\n"
        "from tests.methods.particles.test_warmup import _signatures\n"
        "warmup.compile_backward(); before = _signatures()\n"
        "warmup.compile_kernels(types.SimpleNamespace(means=torch.zeros(1, 3)))\n"
        "assert all(len(found) == 1 for found in before.values()), before\n"
        "assert _signatures() == before, (before, _signatures())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_another_process_is_started_only_for_new_kernels_and_a_second_core(monkeypatch):
    started = []

    class Process:
        def __init__(self, command, **_):
            started.append(command)

        returncode = 0

        def wait(self, timeout):
            started.append("waited")

    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(warmup, "cores", lambda: 2)
    with warmup._backward_compiled_beside(False):
        assert not started
    with warmup._backward_compiled_beside(True):
        assert started == [COMMAND]
    assert started[-1] == "waited"
    started.clear()
    monkeypatch.setattr(warmup, "cores", lambda: 1)
    with warmup._backward_compiled_beside(True):
        assert not started


def test_where_no_process_can_be_started_all_is_compiled_here(monkeypatch):
    def refuse(*_, **__):
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    monkeypatch.setattr(warmup, "cores", lambda: 2)
    done = []
    with warmup._backward_compiled_beside(True):
        done.append(True)
    assert done


def test_why_the_second_process_failed_is_told(monkeypatch, capsys):
    command = [sys.executable, "-c", "import sys; sys.exit('no room')"]
    start = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda _, **how: start(command, **how))
    monkeypatch.setattr(warmup, "cores", lambda: 2)
    with warmup._backward_compiled_beside(True):
        pass
    assert capsys.readouterr().out.endswith("as a second one failed: no room\n")


@pytest.mark.slow
def test_what_the_other_process_compiles_is_found_in_the_cache(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = COMMAND
    subprocess.run(command, env=environment, check=True)
    script = (
        "from forewarp.methods.particles import start as warmup\n"
        "from forewarp.ops.kernels import backward, rasterize\n"
        "warmup.compile_backward()\n"
        "for kernel in (backward.chain, backward.splat_gradients, rasterize.compare):\n"
        "    assert kernel.stats.cache_misses.total() == 0, kernel\n"
    )
    subprocess.run([sys.executable, "-c", script], env=environment, check=True)
