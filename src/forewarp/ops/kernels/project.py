"""Numba kernels behind ``project``, by the rules of ``voxels``. The equations stand there.

Sixteen particles are treated side by side: a *row* of a ``room`` has one number of each of them.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels.lanes import (
    at_least,
    exp,
    fma,
    get_row,
    log,
    put_row,
    room,
    root,
    row_of,
    set_row,
    sixteen,
    transpose,
    where_above,
)

SIDE_BY_SIDE = 16
SPLAT = 16  # numbers of a splat; the last three are 0
LEAST_LOG = -5.541263545158426  # log(1 / 255): what adds less to a pixel is not seen
# Where the numbers of a view lie in its row; see ``project.View.row``.
ROTATION, CENTER, FOCAL, SKEW, MIDDLE, SIZE, NEAR, BLUR, MARGIN, RADIAL, TANGENTIAL, REACH = (
    0, 9, 12, 14, 15, 17, 19, 20, 21, 22, 25, 27,
)  # fmt: skip
# Rows of a room: the blended map, then what is gathered of the particles, then harmonics.
MEAN, SCALE, QUATERNION, ANY, BASIS, ROWS = 16, 19, 22, 26, 29, 45
C0, C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
C20, C21, C22 = (np.float32(c) for c in (1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
C30, C31, C32 = (np.float32(c) for c in (0.5900435899266435, 2.890611442640554, 0.4570457994644658))
C33, C34 = (np.float32(c) for c in (0.3731763325901154, 1.445305721320277))


@njit(forceinline=True)
def harmonics(x, y, z, count, place):
    """Real spherical harmonics of unit directions into the rows from ``BASIS`` on; count is 1, 4, 9 or 16."""
    set_row(place, BASIS, sixteen(C0))
    if count > 1:
        set_row(place, BASIS + 1, y * -C1)
        set_row(place, BASIS + 2, z * C1)
        set_row(place, BASIS + 3, x * -C1)
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        set_row(place, BASIS + 4, x * y * C20)
        set_row(place, BASIS + 5, y * z * -C20)
        set_row(place, BASIS + 6, (zz * 2.0 - xx - yy) * C21)
        set_row(place, BASIS + 7, x * z * -C20)
        set_row(place, BASIS + 8, (xx - yy) * C22)
        if count > 9:
            set_row(place, BASIS + 9, y * (xx * 3.0 - yy) * -C30)
            set_row(place, BASIS + 10, x * y * z * C31)
            set_row(place, BASIS + 11, y * (zz * 4.0 - xx - yy) * -C32)
            set_row(place, BASIS + 12, z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * C33)
            set_row(place, BASIS + 13, x * (zz * 4.0 - xx - yy) * -C32)
            set_row(place, BASIS + 14, z * (xx - yy) * C34)
            set_row(place, BASIS + 15, x * (xx - yy * 3.0) * -C30)


@njit(inline="always")
def own_rows(seen, share, shares, total):
    """Return a thread's rows of ``total``: from the first that its blocks of ``seen`` write to, to that of
    the next thread; the first one's begin at 0.
    """
    blocks, first, end = (len(seen) + SIDE_BY_SIDE - 1) // SIDE_BY_SIDE, 0, total
    if share > 0:
        k = SIDE_BY_SIDE * (blocks * share // shares)
        first = seen[k] if k < len(seen) else total
    if share + 1 < shares:
        k = SIDE_BY_SIDE * (blocks * (share + 1) // shares)
        end = seen[k] if k < len(seen) else total
    return first, end


@njit(forceinline=True)
def gathered(array, which, place, first, count):
    """Copy the columns (N, count) of 16 particles to the rows from ``first`` on."""
    for lane in range(SIDE_BY_SIDE):
        i = np.uintp(which[lane])
        for c in range(count):
            place[SIDE_BY_SIDE * (first + c) + lane] = array[i, c]


@njit(forceinline=True)
def followed(means, maps, links, weights, which, place):
    """Blend the maps (M, 16) of 16 particles' nodes into 12 rows: I + sum w D row by row, then the shift.

    Returns where the particles go.
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
    gathered(means, which, place, MEAN, 3)
    x, y, z = row_of(place, MEAN), row_of(place, MEAN + 1), row_of(place, MEAN + 2)
    return (
        fma(row_of(place, 0), x, fma(row_of(place, 1), y, fma(row_of(place, 2), z, row_of(place, 9)))),
        fma(row_of(place, 3), x, fma(row_of(place, 4), y, fma(row_of(place, 5), z, row_of(place, 10)))),
        fma(row_of(place, 6), x, fma(row_of(place, 7), y, fma(row_of(place, 8), z, row_of(place, 11)))),
    )


