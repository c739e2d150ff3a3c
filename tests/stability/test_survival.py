"""A run is killed, starved and interrupted wherever it may be; continued, it ends as if nothing had been."""

import contextlib
import json
import os
import random
import shutil
import signal
import time

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from forewarp.files import read_rows
from forewarp.synth.scenes import synthesize
from tests.support.zygote import Zygote

pytestmark = [pytest.mark.stability, pytest.mark.slow]
KILLS = 4  # of a run killed at random moments
STAGES = ("coarse", "fine")
COMMON = [
    *("data=dnerf", "data.scene=vehicle", "data.half_resolution=false", "data.held_out=1", "preset=demo"),
    *("budget.minutes=null", "stage.coarse.share=0.5", "stage.fine.share=0.5"),
    *("callbacks.pictures=null", "callbacks.accuracy.first=0.05", "callbacks.accuracy.rays=50"),
    *("sheets=1", "logger=none", "trainer=cpu", "threads=1"),
]
SMALL = [
    *(*COMMON, "checkpoint_seconds=0.02", "model=forward", "data.rays=64", "preset.nodes=6"),
    *("budget.iterations=36", "stage.fine.see_steps=2"),
    *("stage.coarse.num_voxels=[[0,800],[0.5,1500]]", "stage.fine.num_voxels=[[0,1500],[0.5,2500]]"),
    *("stage.coarse.refresh_every=4", "stage.fine.refresh_every=4"),
    "stage.coarse.bases=[[0,2],[0.5,4],[0.75,6]]",
    "stage.coarse.curriculum={start: 2, all_in: 0.8}",
]
PARTICLES = [
    *(*COMMON, "checkpoint_seconds=0", "model=particles", "budget.iterations=48"),
    *("stage.fine.density_interval=0.1", "stage.fine.relink=2", "stage.fine.rest_from=0.2"),
    *("model/opacity_over_time=cosines", "model/background=still"),
]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Write the scene ``vehicle``, 16 x 16 pixels; return the folder above it."""
    root = tmp_path_factory.mktemp("scenes")
    synthesize(root / "vehicle", size=16, frames=8, test_views=(1, 1, 1), val_views=1, samples_per_pixel=1)
    return root


@pytest.fixture(scope="module")
def zygote():
    with Zygote() as server:
        yield server


@pytest.fixture(scope="module")
def begin(zygote, scenes, tmp_path_factory):
    """``begin(folder, *more, **limits)`` runs the command to its end; returns exit status and output."""
    log = tmp_path_factory.mktemp("logs") / "log.txt"

    def call(folder, *more, options=SMALL, **limits):
        log.write_text("")
        status = zygote.call([*options, f"data.root={scenes}", f"run={folder}", *more], log, **limits)
        return status, log.read_text()

    call.log = log
    return call


@pytest.fixture(scope="module")
def whole(begin, tmp_path_factory):
    """Return the folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert begin(folder)[0] == 0, begin.log.read_text()
    return folder


def read(path):
    return torch.load(path, weights_only=True)


def end(folder):
    """Read all results of a run that do not depend on the clock."""
    left = {}
    for stage in STAGES:
        content = read(folder / stage / "last.ckpt")
        left |= {(stage, name): content[name] for name in ("global_step", "state_dict", "DNeRFDataModule")}
        left[stage, "moments"] = content["optimizer_states"][0]["state"]
        left |= {(stage, name): value for name, value in content["forewarp"].items() if name != "clock"}
        left[stage, "handover"] = (folder / stage / "handover.json").read_text()
        left[stage, "points"] = read(folder / stage / "handover.pt")
    rows = json.loads((folder / "per_image.json").read_text())["images"]
    return left | {"scores": [row["scores"] for row in rows]}


def equal(a, b):
    if torch.is_tensor(a):
        return a.shape == b.shape and torch.equal(a.nan_to_num(-7.0), b.nan_to_num(-7.0))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    return a == b


def differences(folder, whole):
    ours, theirs = end(folder), end(whole)
    assert ours.keys() == theirs.keys()
    return [name for name in theirs if not equal(ours[name], theirs[name])]


