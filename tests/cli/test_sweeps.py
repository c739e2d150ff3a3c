"""``--multirun``: sweeps, a search by Optuna, and jobs that are killed or fail under every launcher."""

import json
import re
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest
import yaml
from omegaconf import OmegaConf

from forewarp.files import read_rows
from forewarp.report.settings import shortest
from forewarp.runs import jobs
from forewarp.runs.overrides import key_of
from forewarp.synth.scenes import synthesize
from tests.support.configs import ROOT

LAUNCHERS = {"local": [], "joblib": [], "ray": ["+hydra.launcher.ray.init.num_cpus=2"], "submitit": []}
SHORT = ["trainer=cpu", "threads=1", "preset=demo", "budget.minutes=null", "logger=none", "sheets=0"]
VOXELS = [*SHORT, "model=forward", "data.rays=64", "stage.coarse.num_voxels=[[0,800]]", "~stage.fine"]


def write(folder, size=16, frames=6, **views):
    synthesize(folder, size=size, frames=frames, samples_per_pixel=1, **{"test_views": (1, 1, 0)} | views)


@pytest.mark.slow
def test_absent_scenes_of_a_sweep_are_named_and_do_not_count_as_failed(ok, in_tmp):
    scenes = "hydra.sweeper.scenes=['experiment=dnerf data.scene=hook']"
    done = ok("train", "--multirun", "sweeps=dnerf", "model=particles", scenes, "paths.scenes=nowhere")
    (line,) = [line for line in done.out.splitlines() if line.startswith("skipped: ")]
    assert line.endswith("/hook: no such scene")
    assert not list(in_tmp.rglob("config.yaml"))


@pytest.mark.slow
def test_seeds_repeat_a_job_and_nothing_else(ok, refused, in_tmp):
    scene = ["data=dnerf", "data.root=nowhere", "data.scene=x", "absent=skip"]
    done = ok("train", "--multirun", *scene, "seeds=2")
    assert done.out.count("skipped: ") == 2
    assert "absent: expected refuse or skip, but got 'maybe'" in refused("train", *scene, "absent=maybe")
    line = "seeds: expected --multirun beside seeds=3; add it, or use seed=N"
    assert refused("train", *scene, "seeds=3") == line


@pytest.mark.slow
def test_a_sweep_without_a_name_has_a_folder_and_a_row_of_scores_for_each_job(ok, in_tmp):
    write(in_tmp / "vehicle")
    scene = ["data=dnerf", "data.root=.", "data.scene=vehicle", "model=forward", "data.rays=64"]
    tiny = ["budget.iterations=4", "stage.coarse.num_voxels=[[0,800]]", "~stage.fine", "logger=csv"]
    words = ["train", "--multirun", *SHORT, *scene, *tiny, "stage.coarse.lr.density=0.1,0.2"]
    done = ok(*words)
    folders = sorted(Path("runs/vehicle").iterdir())
    about, *listed = done.out.splitlines()[-3:]
    assert about == "2 jobs, psnr of held-out or validation views:"
    assert [line.split()[1] for line in listed] == [str(folder) for folder in folders]
    assert all(0 < float(line.split()[0]) < 60 for line in listed)
    for folder, rate in zip(folders, ("0.1", "0.2"), strict=True):
        assert re.fullmatch(rf"forward-demo-seed0-coarse-density-{rate}-\w{{10}}", folder.name)
        rows = read_rows(folder / "csv" / "metrics.csv")
        assert float(rows[-1]["test/space/psnr"]) > 0
        assert f"stage.coarse.lr.density: {rate}" in (folder / "csv" / "hparams.yaml").read_text()
    assert ok(*words).out.count("measured before: ") == 2


@pytest.mark.slow
def test_choices_of_particles_are_fitted_and_listed(ok, in_tmp):
    sweep = yaml.safe_load((ROOT / "sweeps" / "price_list_particles.yaml").read_text())
    changes = sweep["hydra"]["sweeper"]["changes"][::16]  # tests/test_sweeps.py composes all
    write(in_tmp / "x", size=24, frames=12, val_views=0)
    tiny = [*SHORT, "data=dnerf", "data.root=.", "data.scene=x", "budget.iterations=4", "data.held_out=2"]
    tiny += ["callbacks.accuracy.first=1e-3", f"hydra.sweeper.changes={changes}"]
    ok("train", "--multirun", "sweeps=price_list_particles", *tiny)
    for kind, page in (("price_list", "price-list-particles.md"), ("accuracy_time", "accuracy-time.md")):
        ok("report", f"kind={kind}", "out=out")
        text = (in_tmp / "out" / page).read_text()
        rows = {frozenset(line.split("|")[1].split()) for line in text.splitlines() if line.startswith("|")}
        short = shortest({key_of(word) for change in changes for word in change.split()})
        for change in changes:
            words = [word.replace(key_of(word), short[key_of(word)]) for word in change.split()]
            assert frozenset(words or ["base"]) in rows, change


