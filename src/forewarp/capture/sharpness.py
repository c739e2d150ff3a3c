"""Tell sharp pictures from blurred ones, and choose frames by it."""

from __future__ import annotations

import numpy as np

_FLAT = 1e-9


def sharpness(grey: np.ndarray) -> float:
    """Measure how much fine detail a picture (H, W) has: the mean square of its Laplacian.

    Comparable between pictures of the same things alone.
    """
    values = grey.astype(np.float32)
    across, down = np.diff(values, 2, axis=1)[1:-1], np.diff(values, 2, axis=0)[:, 1:-1]
    return float(((across + down) ** 2).mean())


def edge_width(grey: np.ndarray) -> float:
    """Estimate how wide the edges of a picture (H, W) are, in pixels, whatever their contrast.

    An edge blurred by a Gaussian of deviation s has a gradient whose mean square is 2 s^2 times that of its
    own derivative. Of both axes the wider counts, as a shaken camera blurs along one. Infinite without edges.

    >>> step = 255.0 * (np.arange(32) > 15)[None].repeat(32, 0) * (np.arange(32) > 15)[:, None]
    >>> round(edge_width(step), 1)
    0.5
    >>> blurred = np.cumsum(np.exp(-(np.arange(-32, 32) ** 2) / 32))
    >>> round(edge_width(blurred * blurred[:, None]), 1)
    4.0
    """
    values, widths = grey.astype(np.float32), []
    for axis in (0, 1):
        first, second = (float((np.diff(values, n, axis=axis) ** 2).mean()) for n in (1, 2))
        widths.append(np.sqrt(first / (2 * second)) if second > _FLAT else np.inf)
    return float(max(widths))


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
