"""Every operator is tested in both of its implementations."""

import pytest
import torch

from forewarp.ops import backend as choice

SHAPE = (3, 4, 5)


@pytest.fixture(params=["reference", "numba"])
def backend(request, monkeypatch):
    """Runs the test once in plain PyTorch and once with the Numba kernels."""
    if request.param == "numba":
        pytest.importorskip("numba")
    monkeypatch.setattr(choice, "numba_installed", lambda: request.param == "numba")
    return request.param


@pytest.fixture
def sparse():
    """A lattice of 3 x 4 x 5 with every third voxel absent: values (M, 2), index and fill, float64."""
    generator = torch.Generator().manual_seed(0)
    present = torch.arange(60) % 3 != 0
    index = torch.where(present, present.cumsum(0) - 1, -1).to(torch.int32).reshape(SHAPE)
    values = torch.randn(int(present.sum()), 2, generator=generator, dtype=torch.float64)
    return values, index, torch.tensor([-7.0, 0.5], dtype=torch.float64)
