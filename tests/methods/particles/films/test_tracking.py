"""A small film of one camera, whose box and ball are followed as they turn; slow, as it is made first."""

import numpy as np
import pytest
from omegaconf import OmegaConf

from forewarp.ops.gaussians import moved
from forewarp.runs.config import saved_config
from forewarp.runs.fitted import opened
from forewarp.synth.movers import placed_movers
from tests.bench.film import TRUTH, Filming, Form, film
from tests.support.captures import fitted
from tests.support.commands import call

FORM = Form(count=40, size=(180, 320), beside=40)
SETTINGS = ["experiment=video_with_poses", f"data.scene={TRUTH}", "budget.minutes=null", "threads=1"]
SETTINGS += ["budget.iterations=2000"]


def turned(before, now):
    """Rotation (3, 3) of points (P, 3) about their mean, by least squares."""
    left, _, right = np.linalg.svd((now - now.mean(0)).T @ (before - before.mean(0)))
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right


def degrees(rotation):
    return np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))


@pytest.mark.slow
def test_what_turns_is_turned_and_not_repainted(tmp_path):
    """The ball, which rolls by 87 degrees and bounces, is off by less than a third of that at all times.

    A seed in a few repaints it, and which one it is depends on the processor; not one of three does well if
    nothing is followed.
    """
    film(tmp_path, FORM)
    worst = []
    for seed in (1, 2, 3):
        turned_by, errors = errors_of_turns(tmp_path, seed)
        worst.append(errors.max(0).min())  # of the body that is the ball
        if worst[-1] < turned_by / 3:
            return
    raise AssertionError(f"off by {worst} degrees of {turned_by:.0f}")


def errors_of_turns(folder, seed):
    """Train; by how many degrees the ball turns, and how far off two bodies are at the frames (T, 2)."""
    run = folder / f"run{seed}"
    done = call("train", *SETTINGS, f"data.root={folder}", f"run={run}", "evaluate=false", f"seed={seed}")
    assert done.status == 0, done.err
    made, module = opened(saved_config(str(run), OmegaConf.create({"trust": []})))
    method, world = module.method.eval(), Filming(FORM).world
    frames = sorted(made.datamodule.scene.train, key=lambda frame: frame.time)
    turn = fitted([f.camera for f in frames], Filming(FORM).cameras([f.time for f in frames])).turn
    of = method.deformation.nodes.groups[method.deformation.skinning.links[:, 0].long()]
    assert int(of.max()) == 1  # two bodies

    def places(time):
        now = moved(method.gaussians.means.data, method.warp(time))[0].detach().double().numpy()
        return [now[of == body] for body in range(2)]

    start = made.datamodule.scene.canonical_time
    before, ball = places(start), placed_movers(world, start)["ball"]
    true = [turned(ball, placed_movers(world, frame.time)["ball"]) for frame in frames]
    assert max(map(degrees, true)) > 80
    errors = [
        [degrees(turn @ turned(*pair) @ turn.T @ exact.T) for pair in zip(before, places(frame.time))]
        for frame, exact in zip(frames, true)
    ]
    return max(map(degrees, true)), np.array(errors)
