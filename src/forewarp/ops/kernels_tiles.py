"""Numba kernels that order splats by depth and sort them into tiles, by the rules of ``kernels_grid``.

A splat is a row of ``kernels_project``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

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


@njit(forceinline=True)
def _record(splats, i, k, records):
    """Write the record of splat i to the row k of ``records``; see ``kernels_rasterize``."""
    records[k, 0], records[k, 1] = splats[i, 0], splats[i, 1]
    records[k, 2], records[k, 3] = np.float32(-0.5) * splats[i, 2], -splats[i, 3]
    records[k, 4] = np.float32(-0.5) * splats[i, 4]
    records[k, 5] = splats[i, 12]
    for j in range(6, RECORD):
        records[k, j] = splats[i, j]


@njit(inline="always")
def _span(low, high, count):
    """The first tile with a pixel's centre in an interval, and the one after the last."""
    most = np.float32(SIDE * (count + 1))
    low, high = low + (_HALF - _SLACK), high + (np.float32(SIDE) - _HALF + _SLACK)
    first = int(min(max(low, _ZERO), most) * _SHARE)
    return first, min(int(min(max(high, _ZERO), most) * _SHARE), count)


@njit(forceinline=True, fastmath={"contract"})
def _in_row(records, k, reach, row, across):
    """The tiles of a row that the part of a splat's ellipse in that row touches, first and after the last.

    The ellipse is the level of a 255th, ``a x^2 + b x y + c y^2``; its upper and lower end at a height y are
    at ``(b y -+ sqrt(bend y^2 + rest)) half``, its right end, ``reach`` away, at the height ``tip``.
    """
    u, v, a, b, c = records[k, 0], records[k, 1], records[k, 2], records[k, 3], records[k, 4]
    half, bend = np.float32(-0.5) / a, b * b - np.float32(4) * a * c
    rest, slope = np.float32(4) * a * (np.float32(LEAST_LOG) - records[k, 5]), b * half
    tip = np.float32(-0.5) * b / c * reach
    top = np.float32(SIDE * row) + _HALF - v
    bottom = top + np.float32(SIDE - 1)
    at, to = min(max(-tip, top), bottom), min(max(tip, top), bottom)
    left = slope * at - half * math.sqrt(max(bend * at * at + rest, _ZERO))
    right = slope * to + half * math.sqrt(max(bend * to * to + rest, _ZERO))
    return _span(u + left, u + right, across)


@njit(parallel=True, cache=True)
def sort_into_tiles(splats, order, across, down, shares):
    """The ``records`` (V, 10) of splats in an order, which of them each tile has to look at, from near to
    far (``entries``), and where each tile's begin.

    A tile without a pixel's centre in the box of the part of a splat's ellipse that lies in the tile's rows
    is left out. ``shares`` threads take a part of the splats each; the result does not depend on them.
    """
    count, whole = len(order), across * down
    records, spans = np.empty((count, RECORD), np.float32), np.empty((count, 4), np.int32)
    begins, used = np.zeros(shares + 1, np.int64), np.zeros(shares, np.int64)
    for share in prange(shares):
        most = 0
        for k in range(count * share // shares, count * (share + 1) // shares):
            i = np.uintp(order[k])
            _record(splats, i, k, records)
            u, v, wide, high = splats[i, 0], splats[i, 1], splats[i, 10], splats[i, 11]
            spans[k, 0], spans[k, 1] = _span(u - wide, u + wide, across)
            spans[k, 2], spans[k, 3] = _span(v - high, v + high, down)
            most += max(0, spans[k, 1] - spans[k, 0]) * max(0, spans[k, 3] - spans[k, 2])
        begins[share + 1] = most
    for share in range(shares):
        begins[share + 1] += begins[share]
    tiles, owners = np.empty(begins[shares], np.int32), np.empty(begins[shares], np.int32)
    places, ends = np.zeros((shares, whole), np.int64), np.zeros(whole + 1, np.int64)
    for share in prange(shares):
        pairs = begins[share]
        for k in range(count * share // shares, count * (share + 1) // shares):
            first, last, top, bottom = spans[k, 0], spans[k, 1], spans[k, 2], spans[k, 3]
            single = last - first <= 1 or bottom - top <= 1  # then the box is as good
            reach = splats[np.uintp(order[k]), 10]
            for row in range(top, bottom):
                low, high = first, last
                if not single:
                    low, high = _in_row(records, k, reach, row, across)
                    low, high = max(low, first), min(high, last)
                for column in range(low, high):
                    tile = np.uintp(row * across + column)
                    tiles[pairs], owners[pairs] = tile, k
                    places[share, tile] += 1
                    pairs += 1
        used[share] = pairs
    total = 0
    for tile in range(whole):
        for share in range(shares):
            many = places[share, tile]
            places[share, tile] = total
            total += many
        ends[tile + 1] = total
    entries = np.empty(total, np.int32)
    for share in prange(shares):
        for pair in range(begins[share], used[share]):
            tile = np.uintp(tiles[pair])
            entries[places[share, tile]] = owners[pair]
            places[share, tile] += 1
    return records, entries, ends


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
