"""Numba kernels that order splats by depth and sort them into tiles, by the rules of ``kernels_grid``.

A splat is a row of ``kernels_project``.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels_project import SIDE_BY_SIDE
from forewarp.ops.kernels_rasterize import LEAST_LOG, RECORD, SIDE
from forewarp.ops.lanes import maximum, minimum, root, sixteen
from forewarp.ops.lanes_arrays import get_row, put_row, room, row_of, set_row, transpose

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
def _records_of(splats, order, start, end, across, down, records, spans, outline):
    """Write the records of sixteen splats, from ``start`` on in the order and before ``end``, the first
    tiles of their boxes and those after the last, across and down (``spans`` (V, 4)), and their ``outline``
    (7, 16) for ``_by_row``. Returns how many tiles the boxes have.

    The outline is the level of a 255th, ``a x^2 + b x y + c y^2``: its left and right end at a height y are
    at ``(b y -+ sqrt(bend y^2 + rest)) half``, its rightmost one at the height ``tip``.
    """
    place = room(16)
    for lane in range(SIDE_BY_SIDE):
        set_row(place, lane, get_row(splats, order[min(start + lane, end - 1)]))
    transpose(place)
    u, v, wide, high = row_of(place, 0), row_of(place, 1), row_of(place, 10), row_of(place, 11)
    a, b, c = row_of(place, 2) * -0.5, row_of(place, 3) * -1.0, row_of(place, 4) * -0.5
    solid, half = row_of(place, 12), sixteen(-0.5) / a
    put_row(outline[0], 0, u)
    put_row(outline[1], 0, v)
    put_row(outline[2], 0, half)
    put_row(outline[3], 0, b * half)
    put_row(outline[4], 0, b * b - a * c * 4.0)
    put_row(outline[5], 0, a * 4.0 * (np.float32(LEAST_LOG) - solid))
    put_row(outline[6], 0, b / c * wide * -0.5)
    set_row(place, 2, a)
    set_row(place, 3, b)
    set_row(place, 4, c)
    set_row(place, 5, solid)
    first, last = _span(u - wide, u + wide, across)
    top, bottom = _span(v - high, v + high, down)
    set_row(place, 10, first)
    set_row(place, 11, last)
    set_row(place, 12, top)
    set_row(place, 13, bottom)
    transpose(place)
    many = 0
    for lane in range(min(SIDE_BY_SIDE, end - start)):
        k, at = np.uintp(start + lane), SIDE_BY_SIDE * lane
        for j in range(RECORD):
            records[k, j] = place[at + j]
        for j in range(4):
            spans[k, j] = int(place[at + RECORD + j])
        many += max(0, spans[k, 1] - spans[k, 0]) * max(0, spans[k, 3] - spans[k, 2])
    return many


@njit(forceinline=True)
def _span(low, high, count):
    """The first tile with a pixel's centre in an interval, and the one after the last, to be rounded down."""
    most = np.float32(SIDE * (count + 1))
    low, high = low + (_HALF - _SLACK), high + (np.float32(SIDE) - _HALF + _SLACK)
    end = np.float32(SIDE * count)
    low, high = minimum(maximum(low, _ZERO), most), minimum(maximum(high, _ZERO), end)
    return low * _SHARE, high * _SHARE


@njit(forceinline=True)
def _by_row(outline, spans, start, end, across, most, lows, highs):
    """The tiles of each row that the parts of sixteen splats' outlines in that row touch: the first ones
    (``lows``) and those after the last (``highs``, both (rows, 16)), to be rounded down. The rows are
    ``most`` from each splat's first on.
    """
    tops = room(1)
    for lane in range(SIDE_BY_SIDE):
        tops[lane] = np.float32(spans[min(start + lane, end - 1), 2])
    u, v, half, slope = (
        get_row(outline[0], 0),
        get_row(outline[1], 0),
        get_row(outline[2], 0),
        get_row(outline[3], 0),
    )
    bend, rest, tip = get_row(outline[4], 0), get_row(outline[5], 0), get_row(outline[6], 0)
    first = row_of(tops, 0)
    for row in range(most):
        top = (first + row) * SIDE + _HALF - v
        bottom = top + (SIDE - 1)
        at, to = minimum(maximum(tip * -1.0, top), bottom), minimum(maximum(tip, top), bottom)
        left = u + (slope * at - half * root(maximum(bend * at * at + rest, _ZERO)))
        right = u + (slope * to + half * root(maximum(bend * to * to + rest, _ZERO)))
        low, high = _span(left, right, across)
        put_row(lows, row, low)
        put_row(highs, row, high)


@njit(inline="always")
def _single(spans, k):
    """Whether a splat's box is a row or a column of tiles, or one: then its ellipse need not be looked at."""
    return spans[k, 1] - spans[k, 0] <= 1 or spans[k, 3] - spans[k, 2] <= 1


@njit(parallel=True, cache=True)
def sort_into_tiles(splats, order, across, down, shares):
    """The ``records`` (V, 10) of splats in an order, which of them each tile has to look at, from near to
    far (``entries``), and where each tile's begin.

    A tile without a pixel's centre in the box of the part of a splat's ellipse that lies in the tile's rows
    is left out. ``shares`` threads take a part of the splats each; the result does not depend on them.
    """
    count, whole = len(order), across * down
    records, spans = np.empty((count, RECORD), np.float32), np.empty((count, 4), np.int32)
    blocks = count // shares // SIDE_BY_SIDE + 2  # of a thread, at most
    outlines = np.empty((shares, blocks, 7, SIDE_BY_SIDE), np.float32)
    begins, used = np.zeros(shares + 1, np.int64), np.zeros(shares, np.int64)
    for share in prange(shares):
        most, begin, end = 0, count * share // shares, count * (share + 1) // shares
        for start in range(begin, end, SIDE_BY_SIDE):
            outline = outlines[share, (start - begin) // SIDE_BY_SIDE]
            most += _records_of(splats, order, start, end, across, down, records, spans, outline)
        begins[share + 1] = most
    for share in range(shares):
        begins[share + 1] += begins[share]
    tiles, owners = np.empty(begins[shares], np.int32), np.empty(begins[shares], np.int32)
    places, ends = np.zeros((shares, whole), np.int64), np.zeros(whole + 1, np.int64)
    for share in prange(shares):
        pairs, begin, end = begins[share], count * share // shares, count * (share + 1) // shares
        lows, highs = np.empty((down, SIDE_BY_SIDE), np.float32), np.empty((down, SIDE_BY_SIDE), np.float32)
        for start in range(begin, end, SIDE_BY_SIDE):
            outline, most = outlines[share, (start - begin) // SIDE_BY_SIDE], 0
            for k in range(start, min(start + SIDE_BY_SIDE, end)):
                if not _single(spans, k):
                    most = max(most, spans[k, 3] - spans[k, 2])
            _by_row(outline, spans, start, end, across, most, lows, highs)
            for k in range(start, min(start + SIDE_BY_SIDE, end)):
                first, last, top, single = spans[k, 0], spans[k, 1], spans[k, 2], _single(spans, k)
                for row in range(top, spans[k, 3]):
                    low, high = first, last
                    if not single:
                        low = max(int(lows[row - top, k - start]), first)
                        high = min(int(highs[row - top, k - start]), last)
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
