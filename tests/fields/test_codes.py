import pytest
import torch
from torch.autograd import gradcheck

from forewarp.fields.codes import FrameCodes

TIMES = [0.1, 0.7, 0.1, 1 / 3]


def codes(**changes):
    torch.manual_seed(0)
    return FrameCodes(TIMES, 4, **changes)


def test_a_code_for_each_distinct_time():
    made = codes()
    assert made.times == (0.1, 1 / 3, 0.7)
    assert made.codes.shape == (3, 4)
    assert ((made.codes >= 0) & (made.codes < 0.05)).all()


@pytest.mark.parametrize("time", TIMES)
def test_a_training_time_has_exactly_its_own(time):
    made = codes()
    assert torch.equal(made(time), made.codes[made.times.index(time)])
    made(time).sum().backward()
    assert (made.codes.grad.sum(1) != 0).tolist() == [time == own for own in made.times]


def test_between_two_it_is_linear_in_time():
    made = FrameCodes([0.0, 0.5, 1.0], 2)
    with torch.no_grad():
        made.codes.copy_(torch.tensor([[0.0, 4.0], [1.0, 0.0], [9.0, 9.0]]))
    torch.testing.assert_close(made(0.125), torch.tensor([0.25, 3.0]))
    torch.testing.assert_close(made(0.75), torch.tensor([5.0, 4.5]))


def test_outside_it_is_the_nearest_one():
    made = codes()
    assert torch.equal(made(-1.0), made.codes[0])
    assert torch.equal(made(2.0), made.codes[-1])
    alone = FrameCodes([0.4], 3)
    assert all(torch.equal(alone(time), alone.codes[0]) for time in (0.0, 0.4, 1.0))


def test_a_broken_neighbour_stays_where_it_is():
    made = codes()
    with torch.no_grad():
        made.codes[1] = float("nan")
    assert made(0.1).isfinite().all()
    assert made(0.7).isfinite().all()


def test_gradcheck():
    made = codes().double()
    assert gradcheck(lambda c: torch.func.functional_call(made, {"codes": c}, (0.2,)), made.codes)


@pytest.mark.parametrize(("times", "width"), [([], 4), ([0.0], 0)])
def test_refuses(times, width):
    with pytest.raises(ValueError, match="frame codes: expected a time and width >= 1, but got"):
        FrameCodes(times, width)
