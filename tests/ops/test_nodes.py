import math
from functools import partial

import pytest
import torch
from torch import zeros

from forewarp.ops import nodes

F64 = torch.float64


def some(count=7, dtype=F64, seed=0, numbers=6):
    generator = torch.Generator().manual_seed(seed)
    motion = 0.5 * torch.randn(count, numbers, generator=generator, dtype=F64)
    places = torch.randn(count, 3, generator=generator, dtype=F64)
    edges = torch.randint(0, count, (count, 3), generator=generator)
    weights = torch.rand(count, 3, generator=generator, dtype=F64)
    return motion.to(dtype), places.to(dtype), edges, weights.to(dtype)


def test_hand_worked():
    # Half of 90 degrees has the tangent 0.414: what lies along x from the node comes to lie along y.
    motion = torch.tensor([[0.0, 0.0, 3.0, 0.0, 0.0, math.tan(math.pi / 8)]])
    linear, shift = nodes.node_maps(motion, torch.tensor([[1.0, 1.0, 0.0]])).split([9, 3], -1)
    point = torch.tensor([2.0, 1.0, 0.0])
    moved = point + linear.reshape(3, 3) @ point + shift[0]
    half = math.sqrt(0.5)
    assert moved.tolist() == pytest.approx([1 + half, 1 + half, 3.0], abs=1e-6)
    assert not bool(nodes.node_maps(torch.zeros(3, 6), torch.randn(3, 3)).any())


@pytest.mark.parametrize("numbers", [6, 7])
def test_maps_are_rigid(numbers):
    motion, places, *_ = some(20, numbers=numbers)
    rotations = nodes.node_maps(motion, places)[:, :9].reshape(-1, 3, 3) + torch.eye(3)
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3, dtype=F64).expand(20, 3, 3))


def test_what_moves_rigidly_together_is_not_strained():
    _, places, edges, weights = some()
    gibbs = torch.tensor([0.2, -0.1, 0.3], dtype=F64)
    maps = nodes.node_maps(torch.cat([torch.zeros(3).double(), gibbs])[None], torch.zeros(1, 3).double())
    shift = places @ maps[0, :9].reshape(3, 3).T + torch.tensor([1.0, 2.0, 3.0])
    motion = torch.cat([shift, gibbs.expand(len(places), 3)], -1)
    assert float(nodes.stiffness(motion, places, edges, weights)) == pytest.approx(0.0, abs=1e-20)
    motion[0, 0] += 0.1
    assert float(nodes.stiffness(motion, places, edges, weights)) > 1e-4


@pytest.mark.parametrize("numbers", [6, 7])
def test_pull_of_the_kernel_equals_autograd(numbers):
    motion, places, edges, weights = some(30, numbers=numbers)
    by_maps = torch.randn(30, 12, dtype=F64)
    exact, strain = nodes.pull_nodes(motion, places, by_maps, edges, weights, 0.7)
    singles = (motion.float(), places.float(), by_maps.float(), edges, weights.float())
    fast, same = nodes.pull_nodes(*singles, 0.7)
    torch.testing.assert_close(fast.double(), exact, rtol=1e-4, atol=1e-4)
    assert same == pytest.approx(strain, rel=1e-5)


def test_nodes_that_coincide(backend):
    motion, places, edges, weights = some(4, torch.float32)
    gradient, strain = nodes.pull_nodes(motion, 0 * places, torch.zeros(4, 12), edges, weights, 1.0)
    assert bool(gradient.isfinite().all())
    assert math.isfinite(strain)


@pytest.mark.parametrize("rotates", [3, 4, False])
def test_curves_carry_nodes(backend, rotates):
    _, places, *_ = some(5, torch.float32)
    shift, rotation, basis = (
        torch.randn(5, 4, 3),
        torch.randn(5, 4, rotates or 3),
        torch.tensor([0.0, 0.5, -1.0, 0.0]),
    )
    motion, maps = nodes.carry_nodes(shift, rotation if rotates else None, basis, places)
    torch.testing.assert_close(motion[:, :3], 0.5 * shift[:, 1] - shift[:, 2])
    torch.testing.assert_close(motion[:, 3:], (0.5 * rotation[:, 1] - rotation[:, 2]) * bool(rotates))
    torch.testing.assert_close(maps, nodes.node_maps(motion, places))


@pytest.mark.parametrize("rotates", [3, 4, False])
def test_spread_over_curves_equals_autograd(backend, rotates):
    shift, rotation = (torch.randn(5, 7, n, requires_grad=True) for n in (3, rotates or 3))
    by_motion, basis, bend = torch.randn(5, 3 + (rotates or 3)), torch.rand(7), torch.randn(7)
    loss = value = 0.0
    both = (shift, by_motion[:, :3], 2.0), (rotation, by_motion[:, 3:], 1.0)
    for curve, own, unit in both[: 1 + bool(rotates)]:
        squared = (torch.einsum("mkc,k->mc", curve, bend) / unit).square().mean()
        loss = loss + (torch.einsum("mkc,k->mc", curve, basis) * own).sum() + 3.0 * squared
        value += float(squared.detach())
    loss.backward()
    rotation = rotation if rotates else None
    first, second, bent = nodes.spread_nodes(shift, rotation, by_motion, basis, bend, 3.0, 2.0)
    assert bent == pytest.approx(value, rel=1e-5)
    torch.testing.assert_close(first, shift.grad)
    assert second is None if not rotates else torch.allclose(second, rotation.grad, atol=1e-5)


