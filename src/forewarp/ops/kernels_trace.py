"""Numba kernel behind ``trace``, by the rules of ``kernels_grid``."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels_grid import _corner
from forewarp.ops.kernels_march import _first, _seek, _span


@njit(cache=True)
def _raw(raw, index, fill, x, y, z):
    """Interpolate one channel of a sparse lattice."""
    nx, ny, nz = index.shape
    x0, fx = _corner(x, nx)
    y0, fy = _corner(y, ny)
    z0, fz = _corner(z, nz)
    total = 0.0
    for i in range(8):
        a, b, c = i >> 2, (i >> 1) & 1, i & 1
        w = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)
        row = index[x0 + a, y0 + b, z0 + c]
        total += w * (raw[row] if row >= 0 else fill)
    return total


@njit(cache=True)
def _optical(raw, shift, scale):
    """Return the optical depth of a step, ``softplus(raw + shift) * scale``, at most 80."""
    v = raw + shift
    return min((v if v > 20 else np.log1p(np.exp(v))) * scale, 80.0)


@njit(parallel=True, cache=True)
def trace(
    origins, directions, near, far, step, jitter, cells, reach, bounds, block, raw, index, fill,
    shift, scale, early_stop_eps, threshold, sums, read, counts, firsts, starts, ray_ids, distances, weights,
):  # fmt: skip
    """If ``starts`` is empty, compute each ray's ``sums`` (opacity, distance, transmittance), the number of
    samples read, and of those above the threshold the number, the first step and the transmittance before it
    (last column of ``sums``). Else write the samples above the threshold from ``starts[r]`` on.
    """
    counting = starts.shape[0] == 0
    for r in prange(origins.shape[0]):
        o, d = origins[r], directions[r]
        t0, t1 = _span(o, d, near, far, bounds)
        if t0 > t1 or (not counting and counts[r] == 0):
            if counting:
                sums[r, 2] = 1.0
            continue
        k = _first(t0, near, step, jitter[r]) if counting else firsts[r]
        through = 1.0 if counting else sums[r, 3]
        opacity, distance, found, t = 0.0, 0.0, 0, near
        while through >= early_stop_eps and (counting or found < counts[r]):
            k, t = _seek(o, d, k, near, step, jitter[r], t1, cells, reach, block)
            if not t <= t1:
                break
            value = _raw(raw, index, fill, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2])
            x = _optical(value, shift, scale)
            weight = through * -np.expm1(-x)
            if weight > threshold:
                if not counting:
                    ray_ids[starts[r] + found] = r
                    distances[starts[r] + found] = t
                    weights[starts[r] + found] = weight
                elif found == 0:
                    firsts[r] = k
                    sums[r, 3] = through
                found += 1
            if counting:
                opacity += weight
                distance += weight * t
                read[r] += 1
            through *= np.exp(-x)
            k += 1
        if counting:
            sums[r, 0], sums[r, 1], sums[r, 2] = opacity, distance, through
            counts[r] = found
