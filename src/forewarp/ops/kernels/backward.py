"""Numba kernels that carry gradients from splats to particles and nodes, by the rules of ``voxels``.

As in ``project``, sixteen particles are treated side by side.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.lanes import (
    fma,
    get_row,
    put_row,
    room,
    root,
    row_of,
    set_row,
    sixteen,
    total,
    transpose,
    where_above,
)
from forewarp.ops.kernels.project import (
    ANY,
    BASIS,
    MEAN,
    QUATERNION,
    ROWS,
    SIDE_BY_SIDE,
    covariance,
    directed,
    followed,
    gathered,
    harmonics,
    linear_of,
    own_rows,
    product,
    scales_of,
    seen_from,
    slopes_of_pixel,
    through_lens,
    turned,
)

SLOPES = 16  # by u, v, A, B, C, opacity, colour (3) and distance; the last six are 0
_SLOPE, _ROWS = ROWS, ROWS + SLOPES  # where they begin in a room, and how many rows it has


@njit(cache=True)
def ranked(order, count):
    """Rows (V,) int32 of ``count`` that are in an order, the lowest first, and their places (V,) in it.

    What is read row by row should lie side by side: in the order of depth half of the time would be waiting.
    """
    places = np.full(count, -1, np.int32)
    for k in range(len(order)):
        places[order[k]] = k
    rows, ranks = np.empty(len(order), np.int32), np.empty(len(order), np.int32)
    found = 0
    for i in range(count):
        if places[i] >= 0:
            rows[found], ranks[found] = i, places[i]
            found += 1
    return rows, ranks


@njit(parallel=True, cache=True)
def slopes_of(splats, rows, ranks, sums, factor, slopes, pull):
    """From the sums over pixels (S, V, 16) of splats in the order of depth to ``factor`` times the slopes
    by the numbers (V', 16) of ``rows``, whose places in that order are ``ranks``; V' is V or more, a
    multiple of 16.

    The sums are of q, q dx, q dy, q dx^2, q dx dy, q dy^2, with q the slope by the exponent and dx, dy from
    the splat to the pixel, then those by colour and distance. ``pull`` (N,) takes the lengths of those by
    u, v.
    """
    count = len(rows)
    for block in prange(slopes.shape[0] // SIDE_BY_SIDE):
        first, place, conics = SIDE_BY_SIDE * block, room(16), room(16)
        for lane in range(SIDE_BY_SIDE):
            k = min(first + lane, count - 1)
            set_row(conics, lane, get_row(splats, rows[k]))
            found = get_row(sums[0], ranks[k])
            for share in range(1, sums.shape[0]):
                found = found + get_row(sums[share], ranks[k])
            set_row(place, lane, found * factor)
        transpose(place)
        transpose(conics)
        a, b, c = row_of(conics, 2), row_of(conics, 3), row_of(conics, 4)
        s, sx, sy = row_of(place, 0), row_of(place, 1), row_of(place, 2)
        sxx, sxy, syy = row_of(place, 3), row_of(place, 4), row_of(place, 5)
        along, upright = a * sx + b * sy, b * sx + c * sy
        set_row(place, 0, along)
        set_row(place, 1, upright)
        set_row(place, 2, sxx * -0.5)
        set_row(place, 3, sxy * -1.0)
        set_row(place, 4, syy * -0.5)
        set_row(place, 5, s / row_of(conics, 5))
        set_row(conics, 0, root(along * along + upright * upright))
        transpose(place)
        for lane in range(SIDE_BY_SIDE):
            put_row(slopes, first + lane, row_of(place, lane))
            if first + lane < count:
                pull[rows[first + lane]] = conics[lane]


@njit(forceinline=True)
def _scattered(place, first, count, array, which, valid):
    """Copy rows from ``first`` on to the columns (N, count) of the particles they belong to."""
    for lane in range(valid):
        i = np.uintp(which[lane])
        for c in range(count):
            array[i, c] = place[SIDE_BY_SIDE * (first + c) + lane]


@njit(forceinline=True)
def _of_covariance(view, rows, scales, by_a, by_b, by_c):
    """From slopes by the conic A, B, C to those by rows (2, 3) times scales.

    Of the inverse X of a covariance: dL/dcov = -X G X, with G the slopes by X, half of B's on each side.
    """
    a, b, c, determinant = covariance(view, rows, scales)
    inverse = sixteen(1.0) / determinant
    x, y, z = c * inverse, b * inverse * -1.0, a * inverse
    h = by_b * 0.5
    p0, p1, q0, q1 = by_a * x + h * y, by_a * y + h * z, h * x + by_c * y, h * y + by_c * z
    first, beside, second = (x * p0 + y * q0) * -2.0, (x * p1 + y * q1) * -2.0, (y * p1 + z * q1) * -2.0
    u0, u1, u2 = rows[0] * scales[0], rows[1] * scales[1], rows[2] * scales[2]
    v0, v1, v2 = rows[3] * scales[0], rows[4] * scales[1], rows[5] * scales[2]
    return (
        first * u0 + beside * v0,
        first * u1 + beside * v1,
        first * u2 + beside * v2,
        beside * u0 + second * v0,
        beside * u1 + second * v1,
        beside * u2 + second * v2,
    )


@njit(forceinline=True)
def _of_turn(place, d):
    """From slopes (9) by rotations to those by gathered quaternions (4), whatever their length."""
    w, x, y, z = (
        row_of(place, QUATERNION),
        row_of(place, QUATERNION + 1),
        row_of(place, QUATERNION + 2),
        row_of(place, QUATERNION + 3),
    )
    square = w * w + x * x + y * y + z * z
    length = where_above(square, np.float32(1e-24), sixteen(1.0) / root(square))
    w, x, y, z = w * length, x * length, y * length, z * length
    gw = (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])) * 2.0
    gx = (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]) - x * (d[4] + d[8]) * 2.0) * 2.0
    gy = (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]) - y * (d[0] + d[8]) * 2.0) * 2.0
    gz = (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]) - z * (d[0] + d[4]) * 2.0) * 2.0
    along = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - along * w) * length,
        (gx - along * x) * length,
        (gy - along * y) * length,
        (gz - along * z) * length,
    )


@njit(forceinline=True)
def _of_place(view, local, distance, inverse, px, py, bent, place, by_jacobian):
    """Slopes (3) by the world point, of the pixel, of its own slopes (2, 3) and of the distance.

    How the lens bends is taken to be the same around the point.
    """
    a, b, c, d = bent[2], bent[3], bent[4], bent[5]
    by_u, by_v, by_far = row_of(place, _SLOPE), row_of(place, _SLOPE + 1), row_of(place, _SLOPE + 9)
    gx, gy = a * by_u + c * by_v, b * by_u + d * by_v
    # By the slopes of the plane's point: (1/z, 0, -x/z^2) and (0, 1/z, -y/z^2).
    first0, first1 = a * by_jacobian[0] + c * by_jacobian[3], a * by_jacobian[1] + c * by_jacobian[4]
    first2, second0 = a * by_jacobian[2] + c * by_jacobian[5], b * by_jacobian[0] + d * by_jacobian[3]
    second1, second2 = b * by_jacobian[1] + d * by_jacobian[4], b * by_jacobian[2] + d * by_jacobian[5]
    across = first0 * view[0] + first1 * view[1] + first2 * view[2]
    upright = second0 * view[3] + second1 * view[4] + second2 * view[5]
    ahead_x = first0 * view[6] + first1 * view[7] + first2 * view[8]
    ahead_y = second0 * view[6] + second1 * view[7] + second2 * view[8]
    square = inverse * inverse
    far = by_far / distance
    lx = gx * inverse - ahead_x * square + far * local[0]
    ly = gy * inverse - ahead_y * square + far * local[1]
    turn = (px * ahead_x + py * ahead_y) * 2.0 - across - upright
    lz = turn * square - (gx * px + gy * py) * inverse + far * local[2]
    return (
        lx * view[0] + ly * view[3] + lz * view[6],
        lx * view[1] + ly * view[4] + lz * view[7],
        lx * view[2] + ly * view[5] + lz * view[8],
    )


@njit(forceinline=True)
def _of_colors(dx, dy, dz, splats, tints, which, valid, place, to_colors, spots):
    """Slopes by the coefficients of colour; direction has none."""
    plain = len(spots) - len(tints)
    harmonics(dx, dy, dz, plain, place)
    for lane in range(SIDE_BY_SIDE):
        i = np.uintp(which[lane])
        for c in range(3):
            place[SIDE_BY_SIDE * (ANY + c) + lane] = splats[i, 6 + c]
    zero = np.float32(0)
    red = where_above(row_of(place, ANY), zero, row_of(place, _SLOPE + 6))
    green = where_above(row_of(place, ANY + 1), zero, row_of(place, _SLOPE + 7))
    blue = where_above(row_of(place, ANY + 2), zero, row_of(place, _SLOPE + 8))
    for k in range(len(spots)):
        factor = row_of(place, BASIS + k) if k < plain else sixteen(tints[k - plain])
        set_row(place, ANY, factor * red)
        set_row(place, ANY + 1, factor * green)
        set_row(place, ANY + 2, factor * blue)
        for lane in range(valid):
            i = np.uintp(which[lane])
            at = spots[k, 0] + i * spots[k, 1]
            for c in range(3):
                to_colors[at + c] = place[SIDE_BY_SIDE * (ANY + c) + lane]


@njit(forceinline=True)
def _of_maps(maps, links, weights, which, valid, place, to_maps, to_weights, softmax):
    """Add the slopes of blended maps, a particle's in a row of ``place``, to those by maps; fill those by
    weights, or by the numbers whose ``softmax`` they are.
    """
    for lane in range(valid):
        i, own = np.uintp(which[lane]), row_of(place, lane)
        for n in range(links.shape[1]):
            node = links[i, n]
            put_row(to_maps, node, fma(own, weights[i, n], get_row(to_maps, node)))
        if not len(to_weights):
            continue
        mean = np.float32(0)
        for n in range(links.shape[1]):
            value = total(own * get_row(maps, links[i, n]))
            to_weights[i, n] = value
            mean += weights[i, n] * value
        if softmax:
            for n in range(links.shape[1]):
                to_weights[i, n] = weights[i, n] * (to_weights[i, n] - mean)


@njit(forceinline=True)
def _of_shape(view, moved, log_scales, quaternions, which, valid, place, to_scales, to_quaternions):
    """Slopes by scales and quaternions; returns those by ``moved`` (2, 3), what maps a particle's axes,
    before they are turned, to the picture.
    """
    gathered(quaternions, which, place, QUATERNION, 4)
    turn, scales = turned(place), scales_of(log_scales, which, place)
    rows = product(moved, turn)
    by_root = _of_covariance(
        view,
        rows,
        scales,
        row_of(place, _SLOPE + 2),
        row_of(place, _SLOPE + 3),
        row_of(place, _SLOPE + 4),
    )
    r0, r1, r2 = by_root[0] * scales[0], by_root[1] * scales[1], by_root[2] * scales[2]
    r3, r4, r5 = by_root[3] * scales[0], by_root[4] * scales[1], by_root[5] * scales[2]
    set_row(place, ANY, r0 * rows[0] + r3 * rows[3])
    set_row(place, ANY + 1, r1 * rows[1] + r4 * rows[4])
    set_row(place, ANY + 2, r2 * rows[2] + r5 * rows[5])
    _scattered(place, ANY, 3, to_scales, which, valid)
    by_turn = (
        moved[0] * r0 + moved[3] * r3, moved[0] * r1 + moved[3] * r4, moved[0] * r2 + moved[3] * r5,
        moved[1] * r0 + moved[4] * r3, moved[1] * r1 + moved[4] * r4, moved[1] * r2 + moved[4] * r5,
        moved[2] * r0 + moved[5] * r3, moved[2] * r1 + moved[5] * r4, moved[2] * r2 + moved[5] * r5,
    )  # fmt: skip
    by_four = _of_turn(place, by_turn)
    set_row(place, QUATERNION, by_four[0])
    set_row(place, QUATERNION + 1, by_four[1])
    set_row(place, QUATERNION + 2, by_four[2])
    set_row(place, QUATERNION + 3, by_four[3])
    _scattered(place, QUATERNION, 4, to_quaternions, which, valid)
    back = (r0, r1, r2, r3, r4, r5)
    return product(back, _transposed(turn))


@njit(parallel=True, cache=True)
def chain(
    means, log_scales, quaternions, opacity, colors, maps, links, weights, view, tints, fades,
    splats, seen, slopes,
    to_means, to_scales, to_quaternions, to_opacity, to_colors, spots, to_maps, to_weights, softmax,
):  # fmt: skip
    """From slopes (V', 16) of the particles ``seen`` (V,), the lowest first, to those by all particles, and
    by maps; those of what is not seen are 0.

    ``to_colors``: those by coefficient k of particle i begin at ``spots[k, 0] + i spots[k, 1]``.
    ``to_maps`` (S, M, 16): each thread adds to its own. ``to_weights`` (N, L), or empty: by weights, or by
    the numbers whose ``softmax`` they are.
    """
    count, shares = len(seen), to_maps.shape[0]
    blocks = (count + SIDE_BY_SIDE - 1) // SIDE_BY_SIDE
    for share in prange(shares):
        place, which = room(_ROWS), np.empty(SIDE_BY_SIDE, np.intp)
        first, end = own_rows(seen, share, shares, len(means))
        to_means[first:end] = 0
        to_scales[first:end] = 0
        to_quaternions[first:end] = 0
        to_opacity[first:end] = 0
        to_weights[first:end] = 0
        for k in range(len(spots)):
            for i in range(first, end):
                at = np.uintp(spots[k, 0] + i * spots[k, 1])
                to_colors[at], to_colors[at + 1], to_colors[at + 2] = 0, 0, 0
        for block in range(blocks * share // shares, blocks * (share + 1) // shares):
            start = SIDE_BY_SIDE * block
            valid = min(SIDE_BY_SIDE, count - start)
            for lane in range(SIDE_BY_SIDE):
                which[lane] = seen[min(start + lane, count - 1)]
                set_row(place, lane, get_row(slopes, start + lane))
            transpose(place)
            for j in range(SIDE_BY_SIDE):
                set_row(place, _SLOPE + j, row_of(place, j))
            x, y, z = followed(means, maps, links, weights, which, place)
            local = seen_from(view, x, y, z)
            distance, dx, dy, dz = directed(view, x, y, z, local)
            inverse = sixteen(1.0) / local[2]
            px, py = local[0] * inverse, local[1] * inverse
            bent = through_lens(view, px, py)
            jacobian, warp = slopes_of_pixel(view, inverse, px, py, bent), linear_of(place)
            moved = product(jacobian, warp)
            by_moved = _of_shape(
                view, moved, log_scales, quaternions, which, valid, place, to_scales, to_quaternions
            )
            by_point = _of_place(
                view, local, distance, inverse, px, py, bent, place, product(by_moved, _transposed(warp))
            )
            set_row(place, ANY, warp[0] * by_point[0] + warp[3] * by_point[1] + warp[6] * by_point[2])
            set_row(place, ANY + 1, warp[1] * by_point[0] + warp[4] * by_point[1] + warp[7] * by_point[2])
            set_row(place, ANY + 2, warp[2] * by_point[0] + warp[5] * by_point[1] + warp[8] * by_point[2])
            _scattered(place, ANY, 3, to_means, which, valid)
            _of_colors(dx, dy, dz, splats, tints, which, valid, place, to_colors, spots)
            for lane in range(valid):
                i = np.uintp(which[lane])
                slope = (
                    place[SIDE_BY_SIDE * (_SLOPE + 5) + lane] * splats[i, 5] * (np.float32(1) - splats[i, 5])
                )
                for j in range(len(fades)):
                    to_opacity[i, j] = slope * fades[j]
            for r in range(3):
                for c in range(3):
                    value = by_point[r] * row_of(place, MEAN + c)
                    value = fma(jacobian[r], by_moved[c], fma(jacobian[3 + r], by_moved[3 + c], value))
                    set_row(place, 3 * r + c, value)
                set_row(place, 9 + r, by_point[r])
            for j in range(12, SIDE_BY_SIDE):
                set_row(place, j, sixteen(0.0))
            transpose(place)
            _of_maps(maps, links, weights, which, valid, place, to_maps[share], to_weights, softmax)


@njit(forceinline=True)
def _transposed(m):
    """The transpose of (3, 3) in 9 numbers."""
    return m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]
