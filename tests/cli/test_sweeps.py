"""Sweeps over absent scenes, every job of a price list, and launchers that are not installed."""

from importlib.util import find_spec

import pytest
import yaml

from forewarp.synth.scenes import synthesize
from tests.support.configs import ROOT


def test_absent_scenes_of_a_sweep_are_named_and_do_not_count_as_failed(ok, in_tmp):
    words = [
        "sweeps=dnerf",
        "model=particles",
        "dataset=dnerf",
        "data.scene=hook,lego",
        "paths.scenes=nowhere",
    ]
    done = ok("train", "--multirun", *words)
    lines = [line for line in done.out.splitlines() if line.startswith("skipped: ")]
    assert [line.rsplit("/", 1)[1] for line in lines] == ["hook: no such scene", "lego: no such scene"]
    assert not list(in_tmp.rglob("config.yaml"))


@pytest.mark.slow
def test_seeds_repeat_a_job_and_nothing_else(ok, refused, in_tmp):
    scene = ["data=dnerf", "data.root=nowhere", "data.scene=x", "absent=skip"]
    done = ok("train", "--multirun", *scene, "seeds=3")
    assert done.out.count("skipped: ") == 3
    assert "absent: expected refuse or skip, but got maybe" in refused("train", *scene, "absent=maybe")
    assert refused("train", *scene, "seeds=3") == (
        "seeds: expected --multirun beside seeds=3; add it, or use seed=N"
    )


@pytest.mark.slow
def test_every_choice_of_particles_is_fitted_and_listed(ok, in_tmp):
    synthesize(in_tmp / "x", size=24, frames=12, test_views=(1, 1, 0), val_views=0, samples_per_pixel=1)
    tiny = ["data=dnerf", "data.root=.", "data.scene=x", "preset=demo", "trainer=cpu", "threads=1"]
    tiny += ["budget.minutes=null", "budget.iterations=8", "data.held_out=2", "logger=none", "sheets=0"]
    ok("train", "--multirun", "sweeps=price_list_particles", *tiny, "callbacks.accuracy.first=1e-3")
    sweep = yaml.safe_load((ROOT / "sweeps" / "price_list_particles.yaml").read_text())
    for kind, page in (("price_list", "price-list-particles.md"), ("accuracy_time", "accuracy-time.md")):
        ok("report", f"kind={kind}", "out=out")
        text = (in_tmp / "out" / page).read_text()
        named = {frozenset(line.split("|")[1].split()) for line in text.splitlines() if line.startswith("|")}
        for change in sweep["hydra"]["sweeper"]["changes"]:
            assert frozenset((change or "base").split()) in named, change


@pytest.mark.skipif(bool(find_spec("hydra_plugins.hydra_joblib_launcher")), reason="it is installed")
def test_a_launcher_that_is_not_installed_says_what_to_install(refused, in_tmp):
    assert refused("train", "--multirun", "launcher=joblib", "sweeps=dnerf") == (
        "launcher: expected the package of hydra/launcher=joblib, but got none; "
        "install forewarp[sweeps], or use launcher=local"
    )
