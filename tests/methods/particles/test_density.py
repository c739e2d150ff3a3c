"""Particles split and go, their opacity is bounded and decays, and what does not move comes to rest."""

import math
from dataclasses import replace

import pytest
import torch

from forewarp.methods.effect import switched
from forewarp.methods.particles.deformation import Deformation, _product, _quaternions
from forewarp.methods.particles.density import too_near
from forewarp.methods.particles.start import at_rest
from forewarp.methods.rows import take_rows
from forewarp.ops.gaussians import moved, rotations
from forewarp.ops.grid import dilate
from forewarp.scene.frame import Frame, sightings
from tests.support.particles import BARE, EVERY, data_of, look, module_with, small_data

DATA = small_data()
SOME = torch.tensor([0, 1, 3, 4, 5, 6, 8, 9])


def few(**options):
    """Ten particles of length 0.05 that one image has shown, and their optimiser after a step."""
    module = module_with(DATA, **BARE | options)
    method, optimizer = module.method, module.configure_optimizers()
    take_rows(method, optimizer, torch.arange(10))
    for p in method.parameters():
        p.grad = torch.ones_like(p)
    optimizer.step()
    method.gaussians.quaternions.data[:] = torch.tensor([1.0, 0, 0, 0])
    method.gaussians.scales.data.fill_(-3.0)
    method.gaussians.opacity.data.zero_()
    method.extent.fill_(1.0)
    method.density.image_count.fill_(1)
    return method, optimizer


def to_count(method, count, optimizer):
    """Run a round of density control, to so many particles."""
    method.final_count.fill_(count)
    method.control_density(1.0, optimizer)


def freeze(method, least):
    method.deformation.freeze_static_nodes(method.gaussians, method.ends, least)


def test_what_is_pulled_most_is_split_along_its_longest_axis():
    method, optimizer = few()
    method.gaussians.scales.data[3, 1] = -1.0
    method.density.gradient_sum[3], method.density.gradient_sum[5] = 7.0, 3.0
    before, mean = method.gaussians.scales[3].clone(), method.gaussians.means[3].clone()
    to_count(method, 11, optimizer)
    apart = torch.tensor([0.0, 0.6, 0.0]) * before[1].exp()
    torch.testing.assert_close(method.gaussians.means[[3, 10]], torch.stack([mean - apart, mean + apart]))
    shorter = before + torch.tensor([0.0, 1.0, 0.0]) * torch.tensor(0.6).log()
    torch.testing.assert_close(method.gaussians.scales[[3, 10]], shorter.expand(2, 3))
    steps = optimizer.state[method.gaussians.means]["steps"]
    assert steps.tolist() == [1.0] * 10 + [0.0]  # the new half begins afresh
    assert len(method.density.unseen_rounds) == 11
    assert not bool(method.density.gradient_sum.any())
    take_rows(method, optimizer, torch.arange(100) % 11)
    method.density.gradient_sum.copy_(torch.arange(100.0))
    to_count(method, 1000, optimizer)
    assert len(method.gaussians.means) == 111  # at most a tenth and one are split at once


def test_what_has_faded_is_too_large_or_stood_too_near_to_a_camera_goes():
    method, optimizer = few()
    method.gaussians.opacity.data[2], method.gaussians.scales.data[7, 0] = -5.0, 2.0
    kept = method.gaussians.means[SOME].clone()
    to_count(method, 8, optimizer)
    torch.testing.assert_close(method.gaussians.means.data, kept)
    method.density.image_count.fill_(1)
    method.density.unseen_rounds[1] = math.inf
    method.density.gradient_sum[1], method.density.gradient_sum[2] = (
        9.0,
        1.0,
    )  # it is not split, though it is pulled most
    to_count(method, 8, optimizer)
    torch.testing.assert_close(
        method.gaussians.means[:7].data, kept[[0, 2, 3, 4, 5, 6, 7]], atol=0.05, rtol=0
    )
    assert (len(method.gaussians.means), bool(method.density.unseen_rounds.any())) == (8, False)
    method.gaussians.opacity.data.fill_(-9.0)
    to_count(method, 10, optimizer)
    assert len(method.gaussians.means) == 8  # all that there is does not vanish


