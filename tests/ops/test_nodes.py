import math
from functools import partial

import pytest
import torch
from torch import zeros
from torch.autograd import gradcheck

from forewarp.ops.nodes import carry_nodes, node_maps, pull_nodes, spread_nodes, stiffness


def some(count=7, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    motion = 0.5 * torch.randn(count, 6, generator=generator, dtype=torch.float64)
    places = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    edges = torch.randint(0, count, (count, 3), generator=generator)
    weights = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return motion.to(dtype), places.to(dtype), edges, weights.to(dtype)


def test_hand_worked():
    # Half of 90 degrees has the tangent 0.414: what lies along x from the node comes to lie along y.
    motion = torch.tensor([[0.0, 0.0, 3.0, 0.0, 0.0, math.tan(math.pi / 8)]])
    linear, shift = node_maps(motion, torch.tensor([[1.0, 1.0, 0.0]])).split([9, 3], -1)
    point = torch.tensor([2.0, 1.0, 0.0])
    went = point + linear.reshape(3, 3) @ point + shift[0]
    half = math.sqrt(0.5)
    assert went.tolist() == pytest.approx([1 + half, 1 + half, 3.0], abs=1e-6)


def test_turns_are_rotations():
    motion, places, *_ = some(20)
    turned = node_maps(motion, places)[:, :9].reshape(-1, 3, 3) + torch.eye(3)
    torch.testing.assert_close(turned @ turned.mT, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))


def test_no_motion_is_nothing():
    assert not bool(node_maps(torch.zeros(3, 6), torch.randn(3, 3)).any())


def test_gradcheck():
    motion, places, edges, weights = some(4)
    motion.requires_grad_()
    assert gradcheck(lambda m: node_maps(m, places), motion)
    assert gradcheck(lambda m: stiffness(m, places, edges, weights), motion)


def test_what_moves_rigidly_together_is_not_strained():
    _, places, edges, weights = some()
    turn = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)
    maps = node_maps(torch.cat([torch.zeros(3).double(), turn])[None], torch.zeros(1, 3).double())
    shift = places @ maps[0, :9].reshape(3, 3).T + torch.tensor([1.0, 2.0, 3.0])
    motion = torch.cat([shift, turn.expand(len(places), 3)], -1)
    assert float(stiffness(motion, places, edges, weights)) == pytest.approx(0.0, abs=1e-20)
    motion[0, 0] += 0.1
    assert float(stiffness(motion, places, edges, weights)) > 1e-4


def test_kernel_equals_reference():
    motion, places, edges, weights = some(30)
    by_maps = torch.randn(30, 12, dtype=torch.float64)
    exact, strain = pull_nodes(motion, places, by_maps, edges, weights, 0.7)
    fast, same = pull_nodes(motion.float(), places.float(), by_maps.float(), edges, weights.float(), 0.7)
    torch.testing.assert_close(fast.double(), exact, rtol=1e-4, atol=1e-4)
    assert same == pytest.approx(strain, rel=1e-5)


@pytest.mark.parametrize("turns", [True, False])
def test_curves_carry_nodes(backend, turns):
    _, places, *_ = some(5, torch.float32)
    shift, turn, basis = torch.randn(5, 4, 3), torch.randn(5, 4, 3), torch.tensor([0.0, 0.5, -1.0, 0.0])
    motion, maps = carry_nodes(shift, turn if turns else None, basis, places)
    torch.testing.assert_close(motion[:, :3], 0.5 * shift[:, 1] - shift[:, 2])
    torch.testing.assert_close(motion[:, 3:], (0.5 * turn[:, 1] - turn[:, 2]) * turns)
    torch.testing.assert_close(maps, node_maps(motion, places))


def test_nodes_that_coincide(backend):
    motion, places, edges, weights = some(4, torch.float32)
    found, strain = pull_nodes(motion, 0 * places, torch.zeros(4, 12), edges, weights, 1.0)
    assert bool(found.isfinite().all())
    assert math.isfinite(strain)


def pull(motion=zeros(7, 6), places=zeros(7, 3), edges=zeros(7, 2).long(), weights=zeros(7, 2), by=12):  # noqa: B008
    pull_nodes(motion, places, zeros(7, by), edges, weights, 1.0)


def carry(shift=zeros(7, 2, 3), rotation=None, basis=zeros(2), places=zeros(7, 3)):  # noqa: B008
    carry_nodes(shift, rotation, basis, places)


def spread(shift=zeros(7, 2, 3), rotation=None, by_motion=zeros(7, 6), basis=zeros(2), bend=zeros(2)):  # noqa: B008
    spread_nodes(shift, rotation, by_motion, basis, bend, 1.0, 1.0)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (partial(node_maps, zeros(7, 5), zeros(7, 3)), r"motion: expected shape \(M, 6\)"),
        (partial(node_maps, zeros(7, 6), zeros(3, 3)), r"places: expected shape \(7, 3\)"),
        (partial(stiffness, zeros(7, 6), zeros(3, 3), zeros(7, 2).long(), zeros(7, 2)), "places"),
        (partial(pull, motion=zeros(7, 5)), r"motion: expected shape \(M, 6\)"),
        (partial(pull, places=zeros(3, 3)), r"places: expected shape \(7, 3\)"),
        (partial(pull, edges=zeros(2, 2).long()), r"edges: expected shape \(7, E\)"),
        (partial(pull, weights=zeros(7, 1)), r"weights: expected shape \(7, 2\)"),
        (partial(pull, by=9), r"by_maps: expected shape \(7, 12\)"),
        (partial(carry, shift=zeros(7, 3, 3)), r"shift: expected shape \(7, 2, 3\)"),
        (partial(carry, rotation=zeros(3, 2, 3)), r"rotation: expected shape \(7, 2, 3\)"),
        (partial(carry, places=zeros(7, 2)), r"places: expected shape \(M, 3\)"),
        (partial(spread, shift=zeros(7, 2, 2)), r"shift: expected shape \(M, K, 3\)"),
        (partial(spread, rotation=zeros(3, 2, 3)), r"rotation: expected shape \(7, 2, 3\)"),
        (partial(spread, by_motion=zeros(3, 6)), r"by_motion: expected shape \(7, 6\)"),
        (partial(spread, basis=zeros(3)), r"basis: expected shape \(2\)"),
        (partial(spread, bend=zeros(3)), r"bend: expected shape \(2\)"),
    ],
)
def test_shapes_that_do_not_go_together_are_refused(backend, call, text):
    with pytest.raises(ValueError, match=text):
        call()


@pytest.mark.parametrize("turns", [True, False])
def test_spread_over_curves_equals_autograd(backend, turns):
    shift, turn = (torch.randn(5, 7, 3, requires_grad=True) for _ in range(2))
    slope, basis, bend = torch.randn(5, 6), torch.rand(7), torch.randn(7)
    parts = ((shift, slope[:, :3], 2.0), (turn, slope[:, 3:], 1.0))[: 1 + turns]
    loss = value = 0.0
    for curve, own, unit in parts:
        squared = (torch.einsum("mkc,k->mc", curve, bend) / unit).square().mean()
        loss = loss + (torch.einsum("mkc,k->mc", curve, basis) * own).sum() + 3.0 * squared
        value += float(squared.detach())
    loss.backward()
    *found, bent = spread_nodes(shift, turn if turns else None, slope, basis, bend, 3.0, 2.0)
    assert bent == pytest.approx(value, rel=1e-5)
    torch.testing.assert_close(found[0], shift.grad)
    if turns:
        torch.testing.assert_close(found[1], turn.grad)
    else:
        assert found[1] is None
