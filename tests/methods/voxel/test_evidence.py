"""What pictures and a coarse stage's motion say, on balls and fields whose answer is known."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.fields.trajectory import TrajectoryField
from forewarp.methods.voxel.evidence import Movement, movement
from forewarp.ops.dct import dct_basis
from forewarp.scene.box import Lattice
from forewarp.scene.pictures import survey
from tests.support.tiny_scene import BOX, ball_scene, built, forward_model

LATTICE = Lattice(BOX, (12, 9, 8))


def fitted(flow):
    """A method whose flow is given."""
    active = torch.zeros(LATTICE.shape, dtype=torch.bool)
    active[3:8, 3:6, 3:6] = True
    model = forward_model(trajectory=partial(TrajectoryField, bases=8, nodes=8, width=16, layers=2))
    method = built(model, LATTICE, active, density_scale=0.2, frames=20, effects=("motion",))
    with torch.no_grad():
        method.radiance.parameter("density").fill_(8.0)
    method.motion.flow = lambda voxels, time: flow(LATTICE.to_world(voxels.voxels), time)
    return method


def test_a_scene_that_stands_still_is_explained_by_its_hull():
    still = ball_scene(times=[0.0] * 12)
    assert survey(still).times == 1
    assert survey(still).disagreement < 0.01
    moving = survey(ball_scene())
    assert (moving.frames, moving.times) == (12, 12)
    assert moving.disagreement > 0.1
    assert 0.7 < moving.cut_out < 1
    assert 90 < moving.spread <= 180


def test_alpha_that_is_nowhere_transparent_says_nothing():
    scene = ball_scene()
    opaque = torch.full((24, 24, 4), 255, dtype=torch.uint8)
    filled = replace(scene, train=tuple(replace(f, load=lambda: opaque) for f in scene.train))
    found = survey(filled)
    assert (found.cut_out, found.disagreement) == (0, 0)
    assert survey(replace(scene, has_alpha=False)).cut_out == 0


def test_a_shift_moves_all_and_tears_nothing():
    found = movement(
        fitted(lambda at, time: time * at.new_tensor([0.8, 0, 0]).expand(len(at), 3)), [0, 0.5, 1]
    )
    assert (found.moving, found.torn) == (1.0, 0.0)
    assert found.distance == pytest.approx(0.8)


def test_what_is_drawn_out_is_torn():
    def stretched(at, time):
        return 2 * time * (at - at.mean(0)) * at.new_tensor([1.0, 0, 0])

    found = movement(fitted(stretched), [0, 0.4, 1])
    assert found.torn == 1.0  # three voxels from one to the next
    assert found.at == 1
    assert movement(fitted(stretched), [0, 0.4]).torn == 0.0  # 1.8 voxels


def test_nothing_moves_where_nothing_does():
    found = movement(fitted(lambda at, time: torch.zeros_like(at)), [0, 1])
    assert (found.moving, found.distance, found.torn, found.left_out) == (0, 0, 0, (0.0,))
    assert found.bases() == 0


def test_no_matter_does_not_move():
    method = fitted(lambda at, time: torch.ones_like(at))
    with torch.no_grad():
        method.radiance.parameter("density").fill_(-8.0)
    assert movement(method, [0, 1]) == Movement(0, 0, 0, 0.0, (0.0,))


def test_a_wave_needs_its_own_cosine():
    times = [i / 19 for i in range(20)]
    method = fitted(lambda at, time: wave(at, time))
    trajectory = method.motion.trajectory
    strength = torch.zeros(3, 8)
    strength[0, 4] = 1.0  # the fifth cosine

    def wave(at, time):
        basis = dct_basis(time, 8, trajectory.frames, 0.0)
        return (strength @ basis).expand(len(at), 3)

    trajectory.coefficients = lambda points: strength.expand(len(points), 3, 8)
    found = movement(method, times)
    assert len(found.left_out) == 9
    assert found.bases() == 5
    assert found.left_out[4] == pytest.approx(found.left_out[0])
    assert found.left_out[5:] == (0, 0, 0, 0)
