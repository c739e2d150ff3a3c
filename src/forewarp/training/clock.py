"""The training clock, which counts training only."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def now() -> float:
    """Return a time in seconds, after waiting for the GPU to finish its work."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


class Clock:
    """Count the seconds of training across interruptions; leave out what runs inside ``paused()``."""

    def __init__(self) -> None:
        self._done = 0.0
        self._since: float | None = None

    @property
    def seconds(self) -> float:
        """Training seconds so far; reading it never waits for a GPU."""
        running = 0.0 if self._since is None else time.perf_counter() - self._since
        return self._done + running

    def start(self) -> None:
        """Start counting."""
        self._since = now()

    def stop(self) -> None:
        """Stop counting."""
        if self._since is not None:
            self._done, self._since = self._done + now() - self._since, None

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Do not count what runs inside."""
        running = self._since is not None
        self.stop()
        try:
            yield
        finally:
            if running:
                self.start()

    def state_dict(self) -> dict:
        """Return the seconds so far."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state: dict) -> None:
        """Continue from a ``state_dict``."""
        self._done, self._since = float(state["seconds"]), None
