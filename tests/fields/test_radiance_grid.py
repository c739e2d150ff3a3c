import math

import pytest
import torch

from forewarp.fields.grids import EMPTY, Activation, RadianceGrid, density_shift
from forewarp.ops.grid import occupied_cells
from forewarp.scene.box import Box, Lattice
from tests.support.hard_cases import index_with

LATTICE = Lattice(Box((0, 0, 0), (2, 3, 4)), (3, 4, 5))


def grid(raw=3.0, present=None, alpha_threshold=0.0):
    present = torch.ones(LATTICE.shape, dtype=torch.bool) if present is None else present
    index = index_with(present)
    values = torch.cat([torch.full((int(present.sum()), 1), raw), torch.ones(int(present.sum()), 3)], -1)
    return RadianceGrid(LATTICE, index, values, Activation(density_shift(1e-2), 1.0), alpha_threshold)


@pytest.mark.parametrize("alpha", [1e-5, 1e-2, 0.5, 0.99])
def test_raw_inverts_alpha(alpha):
    activation = Activation(density_shift(1e-2), density_scale=0.1)
    raw = activation.raw(alpha, 0.05)
    assert activation.alpha(torch.tensor([raw]), 0.05).item() == pytest.approx(alpha, rel=1e-3)


def test_absent_space_is_empty_and_not_fog():
    empty = grid(present=torch.zeros(LATTICE.shape, dtype=torch.bool))
    sigma = empty.density(torch.tensor([[1.0, 1.0, 1.0]]))
    assert 1 - math.exp(-80 * sigma.item()) < 1e-4
    assert not empty.cells.any()
    assert empty.features(torch.ones(2, 3)).tolist() == [[0, 0, 0]] * 2
    assert empty.fill.tolist() == [EMPTY, 0, 0, 0]


def test_density_and_features_are_read_from_the_voxels():
    whole = grid(raw=2.0)
    points = torch.rand(6, 3)
    torch.testing.assert_close(whole.density(points), whole.activation.sigma(torch.full((6,), 2.0)))
    torch.testing.assert_close(whole.features(points), torch.ones(6, 3))
    assert whole.raw_density.shape == (60,)
    assert whole.color.shape == (60, 3)
    assert whole.with_values(whole.values * 0).raw_density.abs().sum() == 0


def test_cells_too_transparent_are_skipped():
    assert grid(raw=3.0, alpha_threshold=1e-3).cells.all()
    assert not grid(raw=-9.0, alpha_threshold=1e-3).cells.any()
    assert grid(raw=-9.0).cells.all()
    one = grid(raw=-9.0, alpha_threshold=1e-3)
    one.values[one.index[1, 1, 1], 0] = 5.0
    present = torch.full(LATTICE.shape, -1, dtype=torch.int32)
    present[1, 1, 1] = 0
    assert torch.equal(one.cells, occupied_cells(present))
