"""Numba kernels behind ``grid``, ``splat`` and ``march``. Imported only where Numba is installed.

Arrays are NumPy views of contiguous CPU tensors. Loops that write one entry per point run in parallel. Sums
into shared voxels run in a fixed number of chunks, each into its own copy, so that results do not depend on
scheduling.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.keeping import KEPT

# Grid ------------------------------------------------------------------------------------------------------


@njit(inline="always")
def _lower(x, n):
    """The lower of the two voxels of an axis around ``x``, and the fraction beyond it; clamped."""
    base = int(min(max(np.floor(x), 0.0), n - 2.0))
    base = min(max(base, 0), n - 2)  # NaN converts to any integer
    return base, min(max(x - base, 0.0), 1.0)


@njit(inline="always")
def _cell(point, index):
    """The lowest of the 8 voxels around a point (3), and the fractions beyond it; clamped to the lattice."""
    x, fx = _lower(point[0], index.shape[0])
    y, fy = _lower(point[1], index.shape[1])
    z, fz = _lower(point[2], index.shape[2])
    return x, y, z, fx, fy, fz


@njit(inline="always")
def _corner(i, fx, fy, fz):
    """Corner i of 8: its offsets along the axes, and its weights by them."""
    a, b, c = i >> 2, (i >> 1) & 1, i & 1
    return a, b, c, (fx if a else 1 - fx), (fy if b else 1 - fy), (fz if c else 1 - fz)


@njit(parallel=True, cache=KEPT)
def gather(values, index, points, fill, out):
    """out[p] = trilinear read of a sparse lattice; absent voxels read ``fill``."""
    channels = values.shape[1]
    for p in prange(points.shape[0]):
        x0, y0, z0, fx, fy, fz = _cell(points[p], index)
        for c in range(channels):
            out[p, c] = 0.0
        for i in range(8):
            a, b, d, wx, wy, wz = _corner(i, fx, fy, fz)
            w = wx * wy * wz
            row = index[x0 + a, y0 + b, z0 + d]
            if row >= 0:
                for c in range(channels):
                    out[p, c] += w * values[row, c]
            else:
                for c in range(channels):
                    out[p, c] += w * fill[c]


@njit(parallel=True, cache=KEPT)
def gather_backward_values(index, points, gradient, out):
    """out[chunk, row] += weight * gradient[p]; ``out`` holds one copy a chunk."""
    chunks, channels, total = out.shape[0], gradient.shape[1], points.shape[0]
    for chunk in prange(chunks):
        for p in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            x0, y0, z0, fx, fy, fz = _cell(points[p], index)
            for i in range(8):
                a, b, d, wx, wy, wz = _corner(i, fx, fy, fz)
                row = index[x0 + a, y0 + b, z0 + d]
                if row >= 0:
                    w = wx * wy * wz
                    for c in range(channels):
                        out[chunk, row, c] += w * gradient[p, c]


@njit(parallel=True, cache=KEPT)
def gather_backward_points(values, index, points, fill, gradient, out):
    """out[p] = gradient with respect to the point's lattice coordinate; 0 where clamped."""
    channels = values.shape[1]
    nx, ny, nz = index.shape
    for p in prange(points.shape[0]):
        x0, y0, z0, fx, fy, fz = _cell(points[p], index)
        gx, gy, gz = 0.0, 0.0, 0.0
        for i in range(8):
            a, b, d, wx, wy, wz = _corner(i, fx, fy, fz)
            row = index[x0 + a, y0 + b, z0 + d]
            dot = 0.0
            for c in range(channels):
                dot += gradient[p, c] * (values[row, c] if row >= 0 else fill[c])
            gx += dot * (1.0 if a else -1.0) * wy * wz
            gy += dot * (1.0 if b else -1.0) * wx * wz
            gz += dot * (1.0 if d else -1.0) * wx * wy
        out[p, 0] = gx if 0 <= points[p, 0] <= nx - 1 else 0.0
        out[p, 1] = gy if 0 <= points[p, 1] <= ny - 1 else 0.0
        out[p, 2] = gz if 0 <= points[p, 2] <= nz - 1 else 0.0


# Splat -----------------------------------------------------------------------------------------------------


@njit(inline="always")
def _floor(position):
    """The lowest of the 8 voxels around a position (3), and the fractions beyond it."""
    x, y, z = int(np.floor(position[0])), int(np.floor(position[1])), int(np.floor(position[2]))
    return x, y, z, position[0] - x, position[1] - y, position[2] - z


@njit(cache=KEPT)
def number_touched(positions, index):
    """Number the voxels that a kernel touches, in lattice order, in ``index`` (-1 at first); return how many.

    Voxels whose positions are NaN contribute nothing.
    """
    nx, ny, nz = index.shape
    for q in range(positions.shape[0]):
        if np.isnan(positions[q, 0]):
            continue
        x0, y0, z0 = _floor(positions[q])[:3]
        for x in range(max(x0, 0), min(x0 + 2, nx)):
            for y in range(max(y0, 0), min(y0 + 2, ny)):
                for z in range(max(z0, 0), min(z0 + 2, nz)):
                    index[x, y, z] = 0
    rows = 0
    flat = index.reshape(-1)
    for i in range(flat.shape[0]):
        if flat[i] == 0:
            flat[i] = rows
            rows += 1
    return rows


