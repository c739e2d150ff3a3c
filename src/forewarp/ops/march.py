"""Ray marching through occupied cells: samples in empty space are never made."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forewarp.ops.backend import match_threads, use_numba
from forewarp.ops.checks import check_shape
from forewarp.ops.grid import _array

_BLOCK = 4  # cells per side of the coarse occupancy that lets a ray leap over empty space
_MARGIN = 1e-3  # cells


def march(
    origins: Tensor, directions: Tensor, near: float, far: float, step: float, cells: Tensor, jitter: Tensor
) -> tuple[Tensor, Tensor]:
    """Samples ``t_k = near + (k + jitter) step``, k = 0, 1, ..., in occupied cells and before ``far``.

    Args:
        origins: (R, 3), lattice coordinates.
        directions: (R, 3), lattice coordinates per world unit of distance (not unit vectors).
        near, far: distances, world units.
        step: between samples, world units, > 0.
        cells: (X-1, Y-1, Z-1) bool, see ``occupied_cells``.
        jitter: (R,) in [0, 1).

    Returns:
        ray_ids (P,) int64, ascending, and distances (P,) of ``origins``' dtype, ascending within a ray.
        Not differentiable. A ray that misses, or lies beyond, has no sample.

    Cost: one test a step inside the box, one a block where the block is empty; memory P.
    """
    check_march(origins, directions, near, far, step, jitter)
    run = _numba_march if use_numba(origins) else march_reference
    return run(origins.detach(), directions.detach(), near, far, step, cells, jitter)


def check_march(
    origins: Tensor, directions: Tensor, near: float, far: float, step: float, jitter: Tensor
) -> None:
    """Raise ValueError where rays cannot be marched along."""
    check_shape("origins", origins, ("R", 3))
    check_shape("directions", directions, (len(origins), 3))
    check_shape("jitter", jitter, (len(origins),))
    if not (step > 0 and math.isfinite(step)) or not 0 <= near < far < math.inf:
        raise ValueError(f"march: expected step > 0 and 0 <= near < far, but got {step=}, {near=}, {far=}")


def _span(origins: Tensor, directions: Tensor, near: float, far: float, shape) -> tuple[Tensor, Tensor]:
    last = torch.tensor([float(n) for n in shape], dtype=origins.dtype, device=origins.device)
    still = directions == 0
    safe = torch.where(still, torch.ones_like(directions), directions)
    a, b = -origins / safe, (last - origins) / safe
    inf = torch.full_like(a, math.inf)
    outside = still & ((origins < 0) | (origins > last))
    enter = torch.where(outside, inf, torch.where(still, -inf, torch.minimum(a, b)))
    leave = torch.where(outside, -inf, torch.where(still, inf, torch.maximum(a, b)))
    return enter.amax(-1).clamp(min=near), leave.amin(-1).clamp(max=far)


def march_reference(origins, directions, near, far, step, cells, jitter) -> tuple[Tensor, Tensor]:
    """``march`` in plain PyTorch: makes every step inside the box, then keeps those in occupied cells."""
    enter, leave = _span(origins, directions, near, far, cells.shape)
    hit = enter <= leave
    first = torch.where(hit, ((enter - near) / step - jitter).ceil().clamp(min=0), torch.zeros_like(enter))
    extent = torch.where(hit, leave - enter, torch.zeros_like(enter))
    steps = int(extent.max().div(step).floor()) + 2 if len(origins) else 0
    k = first[:, None] + torch.arange(steps, dtype=origins.dtype, device=origins.device)
    t = near + (k + jitter[:, None]) * step  # (R, S)
    keep = hit[:, None] & (t <= leave[:, None])
    ray_ids, columns = keep.nonzero(as_tuple=True)
    distances = t[ray_ids, columns]
    points = origins[ray_ids] + distances[:, None] * directions[ray_ids]
    last = torch.tensor(cells.shape, device=cells.device) - 1
    x, y, z = torch.minimum(points.long().clamp(min=0), last).unbind(-1)
    inside = cells[x, y, z]
    return ray_ids[inside], distances[inside]


def _numba_march(origins, directions, near, far, step, cells, jitter) -> tuple[Tensor, Tensor]:
    from forewarp.ops import kernels_march as kernels

    match_threads()
    counts, firsts = torch.zeros(2, len(origins), dtype=torch.int64).unbind()
    none = torch.zeros(0, dtype=torch.int64)
    common = (*(_array(v) for v in (origins, directions)), float(near), float(far), float(step))
    common = (*common, _array(jitter), *map_cells(cells), counts.numpy(), firsts.numpy())
    kernels.march(*common, none.numpy(), none.numpy(), origins.new_zeros(0).numpy())
    starts = counts.cumsum(0) - counts
    total = int(counts.sum())
    ray_ids, distances = torch.empty(total, dtype=torch.int64), origins.new_empty(total)
    kernels.march(*common, starts.numpy(), ray_ids.numpy(), distances.numpy())
    return ray_ids, distances


def map_cells(cells: Tensor) -> tuple:
    """What the kernels march through: the cells, how far from each block to the next occupied one, the bounds
    of all occupied cells, and the block's side.
    """
    from forewarp.ops import kernels_march as kernels

    array = _array(cells.contiguous().view(torch.uint8))
    reach = torch.empty([-(-n // _BLOCK) for n in cells.shape], dtype=torch.uint8).numpy()
    bounds = torch.empty(2, 3, dtype=torch.float64).numpy()
    kernels.pool_blocks(array, reach, _BLOCK, bounds)
    # A sample that rounding puts just outside its cell is not lost; the box itself stays the limit.
    bounds[0] = (bounds[0] - _MARGIN).clip(min=0)
    bounds[1] = (bounds[1] + _MARGIN).clip(max=cells.shape)
    return array, reach, bounds, _BLOCK
