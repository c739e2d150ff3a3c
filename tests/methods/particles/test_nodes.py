"""Nodes and their curves, corrections of the images' times, and which nodes a particle follows."""

import pytest
import torch

from forewarp.fields.curves import Curve
from forewarp.methods.particles.nodes import Nodes, Skinning, TimeOffsets
from forewarp.methods.rows import RowsAdam
from forewarp.scene.cloud import nearest
from tests.support.particles import module_with, small_data

TIMES = [0.0, 0.25, 0.5, 0.75, 1.0]


def nodes_of(count=12, kind="spline", knots=8, rotates=True, straight=False, **options):
    axis = torch.linspace(-1, 1, 4)
    curve = Curve(kind, knots, 20, 0.0, straight=straight)
    nodes = Nodes(torch.cartesian_prod(axis, axis, axis), count, curve, rotates=rotates, **options)
    generator = torch.Generator().manual_seed(0)
    for value in (nodes.translations, nodes.rotations):
        if value is not None:
            value.data = 0.1 * torch.randn(value.shape, generator=generator)
    return nodes


def test_nearest_is_nearest():
    points, positions = torch.randn(5000, 3), torch.randn(30, 3)
    squared, rows = nearest(points, positions, 4)
    exact = torch.cdist(points, positions).square().sort(-1)
    torch.testing.assert_close(squared, exact.values[:, :4], atol=1e-4, rtol=1e-4)
    assert (rows == exact.indices[:, :4]).float().mean() > 0.999
    assert [part.shape for part in nearest(points[:0], positions, 4)] == [(0, 4)] * 2
    assert [part.shape for part in nearest(points, positions[:2], 4)] == [(5000, 2)] * 2


def test_points_follow_the_nodes_beside_them():
    nodes = nodes_of()
    rows, shares = nodes.links(nodes.positions + 0.01)
    torch.testing.assert_close(shares.sum(-1), torch.ones(12))
    assert torch.equal(rows[:, 0].long(), torch.arange(12))
    assert bool((shares[:, 0] >= shares[:, 1:].amax(-1)).all())
    few = Curve("spline", 5, 9, 0.0)
    assert len(Nodes(torch.randn(3, 3), 10, few).positions) == 3
    rows, shares = Nodes(torch.zeros(1, 3), 10, few).links(torch.randn(4, 3))
    assert (rows.tolist(), shares.tolist()) == ([[0]] * 4, [[1.0]] * 4)


