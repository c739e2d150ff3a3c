import pytest
import torch

from forewarp.ops.curves import dct_basis
from tests.support.reference import dct_difference


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