@njit(forceinline=True)
def through_lens(view, x, y):
    """Where a lens puts a point of the plane, in pixels, and the 2 x 2 slopes of that."""
    k1, k2, k3 = view[RADIAL], view[RADIAL + 1], view[RADIAL + 2]
    p1, p2 = view[TANGENTIAL], view[TANGENTIAL + 1]
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    scale = fma(r2, fma(r2, fma(r2, k3, sixteen(k2)), sixteen(k1)), sixteen(1.0))
    slope = fma(r2, fma(r2, k3 * 6.0, sixteen(k2 * 4.0)), sixteen(k1 * 2.0))
    u = x * scale + xy * (p1 * 2.0) + (r2 + xx * 2.0) * p2
    v = y * scale + xy * (p2 * 2.0) + (r2 + yy * 2.0) * p1
    along = scale + slope * xx + y * (p1 * 2.0) + x * (p2 * 6.0)
    beside = slope * xy + x * (p1 * 2.0) + y * (p2 * 2.0)
    upright = scale + slope * yy + x * (p2 * 2.0) + y * (p1 * 6.0)
    fx, fy, skew = view[FOCAL], view[FOCAL + 1], view[SKEW]
    return (
        u * fx + v * skew + view[MIDDLE],
        v * fy + view[MIDDLE + 1],
        along * fx + beside * skew,
        beside * fx + upright * skew,
        beside * fy,
        upright * fy,
    )


@njit(forceinline=True)
def turned(place):
    """The rotations (9) of 16 gathered quaternions (w, x, y, z) of any length; of length 0 there is none."""
    w, x, y, z = (
        row_of(place, QUATERNION),
        row_of(place, QUATERNION + 1),
        row_of(place, QUATERNION + 2),
        row_of(place, QUATERNION + 3),
    )
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
def seen_from(view, x, y, z):
    """World points in the camera's axes."""
    x, y, z = x - view[CENTER], y - view[CENTER + 1], z - view[CENTER + 2]
    return (
        x * view[0] + y * view[1] + z * view[2],
        x * view[3] + y * view[4] + z * view[5],
        x * view[6] + y * view[7] + z * view[8],
    )


@njit(forceinline=True)
def slopes_of_pixel(view, inverse, px, py, bent):
    """The slopes (2, 3) of pixels by the world point, at 1 / z and a point of the plane."""
    a, b, d, e = bent[2] * inverse, bent[3] * inverse, bent[4] * inverse, bent[5] * inverse
    c, f = a * px + b * py, d * px + e * py
    return (
        a * view[0] + b * view[3] - c * view[6],
        a * view[1] + b * view[4] - c * view[7],
        a * view[2] + b * view[5] - c * view[8],
        d * view[0] + e * view[3] - f * view[6],
        d * view[1] + e * view[4] - f * view[7],
        d * view[2] + e * view[5] - f * view[8],
    )


@njit(forceinline=True)
def linear_of(place):
    """The linear part (9) of the blended maps."""
    return (
        row_of(place, 0), row_of(place, 1), row_of(place, 2), row_of(place, 3), row_of(place, 4),
        row_of(place, 5), row_of(place, 6), row_of(place, 7), row_of(place, 8),
    )  # fmt: skip


@njit(forceinline=True)
def covariance(view, rows, scales):
    """a, b, c of the covariance (a, b; b, c) of rows (2, 3) times scales, and its determinant."""
    x0, x1, x2 = rows[0] * scales[0], rows[1] * scales[1], rows[2] * scales[2]
    y0, y1, y2 = rows[3] * scales[0], rows[4] * scales[1], rows[5] * scales[2]
    blur = view[BLUR]
    a, b, c = x0 * x0 + x1 * x1 + x2 * x2, x0 * y0 + x1 * y1 + x2 * y2, y0 * y0 + y1 * y1 + y2 * y2
    # The first part is the cross product's square: of a needle, a c - b b loses all digits.
    n0, n1, n2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    determinant = n0 * n0 + n1 * n1 + n2 * n2 + (a + c + blur) * blur
    return a + blur, b, c + blur, determinant


@njit(forceinline=True)
def scales_of(log_scales, which, place):
    """The scales (3) of 16 particles."""
    gathered(log_scales, which, place, SCALE, 3)
    return exp(row_of(place, SCALE)), exp(row_of(place, SCALE + 1)), exp(row_of(place, SCALE + 2))


@njit(forceinline=True)
def _solid(opacity, which, fades, place):
    """The opacities of 16 particles."""
    logit = sixteen(0.0)
    for k in range(len(fades)):
        for lane in range(SIDE_BY_SIDE):
            place[SIDE_BY_SIDE * ANY + lane] = opacity[np.uintp(which[lane]), k]
        logit = fma(row_of(place, ANY), fades[k], logit)
    return sixteen(1.0) / (exp(logit * -1.0) + 1.0)