def goes_on(begin, folder, whole):
    """Continue a run to its end; the result must equal the undisturbed run's."""
    status, said = begin(folder)
    assert status == 0, said
    assert differences(folder, whole) == []
    assert not list(folder.rglob("*.part*"))


def where(folder):
    """Return the phase that a killed run had reached."""
    done = [stage for stage in STAGES if (folder / stage / "done.json").is_file()]
    if "fine" in done:
        return "evaluation"
    stage = "fine" if done else "coarse"
    return stage if (folder / stage / "last.ckpt").is_file() else f"before {stage}"


# (count, moment, file): die at the count-th write of that file; then the phase that the run is left in.
PHASES = {
    "config": ((1, "half", "config.yaml"), "before coarse"),
    "data": ((1, "half", "data.json"), "before coarse"),
    "checkpoint writing": ((1, "half", "coarse/last.ckpt"), "before coarse"),
    "checkpoint replacing": ((2, "half", "coarse/last.ckpt"), "coarse"),
    "points": ((1, "half", "coarse/handover.pt"), "coarse"),
    "handover": ((1, "half", "coarse/handover.json"), "coarse"),
    "note": ((1, "half", "coarse/done.json"), "coarse"),
    "between": ((1, "after", "coarse/done.json"), "before fine"),
    "fine": ((2, "after", "fine/last.ckpt"), "fine"),
    "fine handover": ((1, "before", "fine/handover.json"), "fine"),
    "evaluation": ((1, "half", "per_image.json"), "evaluation"),
    "end": ((1, "before", "metrics.json"), "evaluation"),
}


def test_killed_in_every_phase(begin, whole, tmp_path):
    """One run is killed in one phase after another."""
    for phase, (die, left) in PHASES.items():
        assert begin(tmp_path / "run", die=die)[0] == -signal.SIGKILL, phase
        assert where(tmp_path / "run") == left, phase
    goes_on(begin, tmp_path / "run", whole)


def test_killed_at_random_moments(zygote, begin, scenes, whole, tmp_path):
    draw, kills, run, deaths = random.Random(0), 0, 0, []
    since = time.perf_counter()
    assert begin(tmp_path / "timed")[0] == 0
    seconds = time.perf_counter() - since
    while kills < KILLS:
        folder = tmp_path / str(run)
        pid = zygote.start([*SMALL, f"data.root={scenes}", f"run={folder}"], begin.log)
        time.sleep(draw.uniform(0.1, 0.9) * seconds)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        if zygote.status() == 0:
            assert differences(folder, whole) == []
            run += 1
        else:
            deaths.append(where(folder))
            kills += deaths[-1] != "before coarse"  # earlier kills lose nothing
    goes_on(begin, tmp_path / str(run), whole)
    print(f"\nkilled in {', '.join(deaths)}")


def steps_of(run):
    """The steps of which TensorBoard has a loss, and of which the CSV file has one."""
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    rows = read_rows(run / "csv" / "metrics.csv")
    kept = [int(row["step"]) for row in rows if row["train/loss"]]
    return [scalar.step for scalar in events.Scalars("train/loss")], kept


