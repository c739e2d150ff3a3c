"""Show progress in one line: redrawn in a terminal, printed from time to time elsewhere; and text of others
so that it cannot steer the terminal.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.segment import Segment
from rich.table import Column

# Control characters but for tabs and new lines, and those that turn the direction of writing.
_STEERING = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Write characters that would steer a terminal as Python does.

    >>> print(printable("a\\x1b[2Jb"))
    a\\x1b[2Jb
    """
    return _STEERING.sub(lambda sign: ascii(sign[0])[1:-1], text)


class _LastingStream:
    """A stream that lasts: once its reader has closed it (``| head``), what follows is dropped, and the
    command goes on.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write text; return how many characters it has."""
        with self._kept():
            self.stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Hand what was written to the reader."""
        with self._kept():
            self.stream.flush()

    @contextmanager
    def _kept(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), self.stream.fileno())

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)


class PrintableStream:
    """A stream in whose text no name of a file or scene steers the terminal; what the terminal's encoding
    lacks is written as Python does, too.
    """

    def __init__(self, stream: TextIO) -> None:
        self.terminal = _LastingStream(stream)

    def write(self, text: str) -> int:
        """Write text; return how many characters it has."""
        encoding, shown = getattr(self.terminal, "encoding", None) or "utf-8", printable(text)
        self.terminal.write(shown.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def __getattr__(self, name: str) -> object:
        return getattr(self.terminal, name)


@contextmanager
def printable_output() -> Iterator[None]:
    """Let what is printed within steer no terminal."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (
        one if isinstance(one, PrintableStream) else PrintableStream(one) for one in before
    )
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


class TextConsole(Console):
    """Rich's console on stdout or a stream: it steers the terminal itself, but by no text that it shows."""

    def __init__(self, stream: TextIO | None = None) -> None:
        stream = stream or sys.stdout
        super().__init__(file=stream.terminal if isinstance(stream, PrintableStream) else stream)

    def render(self, *given, **options) -> Iterator[Segment]:
        """Render as rich does, control characters of text as Python writes them."""
        for part in super().render(*given, **options):
            yield part if part.control else Segment(printable(part.text), part.style)


def time_text(seconds: float) -> str:
    """Write a duration as minutes and seconds, with hours where there are any.

    >>> time_text(65.4), time_text(3725)
    ('1:05', '1:02:05')
    """
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


@contextmanager
def told_if_slow(title: str, text: str, *, after: float = 3.0) -> Iterator[None]:
    """Show a line, ``title``, 0 % and ``text``, once what is within has taken ``after`` seconds; in a
    terminal with the seconds so far, so that one sees that it goes on.

    Args:
        title: what runs.
        text: what takes the time.
        after: seconds.
    """
    line, ended, begin = ProgressLine(title, refresh=1.0), threading.Event(), time.perf_counter()

    def show() -> None:
        wait = after
        while not ended.wait(wait):
            line.say(0.0, f"{time_text(time.perf_counter() - begin)} | {text}" if line.terminal else text)
            wait = line.interval if line.terminal else None  # elsewhere a line will do

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        line.release()