@pytest.mark.parametrize(
    ("kind", "straight", "rotates"),
    [*(("spline", False, True), ("spline", True, True), ("spline", False, False)), ("cosines", False, True)],
)
def test_gradients_of_curves_are_those_of_autograd(kind, straight, rotates):
    nodes = nodes_of(kind=kind, straight=straight, rotates=rotates)
    nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    motion, _ = nodes.motion_and_maps(nodes.curve(0.5))
    by_motion = torch.randn(motion.shape)
    bent, found = nodes.backward(0.5, 0.5, nodes.curve(0.5), by_motion, 3.0, 2.0)
    step = 1 / 5
    before, now, after = (nodes.curve(t) for t in (0.5 - step, 0.5, 0.5 + step))
    bends = [torch.einsum("mkc,k->mc", nodes.translations, after - 2 * now + before) / 2.0]
    if rotates:
        bends.append(torch.einsum("mkc,k->mc", nodes.rotations, after - 2 * now + before))
    smooth = sum(bend.square().mean() for bend in bends)
    ((motion * by_motion).sum() + 3.0 * smooth).backward()
    assert bent == pytest.approx(float(smooth.detach()), rel=1e-4)
    assert found.keys() == {name for name, _ in nodes.named_parameters()}
    for name, parameter in nodes.named_parameters():
        torch.testing.assert_close(found[name], parameter.grad, atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize(("straight", "known"), [(False, 5), (True, 4)])
def test_a_curve_is_continued_to_times_not_yet_seen_but_not_anew(straight, known):
    nodes = nodes_of(knots=10, straight=straight)
    for value in (nodes.translations, nodes.rotations):
        value.data.zero_()
    nodes.translations.data[:, :5, 0] = torch.arange(5.0)
    nodes.extend(0.29)  # the third span is the last that is seen
    expected, stride = [float(j) for j in range(known)], 1.0
    while len(expected) < nodes.curve.count:
        stride *= 0.5
        expected.append(expected[-1] + stride)
    assert nodes.translations[0, :, 0].tolist() == pytest.approx(expected)
    assert nodes.seen_times.tolist() == pytest.approx([0.0, 0.29])
    before = nodes.translations.clone()
    nodes.extend(0.2)
    assert torch.equal(nodes.translations, before)


@pytest.mark.parametrize("kind", ["spline", "cosines"])
def test_a_node_that_stops_stays(kind):
    nodes = nodes_of(kind=kind, rests=True)
    assert float(nodes.motion_range(TIMES).min()) > 0
    mean = sum(nodes.motion_and_maps(nodes.curve(t))[0] for t in TIMES)[:2, :3] / len(TIMES)
    nodes.stop(torch.arange(12) < 2, TIMES)
    assert (nodes.motion_range(TIMES) < 1e-5).nonzero()[:, 0].tolist() == [0, 1]
    _, found = nodes.backward(0.3, 0.3, nodes.curve(0.3), torch.ones(12, 6), 1.0, 1.0)
    assert not any(bool(gradient[:2].any()) for gradient in found.values())
    if kind == "spline":
        torch.testing.assert_close(nodes.motion_and_maps(nodes.curve(0.3))[0][:2, :3], mean)


def test_times_are_off_by_what_was_learned_and_no_more():
    offsets = TimeOffsets(TIMES, 1.5)
    offsets.values.data[:] = torch.tensor([[0.0], [0.5], [0.0], [0.0], [-0.5]])
    assert [offsets(time) for time in (0.0, 0.25, 0.125, 1.0)] == [0.0, 0.375, 0.1875, 0.875]
    beyond = TimeOffsets([0.25, 0.5, 0.75], 1.5)
    beyond.values.data[:] = torch.tensor([[0.5], [0.0], [0.75]])
    assert (beyond(0.0), beyond(1.0)) == (0.125, 1.1875)  # as the first and the last training time
    bound = TimeOffsets(TIMES, 0.75)
    bound.values.data[:] = torch.tensor([[2.0], [-2.0], [0.01], [-0.01], [0.5]])
    assert bound(0.0) == 0.75 * 0.25  # what a step has just left is bound, too
    bound.settle(1.0)
    torch.testing.assert_close(bound.values[:, 0].detach(), torch.tensor([0.75, -0.75, 0.0, 0.0, 0.48]))
    offsets.values.data.fill_(9.0)
    assert offsets(1.0) == pytest.approx(1.2)  # never by more than a fifth of all time


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "times", "learned"),
    [
        ({}, 12, True),
        ({"motion": "cosines"}, 12, False),
        ({}, 6, False),
        ({"numbers": {"time_offsets": 0}}, 12, False),
    ],
)
def test_times_of_splines_are_corrected_unless_they_are_few(options, times, learned):
    nodes = module_with(small_data(times), **options).method.deformation.nodes
    assert (nodes.time_offsets is not None) == ("time_offsets" in nodes.param_groups()) == learned


@torch.no_grad()
@pytest.mark.parametrize("rotates", [True, False])
@pytest.mark.parametrize("time", [0.0, 0.3, 1.0])
def test_gradients_by_the_offsets_are_finite_differences(rotates, time):
    draw = torch.Generator().manual_seed(0)
    points, offsets = torch.rand(40, 3, generator=draw), TimeOffsets(TIMES, 1.5)
    nodes = Nodes(points, 6, Curve("spline", 8, 5, 0.0), offsets, rotates=rotates)
    for value in (offsets.values, nodes.translations, nodes.rotations):
        if value is not None:
            value.data[:] = torch.rand(value.shape, generator=draw) - 0.5
    nodes.double()
    by_motion = torch.rand(6, 6, generator=draw, dtype=torch.float64)
    if not rotates:
        by_motion[:, 3:] = 0

    def gradients():
        motion_time = nodes.motion_time(time)
        return nodes.backward(time, motion_time, nodes.basis(time), by_motion, 0.0, 1.0)[1]

    def loss() -> float:
        return float((nodes.motion_and_maps(nodes.basis(time))[0] * by_motion).sum())

    found = gradients()["time_offsets.values"]
    for row in range(5):
        sides = []
        for step in (1e-2, -2e-2):
            offsets.values.data[row] += step
            sides.append(loss())
        offsets.values.data[row] += 1e-2
        assert float(found[row]) == pytest.approx((sides[0] - sides[1]) / 2e-2, rel=2e-2, abs=1e-5)
    offsets.learns = False
    assert "time_offsets.values" not in gradients()


