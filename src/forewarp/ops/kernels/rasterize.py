"""Numba kernels behind ``gaussians.rasterize`` and ``compare``, by the rules of ``voxels``.

Splats (N, 16), rows of ``project``, are sorted by depth and into tiles of 8 x 8 pixels; a tile's pixels are
treated at once. A record is a splat as a tile reads it: its columns up to the depth, but the conic as -A/2,
-B, -C/2 and the logarithm of the opacity. Records lie in the order of their depth, and so do the ``entries``
of a tile, from ``ends[tile]`` on.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.keeping import KEPT
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
    put_row,
    put_tile,
    room,
    root,
    row_of,
    rows,
    rows_of,
    set_row,
    set_rows,
    sixteen,
    total,
    transpose,
    where_above,
    widened,
)
from forewarp.ops.kernels.project import SIDE_BY_SIDE
from forewarp.ops.layout import COLUMN, LOG_MIN_ALPHA, MAX_PER_TILE, TILE_SIZE

RECORD = COLUMN.depth + 1  # numbers of a record
_OVER = 1e-3  # transmittance below which nothing behind is seen
_ZERO, _SHARE = np.float32(0), np.float32(1 / TILE_SIZE)
_HALF = np.float32(0.5)  # a tile's first pixel's centre
_SLACK = np.float32(1e-3)  # pixels that rounding may move an edge by


# Sort ------------------------------------------------------------------------------------------------------


@njit(forceinline=True)
def _write_records(splats, order, start, end, across, down, records, spans, outline):
    """Write the records of sixteen splats, from ``start`` on in the order and before ``end``, the first
    tiles of their boxes and those after the last, across and down (``spans`` (V, 4)), and their ``outline``
    (7, 16) for ``_spans_by_row``. Returns how many tiles the boxes have.

    The outline is the level of a 255th, ``a x^2 + b x y + c y^2``: its left and right end at a height y are
    at ``(b y -+ sqrt(bend y^2 + rest)) half``, its rightmost one at the height ``tip``.
    """
    place = room(16)
    for lane in range(SIDE_BY_SIDE):
        set_row(place, lane, get_row(splats, order[min(start + lane, end - 1)]))
    transpose(place)
    x, y, a, b, c = rows_of(place, COLUMN.x, 5)
    wide, high, log_opacity = rows_of(place, COLUMN.reach_x, 3)
    a, b, c = a * -0.5, b * -1.0, c * -0.5
    half = sixteen(-0.5) / a
    put_row(outline, 0, x)
    put_row(outline, 1, y)
    put_row(outline, 2, half)
    put_row(outline, 3, b * half)
    put_row(outline, 4, b * b - a * c * 4.0)
    put_row(outline, 5, a * 4.0 * (np.float32(LOG_MIN_ALPHA) - log_opacity))
    put_row(outline, 6, b / c * wide * -0.5)
    set_rows(place, COLUMN.conic_a, (a, b, c, log_opacity))
    first, last = _span(x - wide, x + wide, across)
    top, bottom = _span(y - high, y + high, down)
    set_rows(place, RECORD, (first, last, top, bottom))
    transpose(place)
    boxes = 0
    for lane in range(min(SIDE_BY_SIDE, end - start)):
        k, at = np.uintp(start + lane), SIDE_BY_SIDE * lane
        for j in range(RECORD):
            records[k, j] = place[at + j]
        for j in range(4):
            spans[k, j] = int(place[at + RECORD + j])
        boxes += max(0, spans[k, 1] - spans[k, 0]) * max(0, spans[k, 3] - spans[k, 2])
    return boxes


@njit(forceinline=True)
def _span(low, high, count):
    """The first tile with a pixel's centre in an interval, and the one after the last, to be rounded down."""
    low, high = low + (_HALF - _SLACK), high + (np.float32(TILE_SIZE) - _HALF + _SLACK)
    low = minimum(maximum(low, _ZERO), np.float32(TILE_SIZE * (count + 1)))
    high = minimum(maximum(high, _ZERO), np.float32(TILE_SIZE * count))
    return low * _SHARE, high * _SHARE


