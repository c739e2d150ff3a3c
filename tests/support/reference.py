"""Slow and obvious reference implementations."""

import math

import numpy as np
import torch

# metrics ---------------------------------------------------------------------------------------------------


def similarity_means(a, b):
    """Mean similarity and contrast of the 11 x 11 windows of two planes (H, W), as they are defined."""
    x = np.arange(-5, 6)
    weights = np.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * 1.5**2))
    a, b = (np.lib.stride_tricks.sliding_window_view(plane, (11, 11)) for plane in (a, b))

    def mean(windows):
        return (weights * windows).sum((-2, -1), keepdims=True) / weights.sum()

    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b, cov = mean((a - mean_a) ** 2), mean((b - mean_b) ** 2), mean((a - mean_a) * (b - mean_b))
    contrast = (2 * cov + 0.03**2) / (var_a + var_b + 0.03**2)
    similarity = contrast * (2 * mean_a * mean_b + 0.01**2) / (mean_a**2 + mean_b**2 + 0.01**2)
    return similarity.mean(), contrast.mean()


def halved(plane):
    """Means of 2 x 2 blocks (H, W) -> (ceil(H/2), ceil(W/2)); at an odd end, of what is there."""
    h, w = plane.shape
    rows = [[plane[i : i + 2, j : j + 2].mean() for j in range(0, w, 2)] for i in range(0, h, 2)]
    return np.array(rows)


