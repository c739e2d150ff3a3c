import threading

import pytest

from forewarp.viewer.queue import FRAME_SECONDS, Cancelled, FrameRateControl, RenderQueue
from tests.support.fakes import Watch


@pytest.fixture
def queue():
    return RenderQueue(Watch())


def run_all(queue):
    """Run all that is due."""
    while queue.run_next():
        pass


def test_urgent_jobs_come_first_then_old_ones_and_the_newest_of_each_is_run(queue):
    done = []

    def submit(page, number, kind="image", **when):
        queue.submit(page, kind, lambda: done.append(number), **when)

    submit("a", 9, "video", priority=2)
    submit("a", 8, "rest", priority=1, delay=0.5)
    for page, number in (("a", 1), ("b", 2), ("a", 3), ("c", 4), ("c", 5), ("b", 6), ("d", 7)):
        submit(page, number)
    queue.cancel("d")
    run_all(queue)
    assert done == [3, 5, 6, 9]
    assert not queue.has_due_job()
    queue._clock.now = 0.5
    assert queue.has_due_job()
    run_all(queue)
    assert done == [3, 5, 6, 9, 8]
    assert not queue.has_due_job()


@pytest.mark.parametrize(
    ("meanwhile", "stale"),
    [
        (lambda queue: None, False),
        (lambda queue: queue.submit(1, "image", print), True),
        (lambda queue: queue.submit(1, "video", print), False),
        (lambda queue: queue.submit(2, "image", print), False),
        (lambda queue: queue.cancel(1), True),
        (lambda queue: queue.cancel(2), False),
        (lambda queue: queue.close(), True),
    ],
    ids=["nothing", "newer", "other kind", "other page", "left", "other left", "closed"],
)
def test_a_job_learns_whether_it_is_still_wanted(queue, meanwhile, stale):
    answers = []

    def job():
        answers.append(queue.is_stale())
        meanwhile(queue)
        answers.append(queue.is_stale())

    queue.submit(1, "image", job)
    queue.run_next()
    assert answers == [False, stale]
    assert not queue.is_stale()


def test_a_job_that_fails_or_gives_up_ends_alone(queue, capsys):
    done = []

    def gives_up():
        raise Cancelled

    def fails():
        raise ZeroDivisionError("by nothing")

    for job in (fails, gives_up, lambda: done.append(1)):
        queue.submit("page", job, job)
    run_all(queue)
    assert done == [1]
    said = capsys.readouterr().err
    assert "ZeroDivisionError: by nothing" in said
    assert "Cancelled" not in said


def test_many_threads_submit_and_one_runs():
    queue, running, most, done = RenderQueue(), [], [], []

    def job():
        running.append(1)
        most.append(len(running))
        running.pop()
        done.append(1)

    def submit(number):
        for _ in range(50):
            queue.submit(number, "image", job)

    runner = threading.Thread(target=queue.run_forever)
    pages = [threading.Thread(target=submit, args=(number,)) for number in range(8)]
    for thread in (runner, *pages):
        thread.start()
    for thread in pages:
        thread.join(10)
    last = threading.Event()
    queue.submit("last", "image", last.set, priority=9)
    assert last.wait(10)
    queue.close()
    runner.join(10)
    assert not runner.is_alive()
    assert max(most) == 1
    assert 8 <= len(done) <= 400
    assert not queue.run_next()


@pytest.mark.parametrize(
    ("fixed", "pixel", "least", "most"),
    [
        (0.0, 1e-6, 288, 296),  # 0.1 s for 316 x 316
        (0.0, 1e-9, 800, 800),  # full images are quick enough
        (0.5, 1e-9, 72, 72),  # a smaller image does not help, but not even that makes it endless
        (0.05, 1e-6, 200, 232),  # 0.05 s for 224 x 224
    ],
)
def test_rows_approach_ten_images_a_second(fixed, pixel, least, most):
    control = FrameRateControl()
    for _ in range(40):
        rows = control.rows("colour", 800)
        control.record("colour", rows, rows * rows, fixed + pixel * rows * rows)
    # Rows are in eights, and approached from below or above.
    assert least - 24 <= control.rows("colour", 800) <= most + 24
    assert control.rows("depth", 800) == 160  # by itself


def test_a_slow_full_image_does_not_shrink_those_while_moving():
    control = FrameRateControl()
    assert control.chunks("colour", 800, 800) == 1
    control.record("colour", 160, 160 * 160, FRAME_SECONDS)
    before = control.rows("colour", 800)
    control.record("colour", 800, 800 * 800, 25 * FRAME_SECONDS)
    assert control.rows("colour", 800) == before
    assert control.chunks("colour", 800, 800) == 9  # of 0.3 s
    control.record("colour", 72, 72 * 72, 1e4)
    assert control.chunks("colour", 800, 100) == 100  # a row each
