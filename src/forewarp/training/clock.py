"""The training clock: counts training only."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def now() -> float:
    """Seconds from an arbitrary beginning, once a GPU has finished what it was told to do."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


class Clock:
    """Seconds spent training, over interruptions; ``paused()`` leaves out what is not training."""

    def __init__(self) -> None:
        self._done = 0.0
        self._since: float | None = None

    @property
    def seconds(self) -> float:
        """Training seconds so far; never waits for a GPU, so that it may be looked at in every step."""
        running = 0.0 if self._since is None else time.perf_counter() - self._since
        return self._done + running

    def start(self) -> None:
        """Count from now."""
        self._since = now()

    def stop(self) -> None:
        """Stop counting."""
        if self._since is not None:
            self._done, self._since = self._done + now() - self._since, None

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leave out what runs inside."""
        running = self._since is not None
        self.stop()
        try:
            yield
        finally:
            if running:
                self.start()

    def state_dict(self) -> dict:
        """Seconds so far."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state: dict) -> None:
        """Continue from there."""
        self._done, self._since = float(state["seconds"]), None
