"""Evidence from a coarse stage on which effects a scene needs: how it moves, and what errors remain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forewarp.fields.radiance_grid import FieldAtTime
from forewarp.methods.voxel.effects.background import Together
from forewarp.methods.voxel.method import SOLID
from forewarp.metrics.image import low_passed
from forewarp.ops.grid import index_of, neighbour_pairs
from forewarp.scene.frame import spread
from forewarp.scene.view import Target, View

if TYPE_CHECKING:
    from forewarp.methods.voxel.forward_warp import ForwardWarp

TORN = 2.0  # distance of neighbours in voxels; a splat reaches one voxel to either side
_TIMES = 40  # at most this many times are examined


@dataclass(frozen=True)
class Movement:
    """What the trajectories of a coarse stage show.

    Attributes:
        moving: share of solid voxels that move by more than one voxel.
        distance: mean over these of their largest displacement, world units.
        torn: largest share, over all times, of solid voxels more than ``TORN`` voxels away from a neighbour,
            so that the splat leaves holes.
        at: the time of ``torn``.
        left_out: RMS movement, in voxels, that the first k = 0, 1, ... cosines cannot represent.
    """

    moving: float
    distance: float
    torn: float
    at: float
    left_out: tuple[float, ...]

    @property
    def enough(self) -> float:
        """Movement that cosines may leave out, in voxels: half a voxel, or a tenth of a large movement."""
        return max(0.5, 0.1 * self.left_out[0])

    def bases(self) -> int:
        """Return the smallest number of cosines that leaves out no more than ``enough``."""
        return next(k for k, rest in enumerate(self.left_out) if rest <= self.enough)


@torch.no_grad()
def movement(method: ForwardWarp, times: Sequence[float]) -> Movement:
    """Measure how a fitted method with motion moves. Cost: one flow per time, at most ``_TIMES``."""
    grid, trajectory = method.radiance(), method.motion.trajectory
    lattice, voxels = grid.lattice, method.radiance.voxels
    solid = grid.activation.alpha(grid.raw_density, lattice.voxel_size) > SOLID
    if not bool(solid.any()):
        return Movement(0.0, 0.0, 0.0, trajectory.canonical_time, (0.0,))
    voxels = voxels[solid]
    some = [times[i] for i in spread(len(times), _TIMES)]
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
    """Return the share of voxels that a flow (N, 3), in voxels, tears from a neighbour; ``pairs`` by axis."""
    torn = torch.zeros(len(flow), dtype=torch.bool, device=flow.device)
    for (rows, other), step in zip(pairs, torch.eye(3, device=flow.device)):
        far = (step + flow[other] - flow[rows]).norm(dim=-1) > TORN
        torn[rows[far]] = torn[other[far]] = True
    return float(torn.float().mean())


def _left_out(trajectory, points: Tensor, times: Sequence[float], voxel_size: float) -> tuple[float, ...]:
    """RMS over points and times of the movement in the cosines above the k-th, k = 0 ... K, in voxels."""
    if not len(points):
        return (0.0,)
    coefficients = trajectory.coefficients(points[:: max(1, len(points) // 20_000)])  # (N, 3, K)
    basis = trajectory.basis(torch.tensor(times))
    rest = []
    for k in range(trajectory.bases + 1):
        left = coefficients[..., k:] @ basis[:, k:].T
        rest.append(float(left.square().sum(1).mean().sqrt()) / voxel_size)
    return tuple(rest)


_WIDER = 4.0  # positions are encoded in a box this much wider, which holds a static background too


@dataclass(frozen=True)
class Residual:
    """The errors that a coarse stage without view dependence leaves in its training images.

    Attributes:
        psnr: PSNR of the coarse stage, dB.
        by_direction: share of the squared error that view-dependent colour would remove: at each place a
            colour linear in the viewing direction is fitted to other images. Negative: the fit adds noise.
        allowed: PSNR of the best images that the last stage's lattice can represent.
    """

    psnr: float
    by_direction: float
    allowed: float


@torch.no_grad()
def residual(method: ForwardWarp, targets: Sequence[Target], voxel_size: float, rays: int = 1500) -> Residual:
    """Measure the errors in some training images.

    Args:
        method: fitted, without view dependence.
        targets: training views.
        voxel_size: voxel size of the last stage's lattice, world units.
        rays: number of pixels of each image.
    """
    generator = torch.Generator().manual_seed(0)
    places, directions, errors, views, bounds = [], [], [], [], []
    for number, target in enumerate(targets):
        camera = target.frame.camera
        pixels = torch.randperm(camera.width * camera.height, generator=generator)[:rays]
        shown = _seen(method, target, pixels)
        error = target.rgb.reshape(-1, 3)[pixels] - shown[0]
        places.append(shown[1]), directions.append(camera.rays(pixels).directions), errors.append(error)
        views.append(torch.full((len(pixels),), number))
        voxel = voxel_size * camera.fx / max(float(shown[2]), 1e-6)
        bounds.append(float((low_passed(target.rgb, voxel) - target.rgb).square().mean()))
    error = torch.cat(errors)
    share = _explained(
        torch.cat(places),
        torch.cat(directions),
        error,
        torch.cat(views),
        2 * method.radiance.lattice.voxel_size,
    )
    return Residual(_psnr(float(error.square().mean())), share, _psnr(sum(bounds) / len(bounds)))


def _psnr(error: float) -> float:
    return -10 * math.log10(max(error, 1e-10))


def _seen(method: ForwardWarp, target: Target, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return colours (R, 3), canonical positions (R, 3), NaN for none, and median depth of some pixels."""
    view, time = View(target.frame.camera, pixels), target.frame.time
    drawn = method.at(target.moment).render(view, target.background.to(method.device))
    place, box = _places(method, time), method.radiance.lattice.box
    rays = view.rays().to(method.device)
    found = method.renderer.picture(place, rays, rays.origins.new_zeros(3))
    solid = found.opacity > 0.5
    low, high = (found.rgb.new_tensor(end) for end in (box.scaled(_WIDER).low, box.scaled(_WIDER).high))
    at = low + (high - low) * found.rgb / found.opacity.clamp(min=1e-6)[:, None]
    at[~solid] = math.nan
    return (
        drawn.rgb.clamp(0, 1).cpu(),
        at.cpu(),
        found.depth[solid].median() if bool(solid.any()) else found.depth.new_tensor(1.0),
    )


