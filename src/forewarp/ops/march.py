"""Volume rendering: sample rays, evenly, by importance or in occupied cells, and composite the samples."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from forewarp.ops.backend import arrays, check_shapes, match_threads, use_numba
from forewarp.ops.grid import index_of, occupied_cells, trilinear
from forewarp.ops.splat import average_splat

_BLOCK = 4  # side, in cells, of the blocks of a coarse occupancy map, by which rays skip empty space
_MARGIN = 1e-3  # cells
_FLOOR = 1e-5  # of the weight of a bin, so that every bin can be drawn

# Sample distances ------------------------------------------------------------------------------------------


def stratified(near: Tensor, far: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Stratified sampling (NeRF): one distance in each of ``count`` bins between ``near`` and ``far``.

    The bins meet midway between the points of ``linspace(near, far, count)``, so the first and the last are
    half as wide as the others.

    Args:
        near, far: (R,) of each ray.
        count: S >= 2.
        generator: draws each distance uniformly in its bin; None: return the linspace.

    Returns:
        (R, S), ascending.

    >>> stratified(torch.tensor([2.0]), torch.tensor([6.0]), 3)
    tensor([[2., 4., 6.]])
    """
    check_shapes("near (R), far (R)", near, far)
    if count < 2:
        raise ValueError(f"stratified: expected count >= 2, but got {count}")
    steps = torch.linspace(0, 1, count, dtype=near.dtype, device=near.device)
    even = near[:, None] + (far - near)[:, None] * steps
    if generator is None:
        return even
    middle = midpoints(even)
    low, high = torch.cat([even[:, :1], middle], 1), torch.cat([middle, even[:, -1:]], 1)
    return low + (high - low) * _uniform(even, generator)


def midpoints(depths: Tensor) -> Tensor:
    """Return the midpoints (R, S - 1) of neighbouring distances (R, S)."""
    return 0.5 * (depths[:, 1:] + depths[:, :-1])


@torch.no_grad()
def by_importance(
    edges: Tensor, weights: Tensor, count: int, generator: torch.Generator | None = None
) -> Tensor:
    """Importance sampling (NeRF): draw ``count`` distances from a piecewise constant density.

    Evaluate the inverse of its distribution function, linear within a bin, at uniform numbers. No gradient
    passes.

    Args:
        edges: (R, B + 1) of the bins, ascending.
        weights: (R, B) >= 0 of the bins, not normalised; 1e-5 is added, so that every bin can be drawn.
        count: S >= 1.
        generator: draws the uniform numbers; None: take them evenly from 0 to 1.

    Returns:
        (R, S), ascending without a generator.

    Cost: R (B + S log B).

    >>> by_importance(torch.tensor([[0.0, 1.0, 3.0]]), torch.tensor([[0.5, 0.5]]), 5)
    tensor([[0.0000, 0.5000, 1.0000, 2.0000, 3.0000]])
    """
    check_shapes("edges (R, E), weights (R, B)", edges, weights, B=edges.shape[-1] - 1)
    if weights.shape[1] < 1 or count < 1:
        raise ValueError(f"weights: expected a bin and count >= 1, but got {weights.shape[1]} and {count=}")
    ends = (weights + _FLOOR).cumsum(1)
    ends = torch.cat([torch.zeros_like(ends[:, :1]), ends / ends[:, -1:]], 1)
    if generator is None:
        at = torch.linspace(0, 1, count, dtype=ends.dtype, device=ends.device).repeat(len(ends), 1)
    else:
        at = _uniform(ends.new_empty(len(ends), count), generator)
    right = torch.searchsorted(ends, at, right=True).clamp(1, weights.shape[1])
    (begin, end), (low, high) = ([t.gather(1, right - 1), t.gather(1, right)] for t in (ends, edges))
    return low + (high - low) * ((at - begin) / (end - begin)).clamp(0, 1)


def _uniform(like: Tensor, generator: torch.Generator) -> Tensor:
    """Draw numbers in [0, 1) on the generator's device, with shape, dtype and device of a tensor."""
    return torch.rand(like.shape, generator=generator, device=generator.device, dtype=like.dtype).to(like)