@pytest.mark.slow
@pytest.mark.skipif(bool(find_spec("hydra_plugins.hydra_joblib_launcher")), reason="it is installed")
def test_a_launcher_that_is_not_installed_says_what_to_install(refused, in_tmp):
    expected = "expected the package of hydra/launcher=joblib, but got none; install forewarp[sweeps]"
    line = refused("train", "--multirun", "launcher=joblib", "sweeps=dnerf")
    assert line == f"launcher: {expected}, or use launcher=local"


@pytest.fixture
def search(in_tmp):
    """A search's command line; its scene is written, and it writes ``runs/search/vehicle``."""
    package = "hydra_plugins.hydra_optuna_sweeper"
    pytest.importorskip(package, reason="needs hydra-optuna-sweeper: install forewarp[sweeps]")
    write(in_tmp / "vehicle", test_views=(1, 0, 0), val_views=1)
    where = ["data=dnerf", "data.root=.", "data.scene=vehicle", "data.rays=64", "trainer=cpu", "threads=1"]
    stage = ["stage.coarse.num_voxels=[[0,800]]", "~stage.fine", "budget.iterations=4"]
    return ["train", "--multirun", "sweeps=search", *where, *stage]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Optuna raises deprecation warnings of its own
def test_trials_of_a_search_find_a_best_one_and_go_on(ok, search, in_tmp):
    ok(*search, "hydra.sweeper.n_trials=1")
    done = ok(*search, "hydra.sweeper.n_trials=2")
    assert done.out.count("finished before") == 1
    folder = in_tmp / "runs" / "search" / "vehicle"
    runs = list(folder.glob("forward-demo-seed0-*"))
    assert len(runs) == 2
    scores = [json.loads((run / "score.json").read_text())["scores"]["psnr"] for run in runs]
    best = yaml.safe_load((folder / "optimization_results.yaml").read_text())
    assert best["best_value"] == max(scores)
    keys = {"stage.coarse.lr.flow", "objective.coarse.weights.tv_flow", "preset.padding"}
    assert set(best["best_params"]) == keys
    assert f"best     psnr {max(scores):.4f}: " in done.out


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_what_goes_wrong_in_a_search_is_named(forewarp, search, in_tmp):
    done = forewarp(*search[:-1], "hydra.sweeper.n_trials=4", "budget.iterations=choice(-1,4)")
    assert done.status == 2
    assert re.search("^forewarp-train: [123] of 4 jobs failed:$", done.err, re.M)
    assert "budget.iterations=-1" in done.err.splitlines()[-1]
    assert "best     psnr" in done.out
    one = [*search, "hydra.sweeper.n_trials=1"]
    assert "seeds: expected 1 in a search, but got 2; use seed=N" in forewarp(*one, "seeds=2").err
    assert "add hydra.sweeper.direction=minimize" in forewarp(*one, "score=lpips_squeeze").err
    plain = [word for word in one if word != "sweeps=search"]
    done = forewarp(*plain, "model=forward", "hydra/sweeper=optuna")
    assert "but got range(0, 1); add hydra.sweeper.params.seed=0" in done.err
    for file in (in_tmp / "vehicle").glob("transforms_val*"):
        file.unlink()
    done = forewarp(*one)
    assert done.status == 2
    assert "score: expected psnr, which the sweeper needs, but got none: " in done.err
    assert "set data.held_out=8" in done.err


