"""How the canonical grid changes while it is trained: which voxels are active, how fine the lattice is."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.fields.radiance_grid import EMPTY
from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.methods.rows import renew_parameters
from forewarp.ops.grid import dilate, trilinear
from forewarp.scene.box import Box, Lattice


def seen_rows(radiance: VoxelGrid, optimizer: torch.optim.Optimizer) -> Tensor:
    """Voxels (N,) bool whose colour has had a gradient since the moments began: some view has seen them."""
    name = "color" if "color" in radiance.names else radiance.names[0]
    moments = optimizer.state.get(radiance.parameter(name), {}).get("exp_avg_sq")
    if moments is None:
        return torch.ones(len(radiance.voxels), dtype=torch.bool, device=radiance.voxels.device)
    return moments.amax(-1) > 0


def occupied(radiance: VoxelGrid, keep_alpha: float, seen: Tensor | None = None) -> Tensor:
    """Voxels (X, Y, Z) bool that are more opaque than ``keep_alpha`` over one voxel, and ``seen`` (N,)."""
    with torch.no_grad():
        grid = radiance()
    solid = grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size) > keep_alpha
    solid = solid if seen is None else solid & seen
    mask = torch.zeros(grid.lattice.shape, dtype=torch.bool, device=solid.device)
    x, y, z = radiance.voxels[solid].unbind(-1)
    mask[x, y, z] = True
    return mask


@torch.no_grad()
def refresh(
    radiance: VoxelGrid,
    optimizer: torch.optim.Optimizer,
    *,
    keep_alpha: float,
    birth_alpha: float,
    only_seen: bool = False,
    allowed: Tensor | None = None,
) -> bool:
    """Keep what is occupied and one voxel around it; forget the rest. The optimiser's moments follow.

    An empty grid is left as it is, so that a scene which has not begun to appear cannot vanish for good.

    Args:
        radiance: the canonical field; its active set changes in place.
        optimizer: holds moments by row.
        keep_alpha: opacity over one voxel above which a voxel is occupied.
        birth_alpha: what a new voxel starts with; below ``keep_alpha``, or fog spreads.
        only_seen: also forget what no view has seen since the moments began, the inside of things.
        allowed: (X, Y, Z) bool, where voxels may be born; None: anywhere.

    Returns:
        Whether the active set changed.
    """
    mask = occupied(radiance, keep_alpha, seen_rows(radiance, optimizer) if only_seen else None)
    if not bool(mask.any()):
        return False
    active = dilate(mask, 1) if allowed is None else (dilate(mask, 1) & allowed) | mask
    if bool((active == (radiance.index >= 0)).all()):
        return False
    before = [radiance.parameter(n) for n in radiance.names]
    rows = radiance.activate(active, radiance.births(birth_alpha))
    renew_parameters(optimizer, before, [radiance.parameter(n) for n in radiance.names], rows)
    return True


@torch.no_grad()
def resample(
    radiance: VoxelGrid,
    box: Box,
    voxels: float,
    *,
    keep_alpha: float,
    optimizer: torch.optim.Optimizer | None = None,
    only_seen: bool = False,
) -> None:
    """Carry the field to a lattice of about ``voxels`` over ``box``; what is occupied is active, dilated.

    An empty field becomes active everywhere. The optimiser's moments of the grid start afresh.
    """
    source = radiance()
    lattice = Lattice.of_count(box, voxels)
    points = source.lattice.to_lattice(lattice.to_world(lattice.all_voxels(source.values.device)))
    raw = source.values[:, :1].detach()
    if only_seen and optimizer is not None:
        raw = torch.where(seen_rows(radiance, optimizer)[:, None], raw, EMPTY)
    raw = trilinear(raw.contiguous(), source.index, points, source.fill[:1])[:, 0]
    last = torch.tensor(source.lattice.shape, device=points.device) - 1
    slack = 1e-3  # voxels: rounding must not cut off the border of the same box
    inside = ((points >= -slack) & (points <= last + slack)).all(-1)
    solid = (source.activation.alpha(raw, source.lattice.voxel_size) > keep_alpha) & inside
    mask = dilate(solid.reshape(lattice.shape), 1)
    if not bool(mask.any()):
        mask = torch.ones_like(mask)
    before = [radiance.parameter(n) for n in radiance.names]
    radiance.resample(lattice, mask, radiance.empties())
    if optimizer is not None:
        renew_parameters(optimizer, before, [radiance.parameter(n) for n in radiance.names], None)


@torch.no_grad()
def box_of_all_times(method, times: list[float], *, alpha: float, pad: float) -> Box | None:
    """The box around everything more opaque than ``alpha`` at any of ``times``, ``pad`` voxels wider.

    None where nothing is that opaque. Sources that left the box are counted by the warp, not here.
    """
    grid = method.radiance()
    solid = grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size) > alpha
    if not bool(solid.any()):
        return None
    home = grid.lattice.to_world(method.radiance.voxels)[solid]
    low, high = home.amin(0), home.amax(0)
    for time in times if method.moves else ():
        at = method.moved(home, solid, time)
        low, high = torch.minimum(low, at.amin(0)), torch.maximum(high, at.amax(0))
    margin = pad * grid.lattice.voxel_size  # added first: a flat thing has no box of its own
    return Box(tuple((low - margin).tolist()), tuple((high + margin).tolist()))