@njit(forceinline=True)
def _spans_by_row(outline, spans, start, end, across, most, lows, highs):
    """The tiles of each row that the parts of sixteen splats' outlines in that row touch: the first ones
    (``lows``) and those after the last (``highs``, both (rows, 16)), to be rounded down. The rows are
    ``most`` from each splat's first on.
    """
    tops = room(1)
    for lane in range(SIDE_BY_SIDE):
        tops[lane] = np.float32(spans[min(start + lane, end - 1), 2])
    x, y, half, slope = get_row(outline, 0), get_row(outline, 1), get_row(outline, 2), get_row(outline, 3)
    bend, rest, tip = get_row(outline, 4), get_row(outline, 5), get_row(outline, 6)
    first = row_of(tops, 0)
    for row in range(most):
        top = (first + row) * TILE_SIZE + _HALF - y
        bottom = top + (TILE_SIZE - 1)
        at, to = minimum(maximum(tip * -1.0, top), bottom), minimum(maximum(tip, top), bottom)
        left = x + (slope * at - half * root(maximum(bend * at * at + rest, _ZERO)))
        right = x + (slope * to + half * root(maximum(bend * to * to + rest, _ZERO)))
        low, high = _span(left, right, across)
        put_row(lows, row, low)
        put_row(highs, row, high)


@njit(inline="always")
def _single(spans, k):
    """Whether a splat's box is a row or a column of tiles, or one: then its ellipse need not be looked at."""
    return spans[k, 1] - spans[k, 0] <= 1 or spans[k, 3] - spans[k, 2] <= 1


@njit(parallel=True, cache=KEPT)
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
            most += _write_records(splats, order, start, end, across, down, records, spans, outline)
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
            _spans_by_row(outline, spans, start, end, across, most, lows, highs)
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
    placed = 0
    for tile in range(whole):
        for share in range(shares):
            many = places[share, tile]
            places[share, tile] = placed
            placed += many
        ends[tile + 1] = placed
    entries = np.empty(placed, np.int32)
    for share in prange(shares):
        for pair in range(begins[share], used[share]):
            tile = np.uintp(tiles[pair])
            entries[places[share, tile]] = owners[pair]
            places[share, tile] += 1
    return records, entries, ends


# Draw ------------------------------------------------------------------------------------------------------


@njit(inline="always")
def _alpha(records, i, column, y):
    """What a splat covers of each pixel of a tile, from a column on and in rows ``y``."""
    dx = narrow_columns() + (column - records[i, COLUMN.x])
    dy = y - records[i, COLUMN.y]
    along = widened(fma(dx * dx, records[i, COLUMN.conic_a], sixteen(records[i, COLUMN.opacity])))
    across = widened(dx * records[i, COLUMN.conic_b])
    power = fma(dy, fma(dy, records[i, COLUMN.conic_c], across), along)
    return where_above(power, np.float32(LOG_MIN_ALPHA), exp_down(power))


@njit(cache=KEPT)
def _blend(records, entries, first, last, column, y, kept, deep):
    """Composite a tile's entries from near to far.

    Returns what is let through, the colour, the depth times coverage, and how many entries were looked at.
    ``kept`` takes the alpha of each entry, and its weight; None: nothing is kept. The depth is left out where
    ``deep`` is None.
    """
    through, red, green, blue, far = lanes(1.0), lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
    count = 0
    for at in range(first, min(last, first + MAX_PER_TILE)):
        i = entries[at]
        alpha = _alpha(records, i, column, y)
        weight = alpha * through
        if deep is not None:
            far = fma(weight, records[i, COLUMN.depth], far)
        if kept is not None:
            put_row(kept, 2 * count, alpha)
            put_row(kept, 2 * count + 1, weight)
        red = fma(weight, records[i, COLUMN.red], red)
        green = fma(weight, records[i, COLUMN.green], green)
        blue = fma(weight, records[i, COLUMN.blue], blue)
        through = through - weight
        count += 1
        if count & 3 == 0 and not any_above(through, np.float32(_OVER)):
            break
    return through, red, green, blue, far, count


