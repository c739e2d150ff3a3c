"""A run of particles is killed after density control changed their number; it ends as if never killed."""

import json
import signal

import pytest
import torch

from forewarp.synth.scenes import synthesize
from tests.stability.test_survival import equal
from tests.support.zygote import Zygote

pytestmark = [pytest.mark.stability, pytest.mark.slow]

STEPS = 24  # of a stage
SMALL = [
    *("data=dnerf", "data.scene=vehicle", "data.half_resolution=false", "data.held_out=1"),
    *("model=particles", "preset=demo", "budget.minutes=null", f"budget.iterations={2 * STEPS}"),
    *(
        "stage.coarse.share=0.5",
        "stage.fine.share=0.5",
        "stage.fine.density_interval=0.1",
        "stage.fine.relink=2",
    ),
    *("model/opacity_over_time=cosines", "model/background=still", "stage.fine.rest_from=0.2"),
    *("callbacks.pictures=null", "callbacks.accuracy.first=0.05", "callbacks.accuracy.rays=50"),
    *("checkpoint_seconds=0", "sheets=1", "logger=none", "trainer=cpu", "threads=1"),
]


@pytest.fixture(scope="module")
def train(tmp_path_factory):
    """``train(folder, die=...)`` runs the command in a process of its own; returns its exit status."""
    root, log = tmp_path_factory.mktemp("scenes"), tmp_path_factory.mktemp("logs") / "log.txt"
    synthesize(root / "vehicle", size=16, frames=8, test_views=(1, 1, 1), val_views=1, samples_per_pixel=1)
    with Zygote() as server:

        def call(folder, **limits):
            status = server.call([*SMALL, f"data.root={root}", f"run={folder}"], log, **limits)
            assert status == (-signal.SIGKILL if limits else 0), log.read_text()

        yield call


def read(path):
    return torch.load(path, weights_only=True)


def end(folder):
    """All that a run left, stage by stage, that does not depend on the clock."""
    left = {}
    for stage in ("coarse", "fine"):
        content = read(folder / stage / "last.ckpt")
        left |= {(stage, name): content[name] for name in ("global_step", "state_dict", "DNeRFDataModule")}
        left[stage, "moments"] = content["optimizer_states"][0]["state"]
        left |= {(stage, name): value for name, value in content["forewarp"].items() if name != "clock"}
        left[stage, "handover"] = (folder / stage / "handover.json").read_text()
        left[stage, "points"] = read(folder / stage / "handover.pt")
    rows = json.loads((folder / "per_image.json").read_text())["images"]
    return left | {"scores": [row["scores"] for row in rows]}


def particles(path):
    content = read(path)
    return content["global_step"], len(content["state_dict"]["method.means"])


def test_killed_after_density_control(train, tmp_path):
    """Once between two rounds of it, and again, three steps later, while a checkpoint is written."""
    whole, run = tmp_path / "whole", tmp_path / "run"
    train(whole)
    train(run, die=[9, "after", "fine/last.ckpt"])
    assert not (run / "fine" / "done.json").exists()
    step, first = particles(run / "fine" / "last.ckpt")
    assert step == 9
    train(run, die=[4, "half", "fine/last.ckpt"])
    step, second = particles(run / "fine" / "last.ckpt")
    assert step == 12
    counts = [particles(whole / stage / "last.ckpt")[1] for stage in ("coarse", "fine")]
    assert len({counts[0], first, second, counts[1]}) == 4  # it was on its way
    train(run)
    ours, theirs = end(run), end(whole)
    assert ours.keys() == theirs.keys()
    assert [name for name in theirs if not equal(ours[name], theirs[name])] == []
