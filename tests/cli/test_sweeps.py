"""Sweeps over absent scenes, and launchers that are not installed."""

import pytest


def test_absent_scenes_of_a_sweep_are_named_and_do_not_count_as_failed(forewarp, in_tmp):
    done = forewarp(
        "train", "--multirun", "sweeps=dnerf", "scene=dnerf_hook,dnerf_lego", "paths.scenes=nowhere"
    )
    assert done.status == 0, done.err
    lines = [line for line in done.out.splitlines() if line.startswith("skipped: ")]
    assert [line.rsplit("/", 1)[1] for line in lines] == ["hook: no such scene", "lego: no such scene"]
    assert not list(in_tmp.rglob("config.yaml"))


def test_without_a_sweep_an_absent_scene_is_a_mistake(refused, in_tmp):
    assert "nowhere" in refused("train", "scene=dnerf_hook", "paths.scenes=nowhere")
    expected = "absent: expected refuse or skip, but got maybe"
    assert expected in refused("train", "scene=dnerf_hook", "absent=maybe")


def test_seeds_repeat_a_job_and_nothing_else(forewarp, refused, in_tmp):
    scene = ["data=dnerf", "data.root=nowhere", "data.scene=x", "absent=skip"]
    done = forewarp("train", "--multirun", *scene, "seeds=3")
    assert done.status == 0, done.err
    assert done.out.count("skipped: ") == 3
    assert refused("train", *scene, "seeds=3") == (
        "seeds: expected --multirun beside seeds=3; add it, or use seed=N"
    )


@pytest.mark.parametrize(
    ("word", "plugin", "launcher"),
    [
        ("joblib", "hydra_joblib_launcher", "joblib"),
        ("ray", "hydra_ray_launcher", "ray"),
        ("slurm", "hydra_submitit_launcher", "submitit_slurm"),
    ],
)
def test_a_launcher_that_is_not_installed_says_what_to_install(refused, in_tmp, word, plugin, launcher):
    try:
        __import__(f"hydra_plugins.{plugin}")
    except ImportError:
        line = refused("train", "--multirun", f"launcher={word}", "sweeps=dnerf")
        assert line == (
            f"launcher: expected the package of hydra/launcher={launcher}, but got none; "
            "install forewarp[sweeps], or use launcher=local"
        )
    else:
        pytest.skip(f"{plugin} is installed")
