import threading

import pytest

from forewarp.viewer.desk import Desk, Superseded


class Watch:
    """A clock that stands until it is set."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def desk():
    return Desk(Watch())


def served(desk):
    """Serve all that is due; returns what was done."""
    while desk.serve():
        pass


def test_the_newest_wish_of_each_is_done_and_who_waits_longest_comes_first(desk):
    done = []
    for who, what in (("a", 1), ("b", 2), ("a", 3), ("c", 4), ("c", 5), ("b", 6)):
        desk.ask(who, lambda stale, what=what: done.append(what))
    served(desk)
    assert done == [3, 5, 6]


def test_urgent_wishes_come_first_and_later_ones_when_they_are_due(desk):
    done = []
    desk.ask("film", lambda stale: done.append("film"), urgency=2)
    desk.ask("rest", lambda stale: done.append("rest"), urgency=1, after=0.5)
    desk.ask("move", lambda stale: done.append("move"))
    served(desk)
    assert done == ["move", "film"]
    assert not desk.is_due()
    desk._clock.now = 0.5
    assert desk.is_due()
    served(desk)
    assert done == ["move", "film", "rest"]
    assert not desk.is_due()


@pytest.mark.parametrize(
    ("meanwhile", "gone"),
    [
        (lambda desk: None, False),
        (lambda desk: desk.ask((1, "picture"), lambda stale: None), True),
        (lambda desk: desk.ask((1, "film"), lambda stale: None), False),
        (lambda desk: desk.ask((2, "picture"), lambda stale: None), False),
        (lambda desk: desk.leave(1), True),
        (lambda desk: desk.leave(2), False),
        (lambda desk: desk.close(), True),
    ],
    ids=["nothing", "newer", "other wish", "other page", "left", "other left", "closed"],
)
def test_a_job_learns_whether_it_is_still_wanted(desk, meanwhile, gone):
    said = []

    def job(stale):
        said.append(stale())
        meanwhile(desk)
        said.append(stale())

    desk.ask((1, "picture"), job)
    desk.serve()
    assert said == [False, gone]


def test_what_a_page_asked_for_goes_with_it(desk):
    done = []
    for page in (1, 2):
        for what in ("picture", "film"):
            desk.ask((page, what), lambda stale, page=page: done.append(page))
    desk.leave(1)
    served(desk)
    assert done == [2, 2]


def test_a_job_that_fails_or_gives_up_ends_alone(desk, capsys):
    done = []

    def gives_up(stale):
        raise Superseded

    def fails(stale):
        raise ZeroDivisionError("by nothing")

    for job in (fails, gives_up, lambda stale: done.append(1)):
        desk.ask(job, job)
    served(desk)
    assert done == [1]
    said = capsys.readouterr().err
    assert "ZeroDivisionError: by nothing" in said
    assert "Superseded" not in said


def test_many_threads_ask_and_one_serves():
    desk, running, most, done = Desk(), [], [], []

    def job(stale):
        running.append(1)
        most.append(len(running))
        running.pop()
        done.append(1)

    def ask(number):
        for _ in range(50):
            desk.ask((number, "picture"), job)

    server = threading.Thread(target=desk.serve_forever)
    askers = [threading.Thread(target=ask, args=(number,)) for number in range(8)]
    for thread in (server, *askers):
        thread.start()
    for thread in askers:
        thread.join(10)
    left = threading.Event()
    desk.ask("last", lambda stale: left.set(), urgency=9)
    assert left.wait(10)
    desk.close()
    server.join(10)
    assert not server.is_alive()
    assert max(most) == 1
    assert 8 <= len(done) <= 400
    assert not desk.serve()
