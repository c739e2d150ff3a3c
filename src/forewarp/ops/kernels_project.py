"""Numba kernels behind ``project``, by the rules of ``kernels_grid``. The equations stand there."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from forewarp.ops.lanes_arrays import room, take_row

SPLAT = 12
ONE, TWO = np.float32(1), np.float32(2)  # whole numbers would make float64 of all they meet
# Where the numbers of a view lie in its row; see ``project.View.row``.
ROTATION, CENTER, FOCAL, SKEW, MIDDLE, SIZE, NEAR, BLUR, MARGIN, RADIAL, TANGENTIAL, REACH = (
    0, 9, 12, 14, 15, 17, 19, 20, 21, 22, 25, 27,
)  # fmt: skip
C0, C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
C20, C21, C22 = (np.float32(c) for c in (1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
C30, C31, C32 = (np.float32(c) for c in (0.5900435899266435, 2.890611442640554, 0.4570457994644658))
C33, C34 = (np.float32(c) for c in (0.3731763325901154, 1.445305721320277))
ZERO, HALF, THREE, FOUR, FULL = (np.float32(c) for c in (0, 0.5, 3, 4, 255))


@njit(inline="always", fastmath={"contract"})
def harmonics(x, y, z, count, out):
    """Real spherical harmonics of a unit direction into ``out[:count]``; count is 1, 4, 9 or 16."""
    out[0] = C0
    if count > 1:
        out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        out[4], out[5] = C20 * x * y, -C20 * y * z
        out[6] = C21 * (TWO * zz - xx - yy)
        out[7], out[8] = -C20 * x * z, C22 * (xx - yy)
        if count > 9:
            out[9] = -C30 * y * (THREE * xx - yy)
            out[10] = C31 * x * y * z
            out[11] = -C32 * y * (FOUR * zz - xx - yy)
            out[12] = C33 * z * (TWO * zz - THREE * xx - THREE * yy)
            out[13] = -C32 * x * (FOUR * zz - xx - yy)
            out[14] = C34 * z * (xx - yy)
            out[15] = -C30 * x * (xx - THREE * yy)


@njit(inline="always", fastmath={"contract"})
def _follow(mean, maps, links, weights, i, warp):
    """Blend the maps (M, 16) of a particle's nodes into ``warp``: I + sum w D row by row, then the shift."""
    for j in range(16):
        warp[j] = np.float32(0)
    for k in range(links.shape[1]):
        w = weights[i, k]
        if w != 0:
            take_row(maps, links[i, k], w, warp)
    warp[0] += ONE
    warp[4] += ONE
    warp[8] += ONE
    x, y, z = mean[i, 0], mean[i, 1], mean[i, 2]
    return (
        warp[0] * x + warp[1] * y + warp[2] * z + warp[9],
        warp[3] * x + warp[4] * y + warp[5] * z + warp[10],
        warp[6] * x + warp[7] * y + warp[8] * z + warp[11],
    )


@njit(inline="always", fastmath={"contract"})
def _lens(view, x, y):
    """Where a lens puts a point of the plane, in pixels, and the 2 x 2 slopes of that."""
    k1, k2, k3 = view[RADIAL], view[RADIAL + 1], view[RADIAL + 2]
    p1, p2 = view[TANGENTIAL], view[TANGENTIAL + 1]
    r2 = x * x + y * y
    scale = ONE + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = TWO * (k1 + r2 * (TWO * k2 + r2 * THREE * k3))
    u = x * scale + TWO * p1 * x * y + p2 * (r2 + TWO * x * x)
    v = y * scale + TWO * p2 * x * y + p1 * (r2 + TWO * y * y)
    xx = scale + slope * x * x + TWO * p1 * y + TWO * THREE * p2 * x
    xy = slope * x * y + TWO * p1 * x + TWO * p2 * y
    yy = scale + slope * y * y + TWO * p2 * x + TWO * THREE * p1 * y
    fx, fy, skew = view[FOCAL], view[FOCAL + 1], view[SKEW]
    return (
        fx * u + skew * v + view[MIDDLE],
        fy * v + view[MIDDLE + 1],
        fx * xx + skew * xy,
        fx * xy + skew * yy,
        fy * xy,
        fy * yy,
    )


@njit(inline="always", fastmath={"contract"})
def _turn(quaternions, i, out):
    """The rotation (9) of a quaternion (w, x, y, z) of any length; of length 0 it is none."""
    w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
    square = w * w + x * x + y * y + z * z
    if not square > 1e-24:
        w, x, y, z, square = ONE, ZERO, ZERO, ZERO, ONE
    s = TWO / square
    out[0], out[1], out[2] = ONE - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)
    out[3], out[4], out[5] = s * (x * y + w * z), ONE - s * (x * x + z * z), s * (y * z - w * x)
    out[6], out[7], out[8] = s * (x * z - w * y), s * (y * z + w * x), ONE - s * (x * x + y * y)


@njit(inline="always", fastmath={"contract"})
def _times(a, b, out):
    """``out = a b`` of (2, 3) and (3, 3), row by row in 6, 9 and 6 numbers."""
    for r in range(2):
        for c in range(3):
            out[3 * r + c] = a[3 * r] * b[c] + a[3 * r + 1] * b[3 + c] + a[3 * r + 2] * b[6 + c]