@pytest.fixture
def start(tmp_path, monkeypatch):
    """``start(launcher, ...)`` begins a sweep in the test's own folder, where the scene ``hook`` is."""
    write(tmp_path / "hook", frames=4, val_views=0)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    begun = []

    def call(launcher, *words):
        pytest.importorskip("hydra" if launcher == "local" else f"hydra_plugins.hydra_{launcher}_launcher")
        code = "from forewarp.cli.train import main; main()"
        words = ["--multirun", "experiment=dnerf", "data.root=.", *VOXELS, "callbacks.pictures=null", *words]
        words += ["absent=skip", "run='runs/${data.scene}-{hash}'"]
        arguments = [sys.executable, "-c", code, *words, "checkpoint_seconds=0", f"launcher={launcher}"]
        with open(tmp_path / "log", "w") as log:
            options = {"cwd": tmp_path, "stdout": log, "stderr": subprocess.STDOUT}
            begun.append(subprocess.Popen([*arguments, *LAUNCHERS[launcher]], **options))
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


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_killed_sweep_goes_on_with_what_is_missing(launcher, start, tmp_path):
    jobs = ["data.scene=hook", "budget.iterations=5,300"]
    sweep = start(launcher, *jobs)
    latest = time.monotonic() + 300
    checkpoints = set()
    while not (measured(tmp_path) and checkpoints - measured(tmp_path).keys()):
        assert sweep.poll() is None, (tmp_path / "log").read_text()
        assert time.monotonic() < latest
        time.sleep(0.02)
        checkpoints = {path.parents[1] for path in (tmp_path / "runs").rglob("last.ckpt")}
    kill(sweep)
    before = measured(tmp_path)
    assert len(before) == 1
    assert start(launcher, *jobs).wait(300) == 0, (tmp_path / "log").read_text()
    after = measured(tmp_path)
    assert before.items() <= after.items()  # what was finished was not touched
    steps = [json.loads((run / "coarse" / "done.json").read_text())["steps"] for run in after]
    assert sorted(steps) == [5, 300]


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_jobs_that_fail_are_named_and_stop_no_other(launcher, start, tmp_path):
    (tmp_path / "lego").mkdir()
    sweep = start(launcher, "data.scene=lego,hook,mutant", "budget.iterations=5")
    assert sweep.wait(300) == 2
    said = (tmp_path / "log").read_text()
    _, found, failed = said.partition("forewarp-train: 1 of 3 jobs failed:\n")
    assert found
    listed = [line for line in failed.splitlines() if line.startswith("  forewarp-train ")]
    assert ["data.scene=lego" in line for line in listed] == [True]  # what Ray passes on may come later
    assert len(measured(tmp_path)) == 1


@pytest.mark.slow
def test_a_cost_that_cannot_be_told_ends_a_command_that_asks_for_it_alone(
    refused, in_tmp, monkeypatch, capsys
):
    words = ["train", "--multirun", "experiment=demo", "data.root=nowhere", "plan_only=true"]
    line = "budget.minutes: expected a number > 0 or null, but got 'abc'"
    assert refused(*words, "budget.minutes=abc,1") == line
    assert refused(*words, "budget.iterations=-1,1").startswith("budget.iterations: expected a number > 0")

    def fails(*_, **__):
        raise RuntimeError("no\nidea")

    monkeypatch.setattr(jobs, "estimate_lines", fails)
    assert refused(*words, "seeds=2") == "RuntimeError: no; idea"
    assert not [*in_tmp.iterdir()]
    jobs.ReportCost().on_multirun_start(OmegaConf.create({"plan_only": False}))  # goes on
    assert capsys.readouterr().out == "no estimate: no idea\n"


@pytest.mark.slow
def test_a_sweep_says_first_what_it_costs_by_its_own_jobs(ok, in_tmp, monkeypatch):
    monkeypatch.setenv("FOREWARP_TIMES", str(in_tmp / "times.csv"))
    write(in_tmp / "vehicle")
    words = ["train", "--multirun", *VOXELS, "data=dnerf", "data.root=.", "data.scene=vehicle"]
    words += ["budget.iterations=8"]
    plan = ok(*words, "seeds=2", "plan_only=true").out.splitlines()
    assert plan[0] == "2 jobs; 1 at a time"
    assert [line.split("-seed")[1][0] for line in plan[-2:]] == ["0", "1"]
    assert sorted(path.name for path in in_tmp.iterdir()) == ["vehicle"]
    said = ok(*words, "seeds=2").out
    assert said.startswith("2 jobs; 1 at a time\n")
    rows = read_rows(in_tmp / "times.csv")
    assert [(row["model"], row["scene"], float(row["steps"])) for row in rows] == [
        ("forward", "vehicle", 8)
    ] * 2
    assert all(float(row["views"]) == 2 and float(row["disk"]) > 0 for row in rows)
    first, *lines = ok(*words, "seeds=3", "plan_only=true").out.splitlines()
    assert first == "3 jobs: 2 finished before, 1 to do"
    assert "  estimated from runs of this machine (1)" in lines
    assert [line.split()[0] for line in lines[-3:-1]] == ["finished"] * 2
