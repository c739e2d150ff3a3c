"""Ctrl-C while a stage is trained: the step is ended and kept before the run stops."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress


class Interruption:
    """A context in which the first Ctrl-C only sets ``asked``; the next one stops at once, as outside.

    Whoever sees to signals in another way, or ignores them, is left alone: nothing is done then, nor in
    another thread than the first, where Python hands no signals to.
    """

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> Interruption:
        self._installed = False
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            with suppress(ValueError):  # of another thread
                signal.signal(signal.SIGINT, self._ask)
                self._installed = True
        return self

    def __exit__(self, *error) -> None:
        if self._installed:  # Lightning may have put one of its own in its place
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _ask(self, number, frame) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.asked = True
        with suppress(OSError, RuntimeError):  # it may come in the middle of another print
            print("\nends this step and saves it; Ctrl-C again stops at once", file=sys.stderr, flush=True)