def pull(motion=zeros(7, 6), places=zeros(7, 3), edges=zeros(7, 2).long(), weights=zeros(7, 2), by=12):  # noqa: B008
    nodes.pull_nodes(motion, places, zeros(7, by), edges, weights, 1.0)


def carry(shift=zeros(7, 2, 3), rotation=None, basis=zeros(2), places=zeros(7, 3)):  # noqa: B008
    nodes.carry_nodes(shift, rotation, basis, places)


def spread(shift=zeros(7, 2, 3), rotation=None, by_motion=zeros(7, 6), basis=zeros(2), bend=zeros(2)):  # noqa: B008
    nodes.spread_nodes(shift, rotation, by_motion, basis, bend, 1.0, 1.0)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (partial(nodes.node_maps, zeros(7, 5), zeros(7, 3)), r"motion: expected shape \(M, 6\)"),
        (partial(nodes.node_maps, zeros(7, 6), zeros(3, 3)), r"places: expected shape \(7, 3\)"),
        (partial(nodes.stiffness, zeros(7, 6), zeros(3, 3), zeros(7, 2).long(), zeros(7, 2)), "places"),
        (partial(nodes.stiffness, zeros(7, 6), zeros(7, 3), zeros(2, 2).long(), zeros(7, 2)), "edges"),
        (partial(nodes.stiffness, zeros(7, 6), zeros(7, 3), zeros(7, 2).long(), zeros(7, 1)), "weights"),
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
        (partial(nodes.skin_weights, zeros(3, 2), zeros(3, 4)), "^learned: expected"),
        (partial(nodes.move_by_screw, zeros(5, 3), zeros(4, 3), zeros(5, 3)), "rotation: expected shape"),
        (partial(nodes.move_by_screw, zeros(5, 3), zeros(5, 2), zeros(5, 3)), "rotation: expected shape"),
    ],
)
def test_shapes_that_do_not_go_together_are_refused(call, text):
    with pytest.raises(ValueError, match=text):
        call()


def numbers(count, width, spread=1.0):
    generator = torch.Generator().manual_seed(count)
    shares = torch.rand(count, width, generator=generator)
    shares[::7] = 0  # at rest
    return shares, spread * torch.randn(count, width, generator=generator)


@pytest.mark.parametrize("count", [0, 1, 16, 17, 33, 2000])
@pytest.mark.parametrize("width", [1, 6, 16, 17])
def test_weights_equal_a_softmax_and_sum_to_one_but_at_rest(backend, count, width):
    shares, learned = numbers(count, width)
    weights = nodes.skin_weights(shares, learned)
    exact = (shares.log() + learned).double().softmax(-1).nan_to_num(0.0)
    torch.testing.assert_close(weights, exact.float(), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("added", [-1e6, -300.0, 300.0, 1e6])
def test_only_differences_count(backend, added):
    shares, learned = numbers(40, 6, spread=1e2)
    learned = learned.round()  # exact beside a million
    assert torch.equal(nodes.skin_weights(shares, learned + added), nodes.skin_weights(shares, learned))


def test_parts_of_arrays_are_read_as_they_are(backend):
    shares, learned = numbers(40, 6)
    wide = torch.stack([learned, torch.zeros_like(learned)], -1)[..., 0]
    assert torch.equal(nodes.skin_weights(shares, wide), nodes.skin_weights(shares, learned))


def test_weights_by_two_threads_are_the_same(two_threads):
    together = nodes.skin_weights(*numbers(5000, 6))
    torch.set_num_threads(1)
    assert torch.equal(nodes.skin_weights(*numbers(5000, 6)), together)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0499, 0.0501, 1.0, 3.1, 7.0])
def test_a_screw_is_the_exponential_of_its_matrix(angle):
    draw = torch.Generator().manual_seed(0)
    axis = torch.nn.functional.normalize(torch.randn(3, generator=draw, dtype=F64), dim=0)
    shift, points = torch.randn(2, 3, generator=draw, dtype=F64)
    x, y, z = (angle * axis).tolist()
    generator = torch.zeros(4, 4, dtype=F64)
    generator[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=F64)
    generator[:3, 3] = shift
    expected = torch.linalg.matrix_exp(generator) @ torch.cat([points, torch.ones(1, dtype=F64)])
    rotation = (angle * axis).requires_grad_()
    moved = nodes.move_by_screw(points, rotation, shift)
    torch.testing.assert_close(moved, expected[:3], rtol=0, atol=1e-9)
    moved.sum().backward()
    assert rotation.grad.isfinite().all()


def test_a_rigid_map_is_not_stretched_and_its_gradient_is_finite():
    jacobian = torch.eye(3, dtype=F64).requires_grad_()
    energy = nodes.stretch(jacobian)
    energy.backward()
    assert energy == 0
    assert jacobian.grad.isfinite().all()
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert float(nodes.stretch(quarter)) == pytest.approx(0, abs=1e-10)
    assert float(nodes.stretch(2 * quarter)) == pytest.approx(3 * math.log(2) ** 2)
    assert nodes.stretch(torch.zeros(3, 3)).isfinite()


def test_the_robust_function():
    q = torch.tensor([0.0, 1e-4, 4.0, 1e30, torch.inf])
    for scale in (1.0, 0.03, 1e-3):
        squared = (q * scale**2).requires_grad_()
        rho = nodes.geman_mcclure(squared, scale)
        expected = scale * torch.tensor([0.0, 5e-5, 1.0, 2.0, 2.0])
        torch.testing.assert_close(rho, expected, atol=1e-8 * scale, rtol=1e-4)
        (gradient,) = torch.autograd.grad(rho[1], squared)
        assert float(gradient[1]) == pytest.approx(0.5 / scale, rel=1e-3)
