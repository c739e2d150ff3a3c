"""Tell sharp pictures from blurred ones, and choose frames by it."""

from __future__ import annotations

import numpy as np

_FLAT = 1e-9


def _derivatives(grey: np.ndarray) -> tuple[float, float]:
    """The mean square of the gradient and of the Laplacian of (H, W), grey levels a pixel."""
    values = grey.astype(np.float32)
    across, down = np.diff(values, axis=1), np.diff(values, axis=0)
    second = np.diff(across, axis=1)[1:-1] + np.diff(down, axis=0)[:, 1:-1]
    return float((across**2).mean() + (down**2).mean()), float((second**2).mean())


def sharpness(grey: np.ndarray) -> float:
    """Measure how much fine detail a picture (H, W) has: the mean square of its Laplacian.

    Comparable between pictures of the same things alone.
    """
    return _derivatives(grey)[1]


def edge_width(grey: np.ndarray) -> float:
    """Estimate how wide the edges of a picture (H, W) are, in pixels, whatever their contrast.

    An edge blurred by a Gaussian of deviation s has a gradient whose mean square is 2 s^2 / 3 times that of
    its second derivative. Infinite where there are no edges.

    >>> step = 255.0 * (np.arange(32) > 15)[None].repeat(32, 0)
    >>> soft = 255.0 / (1 + np.exp(-(np.arange(32) - 15.5) / 3))[None].repeat(32, 0)
    >>> edge_width(step) < 1 < 4 < edge_width(soft)
    True
    """
    first, second = _derivatives(grey)
    return float(np.sqrt(1.5 * first / second)) if second > _FLAT else float("inf")


def sharpest(stamps: np.ndarray, sharp: np.ndarray, count: int) -> list[int]:
    """Choose the sharpest frame of each of ``count`` windows of equal length in time.

    Args:
        stamps: (N,) seconds, ascending, at any distances.
        sharp: (N,) larger is better.
        count: of windows; those without a frame give none. All frames, where there are no more.

    Returns:
        indices, ascending.

    >>> sharpest(np.array([0, 1, 2, 3, 9, 10.0]), np.array([1, 5, 2, 3, 1, 2]), 2)
    [1, 5]
    """
    if len(stamps) <= count:
        return list(range(len(stamps)))
    span = (stamps[-1] - stamps[0]) * (1 + 1e-9)
    window = np.floor((stamps - stamps[0]) / span * count).astype(int)
    found = (np.flatnonzero(window == w) for w in range(count))
    return [int(rows[np.argmax(sharp[rows])]) for rows in found if len(rows)]
