"""Somebody else's package, found on the path alone: a method, data, an effect, a callback and a logger."""

import importlib
import json
import os
import shutil
import signal
import sys
from pathlib import Path

import pytest
import torch
import yaml

from forewarp import load
from forewarp.training.handover import load_handover
from tests.support.commands import call

HERE = Path(__file__).parents[1] / "foreign"
SMALL = [
    *("hydra.searchpath=[pkg://theirs.conf]", "trainer=cpu", "data.rays=64", "threads=1"),
    *("budget.minutes=null", "budget.iterations=6", "checkpoint_seconds=0", "sheets=0"),
]
DISC = [*SMALL, "experiment=disc", "model=forward", "model/view_dependence=tint", "~stage.fine"]
MIST = [*SMALL, "experiment=disc", "model=mist"]
TRUST = "trust=[theirs]"
ADVICE = "; if you trust the package theirs, add trust=[theirs] (or set FOREWARP_TRUST=theirs)"


@pytest.fixture(autouse=True)
def theirs(monkeypatch):
    """The package can be imported, and nothing of it remains."""
    monkeypatch.syspath_prepend(str(HERE))
    monkeypatch.delenv("FOREWARP_TRUST", raising=False)
    importlib.invalidate_caches()
    yield
    forget("theirs")


@pytest.fixture
def ctrl_c():
    """Ctrl-C works, also where whoever started the tests in the background has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def forget(package):
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """A finished run of their data and effect, and one of their method."""
    root = tmp_path_factory.mktemp("theirs")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HERE))
        for name, overrides in (("disc", DISC), ("mist", MIST)):
            done = call("train", *overrides, f"run={root / name}")
            assert done.status == 0, done.err
    forget("theirs")
    return root


@pytest.fixture
def fitted(originals, in_tmp):
    """``run`` in the current folder: a finished run, in a process that has not seen the package."""
    return shutil.copytree(originals / "disc", in_tmp / "run")


@pytest.fixture
def mist(originals, in_tmp):
    """As ``fitted``, of their method."""
    return shutil.copytree(originals / "mist", in_tmp / "run")


def steps_of(run, stage="coarse"):
    return json.loads((run / stage / "done.json").read_text())["steps"]


def test_what_is_typed_trains_and_trains_again_without_trust(forewarp, ok, fitted):
    config = yaml.safe_load((fitted / "config.yaml").read_text())
    assert config["data"]["_target_"] == "theirs.data.DiscDataModule"
    assert config["model"]["view_dependence"]["_target_"] == "theirs.effects.Tint"
    assert config["trust"] is None
    assert (fitted / "coarse" / "steps.txt").read_text() == "6"
    assert "theirs/step" in (fitted / "coarse" / "csv" / "metrics.csv").read_text()
    again = forewarp("train", *DISC, "run=run")
    assert (again.status, again.out.strip()[:15]) == (0, "measured before"), again
    (fitted / "metrics.json").unlink()
    again = ok("train", *DISC, "run=run")
    assert "coarse: finished before" in again.out


@pytest.mark.slow
def test_an_interrupted_run_goes_on(forewarp, ok, refused, in_tmp, ctrl_c):
    stopped = forewarp("train", *DISC, "run=run", "callbacks.count.stop_at=3", "evaluate=false", TRUST)
    assert stopped.status == 130, stopped
    run = in_tmp / "run"
    assert (run / "coarse" / "last.ckpt").is_file()
    config = run / "config.yaml"
    text = config.read_text()
    assert yaml.safe_load(text)["trust"] is None  # a folder has no say in it
    config.write_text(text.replace("stop_at: 3", "stop_at: null").replace("trust: null", "trust: [theirs]"))
    forget("theirs")
    assert refused("train", "resume=run").endswith(ADVICE)
    assert "theirs" not in sys.modules
    done = ok("train", "resume=run", TRUST)
    assert "coarse: goes on at 50%, step 3" in done.out
    assert steps_of(run) == 6


def test_a_stored_run_is_measured_by_who_trusts_it(ok, refused, fitted, monkeypatch):
    line = refused("evaluate", "run=run")
    assert line.startswith(
        "run/config.yaml: data._target_: expected a class of forewarp, but got 'theirs.data."
    )
    assert line.endswith(ADVICE)
    assert "theirs" not in sys.modules
    for override in ("trust=theirs", "trust=[other,theirs]"):
        ok("evaluate", "run=run", override)
    monkeypatch.setenv("FOREWARP_TRUST", "other, theirs")
    ok("evaluate", "run=run")


@pytest.mark.slow
def test_no_job_of_a_sweep_measures_a_run_that_is_not_trusted(forewarp, ok, fitted):
    shutil.copytree(fitted, "again")
    sweep = ["evaluate", "--multirun", "run=run,again"]
    written = [Path(run, "metrics.json").stat().st_mtime_ns for run in ("run", "again")]
    done = forewarp(*sweep)
    assert done.status == 2
    assert done.err.count(f"{ADVICE}\n") == 2
    assert "2 of 2 jobs failed" in done.err
    assert "theirs" not in sys.modules
    assert written == [Path(run, "metrics.json").stat().st_mtime_ns for run in ("run", "again")]
    ok(*sweep, TRUST)


def test_the_page_of_a_run_takes_trust(ok, fitted, monkeypatch):
    monkeypatch.setattr("forewarp.cli.report.write_film", lambda *_: None)
    page = ["report", "kind=run", "run=run"]
    assert ADVICE in ok(*page).out
    assert "Rendering" not in ok(*page, TRUST).out


def test_the_environment_goes_along_whatever_a_launcher_hands_on(ok, fitted, monkeypatch):
    """A job of another process or machine: its environment is its own."""
    import hydra

    monkeypatch.setenv("FOREWARP_TRUST", "theirs")
    begun = hydra.main

    def elsewhere(**options):
        def wrapped(job):
            def launched(config):
                os.environ.pop("FOREWARP_TRUST")
                return job(config)

            launched.__module__ = "__main__"
            return begun(**options)(launched)

        return wrapped

    monkeypatch.setattr(hydra, "main", elsewhere)
    ok("evaluate", "run=run")


def test_a_method_of_theirs_is_measured_and_rendered_with_trust(ok, refused, mist):
    assert steps_of(mist, "fine") == 6
    still = ["format=png", "frames=2", "size=16", "threads=1"]
    for words in (["evaluate", "run=run"], ["render", "run=run", *still]):
        forget("theirs")
        assert refused(*words).endswith(ADVICE)
        ok(*words, TRUST)
    assert len(list((mist / "videos").rglob("*.png"))) == 2


@pytest.mark.slow
def test_a_method_of_theirs_is_swept_beside_ours_and_reported(ok, in_tmp):
    run = "run=runs/disc/${model.name}-seed${seed}"
    done = ok("train", "--multirun", *SMALL, "experiment=disc", "model=forward,mist", run)
    assert done.out.count("of 1 validation view") == 2  # and scored
    assert {path.name for path in in_tmp.glob("runs/disc/*-seed*")} == {"forward-seed0", "mist-seed0"}
    ok("report", "kind=accuracy_time", "runs=runs", "out=page")
    assert "mist-demo" in (in_tmp / "page" / "accuracy-time.md").read_text()


def test_a_method_of_theirs_is_opened_with_trust(mist):
    with pytest.raises(ValueError, match="expected a class of forewarp, but got 'theirs"):
        load(mist)
    assert "theirs" not in sys.modules
    scene = load(mist, trust=["theirs"])
    frame = scene.frames("test")[0]
    assert scene.render(frame.camera, 0.5).shape == (16, 16, 3)
    assert scene.trajectories(scene.matter().points, [0.0, 1.0]).shape == (8, 2, 3)


def test_a_stage_has_a_method_of_its_own(ok, in_tmp):
    ok("train", *SMALL, "experiment=disc_in_two", "run=run", "evaluate=false")
    run = in_tmp / "run"
    assert [steps_of(run, stage) for stage in ("coarse", "fine")] == [3, 3]
    module = load(run, trust=["theirs"]).module
    left = load_handover(run / "coarse").cloud.points
    assert torch.cdist(module.method.began, left).amin(-1).max() == 0
    ok("evaluate", "run=run", TRUST)