@pytest.mark.slow
@torch.no_grad()
def test_a_first_image_that_shows_the_second_time_is_understood():
    times, speed = [i / 20 for i in range(21)], torch.tensor([2.0, 1.0, 0.5])
    offsets = TimeOffsets(times, 1.5)
    nodes = Nodes(torch.zeros(1, 3), 1, Curve("spline", 8, 21, 0.0), offsets, rotates=False)
    nodes.translations.copy_((torch.arange(8.0)[:, None] - 1) / 5 * speed)  # an even motion
    adam = RowsAdam([{"params": [offsets.values], "lr": 0.3}])
    for step in range(2000):
        time = times[step * 8 % 21]
        motion_time, error = nodes.motion_time(time), nodes.motion_and_maps(nodes.basis(time))[0]
        error[:, :3] -= speed * max(times[1], time)
        error[:, 2] = 0  # along the line of sight
        found = nodes.backward(time, motion_time, nodes.basis(time), error, 0.0, 1.0)[1]
        offsets.values.grad = found["time_offsets.values"]
        adam.step()
        offsets.settle(adam.param_groups[0]["lr"])
        adam.param_groups[0]["lr"] *= 0.998
    assert float(offsets.values[0]) == pytest.approx(1.0, abs=0.05)
    assert float(offsets.values[1:].abs().max()) < 0.05
    assert float(nodes.motion_and_maps(nodes.basis(0.0))[0][0, 2]) == pytest.approx(0.025, abs=2e-3)


def skinning_of(nodes, count=5):
    skinning = Skinning(nodes, nodes.positions[:count] + 0.01)
    skinning.logits.data = torch.randn(skinning.logits.shape, generator=torch.Generator().manual_seed(0))
    return skinning


def test_particles_learn_whom_they_follow():
    skinning = skinning_of(nodes_of())
    skinning.release(torch.arange(5) == 2)
    weights = skinning.weights()
    torch.testing.assert_close(weights.sum(-1), torch.tensor([1.0, 1.0, 0.0, 1.0, 1.0]))
    skinning.logits.data += torch.tensor([[-300.0], [0.0], [5.0], [300.0], [1e6]])  # of a row: means nothing
    torch.testing.assert_close(skinning.weights()[[0, 1, 3]], weights[[0, 1, 3]], atol=1e-4, rtol=0)
    assert bool(skinning.weights().isfinite().all())


def test_what_was_learned_of_nodes_that_stay_is_kept():
    nodes = nodes_of()
    skinning, drifted = skinning_of(nodes), skinning_of(nodes)
    drifted.logits.data += 5.0
    optimizer, logits = RowsAdam([{"params": [skinning.logits]}]), skinning.logits
    moments = torch.arange(float(logits.numel())).reshape(logits.shape)
    optimizer.state[logits] = {"exp_avg": moments, "exp_avg_sq": moments + 1, "steps": torch.ones(5)}

    def by_link(values):
        return {(i, int(n)): float(values[i, k]) for i in range(5) for k, n in enumerate(skinning.links[i])}

    factors, known = by_link(skinning.weights().data / skinning.shares), by_link(moments)
    skinning.relink(nodes, nodes.positions[:5] + 0.4, optimizer)
    drifted.relink(nodes, nodes.positions[:5] + 0.4, RowsAdam([{"params": [drifted.logits]}]))
    torch.testing.assert_close(drifted.logits, logits, atol=1e-4, rtol=0)
    after = by_link(logits.data.exp())
    assert 0 < len(factors.keys() & after.keys()) < len(after)
    assert after == pytest.approx({link: factors.get(link, 1.0) for link in after}, rel=1e-4)
    assert by_link(optimizer.state[logits]["exp_avg"]) == {link: known.get(link, 0.0) for link in after}
