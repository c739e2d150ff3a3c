"""Numba kernel that projects Gaussians, by the rules of ``voxels``. The equations stand in ``ops.gaussians``.

Sixteen Gaussians are treated side by side: a *row* of a ``room`` has one number of each of them.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from forewarp.ops.gaussians import COLUMN, LEAST_LOG
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
    transpose,
    where_above,
)

SIDE_BY_SIDE = NARROW
# Where the numbers of a camera lie, after its rotation; see ``Pinhole.row``.
CENTER, FOCAL, SKEW, MIDDLE, SIZE, NEAR, BLUR, MARGIN, RADIAL, TANGENTIAL, REACH = (
    9, 12, 14, 15, 17, 19, 20, 21, 22, 25, 27,
)  # fmt: skip
# Rows of a room: the blended map, then what is gathered of the Gaussians, then harmonics.
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
    reach = where_above(opacity, np.float32(1 / 255), (log_opacity - np.float32(LEAST_LOG)) * 2.0)
    reach = where_above(ahead, camera[NEAR], reach)
    reach = where_above(camera[REACH] - beside, zero, reach)
    for pixel, size in ((lens[0], camera[SIZE]), (lens[1], camera[SIZE + 1])):
        reach = where_above(pixel, -camera[MARGIN], reach)
        reach = where_above(camera[MARGIN] + size - pixel, zero, reach)
    reach = where_above(determinant, zero, reach)
    return where_above(np.float32(1e30) - determinant, zero, reach)


@njit(parallel=True, cache=True)
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
