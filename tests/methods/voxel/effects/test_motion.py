import math

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import EMPTY, Activation, RadianceGrid
from forewarp.methods.voxel.effects import Motion
from forewarp.ops.splat import average_splat
from forewarp.scene.box import Box, Lattice

BOX = Box((0, 0, 0), (1, 6, 8))  # spacings 1/2, 2, 2
LATTICE = Lattice(BOX, (3, 4, 5))


def motion(**changes):
    return Motion(TrajectoryField(BOX, bases=2, frames=5, canonical_time=0.0, nodes=8), **changes)


def solid(raw=6.0):
    index = torch.arange(60, dtype=torch.int32).reshape(LATTICE.shape)
    colors = torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
    values = torch.cat([torch.full((60, 1), raw), colors], -1)
    return RadianceGrid(LATTICE, index, values, Activation(-4.6, 1.0))


def test_flow_is_in_world_units():
    canonical = solid()
    shift = torch.tensor([0.5, 0.0, -2.0])  # one voxel up in x, one down in z
    warped, coverage, dropped = motion().warp(canonical, LATTICE.all_voxels(), shift.expand(60, 3))
    arrived = warped.values[warped.index[1:, :, :4].long()]
    torch.testing.assert_close(arrived, canonical.values.reshape(3, 4, 5, 4)[:2, :, 1:])
    assert dropped == 60 - 2 * 4 * 4
    assert len(coverage) == len(warped.values)


@pytest.mark.parametrize("fade", [0.5, 0.0])
def test_holes_are_empty_and_not_fog(fade):
    canonical = solid()
    flow = torch.zeros(60, 3)
    flow[:, 2] = 2.0 * (1 - 1e-4)  # a sliver of one in ten thousand stays in the first plane of z
    warped, coverage, _ = motion(fade=fade).warp(canonical, LATTICE.all_voxels(), flow)
    padded = torch.cat([warped.raw_density, torch.tensor([EMPTY])])
    opened = padded[warped.index[:, :, 0].long()]
    fog = 1 - math.exp(-80 * float(warped.activation.sigma(opened).max()) * LATTICE.voxel_size)
    assert fog < 1e-3
    assert warped.raw_density.max() == pytest.approx(6.0, abs=1e-4)
    assert 0 < coverage.min() < 2e-4


def test_what_rests_is_copied_and_what_moves_is_splatted(monkeypatch):
    canonical, flow = solid(), torch.zeros(60, 3)
    flow[40:] = torch.tensor([0.3, 0.4, 0.0])
    flow[:40] = 0.01  # 0.02 voxels along x at most
    splatted = []

    def noted(values, *others):
        splatted.append(len(values))
        return average_splat(values, *others)

    monkeypatch.setattr("forewarp.methods.voxel.effects.average_splat", noted)
    with torch.no_grad():
        warped, coverage, _ = motion(rest=0.05).warp(canonical, LATTICE.all_voxels(), flow)
        every, _, _ = motion(rest=0.0).warp(canonical, LATTICE.all_voxels(), flow)
    assert splatted == [20, 60]
    assert (warped.values[warped.index[:1].long()] == canonical.values[:20].reshape(1, 4, 5, 4)).all()
    reached = (warped.index >= 0) & (every.index >= 0)
    one, other = (grid.values[grid.index[reached].long()] for grid in (warped, every))
    assert (one[:, 1:] - other[:, 1:]).abs().max() < 0.2  # 0.05 voxels of colours that are a few apart
    motion(rest=0.05).warp(canonical, LATTICE.all_voxels(), flow.requires_grad_())
    assert splatted == [20, 60, 60]  # or it would never learn to move