def test_killed_while_loggers_are_on(begin, tmp_path):
    watched = ["logger=[tensorboard,csv]", "callbacks.scalars.every=1", "evaluate=false"]
    watched += ["checkpoint_seconds=0"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert begin(whole, *watched)[0] == 0
    for die in ([2, "after", "coarse/last.ckpt"], [3, "after", "fine/last.ckpt"]):
        assert begin(killed, *watched, die=die)[0] == -signal.SIGKILL
    status, said = begin(killed, *watched)
    assert status == 0, said
    for stage in STAGES:
        ours, theirs = (read(run / stage / "last.ckpt")["state_dict"] for run in (killed, whole))
        assert equal(ours, theirs)
    assert steps_of(killed) == steps_of(whole)


HARM = [lambda content: b"", lambda content: content[: len(content) // 2], lambda content: b"\x00nonsense"]


def test_no_harmed_note_is_taken_for_one(begin, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "run")
    notes = ("coarse/handover.json", "fine/handover.pt", "fine/done.json")
    for number, name in enumerate((*notes, "metrics.json", "per_image.json", "data.json")):
        path = tmp_path / "run" / name
        path.write_bytes(HARM[number % 3](path.read_bytes()))
    goes_on(begin, tmp_path / "run", whole)


def refused(status, said, *words):
    """Assert that a command ended with one line of error that holds these words."""
    lines = [line for line in said.splitlines() if "error:" in line]
    assert status not in (0, 1), said
    assert "Traceback" not in said
    assert len(lines) == 1, said
    assert all(word in lines[0] for word in words), lines[0]


def test_a_harmed_checkpoint_is_refused_by_name(begin, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "run")
    (tmp_path / "run" / "fine" / "done.json").unlink()
    path = tmp_path / "run" / "fine" / "last.ckpt"
    content = path.read_bytes()
    for harm in HARM:
        path.write_bytes(harm(content))
        said = "fine/last.ckpt: expected a checkpoint, but it cannot be read"
        refused(*begin(tmp_path / "run"), said, "delete it")
    path.unlink()
    goes_on(begin, tmp_path / "run", whole)


def test_a_full_disk_ends_in_one_line_and_the_run_goes_on(begin, whole, tmp_path):
    """A limit on the size of files stands for the disk: the finer lattice's checkpoint does not fit."""
    last = tmp_path / "run" / "coarse" / "last.ckpt"
    size = (whole / "coarse" / "last.ckpt").stat().st_size
    said = begin(tmp_path / "run", file=size - 1)
    refused(*said, "last.ckpt: expected room to write, but got File too large")
    assert 0 < read(last)["global_step"] < 18
    goes_on(begin, tmp_path / "run", whole)


def test_a_place_that_cannot_be_written(begin, tmp_path):
    (tmp_path / "file").write_text("")
    refused(*begin(tmp_path / "file" / "run"), "file/run", "Not a directory")


def test_starved_halfway_a_run_keeps_its_checkpoint_and_goes_on(begin, tmp_path):
    run, die = tmp_path / "run", (1, "after", "coarse/last.ckpt")
    more, last = ["data.rays=200000", "evaluate=false"], run / "coarse" / "last.ckpt"
    assert begin(run, *more, die=die)[0] == -signal.SIGKILL
    before, step = last.read_bytes(), read(last)["global_step"]
    refused(*begin(run, *more, memory=128 * 2**20), "memory: expected room for", "data.rays")
    assert last.read_bytes() == before
    assert begin(run, *more, die=die)[0] == -signal.SIGKILL
    assert read(last)["global_step"] > step


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_keeps_the_last_checkpoint(zygote, begin, scenes, whole, tmp_path, number):
    folder, log = tmp_path / "run", tmp_path / "log.txt"
    pid = zygote.start([*SMALL, f"data.root={scenes}", f"run={folder}"], log)
    deadline = time.perf_counter() + 60
    while not (folder / "coarse" / "last.ckpt").is_file() and time.perf_counter() < deadline:
        time.sleep(0.01)
    os.kill(pid, number)
    assert zygote.status() == 128 + number, log.read_text()
    said = log.read_text()
    ended = "interrupted" if number == signal.SIGINT else "ended by SIGTERM"
    assert f"forewarp-train: {ended}; run the same command again to go on from the last checkpoint" in said
    assert "Traceback" not in said
    goes_on(begin, folder, whole)


def test_killed_after_density_control(begin, tmp_path):
    """Between two rounds of it, and again, three steps later, while a checkpoint is written."""

    def train(folder, **limits):
        status, said = begin(folder, options=PARTICLES, **limits)
        assert status == (-signal.SIGKILL if limits else 0), said

    def particles(folder, stage="fine"):
        content = read(folder / stage / "last.ckpt")
        return content["global_step"], len(content["state_dict"]["method.gaussians.means"])

    whole, run = tmp_path / "whole", tmp_path / "run"
    train(whole)
    train(run, die=[9, "after", "fine/last.ckpt"])
    assert not (run / "fine" / "done.json").exists()
    step, first = particles(run)
    assert step == 9
    train(run, die=[4, "half", "fine/last.ckpt"])
    step, second = particles(run)
    assert step == 12
    counts = [particles(whole, stage)[1] for stage in STAGES]
    assert len({counts[0], first, second, counts[1]}) == 4  # it was on its way
    train(run)
    assert differences(run, whole) == []
