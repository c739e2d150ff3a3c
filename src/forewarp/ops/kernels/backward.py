"""Numba kernels that carry gradients from splats to Gaussians and nodes, by the rules of ``voxels``.

As in ``project``, sixteen Gaussians are treated side by side.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.gaussians import COLUMN, SPLAT
from forewarp.ops.kernels.lanes import (
    fma,
    get_row,
    put_row,
    room,
    root,
    row_of,
    rows_of,
    set_row,
    set_rows,
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
    gather,
    harmonics,
    pixel_jacobian,
    product,
    rotated_back,
    rotations,
    scales_of,
    through_lens,
    to_camera,
    warp_points,
)

_GRADIENT, _ROWS = ROWS, ROWS + SPLAT  # where gradients by the splats' columns begin in a room, and its rows


@njit(parallel=True, cache=True)
def splat_gradients(splats, rows, ranks, sums, factor, gradients, pixel_gradient):
    """Turn sums over pixels (S, V, 16) of splats in the order of depth into ``factor`` times the gradients by
    the columns (V', 16) of ``rows``, whose places in that order are ``ranks``; V' is V or more, a multiple
    of 16.

    The sums are of q, q dx, q dy, q dx^2, q dx dy, q dy^2, with q the gradient by the exponent and dx, dy
    from the splat to the pixel, then those by colour and depth. ``pixel_gradient`` (N,) takes the lengths of
    those by x, y.
    """
    count = len(rows)
    for block in prange(gradients.shape[0] // SIDE_BY_SIDE):
        first, place, conics = SIDE_BY_SIDE * block, room(16), room(16)
        for lane in range(SIDE_BY_SIDE):
            k = min(first + lane, count - 1)
            set_row(conics, lane, get_row(splats, rows[k]))
            added = get_row(sums[0], ranks[k])
            for share in range(1, sums.shape[0]):
                added = added + get_row(sums[share], ranks[k])
            set_row(place, lane, added * factor)
        transpose(place)
        transpose(conics)
        a, b, c, opacity = rows_of(conics, COLUMN.conic_a, 4)
        s, sx, sy, sxx, sxy, syy = rows_of(place, 0, 6)
        along, upright = a * sx + b * sy, b * sx + c * sy
        set_rows(place, 0, (along, upright, sxx * -0.5, sxy * -1.0, syy * -0.5, s / opacity))
        set_row(conics, 0, root(along * along + upright * upright))
        transpose(place)
        for lane in range(SIDE_BY_SIDE):
            put_row(gradients, first + lane, row_of(place, lane))
            if first + lane < count:
                pixel_gradient[rows[first + lane]] = conics[lane]


@njit(forceinline=True)
def _scatter(place, values, array, which, valid):
    """Write a tuple of vectors to the columns of the Gaussians that they belong to."""
    set_rows(place, ANY, values)
    for lane in range(valid):
        i = np.uintp(which[lane])
        for c in range(len(values)):
            array[i, c] = place[SIDE_BY_SIDE * (ANY + c) + lane]


@njit(forceinline=True)
def _by_covariance(camera, rows, scales, by_conic):
    """From gradients by the conic A, B, C to those by rows (2, 3) times scales.

    Of the inverse I of a covariance: dL/dcov = -I G I, with G the gradients by I, half of B's on each side.
    """
    by_a, by_b, by_c = by_conic
    a, b, c, determinant = covariance(camera, rows, scales)
    inverse = sixteen(1.0) / determinant
    x, y, z = c * inverse, b * inverse * -1.0, a * inverse
    h = by_b * 0.5
    p0, p1, q0, q1 = by_a * x + h * y, by_a * y + h * z, h * x + by_c * y, h * y + by_c * z
    first, beside, second = (x * p0 + y * q0) * -2.0, (x * p1 + y * q1) * -2.0, (y * p1 + z * q1) * -2.0
    u0, u1, u2 = rows[0] * scales[0], rows[1] * scales[1], rows[2] * scales[2]
    v0, v1, v2 = rows[3] * scales[0], rows[4] * scales[1], rows[5] * scales[2]
    return (
        first * u0 + beside * v0, first * u1 + beside * v1, first * u2 + beside * v2,
        beside * u0 + second * v0, beside * u1 + second * v1, beside * u2 + second * v2,
    )  # fmt: skip


@njit(forceinline=True)
def _by_quaternion(place, d):
    """From gradients (9) by rotations to those by gathered quaternions (4), whatever their length."""
    w, x, y, z = rows_of(place, QUATERNION, 4)
    square = w * w + x * x + y * y + z * z
    length = where_above(square, np.float32(1e-24), sixteen(1.0) / root(square))
    w, x, y, z = w * length, x * length, y * length, z * length
    gw = (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])) * 2.0
    gx = (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]) - x * (d[4] + d[8]) * 2.0) * 2.0
    gy = (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]) - y * (d[0] + d[8]) * 2.0) * 2.0
    gz = (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]) - z * (d[0] + d[4]) * 2.0) * 2.0
    along = gw * w + gx * x + gy * y + gz * z
    gw, gx, gy, gz = gw - along * w, gx - along * x, gy - along * y, gz - along * z
    return gw * length, gx * length, gy * length, gz * length


@njit(forceinline=True)
def _by_point(camera, local, depth, inverse, px, py, lens, place, by_jacobian):
    """Gradients (3) by the world point, from those by the pixel, its Jacobian (2, 3) and the depth.

    The lens's own Jacobian is taken to be the same around the point.
    """
    a, b, c, d = lens[2], lens[3], lens[4], lens[5]
    by_x, by_y = rows_of(place, _GRADIENT, 2)
    gx, gy = a * by_x + c * by_y, b * by_x + d * by_y
    # By the Jacobian of the plane's point: (1/z, 0, -x/z^2) and (0, 1/z, -y/z^2).
    j = by_jacobian
    first0, first1, first2 = a * j[0] + c * j[3], a * j[1] + c * j[4], a * j[2] + c * j[5]
    second0, second1, second2 = b * j[0] + d * j[3], b * j[1] + d * j[4], b * j[2] + d * j[5]
    across = first0 * camera[0] + first1 * camera[1] + first2 * camera[2]
    upright = second0 * camera[3] + second1 * camera[4] + second2 * camera[5]
    ahead_x = first0 * camera[6] + first1 * camera[7] + first2 * camera[8]
    ahead_y = second0 * camera[6] + second1 * camera[7] + second2 * camera[8]
    square = inverse * inverse
    far = row_of(place, _GRADIENT + COLUMN.depth) / depth
    lx = gx * inverse - ahead_x * square + far * local[0]
    ly = gy * inverse - ahead_y * square + far * local[1]
    turn = (px * ahead_x + py * ahead_y) * 2.0 - across - upright
    lz = turn * square - (gx * px + gy * py) * inverse + far * local[2]
    return rotated_back(camera, lx, ly, lz)


@njit(forceinline=True)
def _color_gradients(direction, splats, color_basis, which, valid, place, to_colors, spots):
    """Fill the gradients by the coefficients of colour; direction has none."""
    plain = len(spots) - len(color_basis)
    x, y, z = direction
    harmonics(x, y, z, plain, place)
    gather(splats[:, COLUMN.red :], which, place, ANY, 3)
    zero, shown, by_color = np.float32(0), rows_of(place, ANY, 3), rows_of(place, _GRADIENT + COLUMN.red, 3)
    red = where_above(shown[0], zero, by_color[0])
    green = where_above(shown[1], zero, by_color[1])
    blue = where_above(shown[2], zero, by_color[2])
    for k in range(len(spots)):
        factor = row_of(place, BASIS + k) if k < plain else sixteen(color_basis[k - plain])
        set_rows(place, ANY, (factor * red, factor * green, factor * blue))
        for lane in range(valid):
            at = spots[k, 0] + np.uintp(which[lane]) * spots[k, 1]
            for c in range(3):
                to_colors[at + c] = place[SIDE_BY_SIDE * (ANY + c) + lane]


@njit(forceinline=True)
def _map_gradients(maps, links, weights, which, valid, place, to_maps, to_weights, softmax):
    """Add the gradients by blended maps, a Gaussian's in a row of ``place``, to those by maps; fill those by
    weights, or by the numbers whose ``softmax`` they are.
    """
    for lane in range(valid):
        i, blended = np.uintp(which[lane]), row_of(place, lane)
        for n in range(links.shape[1]):
            node = links[i, n]
            put_row(to_maps, node, fma(blended, weights[i, n], get_row(to_maps, node)))
        if not len(to_weights):
            continue
        mean = np.float32(0)
        for n in range(links.shape[1]):
            value = total(blended * get_row(maps, links[i, n]))
            to_weights[i, n] = value
            mean += weights[i, n] * value
        if softmax:
            for n in range(links.shape[1]):
                to_weights[i, n] = weights[i, n] * (to_weights[i, n] - mean)


@njit(forceinline=True)
def _shape_gradients(camera, moved, log_scales, quaternions, which, valid, place, to_scales, to_quaternions):
    """Fill the gradients by scales and quaternions; returns those by ``moved`` (2, 3), what maps a Gaussian's
    axes, before they are rotated, to the image.
    """
    gather(quaternions, which, place, QUATERNION, 4)
    rotation, scales = rotations(place), scales_of(log_scales, which, place)
    rows = product(moved, rotation)
    by_root = _by_covariance(camera, rows, scales, rows_of(place, _GRADIENT + COLUMN.conic_a, 3))
    r0, r1, r2 = by_root[0] * scales[0], by_root[1] * scales[1], by_root[2] * scales[2]
    r3, r4, r5 = by_root[3] * scales[0], by_root[4] * scales[1], by_root[5] * scales[2]
    by_scale = (r0 * rows[0] + r3 * rows[3], r1 * rows[1] + r4 * rows[4], r2 * rows[2] + r5 * rows[5])
    _scatter(place, by_scale, to_scales, which, valid)
    by_rotation = (
        moved[0] * r0 + moved[3] * r3, moved[0] * r1 + moved[3] * r4, moved[0] * r2 + moved[3] * r5,
        moved[1] * r0 + moved[4] * r3, moved[1] * r1 + moved[4] * r4, moved[1] * r2 + moved[4] * r5,
        moved[2] * r0 + moved[5] * r3, moved[2] * r1 + moved[5] * r4, moved[2] * r2 + moved[5] * r5,
    )  # fmt: skip
    _scatter(place, _by_quaternion(place, by_rotation), to_quaternions, which, valid)
    return product((r0, r1, r2, r3, r4, r5), _transposed(rotation))


@njit(forceinline=True)
def _transposed(m):
    """The transpose of (3, 3) in 9 numbers."""
    return m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]


@njit(parallel=True, cache=True)
def chain(
    means, log_scales, quaternions, opacity, colors, maps, links, weights, camera, color_basis, opacity_basis,
    splats, seen, gradients,
    to_means, to_scales, to_quaternions, to_opacity, to_colors, spots, to_maps, to_weights, softmax,
):  # fmt: skip
    """Apply the chain rule: from gradients (V', 16) by the splats ``seen`` (V,), the lowest first, to those
    by all Gaussians, and by maps; those of what is not seen are 0.

    ``to_colors``: those by coefficient k of Gaussian i begin at ``spots[k, 0] + i spots[k, 1]``.
    ``to_maps`` (S, M, 16): each thread adds to its own. ``to_weights`` (N, L), or empty: by weights, or by
    the numbers whose ``softmax`` they are.
    """
    count, shares = len(seen), to_maps.shape[0]
    blocks = (count + SIDE_BY_SIDE - 1) // SIDE_BY_SIDE
    for share in prange(shares):
        first, end = len(means) * share // shares, len(means) * (share + 1) // shares
        to_means[first:end] = 0
        to_scales[first:end] = 0
        to_quaternions[first:end] = 0
        to_opacity[first:end] = 0
        to_weights[first:end] = 0
        for k in range(len(spots)):
            for i in range(first, end):
                at = np.uintp(spots[k, 0] + i * spots[k, 1])
                to_colors[at], to_colors[at + 1], to_colors[at + 2] = 0, 0, 0
    for share in prange(shares):
        place, which = room(_ROWS), np.empty(SIDE_BY_SIDE, np.intp)
        for block in range(blocks * share // shares, blocks * (share + 1) // shares):
            start = SIDE_BY_SIDE * block
            valid = min(SIDE_BY_SIDE, count - start)
            for lane in range(SIDE_BY_SIDE):
                which[lane] = seen[min(start + lane, count - 1)]
                set_row(place, lane, get_row(gradients, start + lane))
            transpose(place)
            set_rows(place, _GRADIENT, rows_of(place, 0, SPLAT))
            x, y, z = warp_points(means, maps, links, weights, which, place)
            local, depth, direction = to_camera(camera, x, y, z)
            inverse = sixteen(1.0) / local[2]
            px, py = local[0] * inverse, local[1] * inverse
            lens = through_lens(camera, px, py)
            jacobian, warp = pixel_jacobian(camera, inverse, px, py, lens), rows_of(place, 0, 9)
            by_moved = _shape_gradients(
                camera, product(jacobian, warp), log_scales, quaternions, which, valid, place, to_scales,
                to_quaternions,
            )  # fmt: skip
            by_jacobian = product(by_moved, _transposed(warp))
            by_point = _by_point(camera, local, depth, inverse, px, py, lens, place, by_jacobian)
            x, y, z = by_point
            _scatter(place, rotated_back(warp, x, y, z), to_means, which, valid)
            _color_gradients(direction, splats, color_basis, which, valid, place, to_colors, spots)
            for lane in range(valid):
                i = np.uintp(which[lane])
                covers = splats[i, COLUMN.opacity]
                by_opacity = place[SIDE_BY_SIDE * (_GRADIENT + COLUMN.opacity) + lane]
                by_logit = by_opacity * covers * (np.float32(1) - covers)
                for j in range(len(opacity_basis)):
                    to_opacity[i, j] = by_logit * opacity_basis[j]
            for r in range(3):
                for c in range(3):
                    value = by_point[r] * row_of(place, MEAN + c)
                    value = fma(jacobian[r], by_moved[c], fma(jacobian[3 + r], by_moved[3 + c], value))
                    set_row(place, 3 * r + c, value)
                set_row(place, 9 + r, by_point[r])
            none = sixteen(0.0)
            set_rows(place, 12, (none, none, none, none))
            transpose(place)
            _map_gradients(maps, links, weights, which, valid, place, to_maps[share], to_weights, softmax)
