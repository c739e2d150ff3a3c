"""The motion effect: splat the canonical radiance forward along its trajectories."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from forewarp.fields.radiance_grid import EMPTY, RadianceGrid
from forewarp.fields.trajectory import TrajectoryField
from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.ops.splat import Splat, average_splat, with_copies


class Motion(nn.Module):
    """Warp the canonical radiance to any time.

    Args:
        trajectory: the canonical trajectory field.
        tau: lower bound of the splat's divisor; bounds its gradient.
        fade: coverage below which a voxel fades to empty space. At coverages below ``tau`` averages shrink
            to 0, and a raw density of 0 is fog.
        rest: copy voxels that move by less than this many voxels per axis instead of splatting them; only
            without gradient, or static voxels would never learn to move.
    """

    def __init__(
        self, trajectory: TrajectoryField, *, tau: float = 1e-2, fade: float = 0.5, rest: float = 0.05
    ) -> None:
        super().__init__()
        if not (0 < tau <= 1 and 0 <= fade <= 1 and 0 <= rest < 0.5):
            raise ValueError(
                "model.motion: expected 0 < tau <= 1, 0 <= fade <= 1 and 0 <= rest < 0.5, "
                f"but got {tau=}, {fade=}, {rest=}"
            )
        self.trajectory, self.tau, self.fade, self.rest = trajectory, tau, fade, rest

    def flow(self, grid: VoxelGrid, time: float) -> Tensor:
        """Return the flow (N, 3) of a grid's active voxels from the canonical time, in world units."""
        return self.trajectory.flow(grid, time)

    def warp(self, canonical: RadianceGrid, voxels: Tensor, flow: Tensor) -> tuple[RadianceGrid, Tensor, int]:
        """Average-splat ``canonical`` along a flow.

        Args:
            canonical: the grid to warp.
            voxels: (N, 3), positions of its rows on the lattice.
            flow: (N, 3), world units.

        Returns:
            the warped grid, its coverage (M,), and the number of voxels that left the box.
        """
        splat = self._splat(canonical, voxels, flow / flow.new_tensor(canonical.lattice.spacing))
        share = (splat.coverage / max(self.fade, self.tau)).clamp(max=1.0)[:, None]
        density = splat.values[:, :1] * share + EMPTY * (1 - share)
        values = torch.cat([density, splat.values[:, 1:]], -1)
        return replace(canonical, index=splat.index, values=values), splat.coverage, splat.dropped

    def _splat(self, canonical: RadianceGrid, voxels: Tensor, flow: Tensor) -> Splat:
        """Splat along a flow (N, 3) in voxels."""
        values, shape = canonical.values, canonical.lattice.shape
        asks = torch.is_grad_enabled() and (values.requires_grad or flow.requires_grad)
        moves = None if asks or self.rest == 0 else ~(flow.abs() < self.rest).all(-1)
        if moves is None or bool(moves.all()):
            return average_splat(values, voxels + flow, shape, self.tau)
        splat = average_splat(values[moves], voxels[moves] + flow[moves], shape, self.tau)
        return with_copies(splat, values[~moves], voxels[~moves], self.tau)
