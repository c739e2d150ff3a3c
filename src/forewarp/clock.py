"""The training clock, which counts training only: by the wall clock, or in processor time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch

KINDS = {"wall": lambda: time.perf_counter(), "processor": lambda: time.process_time()}
_left_out = dict.fromkeys(KINDS, 0.0)  # seconds spent inside ``left_out()`` so far


def now(kind: str = "wall") -> float:
    """Return a time in seconds, after waiting for the GPU to finish its work."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return KINDS[kind]()


@contextmanager
def left_out() -> Iterator[None]:
    """Let no training clock count what runs inside: reading images. Not to be nested."""
    began = {kind: read() for kind, read in KINDS.items()}
    try:
        yield
    finally:
        for kind, read in KINDS.items():
            _left_out[kind] += read() - began[kind]


class Clock:
    """Count the seconds of training across interruptions; leave out what runs inside ``paused()``.

    Args:
        kind: ``wall``, or ``processor``: processor time of all threads of the process together. With one
            thread both are equal on an idle machine, and the second stays the same beside other work.

    Raises:
        ValueError: for another kind.
    """

    def __init__(self, kind: str = "wall") -> None:
        if kind not in KINDS:
            raise ValueError(f"budget.clock: expected {' or '.join(KINDS)}, but got {kind!r}")
        self.kind = kind
        self._done = dict.fromkeys(KINDS, 0.0)
        self._since: dict[str, float] | None = None

    @property
    def seconds(self) -> float:
        """Training seconds so far; reading it never waits for a GPU."""
        return self._of(self.kind)

    @property
    def every(self) -> dict[str, float]:
        """The same seconds by every kind of clock that was read from the start."""
        return {kind: self._of(kind) for kind in self._done}

    def start(self) -> None:
        """Start counting."""
        now(self.kind)
        self._since = {kind: _counted(kind) for kind in KINDS}

    def stop(self) -> None:
        """Stop counting."""
        if self._since is not None:
            now(self.kind)
            self._done, self._since = self.every, None

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

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count what runs inside."""
        self.start()
        try:
            yield
        finally:
            self.stop()

    def state_dict(self) -> dict:
        """Return the seconds so far."""
        return {"seconds": self.seconds, "every": self.every}

    def load_state_dict(self, state: dict) -> None:
        """Continue from a ``state_dict``."""
        known = {kind: float(seconds) for kind, seconds in state.get("every", {}).items() if kind in KINDS}
        self._done, self._since = known | {self.kind: float(state["seconds"])}, None

    def _of(self, kind: str) -> float:
        return self._done[kind] + (0.0 if self._since is None else _counted(kind) - self._since[kind])


def _counted(kind: str) -> float:
    return KINDS[kind]() - _left_out[kind]
