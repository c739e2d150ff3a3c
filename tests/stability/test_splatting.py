"""Forward warping where nothing, almost nothing or far too much arrives (cases 1 to 4, 22 and 29)."""

import math

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import EMPTY
from forewarp.methods.voxel.effects import Motion
from forewarp.ops.splat import average_splat
from tests.support.hard_cases import LATTICE, SHAPE, check_finite, grid, voxels

pytestmark = pytest.mark.stability


def source_of(count, device, seed=0):
    made = torch.randn(count, 4, generator=torch.Generator().manual_seed(seed))
    return made.to(device).requires_grad_()


def motion():
    return Motion(TrajectoryField(LATTICE.box, bases=2, frames=5, canonical_time=0.0, nodes=8))


@pytest.mark.parametrize("sliver", [1e-9, 1e-7, 1e-4])
def test_coverage_of_a_billionth(place, sliver):
    positions = torch.tensor(
        [[1.0, 1.0, 1.0 - sliver], [0.0, -1 + sliver, 2.0]], device=place
    ).requires_grad_()
    source = source_of(2, place)
    result = average_splat(source, positions, SHAPE)
    slopes = check_finite((result.values, result.coverage), source, positions)
    assert float(slopes[1].abs().max()) < 10 / 1e-2  # tau caps what would be 1 / sliver
    assert float(result.values.detach().abs().max()) <= float(source.detach().abs().max()) * (1 + 1e-6)


def test_all_voxels_land_in_one_cell(place):
    count = 200_000
    generator = torch.Generator().manual_seed(1)
    positions = (1.2 + 0.6 * torch.rand(count, 3, generator=generator)).to(place).requires_grad_()
    source = source_of(count, place)
    result = average_splat(source, positions, SHAPE)
    check_finite((result.values, result.coverage), source, positions)
    assert int((result.index >= 0).sum()) == 8
    assert float(result.coverage.detach().sum()) == pytest.approx(count, rel=1e-4)
    exact = average_splat(source.detach().double(), positions.detach().double(), SHAPE)
    torch.testing.assert_close(result.values.double(), exact.values, atol=1e-4, rtol=1e-3)


def test_expansion_opens_holes_everywhere(place):
    canonical = grid(6.0, device=place)
    home = voxels(device=place)
    spacing = torch.tensor(LATTICE.spacing, device=place)
    flow = ((home * 0.9 - torch.tensor([1.0, 1.5, 2.0], device=place)) * spacing).requires_grad_()
    warped, coverage, dropped = motion().warp(canonical, home.long(), flow)
    check_finite((warped.values, coverage), canonical.values, flow)
    assert dropped > 0
    assert float(warped.raw_density.detach().max()) <= 6.0 + 1e-5
    assert float(warped.raw_density.detach().min()) >= EMPTY - 1e-5


@pytest.mark.parametrize("bad", [1e3, -1e30, math.inf, -math.inf, math.nan])
def test_flow_far_outside_infinite_and_nan(place, bad):
    canonical = grid(6.0, device=place)
    flow = torch.zeros(60, 3, device=place)
    flow[::2, 1] = bad
    flow.requires_grad_()
    warped, coverage, dropped = motion().warp(canonical, voxels(device=place).long(), flow)
    gradients = check_finite((warped.values, coverage), canonical.values, flow)
    assert dropped == 30  # counted, not silent
    assert torch.equal(warped.values[coverage == 1], canonical.values[:30])  # where the other half stays
    assert int((coverage != 0).sum()) == 30
    assert (gradients[1][::2] == 0).all()