@pytest.mark.slow
@pytest.mark.parametrize(("last", "left"), [(1.0, 9), (0.5, 10)])
def test_what_is_never_seen_goes_after_some_rounds_once_all_times_are_in_play(last, left):
    method, optimizer = few(motion="spline")
    method.deformation.nodes.seen_times.copy_(torch.tensor([0.0, last]))
    for _ in range(5):
        method.density.image_count.fill_(1)
        method.density.image_count[6] = 0
        to_count(method, 10, optimizer)
    assert len(method.gaussians.means) == left


def test_few_that_stand_before_all_others_are_too_near_and_many_are_not():
    order, far = torch.arange(200).flip(0), torch.linspace(2.0, 3.0, 200)
    assert not len(too_near(order, far))
    for count, gone in ((1, 1), (4, 4), (6, 0)):
        distances = torch.cat([torch.full((count,), 0.5), far[count:]]).flip(0)  # of each row
        assert too_near(order, distances).tolist() == order[:gone].tolist()
    assert not len(too_near(order[:0], far[:0]))
    lone = torch.tensor([0.1, 2.0, 2.5])
    assert not len(too_near(torch.arange(3), lone))  # of so few it may be the scene itself


def test_opacity_counts_where_it_is_largest_and_is_bounded_there():
    method, optimizer = few(opacity_over_time=3)
    logits = method.gaussians.opacity.data
    logits[:5, 0] = torch.tensor([20.0, 5.0, -8.0, 6.0, 7.0])
    method.gaussians.opacity_over_time.data.zero_()
    method.gaussians.opacity_over_time.data[1:3, 0] = -9.0  # the first cosine falls from 0 to -2
    method.gaussians.opacity_over_time.data[3, 0] = 2.0
    method.advance(0.999, 0, optimizer)
    assert logits[:6, 0].tolist() == pytest.approx([6.0, -12.0, -12.0, 6.0, 6.0, 0.0])
    bases = torch.stack([method.gaussians.time_bases(i / 64)[1] for i in range(65)])
    assert float((method.gaussians.joined().opacity.detach() @ bases.T).amax()) == pytest.approx(
        6.0, abs=1e-4
    )
    logits.fill_(-20.0)
    method.gaussians.opacity_over_time.data.zero_()[:3, 0] = -15.0
    to_count(method, 3, optimizer)
    assert len(method.gaussians.means) == 3  # what appears later is not thrown away


@pytest.mark.slow
@pytest.mark.parametrize(("share", "hidden"), [(0.0, 0.0), (1e-3, 0.0), (0.2, 0.1), (0.0, 0.3)])
def test_a_step_takes_opacity_of_what_its_image_shows_and_hides_as_the_rate_falls(share, hidden):
    numbers = {"opacity_decay": share, "crowd_decay": 0.0, "hidden_decay": hidden, "density_until": 0.0}
    module = module_with(DATA, numbers=numbers)
    method, optimizer = module.method, module.configure_optimizers()
    (group,) = (group for group in optimizer.param_groups if group["name"] == "opacity")
    method.gaussians.means.data[:3] = 90.0  # beside every image
    method.gaussians.opacity.data[:, 0] = torch.linspace(-8, 6, len(method.gaussians.opacity))
    for factor in (1.0, 0.25, 0.0):
        group["lr"] = factor * group["base_lr"]
        method.gaussians.opacity.grad, before = None, method.gaussians.opacity.data.clone()
        method.advance(0.5, 0, optimizer)
        look(module, DATA)
        optimizer.step()  # without gradients, as of a step that is dropped
        assert torch.equal(method.gaussians.opacity.data, before)
        method.density.image_count.zero_()
        look(module, DATA)
        method.gaussians.opacity.grad = torch.zeros_like(method.gaussians.opacity)
        optimizer.step()
        shown = method.density.image_count[:, None] > 0
        expected = torch.where(shown, 1 - factor * share, 1 - factor * hidden).double()
        assert 0 < int(method.density.image_count.sum()) < len(expected) - 3
        left = method.gaussians.opacity.data.double().sigmoid() / before.double().sigmoid()
        torch.testing.assert_close(left, expected, rtol=1e-5, atol=0)
    group["base_lr"] = group["lr"] = 0.0  # what does not learn does not decay
    method.advance(0.5, 0, optimizer)
    assert method.density.decay == method.density.hidden_decay == 0


