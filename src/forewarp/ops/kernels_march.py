"""Numba kernels behind ``march``, by the rules of ``kernels_grid``."""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(inline="always")
def _slab(o, d, near, far, nx, ny, nz):
    t0, t1 = near, far
    for k in range(3):
        last = (nx, ny, nz)[k] - 1.0
        if d[k] == 0.0:
            if o[k] < 0.0 or o[k] > last:
                return 1.0, 0.0
        else:
            a, b = -o[k] / d[k], (last - o[k]) / d[k]
            t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    return t0, t1


@njit(parallel=True, cache=True)
def march(
    origins, directions, near, far, step, jitter, cells, blocks, block, counts, starts, ray_ids, distances
):
    """Samples in occupied cells only. With ``starts`` empty it counts, else it writes from ``starts[r]``."""
    nx, ny, nz = cells.shape[0] + 1, cells.shape[1] + 1, cells.shape[2] + 1
    for r in prange(origins.shape[0]):
        o, d = origins[r], directions[r]
        t0, t1 = _slab(o, d, near, far, nx, ny, nz)
        found = 0
        if t0 <= t1:
            k = int(np.ceil((t0 - near) / step - jitter[r]))
            k = max(k, 0)
            t = near + (k + jitter[r]) * step
            while t <= t1:
                x = min(max(int(o[0] + t * d[0]), 0), nx - 2)
                y = min(max(int(o[1] + t * d[1]), 0), ny - 2)
                z = min(max(int(o[2] + t * d[2]), 0), nz - 2)
                bx, by, bz = x // block, y // block, z // block
                if blocks[bx, by, bz] == 0:
                    exit_t = 1e30
                    for axis in range(3):
                        if d[axis] != 0.0:
                            corner = (bx, by, bz)[axis] + (1 if d[axis] > 0 else 0)
                            exit_t = min(exit_t, (corner * block - o[axis]) / d[axis])
                    k = max(k + 1, int(np.floor((exit_t - near) / step - jitter[r])))
                else:
                    if cells[x, y, z]:
                        if starts.shape[0]:
                            ray_ids[starts[r] + found] = r
                            distances[starts[r] + found] = t
                        found += 1
                    k += 1
                t = near + (k + jitter[r]) * step
        counts[r] = found


@njit(cache=True)
def pool_blocks(cells, blocks, block):
    """blocks = 1 where one of their ``block`` cubed cells is."""
    nx, ny, nz = cells.shape
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                if cells[x, y, z]:
                    blocks[x // block, y // block, z // block] = 1
