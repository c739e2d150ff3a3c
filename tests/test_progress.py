import io

import pytest

from forewarp import progress
from forewarp.progress import Counted, ProgressLine


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
