"""Rows of parameters, buffers and moments are added and removed together; contradictions are named."""

import pytest
import torch
from torch import nn

from forewarp.methods.method import Method
from forewarp.methods.rows import RowsAdam, take_rows


class Points(nn.Module):
    def __init__(self):
        super().__init__()
        self.place = nn.Parameter(torch.arange(8.0).reshape(4, 2))


class Method4(Method):
    grows = ("points.place", "size_of", "seen")

    def __init__(self):
        super().__init__()
        self.points = Points()
        self.size_of = nn.Parameter(torch.ones(4), requires_grad=False)
        self.register_buffer("seen", torch.tensor([5, 6, 7, 8]))


def stepped():
    method = Method4()
    optimizer = torch.optim.Adam([method.points.place], lr=0.1)
    method.points.place.square().sum().backward()
    optimizer.step()
    return method, optimizer


def test_rows_of_parts_are_taken_with_their_moments():
    method, optimizer = stepped()
    place, moment = method.points.place.data.clone(), optimizer.state[method.points.place]["exp_avg"].clone()
    rows = torch.tensor([3, 1, 1])
    take_rows(method, optimizer, rows, fresh=torch.tensor([False, False, True]))
    assert torch.equal(method.points.place, place[rows])
    assert method.seen.tolist() == [8, 6, 6]
    assert not method.size_of.requires_grad
    (held,) = optimizer.param_groups[0]["params"]
    assert held is method.points.place
    assert torch.equal(optimizer.state[held]["exp_avg"], moment[rows] * torch.tensor([[1.0], [1.0], [0.0]]))


@pytest.mark.parametrize("rows", [[-1], [4], [0.5], [True]])
def test_rows_that_there_are_not_are_refused(rows):
    method, optimizer = stepped()
    with pytest.raises(ValueError, match=r"rows: expected int64 in \[0, 4\), but got"):
        take_rows(method, optimizer, torch.tensor(rows))
    assert len(method.points.place) == 4


def test_a_state_of_other_rows_is_adopted_and_one_that_contradicts_itself_is_named():
    method, state = Method4(), Method4().state_dict()
    more = {name: torch.cat([value, value]) for name, value in state.items()}
    assert method.misfit(more) is None
    method.load_state_dict(more)
    assert len(method.points.place) == len(method.seen) == 8
    assert method.misfit(state | {"seen": more["seen"]}) == "seen"
    assert method.misfit(state | {"seen": state["seen"].float()}) == "seen"
    assert method.misfit(state | {"points.place": torch.ones(4, 3)}) == "points.place"


def test_groups_have_rates_and_betas_of_their_own():
    values = [nn.Parameter(torch.zeros(20, 3)) for _ in range(3)]
    changes = {"lr": 0.1}, {"lr": 0.2}, {"lr": 0.1, "betas": (0.5, 0.5)}
    optimizer = RowsAdam([{"params": [value], **change} for value, change in zip(values, changes)])
    for sign in (1.0, -2.0):
        for value in values:
            value.grad = torch.full((20, 3), sign)
        assert optimizer.step(lambda: 7) == 7
    first, second, third = (float(value.detach()[0, 0]) for value in values)
    assert second == pytest.approx(2 * first)
    assert third != pytest.approx(first, abs=1e-3)
