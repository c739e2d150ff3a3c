"""A sweep of four jobs that is killed and begun again, and one with jobs that fail, under every launcher."""

import json
import signal
import subprocess
import sys
import time

import psutil
import pytest

from forewarp.synth.scenes import synthesize

LAUNCHERS = {"local": [], "joblib": [], "ray": ["+hydra.launcher.ray.init.num_cpus=2"], "submitit": []}
JOB = [
    *("--multirun", "sweeps=dnerf", "model=forward", "paths.scenes=.", "preset=demo", "seeds=2"),
    "budget.minutes=null",
    *("trainer=cpu", "threads=1", "data.rays=64", "logger=none", "callbacks.pictures=null", "~stage.fine"),
    *("stage.coarse.num_voxels=[[0,800]]", "checkpoint_seconds=0", "sheets=0"),
]
SHORT_AND_LONG = ["dataset=dnerf", "data.scene=hook", "budget.iterations=5,600"]


@pytest.fixture
def start(tmp_path, monkeypatch):
    """``start(launcher, ...)`` begins a sweep in the test's own folder, where the scene ``hook`` is."""
    scene = tmp_path / "dnerf" / "hook"
    synthesize(scene, size=16, frames=4, test_views=(1, 1, 1), val_views=1, samples_per_pixel=1)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    begun = []

    def call(launcher, *words):
        pytest.importorskip("hydra" if launcher == "local" else f"hydra_plugins.hydra_{launcher}_launcher")
        code = "from forewarp.cli.train import main; main()"
        arguments = [sys.executable, "-c", code, *JOB, f"launcher={launcher}", *LAUNCHERS[launcher], *words]
        with open(tmp_path / "log", "w") as log:
            begun.append(subprocess.Popen(arguments, cwd=tmp_path, stdout=log, stderr=subprocess.STDOUT))
        return begun[-1]

    yield call
    for process in begun:
        kill(process)


def kill(process):
    """End a sweep with all of its processes, as a power cut would."""
    if process.poll() is None:
        process.send_signal(signal.SIGSTOP)  # or it would begin more
        for child in psutil.Process(process.pid).children(recursive=True):
            child.kill()
        process.kill()
        process.wait(30)


def measured(folder):
    """The runs that are finished, and when they were."""
    return {path.parent: path.stat().st_mtime_ns for path in (folder / "runs").rglob("metrics.json")}


def is_in_the_middle(folder):
    """Whether one run is finished, and another has begun to learn."""
    begun = {path.parents[1] for path in (folder / "runs").rglob("last.ckpt")}
    return bool(measured(folder)) and bool(begun - measured(folder).keys())


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_killed_sweep_goes_on_with_what_is_missing(launcher, start, tmp_path):
    sweep = start(launcher, *SHORT_AND_LONG)
    latest = time.monotonic() + 300
    while not is_in_the_middle(tmp_path):
        assert sweep.poll() is None, (tmp_path / "log").read_text()
        assert time.monotonic() < latest
        time.sleep(0.02)
    kill(sweep)
    before = measured(tmp_path)
    assert 1 <= len(before) < 4
    assert start(launcher, *SHORT_AND_LONG).wait(300) == 0, (tmp_path / "log").read_text()
    after = measured(tmp_path)
    assert len(after) == 4
    assert before.items() <= after.items()  # what was finished was not touched
    steps = [json.loads((run / "coarse" / "done.json").read_text())["steps"] for run in after]
    assert sorted(steps) == [5, 5, 600, 600]


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_jobs_that_fail_are_named_and_stop_no_other(launcher, start, tmp_path):
    (tmp_path / "dnerf" / "lego").mkdir()
    sweep = start(launcher, "dataset=dnerf", "data.scene=lego,hook,mutant", "budget.iterations=5")
    assert sweep.wait(300) == 2
    said = (tmp_path / "log").read_text()
    assert "forewarp-train: 2 of 6 jobs failed:" in said
    failed = [set(line.split()) for line in said.splitlines() if line.startswith("  seed=")]
    assert [job & {"data.scene=lego", "data.scene=mutant"} for job in failed] == [{"data.scene=lego"}] * 2
    assert len(measured(tmp_path)) == 2
