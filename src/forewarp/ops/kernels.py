"""Numba kernels behind ``grid``, ``splat`` and ``march``. Imported only where Numba is installed.

Arrays are NumPy views of contiguous CPU tensors. Loops over points run in parallel where they only read;
sums into shared cells run in a fixed number of chunks, each into its own copy, so that results do not depend
on scheduling.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import get_num_threads, njit, prange, set_num_threads
from numba import config as numba_config


def match_threads() -> int:
    """Let Numba use as many threads as PyTorch does; returns that number."""
    asked = torch.get_num_threads()
    wanted = max(1, min(asked, numba_config.NUMBA_NUM_THREADS))
    if get_num_threads() != wanted:
        set_num_threads(wanted)
    if torch.get_num_threads() != asked:  # Numba's first call starts all threads of the OpenMP they share
        torch.set_num_threads(asked)
    return wanted


@njit(inline="always")
def _corner(x, n):
    base = int(min(max(np.floor(x), 0.0), n - 2.0))
    base = min(max(base, 0), n - 2)  # NaN has no whole number
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
    """out[p] = gradient with respect to the point's lattice coordinate; 0 where it is clamped."""
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
def number_touched(positions, index):
    """Give every cell that a kernel touches a row, in the lattice's order. ``index`` starts at -1.

    Positions are NaN where a voxel contributes nothing. Returns the number of rows.
    """
    nx, ny, nz = index.shape
    for q in range(positions.shape[0]):
        if np.isnan(positions[q, 0]):
            continue
        x0, y0, z0 = (
            int(np.floor(positions[q, 0])),
            int(np.floor(positions[q, 1])),
            int(np.floor(positions[q, 2])),
        )
        for a in range(2):
            for b in range(2):
                for d in range(2):
                    x, y, z = x0 + a, y0 + b, z0 + d
                    if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                        index[x, y, z] = 0
    rows = 0
    flat = index.reshape(-1)
    for i in range(flat.shape[0]):
        if flat[i] == 0:
            flat[i] = rows
            rows += 1
    return rows


@njit(parallel=True, cache=True)
def scatter(source, positions, index, out):
    """out[chunk, row] += b(u) (source[q], 1): the sums of the average splat, coverage in the last channel."""
    chunks = out.shape[0]
    channels = source.shape[1]
    total = positions.shape[0]
    nx, ny, nz = index.shape
    for chunk in prange(chunks):
        for q in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            if np.isnan(positions[q, 0]):
                continue
            x0, y0, z0 = (
                int(np.floor(positions[q, 0])),
                int(np.floor(positions[q, 1])),
                int(np.floor(positions[q, 2])),
            )
            fx, fy, fz = positions[q, 0] - x0, positions[q, 1] - y0, positions[q, 2] - z0
            for i in range(8):
                a, b, d = i >> 2, (i >> 1) & 1, i & 1
                x, y, z = x0 + a, y0 + b, z0 + d
                if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                    w = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if d else 1 - fz)
                    row = index[x, y, z]
                    for c in range(channels):
                        out[chunk, row, c] += w * source[q, c]
                    out[chunk, row, channels] += w


@njit(parallel=True, cache=True)
def scatter_backward(source, positions, index, grad, grad_source, grad_positions):
    """Gradients of ``scatter`` with respect to the values and the positions."""
    channels = source.shape[1]
    nx, ny, nz = index.shape
    for q in prange(positions.shape[0]):
        if np.isnan(positions[q, 0]):
            continue
        x0, y0, z0 = (
            int(np.floor(positions[q, 0])),
            int(np.floor(positions[q, 1])),
            int(np.floor(positions[q, 2])),
        )
        fx, fy, fz = positions[q, 0] - x0, positions[q, 1] - y0, positions[q, 2] - z0
        gx, gy, gz = 0.0, 0.0, 0.0
        for i in range(8):
            a, b, d = i >> 2, (i >> 1) & 1, i & 1
            x, y, z = x0 + a, y0 + b, z0 + d
            if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                wx, wy, wz = (fx if a else 1 - fx), (fy if b else 1 - fy), (fz if d else 1 - fz)
                w = wx * wy * wz
                row = index[x, y, z]
                dot = grad[row, channels]
                for c in range(channels):
                    grad_source[q, c] += w * grad[row, c]
                    dot += source[q, c] * grad[row, c]
                gx += dot * (1.0 if a else -1.0) * wy * wz
                gy += dot * (1.0 if b else -1.0) * wx * wz
                gz += dot * (1.0 if d else -1.0) * wx * wy
        grad_positions[q, 0], grad_positions[q, 1], grad_positions[q, 2] = gx, gy, gz


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


@njit(cache=True)
def pool_blocks(cells, blocks, block):
    """blocks = 1 where one of their ``block`` cubed cells is."""
    nx, ny, nz = cells.shape
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                if cells[x, y, z]:
                    blocks[x // block, y // block, z // block] = 1
