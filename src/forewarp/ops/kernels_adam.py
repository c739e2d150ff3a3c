"""Numba kernel behind ``adam``, by the rules of ``kernels_grid``."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numba import njit, prange

KNOWN = 2048  # steps after which a beta's power is taken for 0


@cache
def biases(first: float, second: float) -> np.ndarray:
    """What moments and roots of squares are multiplied by after n steps (n, 2); the last is of all later."""
    left, right = (beta ** np.arange(1, KNOWN + 1, dtype=np.float64) for beta in (first, second))
    found = np.stack([1 / (1 - left), np.sqrt(1 / (1 - right))], -1).astype(np.float32)
    return np.ascontiguousarray(np.concatenate([np.ones((1, 2), np.float32), found]))


@njit(parallel=True, cache=True, fastmath={"contract"})
def adam(value, gradient, mean, square, steps, rate, first, second, eps, bias):
    """See ``adam.adam_rows``; all are (R, C), steps (R,), ``bias`` as of ``biases``."""
    rows, width = value.shape
    b1, b2, c1, c2 = np.float32(first), np.float32(second), np.float32(1 - first), np.float32(1 - second)
    small, whole = np.float32(eps), np.float32(rate)
    for chunk in prange(64):
        for r in range(rows * chunk // 64, rows * (chunk + 1) // 64):
            i = np.uintp(r)
            seen = False
            for c in range(width):
                seen |= gradient[i, c] != 0
            if not seen:
                continue
            steps[i] += np.float32(1)
            n = min(int(steps[i]), KNOWN)
            pace = whole * bias[n, 0]
            scale = bias[n, 1]
            for c in range(width):
                g = gradient[i, c]
                m = b1 * mean[i, c] + c1 * g
                v = b2 * square[i, c] + c2 * g * g
                mean[i, c], square[i, c] = m, v
                value[i, c] -= pace * m / (scale * math.sqrt(v) + small)
