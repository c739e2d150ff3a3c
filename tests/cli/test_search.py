"""A search by Optuna, in which every job returns a score."""

import json

import pytest
import yaml

from forewarp.synth.scenes import synthesize

pytest.importorskip(
    "hydra_plugins.hydra_optuna_sweeper", reason="needs hydra-optuna-sweeper: install forewarp[sweeps]"
)
# Optuna raises deprecation warnings of its own.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

SEARCH = [
    *("--multirun", "sweeps=search", "data=dnerf", "data.root=.", "data.scene=vehicle", "trainer=cpu"),
    *("threads=1", "data.rays=64", "budget.iterations=4", "stage.coarse.num_voxels=[[0,800]]", "~stage.fine"),
]


@pytest.fixture
def folder(in_tmp):
    """Write a scene; return its folder, below which a search writes ``runs/search/vehicle``."""
    synthesize(in_tmp / "vehicle", size=16, frames=6, test_views=(1, 0, 0), val_views=1, samples_per_pixel=1)
    return in_tmp


def test_three_trials_find_a_best_one_and_go_on(ok, folder):
    ok("train", *SEARCH, "hydra.sweeper.n_trials=2")
    done = ok("train", *SEARCH, "hydra.sweeper.n_trials=3")
    assert done.out.count("finished before") == 2
    runs = list(folder.glob("runs/search/vehicle/forward-demo-seed0-*"))
    assert len(runs) == 3
    scores = [json.loads((run / "score.json").read_text())["scores"]["psnr"] for run in runs]
    found = yaml.safe_load((folder / "runs/search/vehicle/optimization_results.yaml").read_text())
    assert found["best_value"] == max(scores)
    assert set(found["best_params"]) == {
        "stage.coarse.lr.flow",
        "objective.coarse.weights.tv_flow",
        "preset.padding",
    }
    assert f"best     psnr {max(scores):.4f}: " in done.out


def test_a_trial_that_fails_is_named_and_ends_nothing(forewarp, folder):
    words = [word for word in SEARCH if not word.startswith("budget.iterations")]
    done = forewarp("train", *words, "hydra.sweeper.n_trials=3", "budget.iterations=choice(-1,4,-2,5)")
    assert done.status == 2
    assert "forewarp-train: 1 of 3 jobs failed:\n" in done.err
    assert "budget.iterations=-2" in done.err.splitlines()[-1]
    assert "best     psnr" in done.out
    done = forewarp("train", *words, "hydra.sweeper.n_trials=2", "budget.iterations=-1")
    assert done.status == 2
    assert "2 of 2 jobs failed:\n" in done.err


def test_a_search_without_views_or_with_seeds_says_what_to_set(forewarp, folder):
    for file in (folder / "vehicle").glob("transforms_val*"):
        file.unlink()
    done = forewarp("train", *SEARCH, "hydra.sweeper.n_trials=1")
    assert done.status == 2
    assert "score: expected psnr, which the sweeper needs, but got none: " in done.err
    assert "set data.held_out=8" in done.err
    done = forewarp("train", *SEARCH, "hydra.sweeper.n_trials=1", "seeds=2")
    assert "seeds: expected 1 in a search, but got 2; use seed=N" in done.err
    plain = [word for word in SEARCH if word != "sweeps=search"]
    done = forewarp("train", *plain, "hydra/sweeper=optuna", "hydra.sweeper.n_trials=1")
    assert "but got range(0, 1); add hydra.sweeper.params.seed=0" in done.err
    done = forewarp("train", *SEARCH, "hydra.sweeper.n_trials=1", "score=lpips_squeeze")
    assert "add hydra.sweeper.direction=minimize" in done.err