@njit(cache=KEPT)
def _walk_back(records, entries, first, count, column, y, kept, by_color, far, behind, sums):
    """Add the gradients of a tile to ``sums``, from far to near.

    ``by_color``: gradients by the image's colours (3); ``far``: by its depth, or None; ``behind``: what
    the tile shows behind its last entry, times the gradients. With T the transmittance before an entry and f
    what it shows itself, times the gradients, ``dL/dalpha = T (f - behind)``.
    """
    red, green, blue = by_color
    beside = narrow_columns()
    for k in range(count - 1, -1, -1):
        i = entries[first + k]
        alpha, weight = get(kept, 2 * k), get(kept, 2 * k + 1)
        shown = fma(blue, records[i, COLUMN.blue], behind * -1.0)
        shown = fma(red, records[i, COLUMN.red], fma(green, records[i, COLUMN.green], shown))
        if far is not None:
            shown = fma(far, records[i, COLUMN.depth], shown)
        behind = fma(alpha, shown, behind)
        by_power = weight * shown
        dy = y - records[i, COLUMN.y]
        low = by_power * dy
        dx = beside + (column - records[i, COLUMN.x])
        s, sy, syy = fold(by_power), fold(low), fold(low * dy)
        sx = s * dx
        colors = (fold(weight * red), fold(weight * green), fold(weight * blue))
        if far is None:
            add_sums(sums, i, (s, sx, sy, sx * dx, sy * dx, syy, *colors))
        else:
            add_sums(sums, i, (s, sx, sy, sx * dx, sy * dx, syy, *colors, fold(weight * far)))


