"""Ctrl-C during training: finish the step and save it before the run stops."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress


class Interruption:
    """A context in which the first Ctrl-C only sets ``asked``; a second one stops the process at once.

    Do nothing if the program handles or ignores Ctrl-C itself, or in a thread other than the main one,
    which receives no signals.
    """

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> Interruption:
        self._installed = False
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            with suppress(ValueError):  # raised in another thread
                signal.signal(signal.SIGINT, self._ask)
                self._installed = True
        return self

    def __exit__(self, *error) -> None:
        if self._installed:  # Lightning may have replaced it
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _ask(self, number, frame) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.asked = True
        with suppress(OSError, RuntimeError):  # it may interrupt another print
            print("\nends this step and saves it; Ctrl-C again stops at once", file=sys.stderr, flush=True)
