"""Jobs of a sweep before any runs: which there are, and what is said of them."""

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf, read_write

from forewarp.runs import cost, jobs
from forewarp.runs.config_files import configurations
from forewarp.runs.jobs import at_once, cost_of_sweep, is_local, jobs_of
from forewarp.runs.overrides import constant, key_of

SMALL = ["experiment=demo", "data.root=nowhere", "budget.minutes=0.5", "threads=1", "trainer=cpu"]


@pytest.fixture
def sweep():
    """``sweep(words)`` is the config that a callback gets of a sweep, while Hydra is ready to compose."""
    with initialize_config_dir(str(configurations()), version_base="1.3"):

        def made(*words):
            single = [word for word in words if "," not in word.partition("=")[2].partition("[")[0]]
            config = compose("train", [*single, "hydra.mode=MULTIRUN"], return_hydra_config=True)
            with read_write(config.hydra):
                config.hydra.overrides.task = [*words]
            constant.update(map(key_of, single))  # as a command does
            return config

        yield made
    constant.clear()


@pytest.mark.slow
def test_values_are_crossed_and_repeated_with_every_seed(sweep, monkeypatch):
    composed = []
    monkeypatch.setattr(jobs, "compose", lambda *a, **k: composed.append(a[1]) or compose(*a, **k))
    found = [
        (job.model.name, job.seed, job.run)
        for job in jobs_of(sweep(*SMALL, "model=forward,tnerf", "seeds=2"))
    ]
    assert found == [
        (model, seed, f"runs/vehicle/{model}-demo-seed{seed}")
        for seed in (0, 1)
        for model in ("forward", "tnerf")
    ]
    assert len(composed) == 2  # seeds share what was composed


@pytest.mark.slow
def test_changes_and_scenes_are_one_at_a_time(sweep):
    changes = "hydra.sweeper.changes=['','preset=fast']"
    config = sweep(*SMALL, "sweeps=price_list_particles", changes)
    with read_write(config.hydra):
        config.hydra.overrides.task = [word for word in config.hydra.overrides.task if word != changes]
    assert [job.preset.name for job in jobs_of(config)] == ["demo", "fast"]


@pytest.mark.slow
def test_a_sweep_is_told_by_its_jobs_in_a_few_lines_and_listed(sweep, monkeypatch, tmp_path):
    config = sweep(*SMALL, "model=particles,forward", f"run={tmp_path}/runs/${{model.name}}")
    done = tmp_path / "runs" / "forward"
    for name in ("coarse", "fine"):
        (done / name).mkdir(parents=True)
        (done / name / "done.json").write_text("{}")
    costs, whole = cost_of_sweep(config)
    assert [job.state for job, _ in costs] == ["", ""]
    assert {(job.like.views, job.like.pixels) for job, _ in costs} == {(30, 10_000)}  # to be written
    (done / "metrics.json").write_text("{}")
    lines = jobs.estimate_lines(config, listed=True)
    assert lines[0] == "2 jobs: 1 finished before, 1 to do"
    assert whole.training == pytest.approx(60.0)
    assert lines[-1] == f"   finished  {done}"
    assert lines[-2].endswith(f"  {tmp_path / 'runs' / 'particles'}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["runs"]


@pytest.mark.slow
def test_a_few_jobs_stand_for_many_unless_each_is_asked_for(sweep, monkeypatch):
    composed, read = [], []
    monkeypatch.setattr(jobs, "_MOST", 3)
    monkeypatch.setattr(jobs, "compose", lambda *a, **k: composed.append(a[1]) or compose(*a, **k))
    monkeypatch.setattr(cost, "_views_of", lambda *_: read.append(1) or (None, None))
    config = sweep(*SMALL, "data.held_out=0,1,2,3,4", "model=particles,forward", "seed=0,1")
    costs, whole = cost_of_sweep(config, every=False)
    assert (len(composed), len(read), len(costs), len({job.folder for job, _ in costs})) == (3, 0, 20, 20)
    assert sorted(job.like.model for job, _ in costs) == ["forward"] * 10 + ["particles"] * 10
    assert (whole.alike, whole.training) == (14, pytest.approx(20 * 30.0))
    assert any(line.startswith("  14 of them are assumed to be unfinished") for line in whole.lines())
    composed.clear()
    assert cost_of_sweep(sweep(*SMALL, "data.held_out=0,1,2,3"))[1].alike == 0
    assert (len(composed), len(read)) == (4, 4)


@pytest.mark.slow
@pytest.mark.parametrize("word", ["target.plateau=-1", "budget.minutes=0"])
def test_what_training_would_refuse_has_no_estimate(sweep, word):
    with pytest.raises(ValueError, match=f"{word.partition('=')[0]}: expected"):
        cost_of_sweep(sweep(*SMALL, word))


@pytest.mark.slow
def test_a_search_has_as_many_jobs_as_it_is_given(sweep):
    config = sweep(*SMALL, "evaluate=false")
    with read_write(config.hydra):
        config.hydra.sweeper = {"_target_": "hydra_plugins.optuna.Optuna", "n_trials": 5, "n_jobs": 1}
    costs, whole = cost_of_sweep(config)
    assert (costs, whole.jobs, whole.training) == (None, 5, pytest.approx(150.0))
    assert "; finished jobs are skipped" in jobs.estimate_lines(config)[0]


@pytest.mark.parametrize(
    ("launcher", "sweeper", "expected"),
    [
        ({"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"}, {}, (1, True)),
        ({"_target_": "joblib_launcher.JoblibLauncher", "n_jobs": 3}, {}, (3, True)),
        ({"_target_": "joblib_launcher.JoblibLauncher", "n_jobs": -1}, {}, (4, True)),
        (
            {"_target_": "joblib_launcher.JoblibLauncher", "n_jobs": 9},
            {"n_jobs": 2},
            (2, True),
        ),
        ({"_target_": "ray_launcher.RayLauncher", "ray": {"remote": {"num_cpus": 2}}}, {}, (2, True)),
        ({"_target_": "ray_launcher.RayLauncher", "ray": {"init": {"address": "auto"}}}, {}, (4, False)),
        ({"_target_": "submitit_launcher.SlurmLauncher"}, {}, (6, False)),
        ({"_target_": "submitit_launcher.LocalLauncher"}, {}, (6, True)),
    ],
)
def test_a_launcher_says_how_many_jobs_run_at_once(launcher, sweeper, expected, monkeypatch):
    monkeypatch.setattr(jobs.os, "cpu_count", lambda: 4)
    config = OmegaConf.create({"hydra": {"launcher": launcher, "sweeper": sweeper}})
    assert (at_once(config, 6), is_local(config)) == expected
