"""Numba kernels that order splats by depth and sort them into tiles, by the rules of ``kernels_grid``.

A splat is a row of ``kernels_project``: u, v, A, B, C, opacity, colour (3), distance, and how far it reaches
along both axes; one that is not seen reaches 0.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from forewarp.ops.kernels_rasterize import LEAST_LOG, RECORD, SIDE

_DIGIT = 11  # bits that are sorted by at once
_ZERO = np.float32(0)


@njit(cache=True)
def by_depth(splats):
    """Rows (V,) int32 of the splats that are seen, from near to far; equal depths in their order."""
    total = splats.shape[0]
    rows, keys = np.empty(total, np.int32), np.empty(total, np.uint32)
    count = 0
    bits = splats.view(np.uint32)
    for i in range(total):
        if splats[i, 10] > 0:
            rows[count] = i
            keys[count] = bits[i, 9]  # of positive numbers bits are ordered as they are
            count += 1
    rows, keys = rows[:count], keys[:count]
    others, their_keys = np.empty(count, np.int32), np.empty(count, np.uint32)
    for digit in range(3):
        shift = np.uint32(_DIGIT * digit)
        starts = np.zeros((1 << _DIGIT) + 1, np.int64)
        for i in range(count):
            starts[((keys[i] >> shift) & np.uint32((1 << _DIGIT) - 1)) + 1] += 1
        for i in range(1 << _DIGIT):
            starts[i + 1] += starts[i]
        for i in range(count):
            place = (keys[i] >> shift) & np.uint32((1 << _DIGIT) - 1)
            others[starts[place]], their_keys[starts[place]] = rows[i], keys[i]
            starts[place] += 1
        rows, others, keys, their_keys = others, rows, their_keys, keys
    return rows


@njit(cache=True)
def records_of(splats, order):
    """The records (V, 10) of splats in an order; see ``kernels_rasterize``."""
    records = np.empty((len(order), RECORD), np.float32)
    for k in range(len(order)):
        i = order[k]
        records[k, 0], records[k, 1] = splats[i, 0], splats[i, 1]
        records[k, 2], records[k, 3] = np.float32(-0.5) * splats[i, 2], -splats[i, 3]
        records[k, 4] = np.float32(-0.5) * splats[i, 4]
        records[k, 5] = math.log(splats[i, 5])
        for j in range(6, RECORD):
            records[k, j] = splats[i, j]
    return records


@njit(inline="always")
def _span(center, reach, count):
    """The first tile that an interval of pixels touches, and the one after the last."""
    low = min(max(center - reach, np.float32(0)), np.float32(SIDE * count))
    high = min(max(center + reach, np.float32(0)), np.float32(SIDE * count))
    return int(low) // SIDE, min(int(high) // SIDE + 1, count)


@njit(inline="always")
def _highest(a, b, c, x0, y0):
    """The largest exponent ``a x^2 + b x y + c y^2`` of a splat in a tile that begins at x0, y0 from it."""
    x1, y1 = x0 + np.float32(SIDE), y0 + np.float32(SIDE)
    x, y = min(max(_ZERO, x0), x1), min(max(_ZERO, y0), y1)
    best = _ZERO if x == 0 and y == 0 else np.float32(-np.inf)
    if x != 0:  # along the nearer upright edge
        at = min(max(np.float32(-0.5) * b * x / c, y0), y1)
        best = a * x * x + at * (b * x + c * at)
    if y != 0:
        at = min(max(np.float32(-0.5) * b * y / a, x0), x1)
        best = max(best, c * y * y + at * (b * y + a * at))
    return best


@njit(cache=True)
def _spans(splats, order, across, down):
    """The tiles (V, 4) that the box of each splat touches, first and after the last, and how many in all."""
    spans, most = np.empty((len(order), 4), np.int32), 0
    for k in range(len(order)):
        i = np.uintp(order[k])
        spans[k, 0], spans[k, 1] = _span(splats[i, 0], splats[i, 10], across)
        spans[k, 2], spans[k, 3] = _span(splats[i, 1], splats[i, 11], down)
        most += max(0, spans[k, 1] - spans[k, 0]) * max(0, spans[k, 3] - spans[k, 2])
    return spans, most


@njit(cache=True, fastmath={"contract"})
def sort_into_tiles(splats, order, records, across, down):
    """Which splats each tile has to look at, from near to far: ``entries``, and where each tile's begin.

    A tile that the ellipse of a splat, at a 255th of a pixel, does not touch is left out.
    """
    spans, most = _spans(splats, order, across, down)
    tiles, owners = np.empty(most, np.int32), np.empty(most, np.int32)
    ends = np.zeros(across * down + 1, np.int64)
    pairs = 0
    for k in range(len(order)):
        first, last, top, bottom = spans[k, 0], spans[k, 1], spans[k, 2], spans[k, 3]
        small = last - first <= 1 and bottom - top <= 1
        u, v, a, b, c = records[k, 0], records[k, 1], records[k, 2], records[k, 3], records[k, 4]
        least = np.float32(LEAST_LOG) - records[k, 5]
        for row in range(top, bottom):
            y = np.float32(SIDE * row) - v
            for column in range(first, last):
                if small or _highest(a, b, c, np.float32(SIDE * column) - u, y) >= least:
                    tile = np.uintp(row * across + column)
                    tiles[pairs], owners[pairs] = tile, k
                    ends[tile + np.uintp(1)] += 1
                    pairs += 1
    for tile in range(across * down):
        ends[tile + 1] += ends[tile]
    entries, place = np.empty(pairs, np.int32), ends[:-1].copy()
    for pair in range(pairs):
        tile = np.uintp(tiles[pair])
        entries[place[tile]] = owners[pair]
        place[tile] += 1
    return entries, ends


@njit(cache=True)
def shared_out(ends, count):
    """Cut the tiles into ``count`` runs of about as many entries each, and the longest tile's number.

    A tile without entries costs about as much as four entries.
    """
    tiles = len(ends) - 1
    shares = np.empty(count + 1, np.int64)
    whole = ends[tiles] + 4 * tiles
    shares[0], share, most = 0, 1, 0
    for tile in range(tiles):
        most = max(most, ends[tile + 1] - ends[tile])
        while share < count and (ends[tile] + 4 * tile) * count >= share * whole:
            shares[share] = tile
            share += 1
    shares[share:] = tiles
    return shares, most