@pytest.fixture
def half():
    """Particles whose nodes on one side of the scene move, while all others stand aside, turned."""
    numbers = {"rest_from": 0.1, "relink": 1, "density_interval": 0.1}
    module = module_with(DATA, **EVERY | {"background": 0.01}, numbers=numbers)
    nodes = module.method.deformation.nodes
    nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    nodes.translations.data.fill_(0.05)
    nodes.rotations.data[..., 2] = 0.02
    moves = nodes.positions[:, 0] > nodes.positions[:, 0].median()
    nodes.translations.data[moves] += torch.linspace(0, 1, nodes.curve.count)[:, None]
    return module, moves


def placed(method, time):
    means, linear = moved(method.gaussians.means.data, method.warp(time))
    return means.detach(), linear.detach() @ rotations(method.gaussians.quaternions.data)


def test_what_does_not_move_rests_where_it_was_and_as_it_was_turned(half):
    method, moves = half[0].method, half[1]
    follows, (before, turned) = method.deformation.skinning.weights() > 1e-3, placed(method, 0.5)
    freeze(method, 0.01)
    rests = method.deformation.resting
    assert torch.equal(method.deformation.nodes.stopped, ~moves)
    assert 0 < int(rests.sum()) < len(rests)
    assert torch.equal(
        rests, (method.deformation.nodes.stopped[method.deformation.skinning.links.long()] | ~follows).all(-1)
    )
    assert torch.equal(rests, (method.deformation.skinning.shares == 0).all(-1))
    after, linear = placed(method, 0.5)
    torch.testing.assert_close(after[rests], before[rests], atol=1e-4, rtol=0)
    torch.testing.assert_close(linear[rests], turned[rests], atol=1e-3, rtol=0)
    ends = [placed(method, time)[0] for time in (0.0, 1.0)]
    assert torch.equal(ends[0][rests], ends[1][rests])
    assert float((ends[1] - ends[0])[~rests].norm(dim=-1).max()) > 0.3


def test_what_rests_keeps_resting_through_steps_and_density_control(half):
    module, moves = half
    method, optimizer = module.method, module.configure_optimizers()
    freeze(method, 0.01)
    kept = method.deformation.nodes.translations.data[~moves].clone()
    for number in range(1, 4):
        step = look(module, DATA)
        for name, p in method.named_parameters():
            p.grad = step.gradients[name]
        optimizer.step()
        method.advance(0.1 * number + 0.05, number, optimizer)
    assert torch.equal(method.deformation.nodes.translations.data[~moves], kept)
    assert len(method.deformation.resting) == len(method.gaussians.means)
    assert int(method.deformation.skinning.shares[method.deformation.resting].count_nonzero()) == 0
    assert bool(method.deformation.resting.any())


def test_what_is_beyond_the_box_rests_without_a_node_and_may_be_large():
    module = module_with(data_of(replace(DATA.scene, has_alpha=False)), numbers={"shell": 4.0})
    method, optimizer = module.method, module.configure_optimizers()
    beyond = method.beyond(method.gaussians.means.data)
    assert 0 < int(beyond.sum()) < len(beyond)
    assert torch.equal(method.deformation.resting, beyond)
    assert not bool(method.beyond(method.deformation.nodes.positions).any())
    method.gaussians.scales.data[beyond] = math.log(0.5 * float(method.extent))
    for number in range(1, 4):
        method.density.gradient_sum.copy_(method.beyond(method.gaussians.means.data).float() + 1.0)
        method.density.image_count.fill_(1.0)
        method.advance(0.1 * number, number, optimizer)
    assert bool(method.deformation.resting[method.beyond(method.gaussians.means.data)].all())
    assert int(method.deformation.resting.sum()) > int(beyond.sum())  # split, not removed
    assert int(method.deformation.skinning.shares[method.deformation.resting].count_nonzero()) == 0