@njit(parallel=True, cache=KEPT)
def scatter(source, positions, index, out):
    """out[chunk, row] += b(u) (source[q], 1): the sums of the average splat, coverage in the last channel."""
    chunks, channels, total = out.shape[0], source.shape[1], positions.shape[0]
    nx, ny, nz = index.shape
    for chunk in prange(chunks):
        for q in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            if np.isnan(positions[q, 0]):
                continue
            x0, y0, z0, fx, fy, fz = _floor(positions[q])
            for i in range(8):
                a, b, d, wx, wy, wz = _corner(i, fx, fy, fz)
                x, y, z = x0 + a, y0 + b, z0 + d
                if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                    w = wx * wy * wz
                    row = index[x, y, z]
                    for c in range(channels):
                        out[chunk, row, c] += w * source[q, c]
                    out[chunk, row, channels] += w


@njit(parallel=True, cache=KEPT)
def scatter_backward(source, positions, index, gradient, to_source, to_positions):
    """Compute the gradients of ``scatter`` with respect to values and positions."""
    channels = source.shape[1]
    nx, ny, nz = index.shape
    for q in prange(positions.shape[0]):
        if np.isnan(positions[q, 0]):
            continue
        x0, y0, z0, fx, fy, fz = _floor(positions[q])
        gx, gy, gz = 0.0, 0.0, 0.0
        for i in range(8):
            a, b, d, wx, wy, wz = _corner(i, fx, fy, fz)
            x, y, z = x0 + a, y0 + b, z0 + d
            if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                w = wx * wy * wz
                row = index[x, y, z]
                dot = gradient[row, channels]
                for c in range(channels):
                    to_source[q, c] += w * gradient[row, c]
                    dot += source[q, c] * gradient[row, c]
                gx += dot * (1.0 if a else -1.0) * wy * wz
                gy += dot * (1.0 if b else -1.0) * wx * wz
                gz += dot * (1.0 if d else -1.0) * wx * wy
        to_positions[q, 0], to_positions[q, 1], to_positions[q, 2] = gx, gy, gz


# March -----------------------------------------------------------------------------------------------------


@njit(cache=KEPT)
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


@njit(cache=KEPT)
def _first(t, near, step, jitter):
    """Return the first step at or after distance ``t``."""
    return max(int(np.ceil((t - near) / step - jitter)), 0)


@njit(cache=KEPT)
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


@njit(cache=KEPT)
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


@njit(cache=KEPT)
def pool_blocks(cells, reach, block, bounds):
    """Fill ``reach``, the chessboard distance of each block (``block`` cells a side) to the nearest occupied
    block, and ``bounds`` (2, 3) of the occupied cells, low > high if there are none.
    """
    reach[:] = 255
    bounds[0], bounds[1] = np.inf, -np.inf
    nx, ny, nz = cells.shape
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


@njit(cache=KEPT)
def _sweep(reach, sign):
    """Sweep the chessboard distance transform, forwards or backwards."""
    nx, ny, nz = reach.shape
    for i, j, k in np.ndindex(reach.shape):
        x, y, z = (i, j, k) if sign > 0 else (nx - 1 - i, ny - 1 - j, nz - 1 - k)
        least = int(reach[x, y, z])
        if least == 0:
            continue
        for n in range(13):  # of the 27 around it, those already swept
            a, b, c = x + sign * (n // 9 - 1), y + sign * (n // 3 % 3 - 1), z + sign * (n % 3 - 1)
            if 0 <= a < nx and 0 <= b < ny and 0 <= c < nz:
                least = min(least, reach[a, b, c] + 1)
        reach[x, y, z] = least


@njit(cache=KEPT)
def _raw(raw, index, fill, x, y, z):
    """Interpolate one channel of a sparse lattice."""
    x0, y0, z0, fx, fy, fz = _cell((x, y, z), index)
    total = 0.0
    for i in range(8):
        a, b, c, wx, wy, wz = _corner(i, fx, fy, fz)
        row = index[x0 + a, y0 + b, z0 + c]
        total += wx * wy * wz * (raw[row] if row >= 0 else fill)
    return total


@njit(parallel=True, cache=KEPT)
def march(
    origins, directions, near, far, step, jitter, cells, reach, bounds, block, raw, index, fill,
    shift, scale, early_stop_eps, threshold, sums, read, counts, firsts, starts, ray_ids, distances, weights,
):  # fmt: skip
    """If ``starts`` is empty, compute each ray's ``sums`` (opacity, distance, transmittance), the number of
    samples read, and of those above the threshold the number, the first step and the transmittance before it
    (last column of ``sums``). Else write the samples above the threshold from ``starts[r]`` on.

    Where ``raw`` is None, nothing is read: samples hide nothing, and no ``weights`` are written.
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
            weight, passed = 1.0, 1.0
            if raw is not None:
                v = _raw(raw, index, fill, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]) + shift
                # The optical depth of a step: softplus(raw + shift) * scale.
                x = min((v if v > 20 else np.log1p(np.exp(v))) * scale, 80.0)
                weight, passed = through * -np.expm1(-x), np.exp(-x)
            if weight > threshold:
                if not counting:
                    ray_ids[starts[r] + found] = r
                    distances[starts[r] + found] = t
                    if raw is not None:
                        weights[starts[r] + found] = weight
                elif found == 0:
                    firsts[r] = k
                    sums[r, 3] = through
                found += 1
            if counting:
                opacity += weight
                distance += weight * t
                read[r] += 1
            through *= passed
            k += 1
        if counting:
            sums[r, 0], sums[r, 1], sums[r, 2] = opacity, distance, through
            counts[r] = found