class ProgressLine:
    """A line with a title, the share that is done, the time left and a text.

    Within the part of a ``WholeProgress`` its line is updated in place of this one.

    Args:
        title: what runs.
        refresh: seconds between two updates in a terminal.
        every: seconds between two lines elsewhere.
        stream: None: stderr.
    """

    whole: WholeProgress | None = None  # that all lines belong to now

    def __init__(
        self, title: str, *, refresh: float = 0.25, every: float = 10.0, stream: TextIO | None = None
    ) -> None:
        self.title, self.stream = title, stream or sys.stderr
        # rich puts streams that are no terminals in place of ours while a line is shown.
        self.terminal = self.stream.isatty() if self.whole is None else self.whole.line.terminal
        self.interval = refresh if self.terminal else every
        self._next = time.perf_counter() + (0.0 if self.terminal else every)
        self._bar: Progress | None = None

    def due(self) -> bool:
        """Tell whether an update is due; ask this before making a text."""
        return self.whole.line.due() if self._is_part else time.perf_counter() >= self._next

    def show(self, fraction: float, left: float | None, text: str) -> None:
        """Update the line now.

        Args:
            fraction: done, in [0, 1].
            left: seconds; None: unknown.
            text: shown at the end.
        """
        if self._is_part:
            self.whole.show(left, f"{self.title} {fraction:.0%} | {text}")
            return
        self.say(fraction, f"{'-:--' if left is None else time_text(left)} left | {text}")
        self._next = time.perf_counter() + self.interval

    def close(self, fraction: float, text: str) -> None:
        """Write the last line and release the terminal."""
        if not self._is_part:
            self.say(fraction, text)
            self.release()

    def release(self) -> None:
        """Release the terminal."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def say(self, fraction: float, text: str) -> None:
        """Update the line now, with no time left."""
        if self._is_part:
            self.whole.show(None, f"{self.title} | {text}")
            return
        text = f"{fraction:4.0%} | {text}"
        if not self.terminal:
            print(f"{self.title} {text}", file=self.stream, flush=True)
            return
        if self._bar is None:
            # A narrow terminal cuts the end of the text, not the title or the bar.
            columns = (
                TextColumn("{task.description}", table_column=Column(min_width=len(self.title))),
                BarColumn(bar_width=12, table_column=Column(min_width=12)),
                TextColumn("{task.fields[text]}", markup=False, table_column=Column(ratio=1, no_wrap=True)),
            )
            # Without a thread of its own it costs nothing between two updates. What is printed into a file
            # stays there.
            options = {"auto_refresh": False, "expand": True, "redirect_stdout": sys.stdout.isatty()}
            self._bar = Progress(*columns, console=TextConsole(self.stream), **options)
            self._task = self._bar.add_task(self.title, total=1.0, text="")
            self._bar.start()
        self._bar.update(self._task, completed=fraction, text=text, refresh=True)

    @property
    def _is_part(self) -> bool:
        return self.whole is not None and self.whole.line is not self


class WholeProgress:
    """One line for several parts, each of which has lines of its own: with the time left of all.

    Args:
        title: what runs.
        seconds: by the names of all parts in their order, how long they may take.
        stream: None: stderr.
    """

    def __init__(self, title: str, seconds: Mapping[str, float], stream: TextIO | None = None) -> None:
        self.line, self.seconds = ProgressLine(title, stream=stream), dict(seconds)
        self.begin, self._name, self._since, self._done = time.perf_counter(), "", 0.0, 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Let lines within be those of a part."""
        self._name, self._since = name, time.perf_counter()
        ProgressLine.whole = self
        try:
            self.show(None, "")
            yield
        finally:
            ProgressLine.whole = None

    def show(self, left: float | None, text: str) -> None:
        """Update the line: ``left`` are seconds of the line that the part shows now, None: unknown."""
        now, names = time.perf_counter(), list(self.seconds)
        at = names.index(self._name)
        of_part = max(left or 0.0, self.seconds[self._name] - (now - self._since))
        remaining = of_part + sum(self.seconds[name] for name in names[at + 1 :])
        spent = now - self.begin
        self._done = max(self._done, spent / max(spent + remaining, 1e-9))  # it never goes back
        self.line.show(
            self._done, remaining, f"{at + 1}/{len(names)} {self._name}" + f" | {text}" * bool(text)
        )

    def __enter__(self) -> WholeProgress:
        return self

    def __exit__(self, *error) -> None:
        if error[0] is None and self.seconds:
            self.line.close(
                1.0, f"{len(self.seconds)} parts in {time_text(time.perf_counter() - self.begin)}"
            )
        self.line.release()


class Counted:
    """Show calls ``progress(done, total)`` as a line with the time left; a context manager."""

    def __init__(self, title: str, stream=None) -> None:
        self.line, self.begin = ProgressLine(title, stream=stream), time.perf_counter()
        self.done, self.total = 0, 1
        self.first: tuple[int, float] | None = None  # what was done at the first call, and when that was

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` are done, where an update is due.

        The time left is told from what was done since the first call, as an earlier run may have done a part.
        """
        self.done, self.total = done, total
        self.first = self.first or (done, time.perf_counter())
        if self.line.due():
            newly, spent = done - self.first[0], time.perf_counter() - self.first[1]
            left = spent / newly * (total - done) if newly else None
            self.line.show(done / total, left, f"{done}/{total}")

    def __enter__(self) -> Counted:
        return self

    def __exit__(self, *error) -> None:
        if self.first is None and error[0] is not None:
            return  # refused before anything was done
        spent = time_text(time.perf_counter() - self.begin)
        self.line.close(self.done / self.total, f"{self.done}/{self.total} in {spent}")
