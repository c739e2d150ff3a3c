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
_ZERO, _SHARE = np.float32(0), np.float32(1 / SIDE)
_HALF = np.float32(0.5)  # a tile's first pixel's centre
_SLACK = np.float32(1e-3)  # pixels that rounding may move an edge by


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
        records[k, 5] = splats[i, 12]
        for j in range(6, RECORD):
            records[k, j] = splats[i, j]
    return records


@njit(inline="always")
def _span(low, high, count):
    """The first tile with a pixel's centre in an interval, and the one after the last."""
    most = np.float32(SIDE * (count + 1))
    low, high = low + (_HALF - _SLACK), high + (np.float32(SIDE) - _HALF + _SLACK)
    first = int(min(max(low, _ZERO), most) * _SHARE)
    return first, min(int(min(max(high, _ZERO), most) * _SHARE), count)


@njit(cache=True)
def _spans(records, splats, order, across, down):
    """The tiles (V, 4) that the box of each splat touches, first and after the last, and how many in all."""
    spans, most = np.empty((len(order), 4), np.int32), 0
    for k in range(len(order)):
        i, u, v = np.uintp(order[k]), records[k, 0], records[k, 1]
        spans[k, 0], spans[k, 1] = _span(u - splats[i, 10], u + splats[i, 10], across)
        spans[k, 2], spans[k, 3] = _span(v - splats[i, 11], v + splats[i, 11], down)
        most += max(0, spans[k, 1] - spans[k, 0]) * max(0, spans[k, 3] - spans[k, 2])
    return spans, most


@njit(cache=True, fastmath={"contract"})
def sort_into_tiles(splats, order, records, across, down):
    """Which splats each tile has to look at, from near to far: ``entries``, and where each tile's begin.

    A tile without a pixel's centre in the box of the part of a splat's ellipse, at a 255th of a pixel, that
    lies in the tile's rows is left out.
    """
    spans, most = _spans(records, splats, order, across, down)
    tiles, owners = np.empty(most, np.int32), np.empty(most, np.int32)
    ends = np.zeros(across * down + 1, np.int64)
    pairs = 0
    for k in range(len(order)):
        first, last, top, bottom = spans[k, 0], spans[k, 1], spans[k, 2], spans[k, 3]
        u, v, a, b, c = records[k, 0], records[k, 1], records[k, 2], records[k, 3], records[k, 4]
        least = np.float32(LEAST_LOG) - records[k, 5]
        single = last - first <= 1 or bottom - top <= 1  # then the box is as good
        # A level of a x^2 + b x y + c y^2 ends at (b y +- sqrt(bend y^2 + rest)) half, right end at tip.
        half, bend = np.float32(-0.5) / a, b * b - np.float32(4) * a * c
        rest, slope = np.float32(4) * a * least, b * half
        tip = np.float32(-0.5) * b / c * splats[np.uintp(order[k]), 10]
        for row in range(top, bottom):
            low, high = first, last
            if not single:
                y0 = np.float32(SIDE * row) + _HALF - v
                y1 = y0 + np.float32(SIDE - 1)
                at, to = min(max(-tip, y0), y1), min(max(tip, y0), y1)
                left = slope * at - half * math.sqrt(max(bend * at * at + rest, _ZERO))
                right = slope * to + half * math.sqrt(max(bend * to * to + rest, _ZERO))
                low, high = _span(u + left, u + right, across)
                low, high = max(low, first), min(high, last)
            for column in range(low, high):
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