@njit(forceinline=True)
def _paint(dx, dy, dz, colors, tints, which, place):
    """The colours of 16 splats: what direction and time make of their coefficients."""
    plain = colors.shape[1] - len(tints)
    harmonics(dx, dy, dz, plain, place)
    red, green, blue = sixteen(0.5), sixteen(0.5), sixteen(0.5)
    for k in range(colors.shape[1]):
        for lane in range(SIDE_BY_SIDE):
            i = np.uintp(which[lane])
            for c in range(3):
                place[SIDE_BY_SIDE * (ANY + c) + lane] = colors[i, k, c]
        factor = row_of(place, BASIS + k) if k < plain else sixteen(tints[k - plain])
        red = fma(factor, row_of(place, ANY), red)
        green = fma(factor, row_of(place, ANY + 1), green)
        blue = fma(factor, row_of(place, ANY + 2), blue)
    return at_least(red, 0.0), at_least(green, 0.0), at_least(blue, 0.0)


@njit(forceinline=True)
def _reach(view, ahead, beside, bent, determinant, solid, log_solid):
    """Twice the logarithm of 255 times the opacity, 0 of what is not seen."""
    reach = where_above(solid, np.float32(1 / 255), (log_solid - np.float32(LEAST_LOG)) * 2.0)
    reach = where_above(ahead, view[NEAR], reach)
    reach = where_above(view[REACH] - beside, np.float32(0), reach)
    for side, size in ((bent[0], view[SIZE]), (bent[1], view[SIZE + 1])):
        reach = where_above(side, -view[MARGIN], reach)
        reach = where_above(view[MARGIN] + size - side, np.float32(0), reach)
    reach = where_above(determinant, np.float32(0), reach)
    return where_above(np.float32(1e30) - determinant, np.float32(0), reach)


@njit(forceinline=True)
def directed(view, x, y, z, local):
    """The distances of world points from the camera, and the unit directions (3) towards them."""
    distance = root(fma(local[0], local[0], fma(local[1], local[1], local[2] * local[2])))
    apart = sixteen(1.0) / distance
    return (
        distance,
        (x - view[CENTER]) * apart,
        (y - view[CENTER + 1]) * apart,
        (z - view[CENTER + 2]) * apart,
    )


@njit(parallel=True, cache=True)
def project(means, log_scales, quaternions, opacity, colors, maps, links, weights, view, tints, fades, out):
    """Fill ``out`` (N', 16) with splats; see ``project.project``. N' is N or more, a multiple of 16.

    A splat: u, v, A, B, C, opacity, colour (3), distance, how far it reaches along both axes (one that is
    not seen reaches 0), and the logarithm of its opacity. Other numbers of what is not seen mean nothing.
    """
    total, blocks = means.shape[0], out.shape[0] // SIDE_BY_SIDE
    for share in prange(64):
        place, which = room(ROWS), np.empty(SIDE_BY_SIDE, np.intp)
        for block in range(blocks * share // 64, blocks * (share + 1) // 64):
            for lane in range(SIDE_BY_SIDE):
                which[lane] = min(SIDE_BY_SIDE * block + lane, total - 1)
            x, y, z = followed(means, maps, links, weights, which, place)
            local = seen_from(view, x, y, z)
            inverse = sixteen(1.0) / local[2]
            px, py = local[0] * inverse, local[1] * inverse
            bent = through_lens(view, px, py)
            jacobian = slopes_of_pixel(view, inverse, px, py, bent)
            gathered(quaternions, which, place, QUATERNION, 4)
            rows = product(product(jacobian, linear_of(place)), turned(place))
            scales = scales_of(log_scales, which, place)
            a, b, c, determinant = covariance(view, rows, scales)
            solid = _solid(opacity, which, fades, place)
            least = log(solid)
            distance, dx, dy, dz = directed(view, x, y, z, local)
            red, green, blue = _paint(dx, dy, dz, colors, tints, which, place)
            reach = _reach(view, local[2], px * px + py * py, bent, determinant, solid, least)
            inverse = sixteen(1.0) / determinant
            set_row(place, 0, bent[0])
            set_row(place, 1, bent[1])
            set_row(place, 2, c * inverse)
            set_row(place, 3, b * inverse * -1.0)
            set_row(place, 4, a * inverse)
            set_row(place, 5, solid)
            set_row(place, 6, red)
            set_row(place, 7, green)
            set_row(place, 8, blue)
            set_row(place, 9, distance)
            set_row(place, 10, where_above(reach, np.float32(0), root(reach * a)))
            set_row(place, 11, where_above(reach, np.float32(0), root(reach * c)))
            set_row(place, 12, least)
            for j in range(13, SPLAT):
                set_row(place, j, sixteen(0.0))
            transpose(place)
            for lane in range(SIDE_BY_SIDE):
                row = SIDE_BY_SIDE * block + lane
                put_row(out, row, row_of(place, lane))
                if row >= total:
                    out[row, 10] = 0
