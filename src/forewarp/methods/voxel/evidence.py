"""What the motion of a coarse stage says of what a scene calls for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forewarp.ops.grid import index_of, neighbour_pairs
from forewarp.scene.frame import spread

if TYPE_CHECKING:
    from forewarp.methods.voxel.forward_warp import ForwardWarp

SOLID = 0.1  # opacity over a voxel of what counts as matter here
TORN = 2.0  # voxels from one to its neighbour; an average splat reaches one to either side
_VIEWS = 40  # times that are looked at, at most


@dataclass(frozen=True)
class Movement:
    """What the trajectories of a coarse stage say.

    ``moving``: share of solid voxels that move by more than a voxel; ``distance``: how far these do at most,
    their mean, world units; ``torn``: the largest share, of all times, of solid voxels that are drawn away
    from a neighbour by more than ``TORN`` voxels, so that the splat leaves holes between them; ``at``: that
    time; ``left_out``: for k = 0, 1, ... cosines, RMS of the movement that they do not hold, voxels.
    """

    moving: float
    distance: float
    torn: float
    at: float
    left_out: tuple[float, ...]

    @property
    def enough(self) -> float:
        """How much cosines may leave out: half a voxel, or a tenth of a movement that is more than five."""
        return max(0.5, 0.1 * self.left_out[0])

    def bases(self) -> int:
        """The fewest cosines that leave out no more than ``enough``."""
        return next(k for k, rest in enumerate(self.left_out) if rest <= self.enough)


@torch.no_grad()
def movement(method: ForwardWarp, times: Sequence[float]) -> Movement:
    """Evidence from a fitted method that has motion. Cost: a flow a time, at most ``_VIEWS`` of them."""
    grid, trajectory = method.radiance(), method.motion.trajectory
    lattice, voxels = grid.lattice, method.radiance.voxels
    solid = grid.activation.alpha(grid.raw_density, lattice.voxel_size) > SOLID
    if not bool(solid.any()):
        return Movement(0.0, 0.0, 0.0, trajectory.canonical_time, (0.0,))
    voxels = voxels[solid]
    some = [times[i] for i in spread(len(times), _VIEWS)]
    flows = [method.motion.flow(method.radiance, time)[solid] for time in some]
    far = torch.stack([flow.norm(dim=-1) for flow in flows]).amax(0)
    moves = far > lattice.voxel_size
    pairs = neighbour_pairs(index_of(voxels, lattice.shape))
    torn = [_torn(pairs, flow / flow.new_tensor(lattice.spacing)) for flow in flows]
    worst = max(range(len(torn)), key=torn.__getitem__)
    return Movement(
        moving=float(moves.float().mean()),
        distance=float(far[moves].mean()) if bool(moves.any()) else 0.0,
        torn=torn[worst],
        at=some[worst],
        left_out=_left_out(trajectory, lattice.to_world(voxels[moves]), some, lattice.voxel_size),
    )


def _torn(pairs: list[tuple[Tensor, Tensor]], flow: Tensor) -> float:
    """Share of voxels that the flow (N, 3), in voxels, draws away from a neighbour by more than ``TORN``;
    ``pairs`` of rows by axis.
    """
    torn = torch.zeros(len(flow), dtype=torch.bool, device=flow.device)
    for (rows, other), step in zip(pairs, torch.eye(3, device=flow.device)):
        far = (step + flow[other] - flow[rows]).norm(dim=-1) > TORN
        torn[rows[far]] = torn[other[far]] = True
    return float(torn.float().mean())


def _left_out(trajectory, points: Tensor, times: Sequence[float], voxel_size: float) -> tuple[float, ...]:
    """RMS over points and times of what the cosines above the k-th add, for k = 0 ... K, in voxels."""
    if not len(points):
        return (0.0,)
    coefficients = trajectory.coefficients(points[:: max(1, len(points) // 20_000)])  # (N, 3, K)
    basis = trajectory.basis(torch.tensor(times))
    rest = []
    for k in range(trajectory.bases + 1):
        left = coefficients[..., k:] @ basis[:, k:].T
        rest.append(float(left.square().sum(1).mean().sqrt()) / voxel_size)
    return tuple(rest)
