"""Numba kernels that project Gaussians, and carry gradients from splats back to Gaussians and nodes.

By the rules of ``voxels``; the equations stand in ``ops.gaussians``. Sixteen Gaussians are treated side by
side: a *row* of a ``room`` has one number of each of them.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.keeping import KEPT
from forewarp.ops.kernels.lanes import (
    NARROW,
    exp,
    fma,
    get_row,
    log,
    maximum,
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
from forewarp.ops.layout import COLUMN, LOG_MIN_ALPHA, SPLAT_WIDTH

SIDE_BY_SIDE = NARROW
# Where the numbers of a camera lie, after its rotation; see ``Pinhole.row``.
CENTER, FOCAL, SKEW, MIDDLE, SIZE, NEAR, BLUR, MARGIN, RADIAL, TANGENTIAL, REACH = (
    9, 12, 14, 15, 17, 19, 20, 21, 22, 25, 27,
)  # fmt: skip
# Rows of a room: the blended map, then what is gathered of the Gaussians, then harmonics.
MEAN, SCALE, QUATERNION, ANY, BASIS, ROWS = 16, 19, 22, 26, 29, 45
# On the way back the gradients by a splat's columns follow.
GRADIENT, ROWS_BACK = ROWS, ROWS + SPLAT_WIDTH
C0, C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
C20, C21, C22 = (np.float32(c) for c in (1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
C30, C31, C32 = (np.float32(c) for c in (0.5900435899266435, 2.890611442640554, 0.4570457994644658))
C33, C34 = (np.float32(c) for c in (0.3731763325901154, 1.445305721320277))


@njit(forceinline=True)
def harmonics(x, y, z, count, place):
    """Real spherical harmonics of unit directions into the rows from ``BASIS`` on; count is 1, 4, 9 or 16."""
    set_row(place, BASIS, sixteen(C0))
    if count > 1:
        set_rows(place, BASIS + 1, (y * -C1, z * C1, x * -C1))
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        second = (x * y * C20, y * z * -C20, (zz * 2.0 - xx - yy) * C21, x * z * -C20, (xx - yy) * C22)
        set_rows(place, BASIS + 4, second)
        if count > 9:
            third = (
                y * (xx * 3.0 - yy) * -C30,
                x * y * z * C31,
                y * (zz * 4.0 - xx - yy) * -C32,
                z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * C33,
                x * (zz * 4.0 - xx - yy) * -C32,
                z * (xx - yy) * C34,
                x * (xx - yy * 3.0) * -C30,
            )
            set_rows(place, BASIS + 9, third)


@njit(forceinline=True)
def gather(array, which, place, first, count):
    """Copy the columns (N, count) of 16 Gaussians to the rows from ``first`` on."""
    for lane in range(SIDE_BY_SIDE):
        i = np.uintp(which[lane])
        for c in range(count):
            place[SIDE_BY_SIDE * (first + c) + lane] = array[i, c]


@njit(forceinline=True)
def warp_points(means, maps, links, weights, which, place):
    """Blend the maps (M, 16) of 16 Gaussians' nodes into 12 rows: I + sum w D row by row, then the shift.

    Returns where the means go.
    """
    for lane in range(SIDE_BY_SIDE):
        i = np.uintp(which[lane])
        blend = sixteen(0.0)
        for k in range(links.shape[1]):
            blend = fma(get_row(maps, links[i, k]), weights[i, k], blend)
        set_row(place, lane, blend)
    transpose(place)
    for j in range(0, 9, 4):
        set_row(place, j, row_of(place, j) + 1.0)
    gather(means, which, place, MEAN, 3)
    x, y, z = rows_of(place, MEAN, 3)
    a, b, c, d, e, f, g, h, i, u, v, w = rows_of(place, 0, 12)
    return (
        fma(a, x, fma(b, y, fma(c, z, u))),
        fma(d, x, fma(e, y, fma(f, z, v))),
        fma(g, x, fma(h, y, fma(i, z, w))),
    )


@njit(forceinline=True)
def through_lens(camera, x, y):
    """Pixels of points of the plane at distance 1, and the Jacobian (2, 2) of that."""
    k1, k2, k3 = camera[RADIAL], camera[RADIAL + 1], camera[RADIAL + 2]
    p1, p2 = camera[TANGENTIAL], camera[TANGENTIAL + 1]
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    scale = fma(r2, fma(r2, fma(r2, k3, sixteen(k2)), sixteen(k1)), sixteen(1.0))
    slope = fma(r2, fma(r2, k3 * 6.0, sixteen(k2 * 4.0)), sixteen(k1 * 2.0))  # d scale / dx is slope * x
    u = x * scale + xy * (p1 * 2.0) + (r2 + xx * 2.0) * p2
    v = y * scale + xy * (p2 * 2.0) + (r2 + yy * 2.0) * p1
    along = scale + slope * xx + y * (p1 * 2.0) + x * (p2 * 6.0)
    beside = slope * xy + x * (p1 * 2.0) + y * (p2 * 2.0)
    upright = scale + slope * yy + x * (p2 * 2.0) + y * (p1 * 6.0)
    fx, fy, skew = camera[FOCAL], camera[FOCAL + 1], camera[SKEW]
    return (
        u * fx + v * skew + camera[MIDDLE],
        v * fy + camera[MIDDLE + 1],
        along * fx + beside * skew,
        beside * fx + upright * skew,
        beside * fy,
        upright * fy,
    )


@njit(forceinline=True)
def rotations(place):
    """The matrices (9) of 16 gathered quaternions (w, x, y, z) of any length; of length 0 the identity."""
    w, x, y, z = rows_of(place, QUATERNION, 4)
    square = w * w + x * x + y * y + z * z
    s = where_above(square, np.float32(1e-24), sixteen(2.0) / square)
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    return (
        1.0 - s * (yy + zz), s * (xy - wz), s * (xz + wy),
        s * (xy + wz), 1.0 - s * (xx + zz), s * (yz - wx),
        s * (xz - wy), s * (yz + wx), 1.0 - s * (xx + yy),
    )  # fmt: skip


@njit(forceinline=True)
def product(a, b):
    """``a b`` of (2, 3) and (3, 3), row by row in 6, 9 and 6 numbers."""
    return (
        fma(a[0], b[0], fma(a[1], b[3], a[2] * b[6])),
        fma(a[0], b[1], fma(a[1], b[4], a[2] * b[7])),
        fma(a[0], b[2], fma(a[1], b[5], a[2] * b[8])),
        fma(a[3], b[0], fma(a[4], b[3], a[5] * b[6])),
        fma(a[3], b[1], fma(a[4], b[4], a[5] * b[7])),
        fma(a[3], b[2], fma(a[4], b[5], a[5] * b[8])),
    )


@njit(forceinline=True)
def rotated_back(m, x, y, z):
    """``m^t (x, y, z)`` of a matrix (9), or of a camera, which begins with its rotation."""
    return x * m[0] + y * m[3] + z * m[6], x * m[1] + y * m[4] + z * m[7], x * m[2] + y * m[5] + z * m[8]


@njit(forceinline=True)
def to_camera(camera, x, y, z):
    """World points in the camera's axes; their distances from it, and unit directions (3) towards them."""
    x, y, z = x - camera[CENTER], y - camera[CENTER + 1], z - camera[CENTER + 2]
    local = (
        x * camera[0] + y * camera[1] + z * camera[2],
        x * camera[3] + y * camera[4] + z * camera[5],
        x * camera[6] + y * camera[7] + z * camera[8],
    )
    distance = root(fma(local[0], local[0], fma(local[1], local[1], local[2] * local[2])))
    inverse = sixteen(1.0) / distance
    return local, distance, (x * inverse, y * inverse, z * inverse)


