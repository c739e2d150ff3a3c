"""What pages ask for, and the one thread that does it."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from itertools import count

Stale = Callable[[], bool]  # whether what is being done is no longer wanted
Job = Callable[[Stale], None]


class Superseded(Exception):
    """What is being done is no longer wanted."""


@dataclass(frozen=True)
class _Wish:
    job: Job
    urgency: int
    due: float
    number: int


class Desk:
    """Keep the newest wish of everyone who asks, until the one thread that serves takes it.

    Any thread may ``ask``; one alone may ``serve``. So no two pictures are drawn at once, and a run in
    training, whose own thread serves between its steps, is never drawn in the middle of one.

    Args:
        clock: gives seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._numbers = clock, count()
        self._wishes: dict[Hashable, _Wish] = {}
        self._newest: dict[Hashable, int] = {}
        self._changed = threading.Condition()
        self.closed = False

    def ask(self, who: Hashable, job: Job, *, urgency: int = 0, after: float = 0.0) -> None:
        """Ask for a job; an earlier one of the same asker is dropped, also if it is being done.

        Args:
            who: who asks; a page's are tuples that begin with the page.
            job: called with a function that tells whether a newer job has come.
            urgency: smaller ones are served first; among equals, who waits longest.
            after: seconds to wait before it is served.
        """
        with self._changed:
            number = next(self._numbers)
            self._wishes[who] = _Wish(job, urgency, self._clock() + after, number)
            self._newest[who] = number
            self._changed.notify()

    def leave(self, page: Hashable) -> None:
        """Drop all that a page has asked for."""
        with self._changed:
            for wishes in (self._wishes, self._newest):
                for who in [who for who in wishes if isinstance(who, tuple) and who[0] == page]:
                    del wishes[who]

    def close(self) -> None:
        """Drop everything; ``serve`` returns at once from now on."""
        with self._changed:
            self.closed = True
            self._wishes.clear()
            self._newest.clear()
            self._changed.notify()

    def is_due(self) -> bool:
        """Tell whether something is to be done now; costs nothing where nothing was asked."""
        if not self._wishes:
            return False
        with self._changed:
            return self._first() is not None

    def serve(self, wait: float = 0.0) -> bool:
        """Do one job, if any is asked for within ``wait`` seconds; return whether one was done.

        A job that fails is told of on stderr and ends alone.
        """
        found = self._take(wait)
        if found is None:
            return False
        who, wish = found
        try:
            wish.job(lambda: self.closed or self._newest.get(who) != wish.number)
        except Superseded:
            pass
        except Exception as error:
            traceback.print_exception(error)
        finally:
            with self._changed:
                if self._newest.get(who) == wish.number:
                    del self._newest[who]
        return True

    def serve_forever(self) -> None:
        """Do job after job until the desk is closed."""
        while not self.closed:
            self.serve(1.0)

    def _take(self, wait: float) -> tuple[Hashable, _Wish] | None:
        end = self._clock() + wait
        with self._changed:
            while not self.closed:
                who = self._first()
                if who is not None:
                    return who, self._wishes.pop(who)
                now = self._clock()
                if now >= end:
                    return None
                next_due = min((wish.due for wish in self._wishes.values()), default=end)
                self._changed.wait(max(1e-3, min(end, next_due) - now))
        return None

    def _first(self) -> Hashable | None:
        now = self._clock()
        due = [(w.urgency, w.number, who) for who, w in self._wishes.items() if w.due <= now]
        return min(due, key=lambda row: row[:2])[2] if due else None
