"""Numba kernel behind ``skin``, by the rules of ``kernels_grid``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from forewarp.ops.lanes import at_least, maximum, sixteen
from forewarp.ops.lanes_arrays import get_row, put_row, room, row_of, set_row, transpose
from forewarp.ops.lanes_math import exp
from forewarp.ops.skin import LEAST

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
