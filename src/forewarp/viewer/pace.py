"""How large a picture may be that is drawn ten times a second."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable

GOAL = 0.1  # seconds a picture may take while the camera moves
_FIRST, _LEAST = 160, 72  # rows of the first picture while moving, and of the smallest
_PART = 0.3  # seconds that a part of a large picture may take


class Pace:
    """Choose the rows of pictures by how long the last ones took; one for each kind of picture.

    Seconds may hardly follow the rows, as where a method is busy with its own before it draws: so rows are
    changed step by step, and never below ``_LEAST``.
    """

    def __init__(self) -> None:
        self._rows: dict[Hashable, float] = {}
        self._second: dict[Hashable, float] = {}  # seconds a pixel of the last picture

    def rows(self, kind: Hashable, full: int) -> int:
        """Return how many rows a picture should have while the camera moves, ``full`` at most, in eights.

        >>> Pace().rows("colour", 400), Pace().rows("colour", 100)
        (160, 100)
        """
        return min(full, 8 * round(self._rows.get(kind, _FIRST) / 8))

    def drew(self, kind: Hashable, rows: int, pixels: int, seconds: float) -> None:
        """Note how long a picture took."""
        self._second[kind] = seconds / pixels
        if rows <= self._rows.get(kind, _FIRST) or seconds < GOAL:
            factor = math.sqrt(GOAL / max(seconds, 1e-4))
            self._rows[kind] = max(_LEAST, rows * min(1.5, max(0.5, factor)))

    def parts(self, kind: Hashable, width: int, rows: int) -> int:
        """Return in how many parts to draw a picture, so that one that is no longer wanted soon ends."""
        seconds = self._second.get(kind, 0.0) * width * rows
        return max(1, min(rows, math.ceil(seconds / _PART)))


_LEAST_SPAN = 0.5  # seconds of pictures before there is a rate


class Rate:
    """Count pictures a second over the last ``span`` seconds, once they took half a second."""

    def __init__(self, span: float = 2.0) -> None:
        self._span, self._drawn = span, deque()

    def drew(self, now: float) -> float:
        """Note a picture; return the rate, 0 for the first ones.

        >>> rate = Rate()
        >>> [rate.drew(now) for now in (0.0, 0.1, 0.5, 1.0)]
        [0.0, 0.0, 4.0, 3.0]
        """
        self._drawn.append(now)
        while now - self._drawn[0] > self._span:
            self._drawn.popleft()
        passed = now - self._drawn[0]
        return (len(self._drawn) - 1) / passed if passed >= _LEAST_SPAN else 0.0
