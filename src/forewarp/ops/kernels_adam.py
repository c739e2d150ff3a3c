"""Numba kernel behind ``adam``, by the rules of ``kernels_grid``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

_KNOWN = 2048  # steps after which a beta's power is taken for 0


@njit(parallel=True, cache=True, fastmath={"contract"})
def adam(value, gradient, mean, square, steps, rate, first, second, eps):
    """See ``adam.adam_rows``; all are (R, C), steps (R,)."""
    rows, width = value.shape
    bias = np.ones((_KNOWN, 2), np.float32)
    left, right = 1.0, 1.0
    for n in range(1, _KNOWN):
        left, right = left * first, right * second
        bias[n, 0], bias[n, 1] = rate / (1.0 - left), math.sqrt(1.0 / (1.0 - right))
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
            n = min(int(steps[i]), _KNOWN)
            pace = bias[n, 0] if n < _KNOWN else whole
            scale = bias[n, 1] if n < _KNOWN else np.float32(1)
            for c in range(width):
                g = gradient[i, c]
                m = b1 * mean[i, c] + c1 * g
                v = b2 * square[i, c] + c2 * g * g
                mean[i, c], square[i, c] = m, v
                value[i, c] -= pace * m / (scale * math.sqrt(v) + small)
