"""Numba kernels behind ``rasterize``: tiles of 8 x 8 pixels at once, by the rules of ``voxels``.

A record is a splat as a tile reads it: u, v, -A/2, -B, -C/2, log of its opacity, colour (3), distance.
Records lie in the order of their depth, and so do the ``entries`` of a tile, from ``ends[tile]`` on.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.lanes import (
    add_sums,
    any_above,
    exp_down,
    fma,
    fold,
    get,
    get_channel,
    get_row,
    get_tile,
    lanes,
    maximum,
    minimum,
    narrow_columns,
    put,
    put_row,
    put_tile,
    room,
    root,
    row_of,
    rows,
    set_row,
    sixteen,
    total,
    transpose,
    where_above,
    widened,
)
from forewarp.ops.kernels.project import LEAST_LOG, SIDE_BY_SIDE

SIDE = 8
RECORD, GRADIENT = 10, 16  # numbers of a record; of a row of sums
_OVER = 1e-3  # transmittance below which nothing behind is seen
MOST = 1 << 15  # entries of a tile that count, the nearest ones


@njit(inline="always")
def _alpha(records, i, column, y):
    """What a splat covers of each pixel of a tile, from a column on and in rows ``y``."""
    dx = narrow_columns() + (column - records[i, 0])
    dy = y - records[i, 1]
    along, across = widened(fma(dx * dx, records[i, 2], sixteen(records[i, 5]))), widened(dx * records[i, 3])
    power = fma(dy, fma(dy, records[i, 4], across), along)
    return where_above(power, np.float32(LEAST_LOG), exp_down(power))


@njit(cache=True)
def _blend(records, entries, first, last, column, y, kept):
    """Composite a tile's entries from near to far. ``kept`` takes the alpha of each, and its weight.

    Returns what is let through, the colour, and how many entries were looked at.
    """
    through, red, green, blue = lanes(1.0), lanes(0.0), lanes(0.0), lanes(0.0)
    count = 0
    for at in range(first, min(last, first + MOST)):
        i = entries[at]
        alpha = _alpha(records, i, column, y)
        put(kept, 2 * count, alpha)
        weight = alpha * through
        put(kept, 2 * count + 1, weight)
        red = fma(weight, records[i, 6], red)
        green = fma(weight, records[i, 7], green)
        blue = fma(weight, records[i, 8], blue)
        through = through - weight
        count += 1
        if count & 3 == 0 and not any_above(through, np.float32(_OVER)):
            break
    return through, red, green, blue, count


@njit(cache=True)
def _walk_back(records, entries, first, count, column, y, kept, slopes, far, behind, sums):
    """Add the gradients of a tile to ``sums``, from far to near.

    ``slopes``: of colour (3); ``far``: of distance, or None; ``behind``: what the tile shows behind its last
    entry, times the slopes. With T the transmittance before an entry and f its own share of the slopes,
    ``dL/dalpha = T (f - behind)``.
    """
    red, green, blue = slopes
    beside = narrow_columns()
    for k in range(count - 1, -1, -1):
        i = entries[first + k]
        alpha, weight = get(kept, 2 * k), get(kept, 2 * k + 1)
        shown = fma(red, records[i, 6], fma(green, records[i, 7], fma(blue, records[i, 8], behind * -1.0)))
        if far is not None:
            shown = fma(far, records[i, 9], shown)
        behind = fma(alpha, shown, behind)
        slope = weight * shown
        dy = y - records[i, 1]
        low = slope * dy
        dx = beside + (column - records[i, 0])
        s, sy, syy = fold(slope), fold(low), fold(low * dy)
        sx = s * dx
        found = (
            s,
            sx,
            sy,
            sx * dx,
            sy * dx,
            syy,
            fold(weight * red),
            fold(weight * green),
            fold(weight * blue),
        )
        if far is None:
            add_sums(sums, i, found)
        else:
            add_sums(sums, i, (*found, fold(weight * far)))


@njit(cache=True)
def _draw_tile(records, entries, first, last, column, y):
    """Composite a tile: what is let through, colour, and distance times coverage."""
    through, red, green, blue, far = lanes(1.0), lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
    for at in range(first, min(last, first + MOST)):
        i = entries[at]
        weight = _alpha(records, i, column, y) * through
        red = fma(weight, records[i, 6], red)
        green = fma(weight, records[i, 7], green)
        blue = fma(weight, records[i, 8], blue)
        far = fma(weight, records[i, 9], far)
        through = through - weight
        if (at - first) & 3 == 3 and not any_above(through, np.float32(_OVER)):
            break
    return through, red, green, blue, far


@njit(parallel=True, cache=True)
def draw(records, entries, ends, shares, out):
    """Draw tiles into ``out`` (5, H', W'): colour without background, distance, what is let through.

    ``shares`` (S + 1): thread s draws the tiles from ``shares[s]`` on.
    """
    across = out.shape[2] // SIDE
    for share in prange(len(shares) - 1):
        for tile in range(shares[share], shares[share + 1]):
            row, column = SIDE * (tile // across), SIDE * (tile % across)
            left, y = np.float32(column), rows() + row
            through, red, green, blue, far = _draw_tile(records, entries, ends[tile], ends[tile + 1], left, y)
            put_tile(out[0], row, column, red)
            put_tile(out[1], row, column, green)
            put_tile(out[2], row, column, blue)
            put_tile(out[3], row, column, far)
            put_tile(out[4], row, column, through)


@njit(parallel=True, cache=True)
def pull(records, entries, ends, shares, slopes, kept, sums):
    """Gradients of ``draw``: ``slopes`` (5, H', W') of its five planes, into ``sums`` (S, V, 16); whatever
    was there before is gone.
    """
    across = slopes.shape[2] // SIDE
    for share in prange(len(shares) - 1):
        sums[share] = 0
        for tile in range(shares[share], shares[share + 1]):
            first, last = ends[tile], ends[tile + 1]
            if first == last:
                continue
            row, column = SIDE * (tile // across), SIDE * (tile % across)
            left, y = np.float32(column), rows() + row
            count = _blend(records, entries, first, last, left, y, kept[share])[4]
            # The last plane is what is let through: its slope stands behind everything, times 1.
            of = (
                get_tile(slopes[0], row, column),
                get_tile(slopes[1], row, column),
                get_tile(slopes[2], row, column),
            )
            far, behind = get_tile(slopes[3], row, column), get_tile(slopes[4], row, column)
            _walk_back(
                records,
                entries,
                first,
                count,
                left,
                y,
                kept[share],
                of,
                far,
                behind,
                sums[share],
            )


@njit(inline="always")
def _copied(pixels, row, column, patch):
    """Copy the part of a tile that lies in the picture into ``patch`` (8, 8), 0 elsewhere."""
    for i in range(SIDE):
        for j in range(SIDE):
            inside = row + i < pixels.shape[0] and column + j < pixels.shape[1]
            patch[i, j] = pixels[row + i, column + j] if inside else np.uint32(0)


@njit(cache=True)
def _residual(pixels, row, column, through, color, background, number, inside):
    """A channel's difference from the truth over the background, 0 outside the picture."""
    alpha = get_channel(pixels, row, column, 3)
    truth = fma(alpha, get_channel(pixels, row, column, number) - background, lanes(background))
    return (fma(through, background, color) - truth) * inside


