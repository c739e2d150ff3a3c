"""March, interpolate and composite in one pass, for images on the CPU."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forewarp.ops.backend import match_threads
from forewarp.ops.checks import check_shape
from forewarp.ops.grid import _array
from forewarp.ops.march import check_march, map_cells


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
    origins: Tensor,
    directions: Tensor,
    near: float,
    far: float,
    step: float,
    cells: Tensor,
    jitter: Tensor,
    *,
    raw: Tensor,
    index: Tensor,
    fill: float,
    shift: float,
    scale: float,
    early_stop_eps: float = 0.0,
    threshold: float = 0.0,
) -> Traced:
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
    check_march(origins, directions, near, far, step, jitter)
    check_shape("raw", raw, ("M",))
    check_shape("index", index, tuple(n + 1 for n in cells.shape))
    from forewarp.ops import kernels_trace as kernels

    match_threads()
    sums = torch.zeros(len(origins), 4, dtype=torch.float64)
    read, counts, firsts = torch.zeros(3, len(origins), dtype=torch.int64).unbind()
    common = (*(_array(v) for v in (origins, directions)), *map(float, (near, far, step)), _array(jitter))
    common = (*common, *map_cells(cells), _array(raw), _array(index))
    common = (*common, *map(float, (fill, shift, scale, early_stop_eps, threshold)))
    common = (*common, *(v.numpy() for v in (sums, read, counts, firsts)))
    ids, none = torch.zeros(0, dtype=torch.int64), origins.new_zeros(0)
    kernels.trace(*common, *(v.numpy() for v in (ids, ids, none, none)))
    starts, total = counts.cumsum(0) - counts, int(counts.sum())
    ids, distances, weights = torch.empty(total, dtype=torch.int64), *origins.new_empty(2, total).unbind()
    kernels.trace(*common, *(v.numpy() for v in (starts, ids, distances, weights)))
    opacity, distance, transmittance, _ = sums.to(origins.dtype).unbind(-1)
    return Traced(opacity, distance, transmittance, ids, distances, weights, int(read.sum()))
