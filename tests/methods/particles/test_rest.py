"""What does not move comes to rest where it was, and needs no nodes any more."""

import pytest
import torch

from forewarp.methods.particles import density
from forewarp.methods.particles.density import _product, _quaternions, come_to_rest
from forewarp.ops.gaussians import moved, rotations
from tests.support.particles import EVERY, look, module_with

TIMES = [0.0, 0.25, 0.5, 0.75, 1.0]


@pytest.fixture
def half(data):
    """Particles whose nodes on one side of the scene move, while all others stand aside, turned."""
    module = module_with(
        data, **EVERY | {"background": 0.01}, numbers={"rest": 0.1, "relink": 1, "every": 0.1}
    )
    method = module.method
    nodes = method.nodes
    nodes.seen.copy_(torch.tensor([0.0, 1.0]))
    nodes.shift.data.fill_(0.05)
    nodes.turn.data[..., 2] = 0.02
    moves = nodes.places[:, 0] > nodes.places[:, 0].median()
    ramp = torch.linspace(0, 1, nodes.curve.count)
    nodes.shift.data[moves] += ramp[:, None]
    return module, moves


def placed(method, time):
    return moved(method.means.data, method.warp(time))


def test_it_rests_where_it_was_and_as_it_was_turned(half):
    module, moves = half
    method = module.method
    follows = method.skin.weights() > 1e-3
    before, linear = placed(method, 0.5)
    turned = linear @ rotations(method.turns.data)
    come_to_rest(method, 0.01)
    assert torch.equal(method.nodes.still, ~moves)
    rests = method.resting
    assert 0 < int(rests.sum()) < len(rests)
    assert torch.equal(rests, (method.nodes.still[method.skin.links.long()] | ~follows).all(-1))
    after, linear = placed(method, 0.5)
    torch.testing.assert_close(after[rests], before[rests], atol=1e-4, rtol=0)
    torch.testing.assert_close(
        (linear @ rotations(method.turns.data))[rests], turned[rests], atol=1e-3, rtol=0
    )
    assert int(method.skin.shares[rests].count_nonzero()) == 0
    ends = [placed(method, time)[0] for time in (0.0, 1.0)]
    assert torch.equal(ends[0][rests], ends[1][rests])
    assert float((ends[1] - ends[0]).detach()[~rests].norm(dim=-1).max()) > 0.3


def test_what_rests_keeps_resting_through_steps_and_density_control(half, data):
    module, moves = half
    method, optimizer = module.method, module.configure_optimizers()
    come_to_rest(method, 0.01)
    kept = method.nodes.shift.data[~moves].clone()
    for number in range(1, 4):
        step = look(module, data)
        for name, p in method.named_parameters():
            p.grad = step.gradients[name]
        optimizer.step()
        method.advance(0.1 * number + 0.05, number, optimizer)
    assert torch.equal(method.nodes.shift.data[~moves], kept)
    assert len(method.resting) == len(method.means)
    assert int(method.skin.shares[method.resting].count_nonzero()) == 0
    assert bool(method.resting.any())


def test_the_share_that_rests_is_told(half):
    module, _ = half
    assert module.method.at_rest() == 0
    come_to_rest(module.method, 0.01)
    alone = (module.method.skin.shares == 0).all(-1)
    assert 0 < module.method.at_rest() < 1
    assert module.method.at_rest() == pytest.approx(float(alone.float().mean()))


@pytest.mark.parametrize(("covered", "least"), [(1e6, 0.02), (100.0, 0.5013)])
def test_what_moves_no_farther_than_a_pixel_from_its_mean_place_may_rest(half, monkeypatch, covered, least):
    asked = []
    monkeypatch.setattr(density, "come_to_rest", lambda _, least: asked.append(least))
    method, optimizer = half[0].method, half[0].configure_optimizers()
    method.covered.fill_(covered)
    method.extent.fill_(2.0)
    method.advance(0.5, 1, optimizer)
    assert asked == [pytest.approx(least, abs=1e-4)]


def test_nothing_comes_to_rest_where_the_effect_is_off(data, monkeypatch):
    monkeypatch.setattr(density, "come_to_rest", lambda *_: pytest.fail("called"))
    module = module_with(data, numbers={"rest": 0.0, "relink": 1, "every": 0.1})
    assert module.method.resting is None
    look(module, data)
    module.method.advance(0.35, 1, module.configure_optimizers())


@pytest.mark.parametrize("motion", ["spline", "cosines"])
def test_what_moves_does_not_come_to_rest(data, motion):
    method = module_with(data, motion=motion, background=0.01).method
    method.nodes.shift.data.normal_()
    come_to_rest(method, 0.01)
    assert not bool(method.nodes.still.any())
    assert not bool(method.resting.any())


@pytest.mark.parametrize("motion", ["spline", "cosines"])
def test_a_node_that_stops_stays(data, motion):
    nodes = module_with(data, motion=motion, background=0.01).method.nodes
    nodes.shift.data.normal_()
    which = torch.zeros(len(nodes), dtype=torch.bool)
    which[:2] = True
    assert float(nodes.reach_of(TIMES).min()) > 0
    mean = sum(nodes.carried(nodes.curve(t))[0] for t in TIMES)[:2, :3] / len(TIMES)
    nodes.stop(which, TIMES)
    assert (nodes.reach_of(TIMES) < 1e-5).nonzero()[:, 0].tolist() == [0, 1]
    if motion == "spline":
        torch.testing.assert_close(nodes.carried(nodes.curve(0.3))[0][:2, :3], mean)


def test_quaternions_multiply_as_their_rotations_do():
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 5, 4, generator=generator)
    torch.testing.assert_close(rotations(_product(a, b)), rotations(a) @ rotations(b))
    a[:, 0] = a[:, 0].abs() + 0.5
    torch.testing.assert_close(rotations(_quaternions(rotations(a))), rotations(a), atol=1e-5, rtol=0)
