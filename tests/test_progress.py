import io
import os
import sys

import pytest
from rich.table import Table

from forewarp import progress
from forewarp.progress import (
    Counted,
    PrintableStream,
    ProgressLine,
    TextConsole,
    WholeProgress,
    printable_output,
    told_if_slow,
)


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("before", [0, 90])
def test_the_time_left_is_told_by_what_this_run_has_done(monkeypatch, before):
    """Nine of ten are there from an earlier run; one takes ten seconds."""
    clock, shown = [0.0], []
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock[0])
    with Counted("features", stream=Terminal()) as counted:
        monkeypatch.setattr(counted.line, "show", lambda fraction, left, text: shown.append(left))
        for done in range(before, before + 3):
            counted(done, 100)
            clock[0] += 10
    assert shown == [None, (99 - before) * 10, (98 - before) * 10]


def test_a_terminal_gets_a_bar_that_is_not_drawn_too_often(monkeypatch):
    clock, stream = [100.0], Terminal()
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock[0])
    line = ProgressLine("fine", refresh=0.25, stream=stream)
    assert line.due()
    line.show(0.5, 65, "psnr 30 dB")
    assert not line.due()
    clock[0] += 0.26
    assert line.due()
    line.close(1.0, "done")
    text = stream.getvalue()
    assert all(part in text for part in ("fine", "50% | 1:05 left | psnr 30 dB", "100% | done", "━"))
    assert text.endswith("\x1b[?25h")  # the cursor is back


def test_parts_share_one_line_with_the_time_left_of_all(monkeypatch):
    clock, stream, shown = [0.0], Terminal(), []
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock[0])
    with WholeProgress("clip", {"cameras": 60.0, "training": 120.0}, stream) as whole:
        monkeypatch.setattr(whole.line, "say", lambda fraction, text: shown.append((fraction, text)))
        with whole.part("cameras"), Counted("features") as counted:
            counted(0, 10)
            for clock[0], done in ((30.0, 5), (90.0, 6)):
                counted(done, 10)
        with whole.part("training"):
            line = ProgressLine("fine", stream=io.StringIO())
            line.show(0.5, 200.0, "psnr 23")
            assert line.terminal  # of the whole
    texts = [text for _, text in shown]
    assert texts[0] == "3:00 left | 1/2 cameras"
    assert "2:30 left | 1/2 cameras | features 50% | 5/10" in texts
    assert "3:00 left | 1/2 cameras | features 60% | 6/10" in texts
    assert "3:20 left | 2/2 training | fine 50% | psnr 23" in texts
    shares = [share for share, _ in shown]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert ProgressLine.whole is None


@pytest.mark.slow
def test_what_takes_long_shows_that_it_moves(capsys):
    stream = Terminal()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stderr", stream)
        with told_if_slow("page", "compiling", after=0.02):
            while "0:01 | compiling" not in stream.getvalue():
                progress.time.sleep(0.02)
    assert "0:00 | compiling" in stream.getvalue()


def test_a_narrow_terminal_shows_the_time_left_and_what_follows_first(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    stream = Terminal()
    line = ProgressLine("coarse", stream=stream)
    line.show(0.45, 192, f"train psnr 23.1 | 25.1 steps/s | frames 12/20 | {'x' * 40}")
    line.release()
    assert " 45% | 3:12 left | train psnr 23.1 | 25.1 steps/s | " in stream.getvalue()


STEERING = "a\x1b]0;title\x07\x1b[2Jb\x9b1A\u202ec\r"


def test_no_name_steers_the_terminal(capsys):
    with printable_output():
        print(STEERING, "\ttab\nline")
        print(STEERING, file=sys.stderr)
        TextConsole().print(STEERING, markup=False)
        table = Table(STEERING)
        table.add_row(STEERING)
        TextConsole().print(table)
    said = capsys.readouterr()
    assert not set("\x1b\x07\x9b\u202e\r") & {*said.out, *said.err}
    assert "\ttab\nline" in said.out
    assert r"a\x1b]0;title\x07\x1b[2Jb\x9b1A\u202ec\r" in said.err
    print("\x1b")
    assert capsys.readouterr().out == "\x1b\n"  # of others as it was


def test_a_terminal_that_knows_no_such_letter_gets_its_number():
    raw = io.TextIOWrapper(io.BytesIO(), "ascii")
    print("José \udcff", file=PrintableStream(raw))
    raw.flush()
    assert raw.buffer.getvalue() == rb"Jos\xe9 \udcff" + b"\n"


def test_a_command_goes_on_once_the_reader_has_closed_its_output():
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as raw:
        for _ in range(2):  # the first is dropped, and so is what follows
            print("a line", file=PrintableStream(raw), flush=True)
            TextConsole(PrintableStream(raw)).print("a table")
        raw.write("a line past it")
