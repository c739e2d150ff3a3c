"""Numba kernels behind ``splat``, by the rules of ``kernels_grid``."""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(inline="always")
def _floor(position):
    return int(np.floor(position[0])), int(np.floor(position[1])), int(np.floor(position[2]))


@njit(cache=True)
def number_touched(positions, index):
    """Number the voxels that a kernel touches, in lattice order, in ``index`` (-1 at first); return how many.

    Voxels whose positions are NaN contribute nothing.
    """
    nx, ny, nz = index.shape
    for q in range(positions.shape[0]):
        if np.isnan(positions[q, 0]):
            continue
        x0, y0, z0 = _floor(positions[q])
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
            x0, y0, z0 = _floor(positions[q])
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
    """Compute the gradients of ``scatter`` with respect to values and positions."""
    channels = source.shape[1]
    nx, ny, nz = index.shape
    for q in prange(positions.shape[0]):
        if np.isnan(positions[q, 0]):
            continue
        x0, y0, z0 = _floor(positions[q])
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