@njit(inline="always", fastmath={"contract"})
def _seen_from(view, x, y, z, local):
    """A world point in the camera's axes, into ``local`` (3)."""
    x, y, z = x - view[CENTER], y - view[CENTER + 1], z - view[CENTER + 2]
    for r in range(3):
        local[r] = view[3 * r] * x + view[3 * r + 1] * y + view[3 * r + 2] * z


@njit(inline="always", fastmath={"contract"})
def _slopes_of_pixel(view, local, bent, jacobian):
    """The slopes (2, 3) of the pixel by the world point."""
    inverse = ONE / local[2]
    px, py = local[0] * inverse, local[1] * inverse
    for r in range(2):
        a, b = bent[2 + 2 * r] * inverse, bent[3 + 2 * r] * inverse
        c = -(a * px + b * py)
        for k in range(3):
            jacobian[3 * r + k] = a * view[k] + b * view[3 + k] + c * view[6 + k]


@njit(inline="always", fastmath={"contract"})
def _covariance(view, rows, scales):
    """a, b, c of the covariance (a, b; b, c) of rows (2, 3) times scales, and its determinant."""
    x0, x1, x2 = rows[0] * scales[0], rows[1] * scales[1], rows[2] * scales[2]
    y0, y1, y2 = rows[3] * scales[0], rows[4] * scales[1], rows[5] * scales[2]
    blur = view[BLUR]
    a, b, c = x0 * x0 + x1 * x1 + x2 * x2, x0 * y0 + x1 * y1 + x2 * y2, y0 * y0 + y1 * y1 + y2 * y2
    # The first part is the cross product's square: of a needle, a c - b b loses all digits.
    n0, n1, n2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    determinant = n0 * n0 + n1 * n1 + n2 * n2 + blur * (a + c) + blur * blur
    return a + blur, b, c + blur, determinant


@njit(inline="always", fastmath={"contract"})
def _logit(opacity, i, fades):
    value = ZERO
    for k in range(opacity.shape[1]):
        value += opacity[i, k] * fades[k]
    return value


@njit(parallel=True, cache=True, fastmath={"contract"})
def project(means, log_scales, quaternions, opacity, colors, maps, links, weights, view, tints, fades, out):
    """Fill ``out`` (N, 12) with splats; see ``project.project``."""
    total = means.shape[0]
    chunks = 64
    for chunk in prange(chunks):
        warp, turn, basis = room(12), room(9), room(16)
        jacobian, moved, rows, scales, local = room(6), room(6), room(6), room(3), room(3)
        plain = colors.shape[1] - len(tints)
        for row in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            i = np.uintp(row)
            out[i, 10] = ZERO
            x, y, z = _follow(means, maps, links, weights, i, warp)
            _seen_from(view, x, y, z, local)
            solid = ONE / (ONE + math.exp(-_logit(opacity, i, fades)))
            px, py = local[0] / local[2], local[1] / local[2]
            if not (local[2] > view[NEAR] and solid * FULL > ONE and px * px + py * py < view[REACH]):
                continue
            bent = _lens(view, px, py)
            beside = max(-bent[0], bent[0] - view[SIZE], -bent[1], bent[1] - view[SIZE + 1])
            if not beside < view[MARGIN]:
                continue
            _slopes_of_pixel(view, local, bent, jacobian)
            _times(jacobian, warp, moved)
            _turn(quaternions, i, turn)
            _times(moved, turn, rows)
            for k in range(3):
                scales[k] = math.exp(log_scales[i, k])
            a, b, c, determinant = _covariance(view, rows, scales)
            if not (determinant > 0 and determinant < 1e30):
                continue
            out[i, 0], out[i, 1] = bent[0], bent[1]
            out[i, 2], out[i, 3], out[i, 4] = c / determinant, -b / determinant, a / determinant
            out[i, 5] = solid
            out[i, 9] = math.sqrt(local[0] * local[0] + local[1] * local[1] + local[2] * local[2])
            reach = TWO * math.log(FULL * solid)
            out[i, 10], out[i, 11] = math.sqrt(reach * a), math.sqrt(reach * c)
            _paint(view, x, y, z, out[i, 9], plain, colors, i, tints, basis, out)


@njit(inline="always", fastmath={"contract"})
def _paint(view, x, y, z, distance, plain, colors, i, tints, basis, out):
    """The colour of a splat: what its direction and the time make of its coefficients."""
    inverse = ONE / distance
    dx, dy, dz = (
        (x - view[CENTER]) * inverse,
        (y - view[CENTER + 1]) * inverse,
        (z - view[CENTER + 2]) * inverse,
    )
    harmonics(dx, dy, dz, plain, basis)
    for channel in range(3):
        value = HALF
        for k in range(plain):
            value += basis[k] * colors[i, k, channel]
        for k in range(len(tints)):
            value += tints[k] * colors[i, plain + k, channel]
        out[i, 6 + channel] = max(value, ZERO)
