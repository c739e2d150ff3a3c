import io

import pytest

from forewarp import progress
from forewarp.progress import Counted


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
