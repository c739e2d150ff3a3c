"""The motion effect: trajectories, and the forward splat that follows them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from forewarp.fields.trajectory import TrajectoryField
from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.ops.splat import average_splat
from forewarp.scene.state import EMPTY, RadianceGrid


class Motion(nn.Module):
    """Carries the canonical radiance along its trajectories.

    Args:
        trajectory: the canonical trajectory field.
        tau: least divisor of the splat; bounds its gradient.
        fade: coverage below which a target voxel fades to empty space, at least ``tau``: below that the
            averages shrink to 0, which as raw density is fog and not empty space.
    """

    def __init__(self, trajectory: TrajectoryField, *, tau: float = 1e-2, fade: float = 0.5) -> None:
        super().__init__()
        if not (0 < tau <= 1 and 0 <= fade <= 1):
            raise ValueError(
                f"model.motion: expected 0 < tau <= 1 and 0 <= fade <= 1, but got {tau=}, {fade=}"
            )
        self.trajectory, self.tau, self.fade = trajectory, tau, fade

    def flow(self, voxels: VoxelGrid, time: float) -> Tensor:
        """Flow (N, 3) from the canonical time, world units."""
        return self.trajectory.flow(voxels, time)

    def warp(self, canonical: RadianceGrid, voxels: Tensor, flow: Tensor) -> tuple[RadianceGrid, Tensor, int]:
        """Average-splat ``canonical``, whose rows lie at ``voxels`` (N, 3), along ``flow`` (N, 3).

        Returns:
            the warped grid, its coverage (M,), and how many voxels left the box.
        """
        spacing = flow.new_tensor(canonical.lattice.spacing)
        splat = average_splat(canonical.values, voxels + flow / spacing, canonical.lattice.shape, self.tau)
        share = (splat.coverage / max(self.fade, self.tau)).clamp(max=1.0)[:, None]
        density = splat.values[:, :1] * share + EMPTY * (1 - share)
        values = torch.cat([density, splat.values[:, 1:]], -1)
        return replace(canonical, index=splat.index, values=values), splat.coverage, splat.dropped
