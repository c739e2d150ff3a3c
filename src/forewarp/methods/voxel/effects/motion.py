"""The motion effect: trajectories, and the forward splat that follows them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from forewarp.fields.radiance_grid import EMPTY, RadianceGrid
from forewarp.fields.trajectory import TrajectoryField
from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.ops.splat import Splat, average_splat, with_copies


class Motion(nn.Module):
    """Carries the canonical radiance along its trajectories.

    Args:
        trajectory: the canonical trajectory field.
        tau: least divisor of the splat; bounds its gradient.
        fade: coverage below which a target voxel fades to empty space, at least ``tau``: below that the
            averages shrink to 0, which as raw density is fog and not empty space.
        rest: what moves by less than this, in voxels along each axis, is copied and not splatted. Where a
            gradient is asked for all is splatted, or what rests at first would never learn to move.
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

    def flow(self, voxels: VoxelGrid, time: float) -> Tensor:
        """Flow (N, 3) from the canonical time, world units."""
        return self.trajectory.flow(voxels, time)

    def warp(self, canonical: RadianceGrid, voxels: Tensor, flow: Tensor) -> tuple[RadianceGrid, Tensor, int]:
        """Average-splat ``canonical``, whose rows lie at ``voxels`` (N, 3), along ``flow`` (N, 3); what rests
        is copied.

        Returns:
            the warped grid, its coverage (M,), and how many voxels left the box.
        """
        splat = self._splat(canonical, voxels, flow / flow.new_tensor(canonical.lattice.spacing))
        share = (splat.coverage / max(self.fade, self.tau)).clamp(max=1.0)[:, None]
        density = splat.values[:, :1] * share + EMPTY * (1 - share)
        values = torch.cat([density, splat.values[:, 1:]], -1)
        return replace(canonical, index=splat.index, values=values), splat.coverage, splat.dropped

    def _splat(self, canonical: RadianceGrid, voxels: Tensor, flow: Tensor) -> Splat:
        """Along a flow (N, 3) in voxels."""
        values, shape = canonical.values, canonical.lattice.shape
        asks = torch.is_grad_enabled() and (values.requires_grad or flow.requires_grad)
        moves = None if asks or self.rest == 0 else ~(flow.abs() < self.rest).all(-1)
        if moves is None or bool(moves.all()):
            return average_splat(values, voxels + flow, shape, self.tau)
        splat = average_splat(values[moves], voxels[moves] + flow[moves], shape, self.tau)
        return with_copies(splat, values[~moves], voxels[~moves], self.tau)
