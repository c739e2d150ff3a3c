"""Ctrl-C, SIGTERM and SIGHUP end a command in one way: by KeyboardInterrupt with the signal's number."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


def interrupt(number: int, frame: object = None) -> None:
    """Raise KeyboardInterrupt with the number of a signal."""
    raise KeyboardInterrupt(number)


def signal_of(error: KeyboardInterrupt) -> signal.Signals:
    """Return the signal that an interruption came from; Python's own, which holds none, from Ctrl-C."""
    return signal.Signals(error.args[0] if error.args else signal.SIGINT)


@contextmanager
def listening(handler: Callable[[int, object], None] = interrupt) -> Iterator[list[int]]:
    """Answer the signals that end a program by ``handler`` within the block; yield which.

    Those that the program handles or ignores itself, as ``nohup`` does, stay as they are. Do nothing in a
    thread other than the main one, which receives no signals.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in ENDING}
    free = (signal.SIG_DFL, signal.default_int_handler, interrupt)
    before = {number: now for number, now in before.items() if now in free}
    answer(before, handler)
    try:
        yield list(before)
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def answer(numbers: Iterable[int], handler: Callable[[int, object], None] = interrupt) -> None:
    """Answer signals by ``handler`` from now on."""
    for number in numbers:
        signal.signal(number, handler)
