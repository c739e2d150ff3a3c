"""Tell sharp pictures from blurred ones, and choose frames by it."""

from __future__ import annotations

import numpy as np
import torch

from forewarp.drawing.images import at_most

_FLAT = 1e-9
_COARSE = 160  # pixels of the longer side at which blur is told from what a codec adds


def sharpness(grey: np.ndarray) -> float:
    """Measure how much fine detail a picture (H, W) has: the mean square of its Laplacian.

    Comparable between pictures of the same things alone.
    """
    values = grey.astype(np.float32)
    across, down = np.diff(values, 2, axis=1)[1:-1], np.diff(values, 2, axis=0)[:, 1:-1]
    return float(((across + down) ** 2).mean())


def edge_width(grey: np.ndarray) -> float:
    """Estimate how wide the edges of a picture (H, W) are, in pixels of one 640 wide.

    Contrast does not count: an edge blurred by a Gaussian of deviation s has a gradient whose mean square is
    2 s^2 times that of its own derivative. This is taken of the picture made 160 pixels wide, as what a codec
    adds to a blurred picture is finer. So no edge is under 2 wide; sharp films give 1.9 to 2.3, those blurred
    by 3 pixels 2.7, by 6 pixels 3.8. Of both axes the wider counts, as a shaken camera blurs along one.
    Infinite without edges.

    >>> step = 255.0 * (np.arange(640) > 319)[None].repeat(640, 0) * (np.arange(640) > 319)[:, None]
    >>> round(edge_width(step), 1)
    2.0
    >>> blurred = np.cumsum(np.exp(-(np.arange(-320, 320) ** 2) / 200))
    >>> round(edge_width(blurred * blurred[:, None]))
    10
    """
    small = at_most(torch.from_numpy(grey.astype(np.float32))[..., None], _COARSE)[..., 0].numpy()
    widths = []
    for axis in (0, 1):
        first, second = (float((np.diff(small, n, axis=axis) ** 2).mean()) for n in (1, 2))
        widths.append(np.sqrt(first / (2 * second)) if second > _FLAT else np.inf)
    return float(max(widths)) * 640 / _COARSE


def sharpest(stamps: np.ndarray, sharp: np.ndarray, count: int) -> list[int]:
    """Choose the sharpest frame of each of ``count`` windows of equal length in time.

    A window without a frame does not count: where there are gaps, windows are so much shorter that ``count``
    of them have frames, or as many as come nearest to it.

    Args:
        stamps: (N,) seconds, ascending, at any distances.
        sharp: (N,) larger is better.
        count: of windows. All frames, where there are no more.

    Returns:
        indices, ascending.

    >>> sharpest(np.array([0, 1, 2, 3, 9, 10.0]), np.array([1, 5, 2, 3, 1, 2]), 2)
    [1, 5]
    >>> sharpest(np.array([0, 1, 2, 3, 9, 10.0]), np.array([1, 5, 2, 3, 1, 2]), 4)
    [1, 2, 3, 5]
    """
    if len(stamps) <= count:
        return list(range(len(stamps)))
    share = (stamps - stamps[0]) / ((stamps[-1] - stamps[0]) * (1 + 1e-9))
    few = many = count
    while len(_windows(share, many)) < count:
        few, many = many, 2 * many
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (middle, many) if len(_windows(share, middle)) < count else (few, middle)
    windows = _windows(share, many)
    if len(windows) > count:
        windows = _windows(share, few)
    return [int(rows[np.argmax(sharp[rows])]) for rows in windows]


def _windows(share: np.ndarray, count: int) -> list[np.ndarray]:
    """Split rows by which of ``count`` windows of [0, 1) their ascending ``share`` is in; none is empty."""
    begins = np.flatnonzero(np.diff(np.floor(share * count))) + 1
    return np.split(np.arange(len(share)), begins)
