"""The objective: which terms count in a step, their weights, and gradients that a method brings."""

import pytest
import torch
from torch import nn

from forewarp.methods.method import Step
from forewarp.training.objective import Objective, parts, set_gradients, total


def step_of(**values):
    """Make a step whose terms have these values."""
    return Step({name: lambda value=value: value for name, value in values.items()}, torch.zeros(()))


def test_the_loss_is_the_weighted_sum_of_the_raw_terms():
    photo, entropy = (torch.tensor(v, requires_grad=True) for v in (2.0, 3.0))
    factors = Objective({"photo": 1.0, "entropy": 0.25}).factors(0)
    loss, raw = total(step_of(photo=photo, entropy=entropy), factors)
    assert (loss.item(), raw) == (pytest.approx(2.75), {"photo": 2.0, "entropy": 3.0})
    assert not any(value.requires_grad for value in raw.values())
    loss.backward()
    assert (photo.grad.item(), entropy.grad.item()) == (1.0, 0.25)


def test_each_nth_step_with_n_times_the_weight():
    objective = Objective({"photo": 1.0, "entropy": 0.5, "never": 0.0}, every={"entropy": 3})
    assert objective.factors(6) == {"photo": 1.0, "entropy": 1.5}
    assert objective.factors(7) == {"photo": 1.0}
    for every in (0, 1.5):
        with pytest.raises(ValueError, match="objective.every: expected whole numbers of steps >= 1"):
            Objective({}, every={"photo": every})


def test_a_term_whose_effect_is_off_is_left_out_and_one_that_is_missing_refused():
    step, factors = step_of(photo=torch.ones(()), entropy=None), {"photo": 1.0, "entropy": 2.0}
    assert list(parts(step, factors)) == ["photo"]
    assert total(step, factors)[0].item() == 1.0
    with pytest.raises(ValueError, match="expected look to give the term 'slow', .* but got photo, entropy"):
        total(step, {"slow": 1.0})


def test_a_method_may_bring_gradients_of_its_own():
    method = nn.ParameterDict({name: nn.Parameter(torch.zeros(2)) for name in ("a", "b", "frozen")})
    method["frozen"].requires_grad_(False)
    given = torch.tensor([1.0, -2.0])
    set_gradients(method, {"b": given, "frozen": given})
    assert method["b"].grad is given  # it is not copied
    assert method["a"].grad is method["frozen"].grad is None


@pytest.mark.parametrize(
    ("gradients", "message"),
    [
        ({}, "expected gradients of some of a, but got none"),
        ({"b": torch.ones(2)}, "expected gradients of some of a, but got b"),
        ({"a": torch.ones(1)}, r"a gradient of a as it is, \(2,\) torch.float32 on cpu"),
        ({"a": torch.ones(2).double()}, r"a gradient of a as it is, \(2,\) torch.float32 on cpu"),
    ],
)
def test_gradients_that_do_not_fit_are_refused(gradients, message):
    with pytest.raises(ValueError, match=message):
        set_gradients(nn.ParameterDict({"a": nn.Parameter(torch.zeros(2))}), gradients)
