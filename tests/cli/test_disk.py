"""Disks that are full or may not be written, for real; a run that is killed while it writes its curves."""

import os
import shutil
import signal
import subprocess
import sys

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.support.commands import TINY
from tests.support.zygote import Zygote

pytestmark = pytest.mark.slow
# What is mounted so, only the command sees.
MINE = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-ec"]
TINIEST = [*TINY, "budget.minutes=null", "budget.iterations=40", "evaluate=false", "checkpoint_seconds=0"]


@pytest.fixture(scope="module")
def begin(fitted, tmp_path_factory):
    """``begin(folder, *more, **limits)`` runs forewarp-train in a process; returns exit status and output."""
    log = tmp_path_factory.mktemp("logs") / "log.txt"
    with Zygote() as zygote:

        def call(folder, *more, **limits):
            log.write_text("")
            words = [*TINIEST, f"data.root={fitted.parent / 'scenes'}", f"run={folder}", *more]
            return zygote.call(words, log, **limits), log.read_text()

        yield call


def weights(run):
    return {s: torch.load(run / s / "last.ckpt", weights_only=True)["state_dict"] for s in ("coarse", "fine")}


def same(a, b):
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return torch.equal(a, b) if torch.is_tensor(a) else a == b


def steps_of(run):
    """The steps of which TensorBoard has a loss, by stage."""
    found = {}
    for stage in ("coarse", "fine"):
        events = EventAccumulator(str(run / stage / "tensorboard"))
        events.Reload()
        found[stage] = sorted({scalar.step for scalar in events.Scalars("train/loss")})
    return found


def test_a_run_killed_while_tensorboard_is_on_goes_on_as_if_nothing_had_been(begin, tmp_path):
    watched = ["logger=tensorboard", "callbacks.scalars.every=1"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert begin(whole, *watched)[0] == 0
    for die in ([2, "after", "coarse/last.ckpt"], [3, "after", "fine/last.ckpt"]):
        assert begin(killed, *watched, die=die)[0] == -signal.SIGKILL
    status, said = begin(killed, *watched)
    assert status == 0, said
    assert same(weights(killed), weights(whole))
    assert steps_of(killed) == steps_of(whole)


@pytest.fixture
def on_its_own(fitted):
    """Runs forewarp-train after a line of the shell that mounts something; skips where nobody may mount."""

    def run(mount, folder, *words):
        if shutil.which("unshare") is None or subprocess.run([*MINE, mount], capture_output=True).returncode:
            pytest.skip("this machine lets nobody mount a file system of his own")
        command = [sys.executable, "-m", "forewarp.cli.train", *TINIEST, "logger=none", f"run={folder}"]
        command += [f"data.root={fitted.parent / 'scenes'}", *words]
        done = subprocess.run(
            [*MINE, f'{mount} && exec "$@"', "sh", *command],
            capture_output=True,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        lines = [line for line in done.stderr.splitlines() if "%" not in line]
        assert done.returncode == 2, done.stderr
        assert len(lines) == 1, done.stderr
        return lines[0].removeprefix("forewarp-train: error: ")

    return run


def test_a_disk_that_is_full_is_told_in_one_line(on_its_own, tmp_path):
    line = on_its_own(f"mount -t tmpfs -o size=64k none {tmp_path}", tmp_path / "run")
    said = "/coarse/last.ckpt: expected room to write, but got No space left on device; free some room"
    assert line.startswith(f"{tmp_path}/run{said}")


def test_a_disk_that_may_not_be_written_is_told_in_one_line(on_its_own, tmp_path):
    mount = f"mount --bind {tmp_path} {tmp_path} && mount -o remount,bind,ro {tmp_path}"
    line = on_its_own(mount, tmp_path / "run")
    assert line.startswith(f"run: {tmp_path}/run: ")
    assert "expected a usable file or folder, but got Read-only file system; check that it exists" in line