@njit(forceinline=True)
def pixel_jacobian(camera, inverse, px, py, lens):
    """The Jacobian (2, 3) of pixels by the world point, at 1 / z and a point of the plane."""
    a, b, d, e = lens[2] * inverse, lens[3] * inverse, lens[4] * inverse, lens[5] * inverse
    c, f = a * px + b * py, d * px + e * py
    u, v = rotated_back(camera, a, b, c * -1.0), rotated_back(camera, d, e, f * -1.0)
    return u[0], u[1], u[2], v[0], v[1], v[2]


@njit(forceinline=True)
def covariance(camera, rows, scales):
    """a, b, c of the covariance (a, b; b, c) of rows (2, 3) times scales, and its determinant."""
    x0, x1, x2 = rows[0] * scales[0], rows[1] * scales[1], rows[2] * scales[2]
    y0, y1, y2 = rows[3] * scales[0], rows[4] * scales[1], rows[5] * scales[2]
    blur = camera[BLUR]
    a, b, c = x0 * x0 + x1 * x1 + x2 * x2, x0 * y0 + x1 * y1 + x2 * y2, y0 * y0 + y1 * y1 + y2 * y2
    # The first part is the cross product's square: of a needle, a c - b b loses all digits.
    n0, n1, n2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    determinant = n0 * n0 + n1 * n1 + n2 * n2 + (a + c + blur) * blur
    return a + blur, b, c + blur, determinant


@njit(forceinline=True)
def scales_of(log_scales, which, place):
    """The scales (3) of 16 Gaussians."""
    gather(log_scales, which, place, SCALE, 3)
    x, y, z = rows_of(place, SCALE, 3)
    return exp(x), exp(y), exp(z)


@njit(forceinline=True)
def _opacities(opacity, which, opacity_basis, place):
    logit = sixteen(0.0)
    for k in range(len(opacity_basis)):
        gather(opacity[:, k:], which, place, ANY, 1)
        logit = fma(row_of(place, ANY), opacity_basis[k], logit)
    return sixteen(1.0) / (exp(logit * -1.0) + 1.0)


