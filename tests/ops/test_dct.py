import pytest
import torch

from forewarp.ops.dct import dct_basis
from tests.support.reference import dct_difference


def test_hand_worked():
    # T = 2, K = 1: b(t) = cos(pi/4 (2t + 1)), so b(1) - b(0) = -sqrt(2).
    assert dct_basis(1.0, 1, 2, canonical_time=0.0).item() == pytest.approx(-(2**0.5))
    assert dct_basis(0.5, 1, 2, canonical_time=0.0).item() == pytest.approx(-(0.5**0.5))


@pytest.mark.parametrize("padding", [0.0, 0.2])
def test_equals_the_slow_twin(padding):
    times = torch.tensor([0.0, 0.13, 0.5, 1.0], dtype=torch.float64)
    basis = dct_basis(times, 5, 9, 0.25, padding)
    expected = [dct_difference(t, 5, 9, 0.25, padding) for t in times.tolist()]
    torch.testing.assert_close(basis, torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("canonical", [0.0, 0.1, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("padding", [0.0, 0.1])
def test_is_exactly_zero_at_the_canonical_time(canonical, padding):
    as_tensors = (torch.tensor([canonical], dtype=dtype) for dtype in (torch.float32, torch.float64))
    for time in (canonical, *as_tensors):
        assert (dct_basis(time, 6, 20, canonical, padding) == 0).all()


def test_is_orthonormal_over_the_training_times():
    basis = dct_basis(torch.linspace(0, 1, 12, dtype=torch.float64), 11, 12, 0.4)
    centred = basis - basis.mean(0)
    torch.testing.assert_close(centred.T @ centred, torch.eye(11, dtype=torch.float64))


def test_shape_and_dtype_follow_the_time():
    assert dct_basis(torch.zeros(2, 3), 4, 8, 0.0).shape == (2, 3, 4)
    assert dct_basis(torch.zeros(2, dtype=torch.float64), 4, 8, 0.0).dtype == torch.float64
    assert dct_basis(1, 4, 8, 0.0).dtype == torch.float32


def test_gradcheck():
    times = torch.tensor([0.2, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: dct_basis(t, 4, 8, 0.5), times)


@pytest.mark.parametrize(("bases", "frames"), [(0, 5), (5, 5), (1, 1)])
def test_refuses_bases_that_are_not_independent(bases, frames):
    with pytest.raises(ValueError, match=r"expected 1 <= bases <= frames - 1, but got bases="):
        dct_basis(0.0, bases, frames, 0.0)


@pytest.mark.parametrize(("time", "canonical"), [(-0.1, 0.0), (1.2, 0.0), (0.0, 1.5), (float("nan"), 0.0)])
def test_refuses_times_where_the_cosine_mirrors(time, canonical):
    with pytest.raises(ValueError, match=r"expected times in \[0, 1\]"):
        dct_basis(time, 2, 5, canonical)
