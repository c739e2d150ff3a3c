"""Ray marching: sample rays in occupied cells only."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forewarp.ops.backend import match_threads, use_numba
from forewarp.ops.checks import check_shape
from forewarp.ops.grid import _array

_BLOCK = 4  # side, in cells, of the blocks of a coarse occupancy map, by which rays skip empty space
_MARGIN = 1e-3  # cells


def march(
    origins: Tensor, directions: Tensor, near: float, far: float, step: float, cells: Tensor, jitter: Tensor
) -> tuple[Tensor, Tensor]:
    """Sample rays at ``t_k = near + (k + jitter) step`` < ``far``, k = 0, 1, ..., in occupied cells.

    Args:
        origins: (R, 3), lattice coordinates.
        directions: (R, 3), lattice coordinates per world unit (not unit vectors).
        near, far: distances, world units.
        step: between samples, world units, > 0.
        cells: (X-1, Y-1, Z-1) bool, see ``occupied_cells``.
        jitter: (R,) in [0, 1).

    Returns:
        ray_ids (P,) int64, ascending, and distances (P,) in the dtype of ``origins``, ascending within a
        ray. A ray that misses all cells has no sample. Not differentiable.

    Raises:
        ValueError: for other shapes, ``step`` <= 0, or near and far out of order.

    Cost: one test per step in blocks with occupied cells, one per empty block; memory P.
    """
    check_march(origins, directions, near, far, step, jitter)
    run = _numba_march if use_numba(origins) else march_reference
    return run(origins.detach(), directions.detach(), near, far, step, cells, jitter)


def check_march(
    origins: Tensor, directions: Tensor, near: float, far: float, step: float, jitter: Tensor
) -> None:
    """Raise ValueError for rays that cannot be marched (see ``march``)."""
    check_shape("origins", origins, ("R", 3))
    check_shape("directions", directions, (len(origins), 3))
    check_shape("jitter", jitter, (len(origins),))
    if not (step > 0 and math.isfinite(step)) or not 0 <= near < far < math.inf:
        raise ValueError(f"march: expected step > 0 and 0 <= near < far, but got {step=}, {near=}, {far=}")


def _span(origins: Tensor, directions: Tensor, near: float, far: float, shape) -> tuple[Tensor, Tensor]:
    last = torch.tensor([float(n) for n in shape], dtype=origins.dtype, device=origins.device)
    level = directions == 0
    safe = torch.where(level, torch.ones_like(directions), directions)
    a, b = -origins / safe, (last - origins) / safe
    inf = torch.full_like(a, math.inf)
    outside = level & ((origins < 0) | (origins > last))
    enter = torch.where(outside, inf, torch.where(level, -inf, torch.minimum(a, b)))
    leave = torch.where(outside, -inf, torch.where(level, inf, torch.maximum(a, b)))
    return enter.amax(-1).clamp(min=near), leave.amin(-1).clamp(max=far)


def march_reference(origins, directions, near, far, step, cells, jitter) -> tuple[Tensor, Tensor]:
    """``march`` in plain PyTorch: make every step inside the box, keep those in occupied cells."""
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
    """Return what the kernels march through.

    Returns:
        the cells, the distance from each block to the next occupied block, the bounds of all occupied cells,
        and the side of a block.
    """
    from forewarp.ops import kernels_march as kernels

    array = _array(cells.contiguous().view(torch.uint8))
    reach = torch.empty([-(-n // _BLOCK) for n in cells.shape], dtype=torch.uint8).numpy()
    bounds = torch.empty(2, 3, dtype=torch.float64).numpy()
    kernels.pool_blocks(array, reach, _BLOCK, bounds)
    # Keep samples that rounding moves just outside their cell; the box itself stays the limit.
    bounds[0] = (bounds[0] - _MARGIN).clip(min=0)
    bounds[1] = (bounds[1] + _MARGIN).clip(max=cells.shape)
    return array, reach, bounds, _BLOCK