def halved_with_zeros(plane):
    """As ``halved``, an odd side first padded with zeros on both ends, what is left over dropped."""
    plane = np.pad(plane, [(s % 2, s % 2) for s in plane.shape])
    return halved(plane[: plane.shape[0] // 2 * 2, : plane.shape[1] // 2 * 2])


def lpips_distance(features, taps, heads, a, b):
    """LPIPS of images (1, 3, H, W) in [-1, 1]: every layer's features from scratch, one pixel at a time."""
    shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
    total = 0.0
    for tap, head in zip(taps, heads):
        fa, fb = (features[: tap + 1]((x - shift) / scale)[0] for x in (a, b))
        _, height, width = fa.shape
        for i in range(height):
            for j in range(width):
                u, v = fa[:, i, j], fb[:, i, j]
                u, v = u / (u.norm() + 1e-10), v / (v.norm() + 1e-10)
                total += float((head.flatten() * (u - v) ** 2).sum()) / (height * width)
    return total


def depth_delta(prediction, truth, foreground, thresholds):
    """Fractions of right pixels, counted one by one."""
    right, count = [0] * len(thresholds), 0
    for d, exact, inside in zip(*(x.flatten().tolist() for x in (prediction, truth, foreground))):
        if not inside or not exact > 0:
            continue
        count += 1
        for k, threshold in enumerate(thresholds):
            right[k] += math.isfinite(d) and d > 0 and max(d / exact, exact / d) < threshold
    return tuple(r / count for r in right)


def end_point_error(predicted, truth, threshold):
    """Mean errors of moving and still points and the mean motion of moving ones, one distance at a time."""
    moving, still, motion = [], [], []
    for p, q in zip(predicted.tolist(), truth.tolist()):
        steps = [math.dist(place, q[0]) for place in q[1:]]
        errors = [math.dist(x, y) for x, y in zip(p[1:], q[1:])]
        if max(steps) > threshold:
            moving += errors
            motion += steps
        else:
            still += errors
    return tuple(sum(v) / len(v) for v in (moving, still, motion))


# cameras ---------------------------------------------------------------------------------------------------


def bend(x, y, k, p):
    """Where OpenCV's lens puts a point of the plane z = 1."""
    r2 = x * x + y * y
    s = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    across = x * s + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x)
    return across, y * s + 2 * p[1] * x * y + p[0] * (r2 + 2 * y * y)


# the core --------------------------------------------------------------------------------------------------


def dct_difference(time, bases, frames, canonical, padding=0.0):
    """``b_k(t) - b_k(canonical)`` for k = 1..K, one cosine at a time."""

    def basis(t, k):
        t = (t + padding) / (1 + 2 * padding)
        return math.sqrt(2 / frames) * math.cos(math.pi / (2 * frames) * (2 * t * (frames - 1) + 1) * k)

    return [basis(time, k) - basis(canonical, k) for k in range(1, bases + 1)]


def tent(u):
    """The trilinear kernel of an offset (3,)."""
    return math.prod(max(0.0, 1 - abs(v)) for v in u)


def lattice_cells(shape):
    """Every (x, y, z), last axis fastest."""
    return [(x, y, z) for x in range(shape[0]) for y in range(shape[1]) for z in range(shape[2])]


def trilinear_read(values, index, points, fill):
    """Every voxel's value times its kernel, all voxels for all points; points clamped to the border."""
    out = []
    for point in points.tolist():
        at = [min(max(v, 0.0), n - 1.0) for v, n in zip(point, index.shape)]
        total = torch.zeros(values.shape[1], dtype=values.dtype)
        for cell in lattice_cells(index.shape):
            row = int(index[cell])
            total += tent([a - c for a, c in zip(at, cell)]) * (fill if row < 0 else values[row])
        out.append(total)
    return torch.stack(out)


def splat_sums(source, positions, shape):
    """Sums of values (X, Y, Z, C) and of weights (X, Y, Z): every source voxel against every cell."""
    sums, weights = np.zeros((*shape, source.shape[1])), np.zeros(shape)
    for value, position in zip(source.tolist(), positions.tolist()):
        if not all(math.isfinite(v) for v in position):
            continue
        for cell in lattice_cells(shape):
            w = tent([p - c for p, c in zip(position, cell)])
            sums[cell] += w * np.array(value)
            weights[cell] += w
    return torch.from_numpy(sums), torch.from_numpy(weights)


def march_samples(origins, directions, near, far, step, cells, jitter):
    """Every step of every ray from near to far, kept where it lies in an occupied cell."""
    found = []
    for ray, (o, d, j) in enumerate(zip(origins.tolist(), directions.tolist(), jitter.tolist())):
        k = 0
        while (t := near + (k + j) * step) <= far:
            at = [a + t * b for a, b in zip(o, d)]
            if all(0 <= v <= n for v, n in zip(at, cells.shape)):
                cell = tuple(min(int(v), n - 1) for v, n in zip(at, cells.shape))
                if cells[cell]:
                    found.append((ray, t))
            k += 1
    return [ray for ray, _ in found], [t for _, t in found]


def composite(optical, ray_ids, rays):
    """Weights and final transmittance by the running product of what is let through."""
    through, weights = [1.0] * rays, []
    for x, ray in zip(optical.tolist(), ray_ids.tolist()):
        alpha = 1 - math.exp(-x)
        weights.append(through[ray] * alpha)
        through[ray] *= 1 - alpha
    return weights, through


def variation(grid):
    """Mean absolute difference of neighbours in a grid (X, Y, Z, C), summed over axes; NaN is absent."""
    total = 0.0
    for axis in range(3):
        difference = np.abs(np.diff(grid, axis=axis))
        present = difference[~np.isnan(difference)]
        total += present.mean() if present.size else 0.0
    return total


def patch_roughness(depth, opacity):
    """Pixel by pixel: squared differences to the right and down, by the smaller opacity."""
    depth, opacity = depth.tolist(), opacity.tolist()
    size = range(len(depth[0]))
    right, down = [], []
    for d, o in zip(depth, opacity):
        right += [(d[i][j + 1] - d[i][j]) ** 2 * min(o[i][j + 1], o[i][j]) for i in size for j in size[:-1]]
        down += [(d[i + 1][j] - d[i][j]) ** 2 * min(o[i + 1][j], o[i][j]) for i in size[:-1] for j in size]
    return sum(right) / len(right) + sum(down) / len(down)
