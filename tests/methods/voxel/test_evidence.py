"""What images, motion and errors of a coarse stage say, where the answer is known."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.methods.voxel.planning import Movement, explained_by_direction, movement_of, residual
from forewarp.ops.curves import dct_basis
from forewarp.scene.box import Lattice
from forewarp.scene.silhouettes import survey
from tests.support.tiny_scene import BOX, ball_data, ball_scene, built, forward_model, make_run, stage

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


def test_a_scene_that_stands_still_isexplained_by_direction_by_its_hull():
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
    found = movement_of(
        fitted(lambda at, time: time * at.new_tensor([0.8, 0, 0]).expand(len(at), 3)), [0, 0.5, 1]
    )
    assert (found.moving, found.torn) == (1.0, 0.0)
    assert found.distance == pytest.approx(0.8)


def test_what_is_drawn_out_is_torn():
    def stretched(at, time):
        return 2 * time * (at - at.mean(0)) * at.new_tensor([1.0, 0, 0])

    found = movement_of(fitted(stretched), [0, 0.4, 1])
    assert found.torn == 1.0  # three voxels from one to the next
    assert found.at == 1
    assert movement_of(fitted(stretched), [0, 0.4]).torn == 0.0  # 1.8 voxels


def test_nothing_moves_where_nothing_does():
    found = movement_of(fitted(lambda at, time: torch.zeros_like(at)), [0, 1])
    assert (found.moving, found.distance, found.torn, found.left_out) == (0, 0, 0, (0.0,))
    assert found.bases() == 0


def test_no_matter_does_not_move():
    method = fitted(lambda at, time: torch.ones_like(at))
    with torch.no_grad():
        method.radiance.parameter("density").fill_(-8.0)
    assert movement_of(method, [0, 1]) == Movement(0, 0, 0, 0.0, (0.0,))


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
    found = movement_of(method, times)
    assert len(found.left_out) == 9
    assert found.bases() == 5
    assert found.left_out[4] == pytest.approx(found.left_out[0])
    assert found.left_out[5:] == (0, 0, 0, 0)


def samples(views=24, places=30, seed=0):
    """Return places (P, 3), directions (P, 3) and images (P,); each image sees all places from one side."""
    generator = torch.Generator().manual_seed(seed)
    where = torch.rand(places, 3, generator=generator).repeat(views, 1) + 0.01
    towards = torch.nn.functional.normalize(torch.randn(views, 3, generator=generator), dim=-1)
    return where, towards.repeat_interleave(places, 0), torch.arange(views).repeat_interleave(places)


def test_only_an_error_linear_in_direction_isexplained_by_direction():
    where, towards, views = samples()
    generator = torch.Generator().manual_seed(1)
    slope, noise = (torch.randn(n, 3, generator=generator) for n in (3, len(where)))
    assert explained_by_direction(where, towards, towards @ slope, views, 0.05) > 0.6
    assert explained_by_direction(where, towards, noise, views, 0.05) < 0.02
    assert abs(explained_by_direction(where, towards, where.sin(), views, 0.05)) < 0.02  # of the place alone
    assert explained_by_direction(where * float("nan"), towards, where, views, 0.05) == 0  # met nowhere


def test_of_a_fitted_ball(tmp_path):
    data = ball_data()
    run = make_run(tmp_path, [stage(iterations=60)], data=data, model=forward_model(view_dependence=None))
    module = run.fit()
    targets = [data.targets("train")[i] for i in range(6)]
    found = residual(module.method, targets, voxel_size=0.05, rays=300)
    drawn = sum(float(10 ** (-module.psnr_of(target) / 10)) for target in targets) / 6
    assert abs(10 ** (-found.psnr / 10) / drawn - 1) < 0.3  # from half of the pixels
    assert found.by_direction < 0.3
    coarser = residual(module.method, targets, voxel_size=0.4, rays=300)
    assert coarser.allowed < found.allowed