def union(*depths: Tensor) -> Tensor:
    """Merge sets of distances (R, S_i) of the same rays into one, ascending (R, sum of S_i)."""
    return torch.cat(depths, 1).sort(1).values


def clip_to_box(
    origins: Tensor, directions: Tensor, near: float, far: float, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    """Clip the interval ``[near, far]`` of each ray to an axis-aligned box.

    Args:
        origins, directions: (R, 3).
        near, far: range of all rays, in multiples of a direction's length.
        low, high: (3,) corners of the box.

    Returns:
        near (R,) and far (R,); far <= near for a ray that misses the box.
    """
    check_shapes("origins (R, 3), directions (R, 3)", origins, directions)
    enter, leave = _crossings(origins, directions, low, high)
    return enter.clamp(near, far), leave.clamp(near, far)


def _crossings(origins: Tensor, directions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return where the lines of rays enter a box and leave it; they leave before they enter if they miss."""
    to_low, to_high = low - origins, high - origins
    inside = (to_low <= 0) & (to_high >= 0)
    level = directions == 0
    safe = torch.where(level, torch.ones_like(directions), directions)
    never = torch.where(inside, -torch.inf, torch.inf).to(origins)  # for rays parallel to a face
    enter = torch.where(level, never, torch.minimum(to_low / safe, to_high / safe))
    leave = torch.where(level, -never, torch.maximum(to_low / safe, to_high / safe))
    return enter.amax(1), leave.amin(1)


# March -----------------------------------------------------------------------------------------------------


@torch.no_grad()
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
    rays = origins, directions, near, far, step, cells, jitter
    _check_march(*rays)
    if not use_numba(origins):
        return march_reference(*rays)
    found = _marched(rays)
    return found.ray_ids, found.distances


def _check_march(origins, directions, near, far, step, cells, jitter) -> None:
    check_shapes("origins (R, 3), directions (R, 3), jitter (R)", origins, directions, jitter)
    if not (step > 0 and math.isfinite(step)) or not 0 <= near < far < math.inf:
        raise ValueError(f"march: expected step > 0 and 0 <= near < far, but got {step=}, {near=}, {far=}")


def march_reference(origins, directions, near, far, step, cells, jitter) -> tuple[Tensor, Tensor]:
    """``march`` in plain PyTorch: make every step inside the box, keep those in occupied cells."""
    last = torch.tensor(cells.shape, device=cells.device) - 1
    enter, leave = _crossings(origins, directions, torch.zeros_like(last), last + 1)
    enter, leave = enter.clamp(min=near), leave.clamp(max=far)
    hit = enter <= leave
    first = torch.where(hit, ((enter - near) / step - jitter).ceil().clamp(min=0), 0.0)
    extent = torch.where(hit, leave - enter, 0.0)
    steps = int(extent.max().div(step).floor()) + 2 if len(origins) else 0
    k = first[:, None] + torch.arange(steps, dtype=origins.dtype, device=origins.device)
    t = near + (k + jitter[:, None]) * step  # (R, S)
    ray_ids, columns = (hit[:, None] & (t <= leave[:, None])).nonzero(as_tuple=True)
    distances = t[ray_ids, columns]
    points = origins[ray_ids] + distances[:, None] * directions[ray_ids]
    x, y, z = torch.minimum(points.long().clamp(min=0), last).unbind(-1)
    inside = cells[x, y, z]
    return ray_ids[inside], distances[inside]


def _march_arrays(origins, directions, near, far, step, cells, jitter) -> tuple:
    """Return what the kernels march through: rays, steps, cells, the distance from each block of cells to the
    next occupied block, the bounds of all occupied cells, and the side of a block.
    """
    from forewarp.ops.kernels import voxels as kernels

    match_threads()
    reach = torch.empty([-(-n // _BLOCK) for n in cells.shape], dtype=torch.uint8)
    bounds = torch.empty(2, 3, dtype=torch.float64)
    kernels.pool_blocks(*arrays(cells, reach), _BLOCK, *arrays(bounds))
    # Keep samples that rounding moves just outside their cell; the box itself stays the limit.
    bounds += torch.tensor([[-_MARGIN], [_MARGIN]], dtype=torch.float64)
    bounds[0].clamp_(min=0)
    bounds[1] = torch.minimum(bounds[1], torch.tensor(cells.shape))
    rays = (*arrays(origins, directions), float(near), float(far), float(step))
    return *rays, *arrays(jitter, cells, reach, bounds), _BLOCK


class Traced(NamedTuple):
    """What ``trace`` finds along R rays.

    Attributes:
        opacity, distance, transmittance: (R,); ``distance`` is the sum of weight times distance.
        ray_ids, distances, weights: (P,), of the samples above the threshold.
        samples: number of samples read.
    """

    opacity: Tensor
    distance: Tensor
    transmittance: Tensor
    ray_ids: Tensor
    distances: Tensor
    weights: Tensor
    samples: int


def trace(
    origins: Tensor, directions: Tensor, near: float, far: float, step: float, cells: Tensor, jitter: Tensor,
    *, raw: Tensor, index: Tensor, fill: float, shift: float, scale: float,
    early_stop_eps: float = 0.0, threshold: float = 0.0,
) -> Traced:  # fmt: skip
    """Do ``march``, ``trilinear`` and ``render_weights`` of ``softplus(raw + shift) * scale`` in one kernel.

    Numba only, without gradient; elsewhere the three operators are called one by one.

    Args:
        origins, directions, near, far, step, cells, jitter: as for ``march``.
        raw: (M,), one channel of a sparse lattice.
        index: (X, Y, Z) int32, its rows or -1.
        fill: value of an absent voxel.
        shift, scale: shift and scale of a step's optical depth.
        early_stop_eps: end a ray once its transmittance is below this; 0: never.
        threshold: return samples of more weight than this; below 0: all.

    Raises:
        ValueError: for other shapes, or rays that cannot be marched.

    Cost: one read of 8 voxels per sample up to a ray's end, twice for returned samples; memory P.
    """
    rays = origins, directions, near, far, step, cells, jitter
    _check_march(*rays)
    sizes = {axis: n + 1 for axis, n in zip("XYZ", cells.shape)}
    check_shapes("raw (M), index (X, Y, Z)", raw, index, **sizes)
    return _marched(rays, (raw, index), fill, shift, scale, early_stop_eps, threshold)


def _marched(
    rays: tuple,
    field: tuple[Tensor, Tensor] | None = None,
    fill: float = 0.0,
    shift: float = 0.0,
    scale: float = 0.0,
    early_stop_eps: float = 0.0,
    threshold: float = 0.0,
) -> Traced:
    """Call the kernel twice: to count each ray's samples, and to write them. See ``trace``; ``field`` is raw
    and index, without which samples hide nothing, and have no weights.
    """
    from forewarp.ops.kernels import voxels as kernels

    origins, *_ = rays
    sums = torch.zeros(len(origins), 4, dtype=torch.float64)
    read, counts, firsts = torch.zeros(3, len(origins), dtype=torch.int64).unbind()
    numbers = map(float, (fill, shift, scale, early_stop_eps, threshold))
    common = (*_march_arrays(*rays), *((None, None) if field is None else arrays(*field)), *numbers)
    common += arrays(sums, read, counts, firsts)
    kernels.march(*common, *arrays(counts[:0], counts[:0], origins[:0, 0], origins[:0, 0]))
    starts, total = counts.cumsum(0) - counts, int(counts.sum())
    ids, distances = counts.new_empty(total), origins.new_empty(total)
    weights = distances[:0] if field is None else torch.empty_like(distances)
    kernels.march(*common, *arrays(starts, ids, distances, weights))
    opacity, distance, transmittance, _ = sums.to(origins.dtype).unbind(-1)
    return Traced(opacity, distance, transmittance, ids, distances, weights, int(read.sum()))


# Composite -------------------------------------------------------------------------------------------------


def render_weights(optical: Tensor, ray_ids: Tensor, rays: int) -> tuple[Tensor, Tensor]:
    """``w_k = T_k (1 - exp(-x_k))``, ``T_k = exp(-sum_{j<k} x_j)`` (the paper's rendering equations).

    One cumulative sum in float64 runs over all rays and each ray's start is subtracted, so that rays do not
    affect each other. In log space the gradient is exact even for opaque samples.

    Args:
        optical: x = sigma * delta (P,) >= 0, the samples of a ray adjacent and in order.
        ray_ids: (P,) int64, ascending.
        rays: R, number of rays.

    Returns:
        weights (P,) and the final transmittance (R,), 1 for a ray without samples. Differentiable in
        ``optical``.

    Cost: one pass over P.

    >>> w, t = render_weights(torch.tensor([0.0, 1e30]), torch.tensor([0, 0]), 2)
    >>> w.tolist(), t.round(decimals=6).tolist()
    ([0.0, 1.0], [0.0, 1.0])
    """
    check_shapes("optical (P), ray_ids (P)", optical, ray_ids)
    # An optical depth of 80 is opaque in float32; the cap keeps the global sum exact.
    x = optical.double().clamp(max=80.0)
    through = x.cumsum(0) - x
    counts = torch.bincount(ray_ids, minlength=rays)
    # A last ray without samples starts at the end.
    offset = torch.cat([through, through.new_zeros(1)])[counts.cumsum(0) - counts]
    before = (through - offset[ray_ids]).clamp(min=0)
    weights = torch.exp(-before) * -torch.expm1(-x)
    total = torch.zeros(rays, dtype=x.dtype, device=x.device).index_add(0, ray_ids, x)
    return weights.to(optical.dtype), torch.exp(-total).to(optical.dtype)


def accumulate(weights: Tensor, values: Tensor, ray_ids: Tensor, rays: int) -> Tensor:
    """Sum ``w_k v_k`` over the samples of each ray.

    Args:
        weights: (P,).
        values: (P, C).
        ray_ids: (P,) int64.
        rays: R, number of rays.

    Returns:
        (R, C), 0 for a ray without samples. Differentiable in both.
    """
    check_shapes("weights (P), values (P, C)", weights, values)
    return values.new_zeros(rays, values.shape[1]).index_add(0, ray_ids, weights[:, None] * values)


def dense_weights(optical: Tensor) -> tuple[Tensor, Tensor]:
    """``render_weights`` for rays with equal numbers of samples.

    Args:
        optical: x = sigma * delta (R, S) >= 0, in order along each ray; may be infinite.

    Returns:
        weights (R, S) and the final transmittance (R,). Differentiable in ``optical``.

    Cost: one pass over R S, in the dtype of ``optical``.

    >>> w, t = dense_weights(torch.tensor([[0.0, 1e30, 1.0]]))
    >>> w.round(decimals=6).tolist(), t.round(decimals=6).tolist()
    ([[0.0, 1.0, 0.0]], [0.0])
    """
    check_shapes("optical (R, S)", optical)
    x = optical.clamp(max=80.0)
    # Shift instead of subtracting, which would lose digits behind an opaque sample.
    before = torch.cat([torch.zeros_like(x[:, :1]), x.cumsum(1)], 1)
    through = torch.exp(-before)
    return through[:, :-1] * -torch.expm1(-x), through[:, -1]


def warm_up(device: torch.device | str = "cpu") -> None:
    """Run each operator forwards and backwards once, on two voxels per axis, without random numbers.

    Numba compiles a kernel, or reads it from its cache, at the first call, which takes seconds.
    """
    voxels = torch.cartesian_prod(*[torch.arange(2, device=device)] * 3)
    positions = voxels.float().requires_grad_()
    with torch.enable_grad():
        splat = average_splat(torch.ones_like(positions).requires_grad_(), positions, (2, 2, 2))
        read = trilinear(splat.values, splat.index, positions, positions.new_zeros(3))
        read.sum().backward()
    index = index_of(voxels, (2, 2, 2))
    cells = occupied_cells(index)
    start, along = positions.new_zeros(1, 3), positions.new_ones(1, 3)
    rays = (start.detach(), along, 0.0, 1.0, 0.5, cells, positions.new_zeros(1))
    march(*rays)
    if use_numba(positions):
        raw = positions.new_zeros(len(voxels))
        trace(*rays, raw=raw, index=index, fill=0.0, shift=0.0, scale=1.0)
