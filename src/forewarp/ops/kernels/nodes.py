"""Numba kernels behind ``nodes``, by the rules of ``voxels``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.keeping import KEPT
from forewarp.ops.kernels.lanes import (
    exp,
    get_row,
    maximum,
    put_row,
    room,
    row_of,
    set_row,
    sixteen,
    transpose,
)
from forewarp.ops.layout import EPSILON

_EPSILON = np.float32(EPSILON)


@njit(inline="always")
def _linear(motion, m, out):
    """``D`` (9) of a node; returns 1 + w, and the factor 2 / ((1 + w)^2 + |r|^2)."""
    x, y, z = motion[m, 3], motion[m, 4], motion[m, 5]
    a = 1.0 + motion[m, 6] if motion.shape[1] > 6 else 1.0
    square = x * x + y * y + z * z
    s = 2.0 / max(a * a + square, _EPSILON)
    out[0], out[1], out[2] = s * (x * x - square), s * (x * y - a * z), s * (x * z + a * y)
    out[3], out[4], out[5] = s * (x * y + a * z), s * (y * y - square), s * (y * z - a * x)
    out[6], out[7], out[8] = s * (x * z - a * y), s * (y * z + a * x), s * (z * z - square)
    return a, s


@njit(cache=KEPT)
def pull(motion, places, by_maps, edges, weights, gradient, factor):
    """Add to ``gradient``, of the shape of ``motion``; returns the stiffness. See ``nodes.pull_nodes``."""
    linear, by_linear, apart, strain = np.empty(9), np.empty(9), np.empty(3), np.empty(3)
    total = 0.0
    for m in range(motion.shape[0]):
        a, s = _linear(motion, m, linear)
        for r in range(3):
            gradient[m, r] += by_maps[m, 9 + r]
            for c in range(3):
                by_linear[3 * r + c] = by_maps[m, 3 * r + c] - by_maps[m, 9 + r] * places[m, c]
        for e in range(edges.shape[1]):
            l, w = edges[m, e], weights[m, e]
            for c in range(3):
                apart[c] = places[l, c] - places[m, c]
            for r in range(3):
                strain[r] = motion[l, r] - motion[m, r]
                for c in range(3):
                    strain[r] -= linear[3 * r + c] * apart[c]
                total += w * strain[r] * strain[r]
                pulled = 2.0 * factor * w * strain[r]
                gradient[l, r] += pulled
                gradient[m, r] -= pulled
                for c in range(3):
                    by_linear[3 * r + c] -= pulled * apart[c]
        x, y, z = motion[m, 3], motion[m, 4], motion[m, 5]
        d = by_linear
        trace, along = d[0] + d[4] + d[8], 0.0
        for j in range(9):
            along += d[j] * linear[j]
        by = (
            (d[0] * x + d[1] * y + d[2] * z) + (d[0] * x + d[3] * y + d[6] * z),
            (d[3] * x + d[4] * y + d[5] * z) + (d[1] * x + d[4] * y + d[7] * z),
            (d[6] * x + d[7] * y + d[8] * z) + (d[2] * x + d[5] * y + d[8] * z),
        )
        across, gibbs = (d[7] - d[5], d[2] - d[6], d[3] - d[1]), (x, y, z)
        for r in range(3):
            gradient[m, 3 + r] += s * (by[r] - 2.0 * trace * gibbs[r] + a * across[r] - along * gibbs[r])
        if motion.shape[1] > 6:
            gradient[m, 6] += s * (x * across[0] + y * across[1] + z * across[2] - along * a)
    return total


@njit(cache=KEPT)
def carry(shift, rotation, basis, places, motion, maps):
    """Fill ``motion`` and ``maps`` (M, 12), as ``nodes.carry_nodes``; ``rotation`` may be empty."""
    linear = np.empty(9)
    for m in range(shift.shape[0]):
        motion[m] = 0.0
        for k in range(shift.shape[1]):
            if basis[k] != 0:
                for c in range(3):
                    motion[m, c] += basis[k] * shift[m, k, c]
                if len(rotation):
                    for c in range(rotation.shape[2]):
                        motion[m, 3 + c] += basis[k] * rotation[m, k, c]
        _linear(motion, m, linear)
        for r in range(3):
            rest = motion[m, r]
            for c in range(3):
                maps[m, 3 * r + c] = linear[3 * r + c]
                rest -= linear[3 * r + c] * places[m, c]
            maps[m, 9 + r] = rest


@njit(cache=KEPT, error_model="numpy")
def spread(value, by_motion, basis, bend, gradient, factor, scale):
    """Fill ``gradient``, as ``value`` (M, K, C); returns the mean of b^2. See ``nodes.spread_nodes``."""
    total, count = 0.0, value.shape[0] * value.shape[2]
    for m in range(value.shape[0]):
        for c in range(value.shape[2]):
            bent = 0.0
            for k in range(value.shape[1]):
                if bend[k] != 0:
                    bent += bend[k] * value[m, k, c]
            bent /= scale
            total += bent * bent
            pulled = 2.0 * factor / (count * scale) * bent
            for k in range(value.shape[1]):
                gradient[m, k, c] = by_motion[m, c] * basis[k] + pulled * bend[k]
    return total / count


@njit(parallel=True, cache=KEPT)
def weigh(shares, learned, weights, width):
    """Fill ``weights``; all are (N L,), L is ``width``, up to 16. See ``nodes.skin_weights``.

    Sixteen particles side by side: a row is read, and written, with what follows it, up to sixteen numbers;
    the next row then puts right what is its own. What is beyond the last sixteen goes number by number.
    """
    rows = len(shares) // width
    blocks = max(0, len(shares) - 16) // (16 * width)
    for chunk in prange(64):
        numbers, parts = room(16), room(16)
        for block in range(blocks * chunk // 64, blocks * (chunk + 1) // 64):
            first = 16 * width * block
            for lane in range(16):
                set_row(numbers, lane, get_row(learned, first + width * lane))
                set_row(parts, lane, get_row(shares, first + width * lane))
            transpose(numbers)
            transpose(parts)
            top, total = row_of(numbers, 0), sixteen(0.0)
            for j in range(1, width):
                top = maximum(top, row_of(numbers, j))
            for j in range(width):
                part = row_of(parts, j) * exp(row_of(numbers, j) - top)
                set_row(parts, j, part)
                total = total + part
            inverse = sixteen(1.0) / maximum(_EPSILON, total)  # NaN stays NaN
            for j in range(width):
                set_row(parts, j, row_of(parts, j) * inverse)
            transpose(parts)
            for lane in range(16):
                at = first + width * lane
                if at + 16 <= first + 16 * width:
                    put_row(weights, at, row_of(parts, lane))
                    continue
                for j in range(width):  # another thread may have written what follows the sixteen
                    weights[at + j] = parts[16 * lane + j]
    for row in range(16 * blocks, rows):
        at, total = row * width, np.float32(0)
        top = learned[at]
        for j in range(1, width):
            top = max(top, learned[at + j])
        for j in range(width):
            weights[at + j] = shares[at + j] * np.float32(math.exp(learned[at + j] - top))
            total += weights[at + j]
        for j in range(width):
            weights[at + j] /= max(total, _EPSILON)
