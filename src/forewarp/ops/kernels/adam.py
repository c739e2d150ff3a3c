"""Numba kernel behind ``adam``, by the rules of ``voxels``, but that it takes addresses."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.keeping import KEPT
from forewarp.ops.kernels.lanes import floats_at, get_row, not_zero, put_row, room, root, row_of, where_bits

_WORD = 64  # numbers that are treated together: a bit each says which


@cache
def biases(first: float, second: float) -> np.ndarray:
    """What moments and roots of squares are multiplied by after n steps (n, 2), float32; the last is 1, and
    of all later.
    """
    least = 2.0**-25  # half of what 1 grows by to the next float32
    count = 1 + max(math.ceil(math.log(least) / math.log(max(beta, 0.5))) for beta in (first, second))
    left, right = (beta ** np.arange(1, count + 1, dtype=np.float64) for beta in (first, second))
    later = np.stack([1 / (1 - left), np.sqrt(1 / (1 - right))], -1).astype(np.float32)
    return np.ascontiguousarray(np.concatenate([np.ones((1, 2), np.float32), later]))


@njit(inline="always")
def _side_by_side(width):
    """How many rows of so many numbers fill 16-number vectors, a word's bits at most; 0 where none do."""
    for rows in (16, 8, 4):
        if rows * width <= _WORD and rows * width % 16 == 0:
            return rows
    return 0


@njit(inline="always")
def _seen(gradient, start, count, width):
    """A bit for the first of each ``width`` of so many numbers, where any of these is not 0."""
    bits = np.uint64(0)
    for c in range(count // 16):
        bits |= not_zero(get_row(gradient, start + 16 * c)) << np.uint64(16 * c)
    seen, first = bits, np.uint64(0)
    for c in range(1, width):
        seen |= bits >> np.uint64(c)
    for c in range(0, count, width):
        first |= np.uint64(1) << np.uint64(c)
    return seen & first


@njit(parallel=True, cache=KEPT)
def adam(table, rates, first, second, eps, bias):
    """A step of P parameters; see ``adam.adam_rows``.

    Args:
        table: (P, 7) int64, of each the addresses of its values, gradients, both moments and steps, how many
            rows it has, and how many numbers a row.
        rates: (P,) float32.
        first, second, eps: as of Adam.
        bias: as of ``biases``.

    Rows that fill vectors are treated together: all are computed, and those without a gradient kept as they
    were. Where all have made so many steps that biases are 1, which soon is the rule, there is one pace. What
    is beyond the last vectors, or of a width that fills none, goes number by number.
    """
    b1, b2, c1, c2 = np.float32(first), np.float32(second), np.float32(1 - first), np.float32(1 - second)
    small, last = np.float32(eps), len(bias) - 1
    for chunk in prange(64):
        paces, scales = room(4), room(4)
        for p in range(len(table)):
            value, gradient, mean = floats_at(table[p, 0]), floats_at(table[p, 1]), floats_at(table[p, 2])
            square, steps, rate = floats_at(table[p, 3]), floats_at(table[p, 4]), rates[p]
            rows, width = table[p, 5], table[p, 6]
            together = _side_by_side(width)
            count, blocks = together * width, rows // together if together else 0
            for block in range(blocks * chunk // 64, blocks * (chunk + 1) // 64):
                start, row = count * block, together * block
                seen, settled = _seen(gradient, start, count, width), True
                if seen == 0:
                    continue
                for i in range(together):
                    made = steps[row + i] + np.float32(seen >> np.uint64(i * width) & np.uint64(1))
                    steps[row + i] = made
                    settled &= made >= last
                if not settled:
                    for i in range(together):
                        n = max(0, min(int(steps[row + i]), last))
                        for c in range(i * width, (i + 1) * width):
                            paces[c], scales[c] = rate * bias[n, 0], bias[n, 1]
                each = seen * np.uint64((1 << width) - 1)  # all of a row's bits
                for c in range(count // 16):
                    at, here = start + 16 * c, each >> np.uint64(16 * c)
                    g, m = get_row(gradient, at), get_row(mean, at)
                    v, x = get_row(square, at), get_row(value, at)
                    m, v = where_bits(here, m + (g - m) * c1, m), where_bits(here, v + (g * g - v) * c2, v)
                    put_row(mean, at, m)
                    put_row(square, at, v)
                    if settled:
                        moved = x - rate * m / (root(v) + small)
                    else:
                        moved = x - row_of(paces, c) * m / (row_of(scales, c) * root(v) + small)
                    put_row(value, at, where_bits(here, moved, x))
            done = together * blocks
            for row in range(done + (rows - done) * chunk // 64, done + (rows - done) * (chunk + 1) // 64):
                seen_row = False
                for i in range(row * width, (row + 1) * width):
                    seen_row |= gradient[i] != 0
                if not seen_row:
                    continue
                steps[row] += np.float32(1)
                n = max(0, min(int(steps[row]), last))
                for i in range(row * width, (row + 1) * width):
                    g = gradient[i]
                    mean[i], square[i] = b1 * mean[i] + c1 * g, b2 * square[i] + c2 * g * g
                    value[i] -= rate * bias[n, 0] * mean[i] / (bias[n, 1] * math.sqrt(square[i]) + small)
