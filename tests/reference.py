"""Slow and obvious twins of what the package does fast."""

import math

import numpy as np
import torch

# metrics ---------------------------------------------------------------------------------------------------


def similarity_at_window(a, b):
    """Similarity and contrast of two 11 x 11 float64 numpy patches, straight from the definition."""
    x = np.arange(-5, 6)
    weights = np.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    mean_a, mean_b = (weights * a).sum(), (weights * b).sum()
    var_a, var_b = (weights * (a - mean_a) ** 2).sum(), (weights * (b - mean_b) ** 2).sum()
    cov = (weights * (a - mean_a) * (b - mean_b)).sum()
    contrast = (2 * cov + 0.03**2) / (var_a + var_b + 0.03**2)
    return contrast * (2 * mean_a * mean_b + 0.01**2) / (mean_a**2 + mean_b**2 + 0.01**2), contrast


def similarity_means(a, b):
    """Mean similarity and contrast over the full windows of two planes (H, W)."""
    both = [
        similarity_at_window(a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11])
        for i in range(a.shape[0] - 10)
        for j in range(a.shape[1] - 10)
    ]
    return np.mean(both, axis=0)


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
