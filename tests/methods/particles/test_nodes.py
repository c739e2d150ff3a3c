import pytest
import torch

from forewarp.fields.curves import Curve
from forewarp.methods.particles.nodes import Nodes, Skin, nearest
from forewarp.methods.rows import RowsAdam


def grid(side=4):
    axis = torch.linspace(-1, 1, side)
    return torch.cartesian_prod(axis, axis, axis)


def nodes_of(count=12, kind="spline", knots=8, canonical=0.0, turns=True, straight=False):
    nodes = Nodes(grid(), count, Curve(kind, knots, 20, canonical, straight=straight), turns=turns)
    generator = torch.Generator().manual_seed(0)
    for value in (nodes.shift, nodes.turn):
        if value is not None:
            value.data = 0.1 * torch.randn(value.shape, generator=generator)
    return nodes


def test_fewer_points_than_nodes():
    assert len(Nodes(torch.randn(3, 3), 10, Curve("spline", 5, 9, 0.0))) == 3
    alone = Nodes(torch.zeros(1, 3), 10, Curve("spline", 5, 9, 0.0))
    rows, shares = alone.links(torch.randn(4, 3))
    assert rows.tolist() == [[0]] * 4
    assert shares.tolist() == [[1.0]] * 4


def test_nearest_is_nearest():
    points, places = torch.randn(5000, 3), torch.randn(30, 3)
    away, rows = nearest(points, places, 4)
    exact = torch.cdist(points, places).square().sort(-1)
    torch.testing.assert_close(away, exact.values[:, :4], atol=1e-4, rtol=1e-4)
    assert (rows == exact.indices[:, :4]).float().mean() > 0.999
    assert [part.shape for part in nearest(points[:0], places, 4)] == [(0, 4)] * 2
    assert [part.shape for part in nearest(points, places[:2], 4)] == [(5000, 2)] * 2


def test_shares_sum_to_one_and_prefer_the_nearest():
    nodes = nodes_of()
    rows, shares = nodes.links(nodes.places + 0.01)
    torch.testing.assert_close(shares.sum(-1), torch.ones(12))
    assert torch.equal(rows[:, 0].long(), torch.arange(12))
    assert bool((shares[:, 0] >= shares[:, 1:].amax(-1)).all())


@pytest.mark.parametrize("turns", [True, False])
def test_slopes_over_time_are_those_of_autograd(turns):
    nodes = nodes_of(turns=turns)
    basis = nodes.curve(0.6)
    motion, _ = nodes.carried(basis)
    slope = torch.randn(motion.shape)
    (motion * slope).sum().backward()
    found = nodes.spread_over_time(0.6, 0.6, basis, slope, 0.0, 1.0)[1]
    torch.testing.assert_close(found["nodes.shift"], nodes.shift.grad)
    assert ("nodes.turn" in found) == turns
    if turns:
        torch.testing.assert_close(found["nodes.turn"], nodes.turn.grad)


@pytest.mark.parametrize(("kind", "straight"), [("spline", False), ("spline", True), ("cosines", False)])
def test_slopes_of_bending_are_those_of_autograd(kind, straight):
    nodes = nodes_of(kind=kind, straight=straight)
    nodes.seen.copy_(torch.tensor([0.0, 1.0]))
    value, found = nodes.spread_over_time(0.5, 0.5, nodes.curve(0.5), torch.zeros(12, 6), 3.0, 2.0)
    step = 1 / 5
    before, now, after = (nodes.curve(t) for t in (0.5 - step, 0.5, 0.5 + step))
    basis = after - 2 * now + before
    bend = [torch.einsum("mkc,k->mc", v, basis) / s for v, s in ((nodes.shift, 2.0), (nodes.turn, 1.0))]
    total = sum(b.square().mean() for b in bend)
    (3.0 * total).backward()
    assert value == pytest.approx(float(total.detach()), rel=1e-4)
    torch.testing.assert_close(found["nodes.shift"], nodes.shift.grad, atol=1e-6, rtol=1e-3)
    torch.testing.assert_close(found["nodes.turn"], nodes.turn.grad, atol=1e-6, rtol=1e-3)


def test_straight_motion_does_not_bend():
    nodes = nodes_of()
    nodes.seen.copy_(torch.tensor([0.0, 1.0]))
    line = torch.arange(8.0)[:, None].expand(8, 3)
    nodes.shift.data = line.expand(12, 8, 3).clone()
    nodes.turn.data.zero_()
    bent = nodes.spread_over_time(0.4, 0.4, nodes.curve(0.4), torch.zeros(12, 6), 1.0, 1.0)[0]
    assert bent == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("straight", "known"), [(False, 5), (True, 4)])
