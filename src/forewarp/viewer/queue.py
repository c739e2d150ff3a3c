"""The render queue: what pages ask for, in which order it is rendered, and how large it may be."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Hashable
from itertools import count
from typing import NamedTuple

Job = Callable[[], None]

FRAME_SECONDS = 0.1  # that an image may take while the camera moves
_FIRST_ROWS, _MIN_ROWS = 160, 72  # rows of the first image while moving, and of the smallest
_CHUNK_SECONDS = 0.3  # that a chunk of a large image may take
_RATE_SECONDS, _MIN_RATE_SECONDS = 2.0, 0.5  # over which frames a second are counted, at most and at least


class Cancelled(Exception):
    """What is being rendered is no longer wanted."""


class _Request(NamedTuple):
    priority: int
    number: int
    due: float
    job: Job


class RenderQueue:
    """Keep the newest request of each kind from each page, until the one rendering thread takes it.

    Any thread may ``submit``; one alone may ``run_next``. So no two images are rendered at once, and a run in
    training, whose own thread renders between its steps, is never rendered in the middle of one.

    Args:
        clock: gives seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._numbers = clock, count()
        self._waiting: dict[tuple, _Request] = {}  # by page and kind
        self._wanted: tuple | None = None  # page and kind of the job that is running, while it is wanted
        self._running = False
        self._changed = threading.Condition()
        self.closed = False

    def submit(self, page: Hashable, kind: Hashable, job: Job, priority: int = 0, delay: float = 0.0) -> None:
        """Submit a job; an earlier one of the same page and kind is cancelled, also if it is running.

        Args:
            page: who asks.
            kind: what for, as an image or a point.
            job: may ask whether it ``is_stale``.
            priority: smaller ones come first; among equals, the oldest.
            delay: seconds to wait before the job may run.
        """
        with self._changed:
            due = self._clock() + delay
            self._waiting[page, kind] = _Request(priority, next(self._numbers), due, job)
            self._wanted = None if self._wanted == (page, kind) else self._wanted
            self._changed.notify()

    def cancel(self, page: Hashable) -> None:
        """Cancel all that a page has submitted."""
        with self._changed:
            self._waiting = {key: request for key, request in self._waiting.items() if key[0] != page}
            self._wanted = None if self._wanted and self._wanted[0] == page else self._wanted

    def close(self) -> None:
        """Cancel everything; ``run_next`` returns at once from now on."""
        with self._changed:
            self.closed, self._wanted = True, None
            self._waiting.clear()
            self._changed.notify()

    def has_due_job(self) -> bool:
        """Tell whether a job is due now; costs nothing where nothing was submitted."""
        if not self._waiting:
            return False
        with self._changed:
            return self._first() is not None

    def run_next(self, wait: float = 0.0) -> bool:
        """Run one job, if any is due within ``wait`` seconds; return whether one was run.

        A job that fails is reported on stderr and ends alone.
        """
        job = self._take(wait)
        if job is None:
            return False
        self._running = True
        try:
            job()
        except Cancelled:
            pass
        except Exception as error:
            traceback.print_exception(error)
        finally:
            self._running, self._wanted = False, None
        return True

    def is_stale(self) -> bool:
        """Tell whether the running job, if any, is no longer wanted."""
        return self._running and self._wanted is None

    def run_forever(self) -> None:
        """Run job after job until the queue is closed."""
        while not self.closed:
            self.run_next(1.0)

    def _take(self, wait: float) -> Job | None:
        """Wait for the first job that is due; it is wanted from now on."""
        end = self._clock() + wait
        with self._changed:
            while not self.closed:
                key, now = self._first(), self._clock()
                if key is not None:
                    self._wanted = key
                    return self._waiting.pop(key).job
                if now >= end:
                    return None
                next_due = min((request.due for request in self._waiting.values()), default=end)
                self._changed.wait(max(1e-3, min(end, next_due) - now))
        return None

    def _first(self) -> tuple | None:
        now = self._clock()
        due = [key for key, request in self._waiting.items() if request.due <= now]
        return min(due, key=lambda key: self._waiting[key][:2], default=None)  # priority, then age


class FrameRateControl:
    """Choose how large images are, by how long the last ones took; for each kind of image by itself.

    Seconds may hardly depend on the number of rows, as where a method must first warp a grid: so rows change
    step by step, and are never fewer than 72.
    """

    def __init__(self) -> None:
        self._rows: dict[Hashable, float] = {}
        self._pixel_seconds: dict[Hashable, float] = {}  # of the last image

    def rows(self, kind: Hashable, full: int) -> int:
        """Return how many rows an image should have while the camera moves, a multiple of 8, or ``full``.

        >>> FrameRateControl().rows("colour", 400), FrameRateControl().rows("colour", 100)
        (160, 100)
        """
        return min(full, 8 * round(self._rows.get(kind, _FIRST_ROWS) / 8))

    def record(self, kind: Hashable, rows: int, pixels: int, seconds: float) -> None:
        """Note how long an image took."""
        self._pixel_seconds[kind] = seconds / pixels
        # A full image that took long says nothing of small ones.
        if rows <= self._rows.get(kind, _FIRST_ROWS) or seconds < FRAME_SECONDS:
            factor = math.sqrt(FRAME_SECONDS / max(seconds, 1e-4))
            self._rows[kind] = max(_MIN_ROWS, rows * min(1.5, max(0.5, factor)))

    def chunks(self, kind: Hashable, width: int, rows: int) -> int:
        """Return in how many chunks to render an image, so that a stale one soon ends."""
        seconds = self._pixel_seconds.get(kind, 0.0) * width * rows
        return max(1, min(rows, math.ceil(seconds / _CHUNK_SECONDS)))


class FrameRate:
    """Count images a second over the last two seconds, once they took half a second."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()

    def record(self, now: float) -> float:
        """Note an image; return the rate, 0 for the first ones.

        >>> rate = FrameRate()
        >>> [rate.record(now) for now in (0.0, 0.1, 0.5, 1.0)]
        [0.0, 0.0, 4.0, 3.0]
        """
        self._times.append(now)
        while now - self._times[0] > _RATE_SECONDS:
            self._times.popleft()
        passed = now - self._times[0]
        return (len(self._times) - 1) / passed if passed >= _MIN_RATE_SECONDS else 0.0
