"""Numba kernels behind ``nodes``, by the rules of ``voxels``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.lanes import (
    at_least,
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
from forewarp.ops.nodes import LEAST


@njit(inline="always")
def _linear(motion, m, out):
    """``D`` (9) of a node; returns the factor 2 / (1 + |r|^2)."""
    x, y, z = motion[m, 3], motion[m, 4], motion[m, 5]
    square = x * x + y * y + z * z
    s = 2.0 / (1.0 + square)
    out[0], out[1], out[2] = s * (x * x - square), s * (x * y - z), s * (x * z + y)
    out[3], out[4], out[5] = s * (x * y + z), s * (y * y - square), s * (y * z - x)
    out[6], out[7], out[8] = s * (x * z - y), s * (y * z + x), s * (z * z - square)
    return s


@njit(cache=True)
def pull(motion, places, by_maps, edges, weights, found, factor):
    """Fill ``found`` (M, 6); returns the stiffness. See ``nodes.pull_nodes``."""
    linear, slope, apart, strain = np.empty(9), np.empty(9), np.empty(3), np.empty(3)
    total = 0.0
    for m in range(motion.shape[0]):
        s = _linear(motion, m, linear)
        for r in range(3):
            found[m, r] += by_maps[m, 9 + r]
            for c in range(3):
                slope[3 * r + c] = by_maps[m, 3 * r + c] - by_maps[m, 9 + r] * places[m, c]
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
                found[l, r] += pulled
                found[m, r] -= pulled
                for c in range(3):
                    slope[3 * r + c] -= pulled * apart[c]
        x, y, z = motion[m, 3], motion[m, 4], motion[m, 5]
        trace, along = slope[0] + slope[4] + slope[8], 0.0
        for j in range(9):
            along += slope[j] * linear[j]
        by = (
            (slope[0] * x + slope[1] * y + slope[2] * z) + (slope[0] * x + slope[3] * y + slope[6] * z),
            (slope[3] * x + slope[4] * y + slope[5] * z) + (slope[1] * x + slope[4] * y + slope[7] * z),
            (slope[6] * x + slope[7] * y + slope[8] * z) + (slope[2] * x + slope[5] * y + slope[8] * z),
        )
        across = (slope[7] - slope[5], slope[2] - slope[6], slope[3] - slope[1])
        turn = (x, y, z)
        for r in range(3):
            found[m, 3 + r] += s * (by[r] - 2.0 * trace * turn[r] + across[r] - along * turn[r])
    return total


@njit(cache=True)
def carry(shift, turn, basis, places, motion, maps):
    """Fill ``motion`` (M, 6) and ``maps`` (M, 12), as ``nodes.carry_nodes``; ``turn`` may be empty."""
    linear = np.empty(9)
    for m in range(shift.shape[0]):
        for c in range(3):
            went, turned = 0.0, 0.0
            for k in range(shift.shape[1]):
                if basis[k] != 0:
                    went += basis[k] * shift[m, k, c]
                    if len(turn):
                        turned += basis[k] * turn[m, k, c]
            motion[m, c], motion[m, 3 + c] = went, turned
        _linear(motion, m, linear)
        for r in range(3):
            rest = motion[m, r]
            for c in range(3):
                maps[m, 3 * r + c] = linear[3 * r + c]
                rest -= linear[3 * r + c] * places[m, c]
            maps[m, 9 + r] = rest


@njit(cache=True, error_model="numpy")
def spread(value, slope, basis, bend, gradient, factor, scale):
    """Fill ``gradient`` (M, K, 3); returns the mean of the squared bend. See ``nodes.spread_nodes``."""
    total, many = 0.0, 3 * value.shape[0]
    for m in range(value.shape[0]):
        for c in range(3):
            bent = 0.0
            for k in range(value.shape[1]):
                if bend[k] != 0:
                    bent += bend[k] * value[m, k, c]
            bent /= scale
            total += bent * bent
            pulled = 2.0 * factor / (many * scale) * bent
            for k in range(value.shape[1]):
                gradient[m, k, c] = slope[m, c] * basis[k] + pulled * bend[k]
    return total / many


_LEAST = np.float32(LEAST)


@njit(parallel=True, cache=True)
def weigh(shares, learned, weights, width):
    """Fill ``weights``; all are (N L,), L is ``width``, up to 16. See ``skin.skin_weights``.

    Sixteen particles side by side: a row is read, and written, with what follows it, up to sixteen numbers;
    the next row then puts right what is its own. What is beyond the last sixteen goes number by number.
    """
    rows = len(shares) // width
    blocks = max(0, len(shares) - 16) // (16 * width)
    for chunk in prange(64):
        numbers, own = room(16), room(16)
        for block in range(blocks * chunk // 64, blocks * (chunk + 1) // 64):
            first = 16 * width * block
            for lane in range(16):
                set_row(numbers, lane, get_row(learned, first + width * lane))
                set_row(own, lane, get_row(shares, first + width * lane))
            transpose(numbers)
            transpose(own)
            top, total = row_of(numbers, 0), sixteen(0.0)
            for j in range(1, width):
                top = maximum(top, row_of(numbers, j))
            for j in range(width):
                part = row_of(own, j) * exp(row_of(numbers, j) - top)
                set_row(own, j, part)
                total = total + part
            inverse = sixteen(1.0) / at_least(total, _LEAST)
            for j in range(width):
                set_row(own, j, row_of(own, j) * inverse)
            transpose(own)
            for lane in range(16):
                at = first + width * lane
                if at + 16 <= first + 16 * width:
                    put_row(weights, at, row_of(own, lane))
                    continue
                for j in range(width):  # another thread may have written what follows the sixteen
                    weights[at + j] = own[16 * lane + j]
    for row in range(16 * blocks, rows):
        at, total = row * width, np.float32(0)
        top = learned[at]
        for j in range(1, width):
            top = max(top, learned[at + j])
        for j in range(width):
            weights[at + j] = shares[at + j] * np.float32(math.exp(learned[at + j] - top))
            total += weights[at + j]
        for j in range(width):
            weights[at + j] /= max(total, _LEAST)
