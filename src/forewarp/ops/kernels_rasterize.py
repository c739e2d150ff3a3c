"""Numba kernels behind ``rasterize``: tiles of 8 x 8 pixels at once, by the rules of ``kernels_grid``.

A record is a splat as a tile reads it: u, v, -A/2, -B, -C/2, log of its opacity, colour (3), distance.
Records lie in the order of their depth, and so do the ``entries`` of a tile, from ``ends[tile]`` on.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.lanes import (
    any_above,
    exp_down,
    fma,
    fold,
    lanes,
    narrow_columns,
    root,
    rows,
    sixteen,
    total,
    where_above,
    widened,
)
from forewarp.ops.lanes_arrays import add_sums, get, get_channel, get_tile, put, put_tile

SIDE = 8
RECORD, GRADIENT = 10, 16  # numbers of a record; of a row of sums
LEAST_LOG = -5.541263545158426  # log(1 / 255): what adds less to a pixel is not seen
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
