"""Numba kernels behind ``march`` and ``trace``, by the rules of ``kernels_grid``."""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(cache=True)
def _span(o, d, near, far, bounds):
    """Return the interval of a ray within ``bounds`` (2, 3); its end precedes its start if it misses."""
    t0, t1 = near, far
    for axis in range(3):
        low, high = bounds[0, axis], bounds[1, axis]
        if d[axis] == 0.0:
            if o[axis] < low or o[axis] > high:
                return 1.0, 0.0
        else:
            a, b = (low - o[axis]) / d[axis], (high - o[axis]) / d[axis]
            t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    return t0, t1


@njit(cache=True)
def _first(t, near, step, jitter):
    """Return the first step at or after distance ``t``."""
    return max(int(np.ceil((t - near) / step - jitter)), 0)


@njit(cache=True)
def _leap(o, d, x, y, z, reach, block, end):
    """Return the distance at which a ray leaves the empty blocks around it, ``reach`` in all directions."""
    for axis in range(3):
        if d[axis] != 0.0:
            at = (x, y, z)[axis] // block
            corner = at + reach if d[axis] > 0 else at - reach + 1
            leaves = (corner * block - o[axis]) / d[axis]
            if leaves < end:
                end = leaves
    return end


@njit(cache=True)
def _seek(o, d, k, near, step, jitter, end, cells, reach, block):
    """Return the next step from ``k`` on in an occupied cell, and its distance; beyond ``end`` if none."""
    nx, ny, nz = cells.shape
    t = near + (k + jitter) * step
    while t <= end:
        x = min(max(int(o[0] + t * d[0]), 0), nx - 1)
        y = min(max(int(o[1] + t * d[1]), 0), ny - 1)
        z = min(max(int(o[2] + t * d[2]), 0), nz - 1)
        blocks = reach[x // block, y // block, z // block]
        if blocks == 0:
            if cells[x, y, z]:
                break
            k += 1
        else:
            to = _leap(o, d, x, y, z, blocks, block, end + 2 * step)
            k = max(k + 1, _first(to - 1e-6 * step, near, step, jitter))  # not too far, in spite of rounding
        t = near + (k + jitter) * step
    return k, t


@njit(parallel=True, cache=True)
def march(
    origins, directions, near, far, step, jitter, cells, reach, bounds, block, counts, firsts, starts,
    ray_ids, distances,
):  # fmt: skip
    """Count each ray's samples and note its first step if ``starts`` is empty; else write the samples from
    ``starts[r]`` on.
    """
    counting = starts.shape[0] == 0
    for r in prange(origins.shape[0]):
        o, d = origins[r], directions[r]
        t0, t1 = _span(o, d, near, far, bounds)
        if t0 > t1 or (not counting and counts[r] == 0):
            continue
        k = _first(t0, near, step, jitter[r]) if counting else firsts[r]
        found, t = 0, near
        while True:
            k, t = _seek(o, d, k, near, step, jitter[r], t1, cells, reach, block)
            if not t <= t1:
                break
            if not counting:
                ray_ids[starts[r] + found] = r
                distances[starts[r] + found] = t
            elif found == 0:
                firsts[r] = k
            found += 1
            if not counting and found == counts[r]:
                break
            k += 1
        if counting:
            counts[r] = found


@njit(cache=True)
def pool_blocks(cells, reach, block, bounds):
    """Fill ``reach``, the chessboard distance of each block (``block`` cells a side) to the nearest occupied
    block, and ``bounds`` (2, 3) of the occupied cells, low > high if there are none.
    """
    nx, ny, nz = cells.shape
    far = 255
    reach[:] = far
    bounds[0] = np.inf
    bounds[1] = -np.inf
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                if cells[x, y, z]:
                    reach[x // block, y // block, z // block] = 0
                    bounds[0, 0], bounds[1, 0] = min(bounds[0, 0], x), max(bounds[1, 0], x + 1)
                    bounds[0, 1], bounds[1, 1] = min(bounds[0, 1], y), max(bounds[1, 1], y + 1)
                    bounds[0, 2], bounds[1, 2] = min(bounds[0, 2], z), max(bounds[1, 2], z + 1)
    _sweep(reach, 1)
    _sweep(reach, -1)


@njit(cache=True)
def _sweep(reach, sign):
    """Sweep the chessboard distance transform, forwards or backwards."""
    nx, ny, nz = reach.shape
    for i in range(nx):
        x = i if sign > 0 else nx - 1 - i
        for j in range(ny):
            y = j if sign > 0 else ny - 1 - j
            for k in range(nz):
                z = k if sign > 0 else nz - 1 - k
                least = int(reach[x, y, z])
                if least == 0:
                    continue
                for n in range(13):  # of the 27 around it, those already swept
                    a, b, c = x + sign * (n // 9 - 1), y + sign * (n // 3 % 3 - 1), z + sign * (n % 3 - 1)
                    if 0 <= a < nx and 0 <= b < ny and 0 <= c < nz:
                        least = min(least, reach[a, b, c] + 1)
                reach[x, y, z] = least