@pytest.mark.slow
def test_what_masks_say_rests_in_a_film_follows_no_node():
    """However little of an image rests. Where no mask says what moves, masks of rest count."""
    height, width = DATA.scene.train[0].camera.height, DATA.scene.train[0].camera.width
    moves, rests = torch.zeros(2, height, width, dtype=torch.bool)
    moves[: round(0.5 * height)], rests[round(0.45 * height) :] = True, True
    cameras = [frame.camera for frame in DATA.scene.train]
    for masks in ({"load_moving": lambda: moves}, {"load_resting": lambda: rests}):
        scene = replace(DATA.scene, train=tuple(replace(frame, **masks) for frame in DATA.scene.train))
        data = data_of(scene)
        assert module_with(data).method.deformation.resting is None
        method = module_with(data, numbers={"rest_by_masks": True}).method
        assert not switched(method)["background"]
        grown = dilate(moves if "load_moving" in masks else ~rests)
        moving, seen = sightings(method.gaussians.means.data, cameras, [grown] * len(cameras))
        assert 0 < int((moving == 0).sum()) < len(seen)
        assert bool(method.deformation.resting[moving == 0].all())
        assert not bool(method.deformation.resting[(moving == seen) & (seen == len(cameras))].any())
        assert int(method.deformation.skinning.shares[method.deformation.resting].count_nonzero()) == 0
    unknown = module_with(data_of(DATA.scene), numbers={"rest_by_masks": True}).method
    assert not bool(unknown.deformation.resting.any())


def test_what_rests_is_told_by_images_in_which_it_is_surface_and_around_the_canonical_time():
    """A point passes for resting behind what moves before it, but not where it moves around that time."""
    camera, times = DATA.scene.train[0].camera, [i / 20 for i in range(21)]
    here, nowhere = (torch.full((camera.height, camera.width), value) for value in (True, False))
    point = (camera.center + 2.0 * camera.rays(torch.tensor([0])).directions[0]).float()[None]

    def rests(moves, depth=lambda frame: torch.zeros_like(here, dtype=torch.float32)):
        shots = [
            Frame("", t, camera, None, load_moving=lambda t=t: here if moves(t) else nowhere) for t in times
        ]
        return bool(at_rest(replace(DATA.scene, train=tuple(shots), canonical_time=0.5), point, depth))

    def passing(frame):
        return torch.full_like(here, 1.0 if frame.time > 0.4 else 2.0, dtype=torch.float32)

    assert rests(lambda time: time > 0.7)
    assert not rests(lambda time: time < 0.7)
    assert not rests(lambda time: 0.3 < time < 0.7)  # at fewer times, but then it counts
    assert rests(lambda time: time > 0.4, passing)
    assert not rests(lambda time: time < 0.4, passing)


@pytest.mark.parametrize(("covered", "least"), [(1e6, 0.02), (100.0, 0.5013)])
def test_what_moves_no_farther_than_a_pixel_from_its_mean_position_may_rest(
    half, monkeypatch, covered, least
):
    asked = []
    monkeypatch.setattr(Deformation, "freeze_static_nodes", lambda *given: asked.append(given[3]))
    method, optimizer = half[0].method, half[0].configure_optimizers()
    method.covered_pixels.fill_(covered)
    method.extent.fill_(2.0)
    method.advance(0.5, 1, optimizer)
    assert asked == [pytest.approx(least, abs=1e-4)]


def test_quaternions_multiply_as_their_rotations_do():
    a, b = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(rotations(_product(a, b)), rotations(a) @ rotations(b))
    a[:, 0] = a[:, 0].abs() + 0.5
    torch.testing.assert_close(rotations(_quaternions(rotations(a))), rotations(a), atol=1e-5, rtol=0)