def test_a_curve_is_continued_to_times_not_yet_seen(straight, known):
    nodes = nodes_of(knots=10, straight=straight)
    for value in (nodes.shift, nodes.turn):
        value.data.zero_()
    nodes.shift.data[:, :5, 0] = torch.arange(5.0)
    nodes.look_ahead(0.29)  # the third span is the last that is seen
    expected, stride = [float(j) for j in range(known)], 1.0
    while len(expected) < nodes.curve.count:
        stride *= 0.5
        expected.append(expected[-1] + stride)
    assert nodes.shift[0, :, 0].tolist() == pytest.approx(expected)
    assert nodes.seen.tolist() == pytest.approx([0.0, 0.29])


def test_a_natural_spline_has_two_numbers_less_and_knots_as_far_apart():
    free, natural = (Curve("spline", 10, 20, 0.0, straight=straight) for straight in (False, True))
    assert (free.count, natural.count) == (10, 8)
    torch.testing.assert_close(natural.reach(), free.reach()[1:-1])
    times = torch.linspace(0, 1, 15)
    inner = natural(times)[5:10, 2:6]  # far from the ends both are the same
    torch.testing.assert_close(inner, free(times)[5:10, 3:7])
    assert Curve("cosines", 10, 20, 0.0, straight=True).count == 10
    assert Curve("spline", 4, 2, 0.0, straight=True)(0.25).tolist() == pytest.approx([0.75, 0.25])


@pytest.mark.parametrize("times", [2, 3, 4])
def test_few_times_leave_a_natural_spline_as_free_as_they_are(times):
    curve = Curve("spline", 4, times, 0.0, straight=True)
    assert torch.linalg.matrix_rank(curve(torch.linspace(0, 1, times))) == times == curve.count


def test_what_was_seen_is_not_continued_anew():
    nodes = nodes_of()
    nodes.look_ahead(1.0)
    before = nodes.shift.clone()
    nodes.look_ahead(0.9)
    assert torch.equal(nodes.shift, before)


def test_another_kind_of_curve_is_refused():
    with pytest.raises(ValueError, match="model.motion: expected spline, cosines or none, but got 'fourier'"):
        Curve("fourier", 8, 20, 0.0)
    with pytest.raises(ValueError, match="at least 2 distinct training times, but got 1"):
        Curve("spline", 8, 1, 0.0)


def skin_of(nodes, count=5):
    skin = Skin(nodes, nodes.places[:count] + 0.01)
    skin.learned.data = torch.randn(skin.learned.shape, generator=torch.Generator().manual_seed(0))
    return skin


def test_particles_learn_whom_they_follow():
    skin = skin_of(nodes_of())
    skin.let_go(torch.arange(5) == 2)
    weights = skin.weights()
    torch.testing.assert_close(weights.sum(-1), torch.tensor([1.0, 1.0, 0.0, 1.0, 1.0]))
    skin.learned.data += torch.tensor([[-300.0], [0.0], [5.0], [300.0], [1e6]])  # of a row it means nothing
    torch.testing.assert_close(skin.weights()[[0, 1, 3]], weights[[0, 1, 3]], atol=1e-4, rtol=0)
    assert bool(skin.weights().isfinite().all())


def test_what_was_learned_of_nodes_that_stay_is_kept():
    nodes = nodes_of()
    skin, drifted = skin_of(nodes), skin_of(nodes)
    drifted.learned.data += 5.0
    optimizer = RowsAdam([{"params": [skin.learned]}])
    moments = torch.arange(float(skin.learned.numel())).reshape(skin.learned.shape)
    optimizer.state[skin.learned] = {"exp_avg": moments, "exp_avg_sq": moments + 1, "steps": torch.ones(5)}
    known = {
        (i, int(n)): v
        for i in range(5)
        for n, v in zip(skin.links[i], skin.weights().data[i] / skin.shares[i])
    }
    places = {(i, int(n)): float(moments[i, k]) for i in range(5) for k, n in enumerate(skin.links[i])}
    skin.relink(nodes, nodes.places[:5] + 0.4, optimizer)
    drifted.relink(nodes, nodes.places[:5] + 0.4, RowsAdam([{"params": [drifted.learned]}]))
    torch.testing.assert_close(drifted.learned, skin.learned, atol=1e-4, rtol=0)
    after = {(i, int(n)): (i, k) for i in range(5) for k, n in enumerate(skin.links[i])}
    assert 0 < len(known.keys() & after.keys()) < len(after)
    for key, at in after.items():  # what comes anew begins with its share
        assert float(skin.learned.data[at].exp()) == pytest.approx(float(known.get(key, 1.0)), rel=1e-4)
        assert float(optimizer.state[skin.learned]["exp_avg"][at]) == places.get(key, 0.0)
