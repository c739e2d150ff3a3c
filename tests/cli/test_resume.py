"""``resume=<run>``, data that changed, broken steps, as one types them."""

import errno
import json
import os
import shutil

import pytest
import torch
import yaml
from filelock import FileLock

from forewarp.runs.session import locked
from forewarp.synth.scenes import synthesize
from tests.support.commands import call

SMALL = [
    *("model=forward", "data=dnerf", "data.scene=vehicle", "preset=demo", "trainer=cpu", "data.rays=64"),
    "logger=none",
    *("budget.minutes=null", "budget.iterations=6", "stage.coarse.num_voxels=[[0,800]]", "~stage.fine"),
    *("callbacks.pictures=null", "callbacks.accuracy=null", "evaluate=false", "checkpoint_seconds=0"),
]


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A folder with a scene and a run that was interrupted at its end."""
    folder = tmp_path_factory.mktemp("begun")
    synthesize(folder / "vehicle", size=16, frames=4, test_views=(1, 1, 1), val_views=1, samples_per_pixel=1)
    done = call("train", *SMALL, f"data.root={folder}", f"run={folder / 'run'}")
    assert done.status == 0, done.err
    (folder / "run" / "coarse" / "done.json").unlink()
    return folder


@pytest.fixture
def begun(original, in_tmp):
    """A copy of it in the current folder; returns the run."""
    shutil.copytree(original, in_tmp, dirs_exist_ok=True)
    path = in_tmp / "run" / "config.yaml"
    path.write_text(path.read_text().replace(str(original), str(in_tmp)))
    return in_tmp / "run"


def config(run):
    return yaml.safe_load((run / "config.yaml").read_text())


def test_a_run_is_resumed_by_its_folder_alone(ok, begun):
    before = config(begun)
    ok("train", f"resume={begun}")
    assert json.loads((begun / "coarse" / "done.json").read_text())["steps"] == 6
    assert config(begun) == before
    assert "forewarp-train model=forward data=dnerf" in before["command"]


def test_beside_it_stands_only_what_may_change(ok, refused, begun):
    ok("train", f"resume={begun}", "threads=1", "sentinel.skip=3", "trainer=cpu")
    assert (config(begun)["threads"], config(begun)["sentinel"]) == (1, {"skip": 3})
    line = refused("train", f"resume={begun}", "seed=3")
    assert line.startswith(
        "seed: expected no such key beside resume=, whose config.yaml holds it, but got seed=3"
    )
    line = refused("train", "resume=nowhere")
    assert line.endswith("expected the configuration of a run, but got none; set resume=<a run's folder>")


@pytest.mark.slow
def test_changed_data_are_refused_unless_accepted(ok, refused, begun):
    path = begun.parent / "vehicle" / "transforms_train.json"
    path.write_text(path.read_text() + " ")
    for words in ([f"resume={begun}"], [*SMALL, "data.root=.", "run=run"]):
        line = refused("train", *words)
        assert "data.json: expected the data that the run was begun with, but got others" in line
        assert "transforms_train.json; use run=..., or go on with data_changed=accept" in line
    line = refused("train", f"resume={begun}", "data_changed=x")
    assert "data_changed: expected one of refuse, accept, but got x" in line
    ok("train", f"resume={begun}", "data_changed=accept")
    ok("train", f"resume={begun}")  # it was accepted once for all
    path.write_text(path.read_text() + " ")
    assert "expected the data" in refused("train", f"resume={begun}")  # and not what comes later


def test_a_run_begun_inside_its_scene_goes_on(ok, begun, monkeypatch):
    scene = begun.parent / "vehicle"
    shutil.rmtree(begun)
    monkeypatch.chdir(scene)
    ok("train", *SMALL, "data.root=..", "run=runs/a")
    (scene / "runs" / "a" / "coarse" / "done.json").unlink()
    ok("train", "resume=runs/a")
    assert (scene / "runs" / "a" / "coarse" / "done.json").is_file()


def test_what_is_measured_on_changed_data_says_so(forewarp, ok, begun):
    ok("train", f"resume={begun}")
    path = begun.parent / "vehicle" / "transforms_test_time.json"
    assert "warning:" not in forewarp("evaluate", f"run={begun}").err
    path.write_text(path.read_text() + " ")
    done = ok("evaluate", f"run={begun}")
    said = f"warning: {begun}/data.json: expected the data that the run was begun with, but got others: "
    assert f"{said}transforms_test_time.json" in done.err


@pytest.mark.slow
def test_a_folder_in_work_is_refused(ok, refused, begun):
    with locked(begun):
        line = refused("train", f"resume={begun}")
        assert f"expected a run that nobody works on, but got one of process {os.getpid()} on " in line
        assert "nobody works on" in refused("evaluate", f"run={begun}")
    ok("train", f"resume={begun}", "evaluate=true")
    with locked(begun):  # measured
        assert "nobody works on" in refused("train", f"resume={begun}", "evaluate=true")


def test_a_file_system_without_locks_is_used_without(begun, monkeypatch):
    asked = []

    def missing(lock):
        asked.append(lock)
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(FileLock, "_acquire", missing)
    with locked(begun), locked(begun):
        assert len(asked) == 2


def test_a_broken_step_ends_in_one_line_and_is_stored(refused, begun, in_tmp):
    shutil.rmtree(in_tmp / "run")
    line = refused("train", *SMALL, "data.root=.", "run=run", "stage.coarse.lr.color=1e39")
    assert line.startswith(
        "stage.coarse: expected finite numbers, but got parameter: radiance.color at step 0,"
    )
    stored = in_tmp / "run" / "coarse" / "broken" / "step_0.pt"
    assert f"; its batch and weights are in {stored.relative_to(in_tmp)}; begin anew with lower" in line
    assert torch.load(stored, weights_only=True)["found"] == "parameter: radiance.color"


def test_skipped_steps_are_told(ok, begun, monkeypatch):
    from forewarp.data.batches import Sampler

    draw, drawn = Sampler.draw, []

    def spoiled(self):
        batch = draw(self)
        drawn.append(batch)
        if len(drawn) == 2:
            batch.observations[0].rgb[0] = float("nan")
        return batch

    shutil.rmtree(begun)
    monkeypatch.setattr(Sampler, "draw", spoiled)
    done = ok("train", *SMALL, "data.root=.", "run=run", "sentinel.skip=1")
    assert "coarse: 1 broken steps skipped; each lies in run/coarse/broken" in done.out
