"""Numba kernels behind ``grid``. Imported only where Numba is installed.

Arrays are NumPy views of contiguous CPU tensors. Loops that write one entry per point run in parallel. Sums
into shared voxels run in a fixed number of chunks, each into its own copy, so that results do not depend on
scheduling.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(inline="always")
def _corner(x, n):
    base = int(min(max(np.floor(x), 0.0), n - 2.0))
    base = min(max(base, 0), n - 2)  # NaN converts to any integer
    return base, min(max(x - base, 0.0), 1.0)


@njit(parallel=True, cache=True, fastmath=False)
def gather(values, index, points, fill, out):
    """out[p] = trilinear read of a sparse lattice; absent voxels read ``fill``."""
    channels = values.shape[1]
    nx, ny, nz = index.shape
    for p in prange(points.shape[0]):
        x0, fx = _corner(points[p, 0], nx)
        y0, fy = _corner(points[p, 1], ny)
        z0, fz = _corner(points[p, 2], nz)
        for c in range(channels):
            out[p, c] = 0.0
        for i in range(8):
            a, b, d = i >> 2, (i >> 1) & 1, i & 1
            w = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if d else 1 - fz)
            row = index[x0 + a, y0 + b, z0 + d]
            if row >= 0:
                for c in range(channels):
                    out[p, c] += w * values[row, c]
            else:
                for c in range(channels):
                    out[p, c] += w * fill[c]


@njit(parallel=True, cache=True)
def gather_backward_values(index, points, grad, out):
    """out[chunk, row] += weight * grad[p]; ``out`` holds one copy a chunk."""
    chunks = out.shape[0]
    channels = grad.shape[1]
    total = points.shape[0]
    nx, ny, nz = index.shape
    for chunk in prange(chunks):
        for p in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            x0, fx = _corner(points[p, 0], nx)
            y0, fy = _corner(points[p, 1], ny)
            z0, fz = _corner(points[p, 2], nz)
            for i in range(8):
                a, b, d = i >> 2, (i >> 1) & 1, i & 1
                row = index[x0 + a, y0 + b, z0 + d]
                if row >= 0:
                    w = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if d else 1 - fz)
                    for c in range(channels):
                        out[chunk, row, c] += w * grad[p, c]


@njit(parallel=True, cache=True)
def gather_backward_points(values, index, points, fill, grad, out):
    """out[p] = gradient with respect to the point's lattice coordinate; 0 where clamped."""
    channels = values.shape[1]
    nx, ny, nz = index.shape
    for p in prange(points.shape[0]):
        x0, fx = _corner(points[p, 0], nx)
        y0, fy = _corner(points[p, 1], ny)
        z0, fz = _corner(points[p, 2], nz)
        gx, gy, gz = 0.0, 0.0, 0.0
        for i in range(8):
            a, b, d = i >> 2, (i >> 1) & 1, i & 1
            wx, wy, wz = (fx if a else 1 - fx), (fy if b else 1 - fy), (fz if d else 1 - fz)
            row = index[x0 + a, y0 + b, z0 + d]
            dot = 0.0
            for c in range(channels):
                dot += grad[p, c] * (values[row, c] if row >= 0 else fill[c])
            gx += dot * (1.0 if a else -1.0) * wy * wz
            gy += dot * (1.0 if b else -1.0) * wx * wz
            gz += dot * (1.0 if d else -1.0) * wx * wy
        out[p, 0] = gx if 0 <= points[p, 0] <= nx - 1 else 0.0
        out[p, 1] = gy if 0 <= points[p, 1] <= ny - 1 else 0.0
        out[p, 2] = gz if 0 <= points[p, 2] <= nz - 1 else 0.0


@njit(cache=True)
def mark_cells(index, keep, cells):
    """cells[x, y, z] = 1 where a corner of the cell is present and kept."""
    nx, ny, nz = index.shape
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                row = index[x, y, z]
                if row >= 0 and keep[row]:
                    for a in range(max(x - 1, 0), min(x + 1, nx - 1)):
                        for b in range(max(y - 1, 0), min(y + 1, ny - 1)):
                            for d in range(max(z - 1, 0), min(z + 1, nz - 1)):
                                cells[a, b, d] = 1
