from contextlib import suppress

import pytest

from forewarp import clock as module
from forewarp.clock import Clock, left_out


@pytest.fixture
def clock(monkeypatch):
    """A clock whose time is set by hand: ``clock.now = 3.0``."""
    made = Clock()
    made.now = 0.0
    monkeypatch.setattr(module.time, "perf_counter", lambda: made.now)
    return made


def test_counts_between_start_and_stop(clock):
    clock.now = 5.0
    assert clock.seconds == 0
    clock.start()
    clock.now = 7.0
    assert clock.seconds == 2
    clock.stop()
    clock.now = 100.0
    assert clock.seconds == 2


def test_pauses_leave_out_what_runs_inside_also_if_it_fails(clock):
    with clock.paused():  # a stopped clock stays stopped after a pause
        clock.now = 5.0
    assert clock.seconds == 0
    clock.start()
    clock.now = 6.0
    with suppress(RuntimeError), clock.paused():
        with clock.paused():
            clock.now = 60.0
        assert clock.seconds == 1
        raise RuntimeError
    clock.now = 62.0
    assert clock.seconds == 3


def test_reading_pictures_is_left_out(clock):
    clock.start()
    clock.now = 1.0
    with left_out():
        clock.now = 4.0
    clock.now = 6.0
    assert clock.seconds == 3
    clock.stop()
    with left_out():
        clock.now = 50.0
    with clock.running():
        clock.now = 51.0
    assert clock.seconds == 4


def test_a_kind_that_there_is_not():
    with pytest.raises(ValueError, match="budget.clock: expected wall or processor, but got 'sun'"):
        Clock("sun")


def test_processor_time_leaves_out_waiting(monkeypatch):
    clock = Clock("processor")
    monkeypatch.setattr(module.time, "process_time", lambda: 7.0)
    with clock.running():
        module.time.sleep(0.002)
    assert clock.seconds == 0


def test_goes_on_from_a_saved_state(clock):
    clock.load_state_dict({"seconds": 40.0})  # of a version that kept one clock
    assert clock.seconds == 40
    clock.start()
    clock.now = 2.0
    assert clock.state_dict() == {"seconds": 42.0, "every": {"wall": 42.0}}
    again = Clock("wall")
    again.load_state_dict({"seconds": 42.0, "every": {"wall": 42.0, "processor": 30.0}})
    assert again.every == {"wall": 42.0, "processor": 30.0}


def test_the_other_clock_is_read_too(clock, monkeypatch):
    monkeypatch.setattr(module.time, "process_time", lambda: 0.5 * clock.now)
    with clock.running():
        clock.now = 6.0
        with clock.paused():
            clock.now = 8.0
        with left_out():
            clock.now = 9.0
    assert clock.every == {"wall": 6.0, "processor": 3.0}


def test_waits_for_a_gpu_where_it_starts_and_stops_only(clock, monkeypatch):
    waits = []
    monkeypatch.setattr(module.torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(module.torch.cuda, "synchronize", lambda: waits.append(clock.seconds))
    clock.start()
    clock.now = 3.0
    assert clock.seconds == 3
    assert waits == [0]
    with clock.paused():
        assert waits == [0, 3]
    clock.stop()
    assert len(waits) == 4
    clock.stop()
    assert len(waits) == 4