@njit(parallel=True, cache=KEPT)
def draw(records, entries, ends, shares, out):
    """Draw tiles into ``out`` (5, H', W'): colour without background, depth, what is let through.

    ``shares`` (S + 1): thread s draws the tiles from ``shares[s]`` on.
    """
    across = out.shape[2] // TILE_SIZE
    for share in prange(len(shares) - 1):
        for tile in range(shares[share], shares[share + 1]):
            row, column = TILE_SIZE * (tile // across), TILE_SIZE * (tile % across)
            first, last, left, y = ends[tile], ends[tile + 1], np.float32(column), rows() + row
            through, red, green, blue, far, _ = _blend(records, entries, first, last, left, y, None, True)
            put_tile(out[0], row, column, red)
            put_tile(out[1], row, column, green)
            put_tile(out[2], row, column, blue)
            put_tile(out[3], row, column, far)
            put_tile(out[4], row, column, through)


@njit(parallel=True, cache=KEPT)
def pull(records, entries, ends, shares, gradients, kept, sums):
    """Gradients of ``draw``: ``gradients`` (5, H', W') by its five planes, into ``sums`` (S, V, 16); whatever
    was there before is gone.
    """
    across = gradients.shape[2] // TILE_SIZE
    for share in prange(len(shares) - 1):
        own, added = kept[share], sums[share]
        added[:] = 0
        for tile in range(shares[share], shares[share + 1]):
            first, last = ends[tile], ends[tile + 1]
            if first == last:
                continue
            row, column = TILE_SIZE * (tile // across), TILE_SIZE * (tile % across)
            left, y = np.float32(column), rows() + row
            count = _blend(records, entries, first, last, left, y, own, None)[5]
            # The last plane is what is let through: its gradient stands behind everything, times 1.
            red, green = get_tile(gradients[0], row, column), get_tile(gradients[1], row, column)
            blue, far = get_tile(gradients[2], row, column), get_tile(gradients[3], row, column)
            behind, of = get_tile(gradients[4], row, column), (red, green, blue)
            _walk_back(records, entries, first, count, left, y, own, of, far, behind, added)


# Compare ---------------------------------------------------------------------------------------------------


@njit(cache=KEPT)
def _residual(pixels, row, column, through, color, background, number, inside):
    """A channel's difference from the truth over the background, 0 outside the image."""
    alpha = get_channel(pixels, row, column, 3)
    truth = fma(alpha, get_channel(pixels, row, column, number) - background, lanes(background))
    return (fma(through, background, color) - truth) * inside


@njit(cache=KEPT)
def _score(residual, width, score):
    """The derivative of ``sqrt(e^2 + width^2) - width``; adds it and the squared error to ``score``."""
    squared = residual * residual
    far = root(squared + width * width)
    score[0] += total(far - width)
    score[1] += total(squared)
    return residual / far


@njit(cache=KEPT)
def _score_depth(error, trust, width, score):
    """The derivative of ``trust (sqrt(e^2 + width^2) - width)``, which is added to ``score``."""
    far = root(error * error + width * width)
    score[2] += total(trust * (far - width))
    return trust * error / far


@njit(parallel=True, cache=KEPT)
def compare(
    records, entries, ends, shares, pixels, wide, high, background, width, planes, deep, kept, sums, scores
):
    """Draw tiles, compare them with an image, and gather the gradients of the loss, tile by tile.

    The loss is the sum over pixels and channels of ``sqrt(e^2 + width^2) - width``; a tile is not looked at
    again. ``pixels`` (H', W') uint32 are straight RGBA, of which ``high`` x ``wide`` count. ``planes``
    (3, H', W'), or None: 1 where a pixel counts, else 0; the inverse of a known depth; and the weight of the
    loss of ``e = D / d + T - 1``, with D the depth times coverage, T what is let through and ``deep`` its
    width. Into ``scores`` (S, 3) go loss, squared error and the loss of depth, into ``sums`` (S, V, 16) the
    gradients; what was there before is gone.
    """
    across = pixels.shape[1] // TILE_SIZE
    for share in prange(len(shares) - 1):
        score, own, added = np.zeros(3, np.float64), kept[share], sums[share]
        added[:] = 0
        for tile in range(shares[share], shares[share + 1]):
            row, column = TILE_SIZE * (tile // across), TILE_SIZE * (tile % across)
            first, last, left, y = ends[tile], ends[tile + 1], np.float32(column), rows() + row
            through, red, green, blue, far, count = _blend(
                records, entries, first, last, left, y, own, planes
            )
            inside = where_above(wide - widened(narrow_columns() + left), _ZERO, lanes(1.0))
            inside = where_above(high - y, _ZERO, inside)
            if planes is not None:
                inside = inside * get_tile(planes[0], row, column)
            red = _residual(pixels, row, column, through, red, background[0], 0, inside)
            green = _residual(pixels, row, column, through, green, background[1], 1, inside)
            blue = _residual(pixels, row, column, through, blue, background[2], 2, inside)
            # Nothing to learn from; NaN is not 0.
            if planes is None and total(fma(red, red, fma(green, green, blue * blue))) == 0:
                continue
            red = _score(red, width, score)
            green = _score(green, width, score)
            blue = _score(blue, width, score)
            behind = fma(red, background[0], fma(green, background[1], blue * background[2]))
            of = (red, green, blue)
            if planes is None:
                _walk_back(records, entries, first, count, left, y, own, of, None, behind, added)
            else:
                inverse = get_tile(planes[1], row, column)
                error = fma(far, inverse, through) - np.float32(1)
                by_error = _score_depth(error, get_tile(planes[2], row, column), deep, score)
                by_far, behind = by_error * inverse, behind + by_error
                _walk_back(records, entries, first, count, left, y, own, of, by_far, behind, added)
        scores[share] = score