def _places(method: ForwardWarp, time: float) -> FieldAtTime:
    """Return the field at a time with canonical positions in place of colours."""
    box = method.radiance.lattice.box.scaled(_WIDER)

    def placed(grid, voxels: Tensor):
        at = grid.lattice.to_world(voxels)
        low, high = at.new_tensor(box.low), at.new_tensor(box.high)
        share = ((at - low) / (high - low)).clamp(1e-4, 1 - 1e-4)
        return grid.with_values(torch.cat([grid.raw_density[:, None], torch.logit(share)], -1))

    field = placed(method.radiance(), method.radiance.voxels)
    if method.motion is not None and time != method.canonical_time:
        flow = method.motion.flow(method.radiance, time)
        field, _, _ = method.motion.warp(field, method.radiance.voxels, flow)
    if method.background is None:
        return field
    return Together(field, placed(method.background(), method.background.voxels))


def _explained(places: Tensor, directions: Tensor, errors: Tensor, views: Tensor, cell: float) -> float:
    """Return the share of the squared error that direction explains, beyond what position explains.

    Fit a colour linear in direction, and a constant one, in each cell of space to one half of the images, and
    compare their errors on the other half.

    Args:
        places: (P, 3), NaN where there is none.
        directions: (P, 3), unit vectors.
        errors: (P, 3).
        views: (P,), the image of each.
        cell: side of a cell, world units.
    """
    known = places.isfinite().all(-1)
    places, directions, errors, views = (x[known] for x in (places, directions, errors, views))
    if not len(places):
        return 0.0
    _, cells = torch.unique((places / cell).floor().long(), dim=0, return_inverse=True)
    count = int(cells.max()) + 1
    inputs = torch.cat([torch.ones_like(directions[:, :1]), directions.float()], -1).double()
    left = [0.0, 0.0]
    for half in (0, 1):
        fitted, other = views % 2 == half, views % 2 != half
        for kind, width in enumerate((1, 4)):
            weights = _fits(inputs[fitted, :width], errors[fitted].double(), cells[fitted], count)
            rest = errors[other] - torch.einsum("pi,pic->pc", inputs[other, :width], weights[cells[other]])
            left[kind] += float(rest.square().sum())
    return (left[0] - left[1]) / max(float(errors.square().sum()), 1e-12)


def _fits(inputs: Tensor, values: Tensor, cells: Tensor, count: int) -> Tensor:
    """Ridge regression of ``values`` (P, C) on ``inputs`` (P, I) in every cell: (cells, I, C)."""
    width = inputs.shape[1]
    squares = inputs.new_zeros(count, width, width).index_add_(0, cells, inputs[:, :, None] * inputs[:, None])
    products = inputs.new_zeros(count, width, values.shape[1]).index_add_(
        0, cells, inputs[:, :, None] * values[:, None]
    )
    ridge = torch.eye(width, dtype=inputs.dtype) * 2.0  # as strong as two images without error
    return torch.linalg.solve(squares + ridge, products)
