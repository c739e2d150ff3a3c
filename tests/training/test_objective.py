"""The objective: which terms count in a step, their weights, and gradients that a method brings."""

import pytest
import torch

from forewarp.methods.method import Step
from forewarp.training.objective import Objective, parts, total


def step_of(gradients=None, **values):
    """Make a step whose terms have these values; ``called`` lists the computed ones."""
    called = []

    def term(name, value):
        called.append(name)
        return value

    terms = {name: lambda name=name, value=value: term(name, value) for name, value in values.items()}
    return Step(terms, torch.zeros(()), gradients=gradients), called


def test_the_loss_is_the_weighted_sum_of_the_raw_terms():
    photo, entropy = (torch.tensor(v, requires_grad=True) for v in (2.0, 3.0))
    step, _ = step_of(photo=photo, entropy=entropy)
    loss, raw = total(step, Objective({"photo": 1.0, "entropy": 0.25}).factors(0), {})
    assert loss.item() == pytest.approx(2.75)
    assert {name: value.item() for name, value in raw.items()} == {"photo": 2.0, "entropy": 3.0}
    assert not any(value.requires_grad for value in raw.values())
    loss.backward()
    assert (photo.grad.item(), entropy.grad.item()) == (1.0, 0.25)


def test_each_nth_step_with_n_times_the_weight():
    objective = Objective({"photo": 1.0, "entropy": 0.5, "never": 0.0}, every={"entropy": 3})
    assert objective.factors(6) == {"photo": 1.0, "entropy": 1.5}
    assert objective.factors(7) == {"photo": 1.0}


def test_a_term_whose_effect_is_off_is_left_out():
    step, _ = step_of(photo=torch.ones(()), entropy=None)
    factors = {"photo": 1.0, "entropy": 2.0}
    assert list(parts(step, factors)) == ["photo"]
    loss, raw = total(step, factors, {})
    assert (loss.item(), list(raw)) == (1.0, ["photo"])


def test_a_method_may_bring_gradients_of_its_own():
    first, second = (torch.nn.Parameter(torch.zeros(2)) for _ in range(2))
    given = {"second": torch.tensor([1.0, -2.0])}
    step, _ = step_of(given, photo=torch.tensor(3.0))
    loss, raw = total(step, {"photo": 2.0}, {"first": first, "second": second})
    assert (loss.item(), raw["photo"].item()) == (6.0, 3.0)
    (2 * loss).backward()
    assert first.grad is None
    assert second.grad.tolist() == [2.0, -4.0]
    with pytest.raises(RuntimeError, match="expected to be led back once"):
        loss.backward()


def test_gradients_of_a_method_are_added_to_those_that_there_are():
    value, frozen = (torch.nn.Parameter(torch.zeros(2)) for _ in range(2))
    frozen.requires_grad_(False)
    value.grad = torch.ones(2)
    step, _ = step_of({"value": torch.tensor([1.0, -2.0]), "frozen": torch.ones(2)}, photo=torch.tensor(3.0))
    total(step, {"photo": 1.0}, {"value": value, "frozen": frozen})[0].backward()
    assert value.grad.tolist() == [2.0, -1.0]
    assert frozen.grad is None


@pytest.mark.parametrize("given", [torch.ones(1), torch.ones(2, dtype=torch.float64)])
def test_a_gradient_that_is_not_as_its_parameter_is_refused(given):
    step, _ = step_of({"value": given}, photo=torch.tensor(3.0))
    with pytest.raises(ValueError, match=r"a gradient of value as it is, \(2,\) torch.float32 on cpu"):
        total(step, {"photo": 1.0}, {"value": torch.nn.Parameter(torch.zeros(2))})


@pytest.mark.parametrize("every", [0, 1.5])
def test_refuses_a_broken_rhythm(every):
    with pytest.raises(ValueError, match="objective.every: expected whole numbers of steps >= 1, but got"):
        Objective({}, every={"photo": every})