@njit(cache=True)
def _scored(residual, width, found):
    """The slope of ``sqrt(e^2 + width^2) - width``; adds it and the squared error to ``found``."""
    squared = residual * residual
    far = root(squared + width * width)
    found[0] += total(far - width)
    found[1] += total(squared)
    return residual / far


@njit(parallel=True, cache=True)
def compare(records, entries, ends, shares, pixels, background, width, kept, sums, found):
    """Draw tiles, compare them with a picture, and gather the gradients of the loss, tile by tile.

    The loss is the sum over pixels and channels of ``sqrt(e^2 + width^2) - width``; a tile is not looked at
    again. ``pixels`` (H, W) uint32 are straight RGBA. Into ``found`` (S, 2) go loss and squared error,
    into ``sums`` (S, V, 16) the gradients; whatever was there before is gone.
    """
    across = (pixels.shape[1] + SIDE - 1) // SIDE
    for share in prange(len(shares) - 1):
        patch, full = np.zeros((SIDE, SIDE), np.uint32), np.ones((SIDE, SIDE), np.float32)
        edge, score = np.zeros((SIDE, SIDE), np.float32), np.zeros(2, np.float64)
        sums[share] = 0
        for tile in range(shares[share], shares[share + 1]):
            row, column = SIDE * (tile // across), SIDE * (tile % across)
            left, y = np.float32(column), rows() + row
            through, red, green, blue, count = _blend(
                records, entries, ends[tile], ends[tile + 1], left, y, kept[share]
            )
            whole = row + SIDE <= pixels.shape[0] and column + SIDE <= pixels.shape[1]
            truth, at, to, inside = pixels, row, column, full
            if not whole:
                _copied(pixels, row, column, patch)
                for i in range(SIDE):
                    for j in range(SIDE):
                        edge[i, j] = row + i < pixels.shape[0] and column + j < pixels.shape[1]
                truth, at, to, inside = patch, 0, 0, edge
            counts = get_tile(inside, 0, 0)
            red = _residual(truth, at, to, through, red, background[0], 0, counts)
            green = _residual(truth, at, to, through, green, background[1], 1, counts)
            blue = _residual(truth, at, to, through, blue, background[2], 2, counts)
            if total(fma(red, red, fma(green, green, blue * blue))) == 0:  # which NaN is not
                continue
            of = (
                _scored(red, width, score),
                _scored(green, width, score),
                _scored(blue, width, score),
            )
            behind = fma(of[0], background[0], fma(of[1], background[1], of[2] * background[2]))
            _walk_back(
                records,
                entries,
                ends[tile],
                count,
                left,
                y,
                kept[share],
                of,
                None,
                behind,
                sums[share],
            )
        found[share, 0] = score[0]
        found[share, 1] = score[1]


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