@njit(forceinline=True)
def _colors(direction, colors, color_basis, which, place):
    """The colours of 16 splats: what direction and time make of their coefficients."""
    plain = colors.shape[1] - len(color_basis)
    x, y, z = direction
    harmonics(x, y, z, plain, place)
    red, green, blue = sixteen(0.5), sixteen(0.5), sixteen(0.5)
    for k in range(colors.shape[1]):
        gather(colors[:, k], which, place, ANY, 3)
        factor = row_of(place, BASIS + k) if k < plain else sixteen(color_basis[k - plain])
        r, g, b = rows_of(place, ANY, 3)
        red, green, blue = fma(factor, r, red), fma(factor, g, green), fma(factor, b, blue)
    return maximum(0.0, red), maximum(0.0, green), maximum(0.0, blue)  # NaN stays NaN


@njit(forceinline=True)
def _squared_reach(camera, ahead, beside, lens, determinant, opacity, log_opacity):
    """Twice the logarithm of 255 times the opacity, 0 of what is not seen."""
    zero = np.float32(0)
    reach = where_above(opacity, np.float32(1 / 255), (log_opacity - np.float32(LOG_MIN_ALPHA)) * 2.0)
    reach = where_above(ahead, camera[NEAR], reach)
    reach = where_above(camera[REACH] - beside, zero, reach)
    for pixel, size in ((lens[0], camera[SIZE]), (lens[1], camera[SIZE + 1])):
        reach = where_above(pixel, -camera[MARGIN], reach)
        reach = where_above(camera[MARGIN] + size - pixel, zero, reach)
    reach = where_above(determinant, zero, reach)
    return where_above(np.float32(1e30) - determinant, zero, reach)


@njit(parallel=True, cache=KEPT)
def project(
    means, log_scales, quaternions, opacity, colors, maps, links, weights, camera, color_basis, opacity_basis,
    out,
):  # fmt: skip
    """Fill ``out`` (N', 16) with splats; see ``gaussians.project``. N' is N or more, a multiple of 16.

    A splat: x, y, conic (3), opacity, colour (3), depth, how far it reaches along both axes (one that is not
    seen reaches 0), and the logarithm of its opacity. Other numbers of what is not seen mean nothing.
    """
    count, blocks = means.shape[0], out.shape[0] // SIDE_BY_SIDE
    for share in prange(64):
        place, which = room(ROWS), np.empty(SIDE_BY_SIDE, np.intp)
        for block in range(blocks * share // 64, blocks * (share + 1) // 64):
            for lane in range(SIDE_BY_SIDE):
                which[lane] = min(SIDE_BY_SIDE * block + lane, count - 1)
            x, y, z = warp_points(means, maps, links, weights, which, place)
            local, depth, direction = to_camera(camera, x, y, z)
            inverse = sixteen(1.0) / local[2]
            px, py = local[0] * inverse, local[1] * inverse
            lens = through_lens(camera, px, py)
            jacobian = pixel_jacobian(camera, inverse, px, py, lens)
            gather(quaternions, which, place, QUATERNION, 4)
            rows = product(product(jacobian, rows_of(place, 0, 9)), rotations(place))
            a, b, c, determinant = covariance(camera, rows, scales_of(log_scales, which, place))
            solid = _opacities(opacity, which, opacity_basis, place)
            log_solid = log(solid)
            red, green, blue = _colors(direction, colors, color_basis, which, place)
            square = px * px + py * py
            reach = _squared_reach(camera, local[2], square, lens, determinant, solid, log_solid)
            reach_x = where_above(reach, np.float32(0), root(reach * a))
            reach_y = where_above(reach, np.float32(0), root(reach * c))
            inverse, none = sixteen(1.0) / determinant, sixteen(0.0)
            conic = (c * inverse, b * inverse * -1.0, a * inverse)
            set_rows(place, 0, (lens[0], lens[1], *conic, solid, red, green, blue, depth, reach_x, reach_y))
            set_rows(place, 12, (log_solid, none, none, none))
            transpose(place)
            for lane in range(SIDE_BY_SIDE):
                row = SIDE_BY_SIDE * block + lane
                put_row(out, row, row_of(place, lane))
                if row >= count:
                    out[row, COLUMN.reach_x] = 0


# Back -------------------------------------------------------------------------------------------------------


@njit(parallel=True, cache=KEPT)
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
    by_x, by_y = rows_of(place, GRADIENT, 2)
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
    far = row_of(place, GRADIENT + COLUMN.depth) / depth
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
    zero, shown, by_color = np.float32(0), rows_of(place, ANY, 3), rows_of(place, GRADIENT + COLUMN.red, 3)
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
    by_root = _by_covariance(camera, rows, scales, rows_of(place, GRADIENT + COLUMN.conic_a, 3))
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


@njit(parallel=True, cache=KEPT)
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
        place, which = room(ROWS_BACK), np.empty(SIDE_BY_SIDE, np.intp)
        for block in range(blocks * share // shares, blocks * (share + 1) // shares):
            start = SIDE_BY_SIDE * block
            valid = min(SIDE_BY_SIDE, count - start)
            for lane in range(SIDE_BY_SIDE):
                which[lane] = seen[min(start + lane, count - 1)]
                set_row(place, lane, get_row(gradients, start + lane))
            transpose(place)
            set_rows(place, GRADIENT, rows_of(place, 0, SPLAT_WIDTH))
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
                by_opacity = place[SIDE_BY_SIDE * (GRADIENT + COLUMN.opacity) + lane]
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
