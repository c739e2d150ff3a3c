"""What a scene's pictures, and the motion of a coarse stage fitted to them, say of what it calls for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from forewarp.methods.voxel.forward_warp import ForwardWarp
from forewarp.ops.grid import dilate, index_of, neighbour_pairs
from forewarp.scene.box import Lattice
from forewarp.scene.frame import Frame, Scene, spread
from forewarp.scene.hull import visual_hull

SOLID = 0.1  # opacity over a voxel of what counts as matter here
TORN = 2.0  # voxels from one to its neighbour; an average splat reaches one to either side
_VIEWS, _SIDE = 40, 40


@dataclass(frozen=True)
class Pictures:
    """What the pictures say before anything is fitted.

    ``times`` distinct ones of ``frames``; ``cut_out``: share of transparent pixels, 0 where there is no alpha
    or it says nothing; ``spread``: degrees between the two cameras that see the scene's middle from the most
    different sides; ``disagreement``: share of the foreground that no still thing can explain, as no point
    projects there that all silhouettes allow (0 without alpha).
    """

    frames: int
    times: int
    cut_out: float
    spread: float
    disagreement: float


def survey(scene: Scene) -> Pictures:
    """Evidence from training frames alone. Cost: ``_VIEWS`` images, ``_SIDE``^3 points in each."""
    frames = [scene.train[i] for i in spread(len(scene.train), _VIEWS)]
    cut_out = 0.0
    if scene.has_alpha:
        cut_out = sum(float((f.load()[..., 3] < 128).float().mean()) for f in frames) / len(frames)
    disagreement = _disagreement(scene, frames) if cut_out > 0 and len(frames) > 1 else 0.0
    return Pictures(len(scene.train), len(scene.times), cut_out, _spread(scene), disagreement)


def _spread(scene: Scene) -> float:
    middle = torch.tensor([(low + high) / 2 for low, high in zip(scene.box.low, scene.box.high)]).double()
    towards = torch.stack([frame.camera.center.double() - middle for frame in scene.train])
    towards = functional.normalize(towards, dim=-1)
    return math.degrees(math.acos(float((towards @ towards.T).min().clamp(-1, 1))))


def _disagreement(scene: Scene, frames: Sequence[Frame]) -> float:
    lattice = Lattice.of_count(scene.box, _SIDE**3)
    points, masks, reach = lattice.to_world(lattice.all_voxels()), [], []
    for frame in frames:
        depth = float(frame.camera.project(points.mean(0, keepdim=True))[1])
        reach.append(max(1, math.ceil(lattice.pitch * frame.camera.fx / max(depth, 1e-6))))
        masks.append(dilate(frame.load()[..., 3] > 127, reach[-1]))
    points = points[visual_hull(points, [frame.camera for frame in frames], masks)]
    missed = total = 0
    for frame, pixels in zip(frames, reach):
        camera, foreground = frame.camera, frame.load()[..., 3] > 127
        pixel, depth = camera.project(points)
        column, row = pixel.floor().long().unbind(-1)
        inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height) & (depth > 0)
        covered = torch.zeros_like(foreground)
        covered[row[inside], column[inside]] = True
        missed += int((foreground & ~dilate(covered, pixels)).sum())
        total += int(foreground.sum())
    return missed / max(total, 1)


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
    solid = grid.activation.alpha(grid.raw_density, lattice.pitch) > SOLID
    if not bool(solid.any()):
        return Movement(0.0, 0.0, 0.0, trajectory.canonical_time, (0.0,))
    voxels = voxels[solid]
    some = [times[i] for i in spread(len(times), _VIEWS)]
    flows = [method.motion.flow(method.radiance, time)[solid] for time in some]
    far = torch.stack([flow.norm(dim=-1) for flow in flows]).amax(0)
    moves = far > lattice.pitch
    pairs = neighbour_pairs(index_of(voxels, lattice.shape))
    torn = [_torn(pairs, flow / flow.new_tensor(lattice.spacing)) for flow in flows]
    worst = max(range(len(torn)), key=torn.__getitem__)
    return Movement(
        moving=float(moves.float().mean()),
        distance=float(far[moves].mean()) if bool(moves.any()) else 0.0,
        torn=torn[worst],
        at=some[worst],
        left_out=_left_out(trajectory, lattice.to_world(voxels[moves]), some, lattice.pitch),
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


def _left_out(trajectory, points: Tensor, times: Sequence[float], pitch: float) -> tuple[float, ...]:
    """RMS over points and times of what the cosines above the k-th add, for k = 0 ... K, in voxels."""
    if not len(points):
        return (0.0,)
    coefficients = trajectory.coefficients(points[:: max(1, len(points) // 20_000)])  # (N, 3, K)
    basis = trajectory.basis(torch.tensor(times))
    rest = []
    for k in range(trajectory.bases + 1):
        left = coefficients[..., k:] @ basis[:, k:].T
        rest.append(float(left.square().sum(1).mean().sqrt()) / pitch)
    return tuple(rest)
