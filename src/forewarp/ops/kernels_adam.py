"""Numba kernel behind ``adam``, by the rules of ``kernels_grid``."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numba import njit, prange

from forewarp.ops.lanes import root, where_above
from forewarp.ops.lanes_arrays import get_row, put_row, room, row_of

_WIDEST = 16  # numbers of a row that are treated so
KNOWN = 2048  # steps after which a beta's power is taken for 0


@cache
def biases(first: float, second: float) -> np.ndarray:
    """What moments and roots of squares are multiplied by after n steps (n, 2); the last is of all later."""
    left, right = (beta ** np.arange(1, KNOWN + 1, dtype=np.float64) for beta in (first, second))
    found = np.stack([1 / (1 - left), np.sqrt(1 / (1 - right))], -1).astype(np.float32)
    return np.ascontiguousarray(np.concatenate([np.ones((1, 2), np.float32), found]))


@njit(inline="always")
def _seen(gradient, row, width):
    """Whether a row has a gradient."""
    for i in range(row * width, (row + 1) * width):  # noqa: SIM110 (Numba takes no generator here)
        if gradient[i] != 0:
            return True
    return False


@njit(inline="always")
def _step_alike(value, gradient, mean, square, steps, block, width, rooms, numbers):
    """A step of sixteen rows of one pace; rows without a gradient are put back as they were."""
    c1, c2, pace, scale, small = numbers
    means, squares, values = rooms
    seen = 0
    for lane in range(16):
        row = 16 * block + lane
        if _seen(gradient, row, width):
            steps[row] += np.float32(1)
            seen |= 1 << lane
            continue
        for c in range(width):
            at, to = row * width + c, lane * width + c
            means[to], squares[to], values[to] = mean[at], square[at], value[at]
    if seen == 0:
        return
    for c in range(width):
        at = 16 * (width * block + c)
        g, m, v = get_row(gradient, at), get_row(mean, at), get_row(square, at)
        m, v = m + (g - m) * c1, v + (g * g - v) * c2
        put_row(mean, at, m)
        put_row(square, at, v)
        put_row(value, at, get_row(value, at) - pace * m / (scale * root(v) + small))
    for lane in range(16):
        if not seen >> lane & 1:
            for c in range(width):
                at, to = (16 * block + lane) * width + c, lane * width + c
                mean[at], square[at], value[at] = means[to], squares[to], values[to]


@njit(parallel=True, cache=True)
def adam(value, gradient, mean, square, steps, rate, first, second, eps, bias):
    """See ``adam.adam_rows``; all are (R C,), steps (R,), ``bias`` as of ``biases``.

    Sixteen rows at once, whose numbers lie side by side in C vectors; what is beyond the last sixteen, or
    wider than a room, number by number. Rows that have all made so many steps that biases are 1, which soon
    is the rule, have one pace.
    """
    rows = len(steps)
    width = len(value) // max(rows, 1)
    b1, b2, c1, c2 = np.float32(first), np.float32(second), np.float32(1 - first), np.float32(1 - second)
    small, whole = np.float32(eps), np.float32(rate)
    blocks = rows // 16 if width <= _WIDEST else 0
    for chunk in prange(64):
        paces, scales, values = room(_WIDEST), room(_WIDEST), room(_WIDEST)
        for block in range(blocks * chunk // 64, blocks * (chunk + 1) // 64):
            any_seen, known = False, True
            for row in range(16 * block, 16 * block + 16):
                known &= steps[row] >= KNOWN
            if known:
                _step_alike(
                    value, gradient, mean, square, steps, block, width, (paces, scales, values),
                    (c1, c2, whole * bias[KNOWN, 0], bias[KNOWN, 1], small),
                )  # fmt: skip
                continue
            for lane in range(16):
                row, pace, scale = 16 * block + lane, np.float32(0), np.float32(0)  # 0: not seen
                if _seen(gradient, row, width):
                    any_seen = True
                    steps[row] += np.float32(1)
                    n = max(0, min(int(steps[row]), KNOWN))
                    pace, scale = whole * bias[n, 0], bias[n, 1]
                for c in range(width):
                    paces[width * lane + c], scales[width * lane + c] = pace, scale
            if not any_seen:
                continue
            for c in range(width):
                at = 16 * (width * block + c)
                pace, scale, g = row_of(paces, c), row_of(scales, c), get_row(gradient, at)
                m, v = get_row(mean, at), get_row(square, at)
                put_row(mean, at, m + where_above(scale, np.float32(0), (g - m) * c1))
                put_row(square, at, v + where_above(scale, np.float32(0), (g * g - v) * c2))
                m, v = get_row(mean, at), get_row(square, at)
                step = where_above(scale, np.float32(0), pace * m / (scale * root(v) + small))
                put_row(value, at, get_row(value, at) - step)
    for row in range(16 * blocks, rows):
        if not _seen(gradient, row, width):
            continue
        steps[row] += np.float32(1)
        n = max(0, min(int(steps[row]), KNOWN))
        for i in range(row * width, (row + 1) * width):
            g = gradient[i]
            mean[i], square[i] = b1 * mean[i] + c1 * g, b2 * square[i] + c2 * g * g
            value[i] -= whole * bias[n, 0] * mean[i] / (bias[n, 1] * math.sqrt(square[i]) + small)
