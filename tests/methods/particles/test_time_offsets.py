"""The time of the motion, where pictures are off the time that is given."""

import pytest
import torch

from forewarp.fields.curves import Curve
from forewarp.methods.particles.nodes import Nodes, TimeOffsets
from forewarp.methods.rows import RowsAdam

TIMES = [0.0, 0.25, 0.5, 0.75, 1.0]


def test_between_two_training_times_offsets_are_on_a_line():
    offsets = TimeOffsets(TIMES, 1.5)
    offsets.off.data[:] = torch.tensor([[0.0], [0.5], [0.0], [0.0], [-0.5]])
    assert offsets(0.0) == 0.0
    assert offsets(0.25) == 0.375
    assert offsets(0.125) == 0.1875
    assert offsets(1.0) == 0.875


def test_beyond_the_training_times_the_offset_is_that_of_the_last():
    offsets = TimeOffsets([0.25, 0.5, 0.75], 1.5)
    offsets.off.data[:] = torch.tensor([[0.5], [0.0], [0.75]])
    assert offsets(0.0) == 0.125
    assert offsets(1.0) == 1.1875


def test_offsets_are_of_splines_and_can_be_switched_off():
    many = [0.1 * i for i in range(11)]
    assert isinstance(TimeOffsets.of("spline", many, 1.5), TimeOffsets)
    assert TimeOffsets.of("cosines", many, 1.5) is None
    assert TimeOffsets.of("spline", many, 0) is None
    assert TimeOffsets.of("spline", TIMES, 1.5) is None


def test_settling_draws_to_the_given_time_and_keeps_to_the_bound():
    offsets = TimeOffsets(TIMES, 0.75)
    offsets.off.data[:] = torch.tensor([[2.0], [-2.0], [0.01], [-0.01], [0.5]])
    assert offsets(0.0) == 0.75 * 0.25  # what a step has just left is bound, too
    offsets.settle(1.0)
    torch.testing.assert_close(offsets.off[:, 0], torch.tensor([0.75, -0.75, 0.0, 0.0, 0.48]))


def test_no_time_is_off_by_more_than_a_fifth_of_all():
    offsets = TimeOffsets(TIMES, 1.5)
    offsets.off.data.fill_(9.0)
    assert offsets(1.0) == pytest.approx(1.2)


@torch.no_grad()
def test_offsets_that_do_not_learn_yet_have_no_slopes():
    offsets = TimeOffsets(TIMES, 0.75)
    nodes = Nodes(torch.zeros(1, 3), 1, Curve("spline", 8, 5, 0.0), offsets, turns=False)
    slope = torch.ones(1, 6)
    for learns in (False, True):
        offsets.learns = learns
        found = nodes.spread_over_time(0.5, 0.5, nodes.basis(0.5), slope, 0.0, 1.0)[1]
        assert ("nodes.offsets.off" in found) is learns


@torch.no_grad()
@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize("time", [0.0, 0.3, 1.0])
def test_slopes_by_the_offsets_are_finite_differences(turns, time):
    draw = torch.Generator().manual_seed(0)
    points = torch.rand(40, 3, generator=draw)
    offsets = TimeOffsets(TIMES, 1.5)
    offsets.off.data[:] = torch.rand(5, 1, generator=draw) - 0.5
    nodes = Nodes(points, 6, Curve("spline", 8, 5, 0.0), offsets, turns=turns)
    for value in (nodes.shift, nodes.turn):
        if value is not None:
            value.data[:] = torch.rand(value.shape, generator=draw) - 0.5
    nodes.double()
    slope = torch.rand(6, 6, generator=draw, dtype=torch.float64)
    if not turns:
        slope[:, 3:] = 0
    taken = nodes.taken(time)
    found = nodes.spread_over_time(time, taken, nodes.basis(time), slope, 0.0, 1.0)[1]["nodes.offsets.off"]

    def loss() -> float:
        return float((nodes.carried(nodes.basis(time))[0] * slope).sum())

    for row in range(5):
        sides = []
        for step in (1e-2, -2e-2):
            offsets.off.data[row] += step
            sides.append(loss())
        offsets.off.data[row] += 1e-2
        assert float(found[row]) == pytest.approx((sides[0] - sides[1]) / 2e-2, rel=2e-2, abs=1e-5)


@torch.no_grad()
def test_a_first_picture_that_shows_the_second_time_is_understood():
    times, speed = [i / 20 for i in range(21)], torch.tensor([2.0, 1.0, 0.5])
    offsets = TimeOffsets(times, 1.5)
    nodes = Nodes(torch.zeros(1, 3), 1, Curve("spline", 8, 21, 0.0), offsets, turns=False)
    nodes.shift.copy_((torch.arange(8.0)[:, None] - 1) / 5 * speed)  # an even motion
    adam = RowsAdam([{"params": [offsets.off], "lr": 0.3}])
    for step in range(4000):
        time = times[step * 8 % 21]
        taken, slope = nodes.taken(time), nodes.carried(nodes.basis(time))[0]
        slope[:, :3] -= speed * max(times[1], time)
        slope[:, 2] = 0  # along the line of sight
        found = nodes.spread_over_time(time, taken, nodes.basis(time), slope, 0.0, 1.0)[1]
        offsets.off.grad = found["nodes.offsets.off"]
        adam.step()
        rate = adam.param_groups[0]["lr"]
        offsets.settle(rate)
        adam.param_groups[0]["lr"] = rate * 0.999
    assert float(offsets.off[0]) == pytest.approx(1.0, abs=0.05)
    assert float(offsets.off[1:].abs().max()) < 0.05
    assert float(nodes.carried(nodes.basis(0.0))[0][0, 2]) == pytest.approx(0.5 * times[1], abs=2e-3)
