"""Numba kernels that carry gradients from splats to particles and nodes, by the rules of ``kernels_grid``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from forewarp.ops.kernels_project import (
    CENTER,
    HALF,
    ONE,
    TWO,
    ZERO,
    _covariance,
    _follow,
    _lens,
    _seen_from,
    _slopes_of_pixel,
    _times,
    _turn,
    harmonics,
)
from forewarp.ops.lanes_arrays import add_row, room

SLOPES = 10  # by u, v, A, B, C, opacity, colour (3) and distance


@njit(cache=True)
def slopes_of(splats, order, sums, factor, slopes, pull):
    """From the sums over pixels (S, V, 16) of splats in their order to ``factor`` times the slopes
    by their numbers (V, 10).

    The sums are of q, q dx, q dy, q dx^2, q dx dy, q dy^2, with q the slope by the exponent and dx, dy from
    the splat to the pixel, then those by colour and distance. ``pull`` (N,) takes the lengths of those by
    u, v.
    """
    for k in range(len(order)):
        i = np.uintp(order[k])
        a, b, c, solid = splats[i, 2], splats[i, 3], splats[i, 4], splats[i, 5]
        for j in range(SLOPES):
            value = ZERO
            for share in range(sums.shape[0]):
                value += sums[share, k, j]
            slopes[k, j] = np.float32(factor) * value
        s, sx, sy = slopes[k, 0], slopes[k, 1], slopes[k, 2]
        sxx, sxy, syy = slopes[k, 3], slopes[k, 4], slopes[k, 5]
        slopes[k, 0], slopes[k, 1] = a * sx + b * sy, b * sx + c * sy
        slopes[k, 2], slopes[k, 3], slopes[k, 4] = -HALF * sxx, -sxy, -HALF * syy
        slopes[k, 5] = s / solid
        pull[i] = math.sqrt(slopes[k, 0] * slopes[k, 0] + slopes[k, 1] * slopes[k, 1])


@njit(cache=True)
def ranks_of(order, count):
    """The place of each of ``count`` rows in an order; -1 where it has none."""
    ranks = np.full(count, -1, np.int32)
    for k in range(len(order)):
        ranks[order[k]] = k
    return ranks


@njit(inline="always", fastmath={"contract"})
def _of_covariance(view, rows, scales, slopes, out):
    """From slopes by the conic A, B, C to those by rows (2, 3) times scales, ``out`` (6).

    Of the inverse X of a covariance: dL/dcov = -X G X, with G the slopes by X, half of B's on each side.
    """
    a, b, c, determinant = _covariance(view, rows, scales)
    x, y, z = c / determinant, -b / determinant, a / determinant
    g, h, k = slopes[2], slopes[3] * HALF, slopes[4]
    p0, p1, q0, q1 = g * x + h * y, g * y + h * z, h * x + k * y, h * y + k * z
    first, beside, second = -(x * p0 + y * q0), -(x * p1 + y * q1), -(y * p1 + z * q1)
    for j in range(3):
        u, v = rows[j] * scales[j], rows[3 + j] * scales[j]
        out[j] = TWO * (first * u + beside * v)
        out[3 + j] = TWO * (beside * u + second * v)


@njit(inline="always", fastmath={"contract"})
def _of_turn(quaternions, i, d, out):
    """From slopes (9) by a rotation to those by its quaternion (4), whatever its length."""
    w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
    square = w * w + x * x + y * y + z * z
    if not square > 1e-24:
        out[0], out[1], out[2], out[3] = ZERO, ZERO, ZERO, ZERO
        return
    length = ONE / math.sqrt(square)
    w, x, y, z = w * length, x * length, y * length, z * length
    gw = TWO * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    gx = TWO * (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]) - TWO * x * (d[4] + d[8]))
    gy = TWO * (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]) - TWO * y * (d[0] + d[8]))
    gz = TWO * (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]) - TWO * z * (d[0] + d[4]))
    along = gw * w + gx * x + gy * y + gz * z
    out[0], out[1] = length * (gw - along * w), length * (gx - along * x)
    out[2], out[3] = length * (gy - along * y), length * (gz - along * z)


@njit(inline="always", fastmath={"contract"})
def _of_place(view, local, bent, slopes, by_jacobian, out):
    """Slopes (3) by the world point, of the pixel, of its own slopes (2, 3) and of the distance.

    How the lens bends is taken to be the same around the point.
    """
    inverse = ONE / local[2]
    px, py = local[0] * inverse, local[1] * inverse
    a, b, c, d = bent[2], bent[3], bent[4], bent[5]
    gx, gy = a * slopes[0] + c * slopes[1], b * slopes[0] + d * slopes[1]
    lx, ly, lz = gx * inverse, gy * inverse, -(gx * px + gy * py) * inverse
    # By the slopes of the plane's point: (1/z, 0, -x/z^2) and (0, 1/z, -y/z^2).
    across, upright, ahead_x, ahead_y = ZERO, ZERO, ZERO, ZERO
    for k in range(3):
        first = a * by_jacobian[k] + c * by_jacobian[3 + k]
        second = b * by_jacobian[k] + d * by_jacobian[3 + k]
        across += first * view[k]
        upright += second * view[3 + k]
        ahead_x += first * view[6 + k]
        ahead_y += second * view[6 + k]
    square = inverse * inverse
    lx -= ahead_x * square
    ly -= ahead_y * square
    lz += (TWO * (px * ahead_x + py * ahead_y) - across - upright) * square
    far = slopes[9] / math.sqrt(local[0] * local[0] + local[1] * local[1] + local[2] * local[2])
    lx, ly, lz = lx + far * local[0], ly + far * local[1], lz + far * local[2]
    for k in range(3):
        out[k] = view[k] * lx + view[3 + k] * ly + view[6 + k] * lz


@njit(inline="always", fastmath={"contract"})
def _of_warp(moved, by_moved, jacobian, warp, by_point, mean, i, out):
    """Slopes (12) by the blended map, of the covariance's and the point's; those by the Jacobian (6)."""
    for r in range(3):
        for c in range(3):
            value = by_point[r] * mean[i, c]
            for row in range(2):
                value += jacobian[3 * row + r] * by_moved[3 * row + c]
            out[3 * r + c] = value
        out[9 + r] = by_point[r]
    for j in range(12, 16):
        out[j] = ZERO


@njit(inline="always", fastmath={"contract"})
def _of_colors(view, warp, mean, i, slopes, splats, plain, tints, basis, out):
    """Slopes by the coefficients of colour; direction has none."""
    x, y, z = mean[i, 0], mean[i, 1], mean[i, 2]
    dx = warp[0] * x + warp[1] * y + warp[2] * z + warp[9] - view[CENTER]
    dy = warp[3] * x + warp[4] * y + warp[5] * z + warp[10] - view[CENTER + 1]
    dz = warp[6] * x + warp[7] * y + warp[8] * z + warp[11] - view[CENTER + 2]
    inverse = ONE / splats[i, 9]
    harmonics(dx * inverse, dy * inverse, dz * inverse, plain, basis)
    for channel in range(3):
        slope = slopes[6 + channel] if splats[i, 6 + channel] > 0 else ZERO
        for k in range(plain):
            out[i, k, channel] = basis[k] * slope
        for k in range(len(tints)):
            out[i, plain + k, channel] = tints[k] * slope


@njit(parallel=True, cache=True, fastmath={"contract"})
def chain(  # long: one particle's way back, step by step
    means, log_scales, quaternions, opacity, colors, maps, links, weights, view, tints, fades,
    splats, ranks, slopes,
    to_means, to_scales, to_quaternions, to_opacity, to_colors, to_maps, to_weights,
):  # fmt: skip
    """From slopes (V, 10), a particle's in the row ``ranks`` (N,) or -1, to those by particles and maps."""
    shares = to_maps.shape[0]
    for share in prange(shares):
        warp, turn, by_warp, basis = room(12), room(9), room(12), room(16)
        jacobian, moved, rows, scales, local = room(6), room(6), room(6), room(3), room(3)
        by_point, by_rows, by_turn, by_four = room(3), room(6), room(9), room(4)
        by_moved, by_jacobian = room(6), room(6)
        plain, count, own_maps = colors.shape[1] - len(tints), len(ranks), to_maps[share]
        for row in range(count * share // shares, count * (share + 1) // shares):
            i = np.uintp(row)
            if ranks[i] < 0:
                continue
            slope = slopes[np.uintp(ranks[i])]
            x, y, z = _follow(means, maps, links, weights, i, warp)
            _seen_from(view, x, y, z, local)
            bent = _lens(view, local[0] / local[2], local[1] / local[2])
            _slopes_of_pixel(view, local, bent, jacobian)
            _times(jacobian, warp, moved)
            _turn(quaternions, i, turn)
            _times(moved, turn, rows)
            for j in range(3):
                scales[j] = math.exp(log_scales[i, j])
            _of_covariance(view, rows, scales, slope, by_rows)
            for j in range(3):
                by_rows[j] *= scales[j]
                by_rows[3 + j] *= scales[j]
                to_scales[i, j] = by_rows[j] * rows[j] + by_rows[3 + j] * rows[3 + j]
            for r in range(3):
                for c in range(3):
                    by_turn[3 * r + c] = moved[r] * by_rows[c] + moved[3 + r] * by_rows[3 + c]
                    # (2, 3) times the transposed rotation
                for row in range(2):
                    by_moved[3 * row + r] = (
                        by_rows[3 * row] * turn[3 * r]
                        + by_rows[3 * row + 1] * turn[3 * r + 1]
                        + by_rows[3 * row + 2] * turn[3 * r + 2]
                    )
            _of_turn(quaternions, i, by_turn, by_four)
            for j in range(4):
                to_quaternions[i, j] = by_four[j]
            for row in range(2):
                for r in range(3):
                    by_jacobian[3 * row + r] = (
                        by_moved[3 * row] * warp[3 * r]
                        + by_moved[3 * row + 1] * warp[3 * r + 1]
                        + by_moved[3 * row + 2] * warp[3 * r + 2]
                    )
            _of_place(view, local, bent, slope, by_jacobian, by_point)
            _of_warp(moved, by_moved, jacobian, warp, by_point, means, i, by_warp)
            for j in range(3):
                to_means[i, j] = warp[j] * by_point[0] + warp[3 + j] * by_point[1] + warp[6 + j] * by_point[2]
            for n in range(links.shape[1]):
                w, node = weights[i, n], links[i, n]
                if w != 0:
                    add_row(own_maps, node, w, by_warp)
                if len(to_weights):
                    value = ZERO
                    for j in range(12):
                        value += by_warp[j] * maps[node, j]
                    to_weights[i, n] = value
            solid = splats[i, 5]
            for j in range(opacity.shape[1]):
                to_opacity[i, j] = slope[5] * solid * (ONE - solid) * fades[j]
            _of_colors(view, warp, means, i, slope, splats, plain, tints, basis, to_colors)
