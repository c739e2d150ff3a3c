import pytest

from forewarp.viewer.pace import GOAL, Pace
from forewarp.viewer.player import WHOLE, Player


@pytest.mark.parametrize(
    ("fixed", "pixel", "least", "most"),
    [
        (0.0, 1e-6, 288, 296),  # 0.1 s for 316 x 316
        (0.0, 1e-9, 800, 800),  # whole pictures are quick enough
        (0.5, 1e-9, 72, 72),  # a smaller picture does not help, but not even that makes it endless
        (0.05, 1e-6, 200, 232),  # 0.05 s for 224 x 224
    ],
)
def test_rows_approach_ten_pictures_a_second(fixed, pixel, least, most):
    pace = Pace()
    for _ in range(40):
        rows = pace.rows("colour", 800)
        pace.drew("colour", rows, rows * rows, fixed + pixel * rows * rows)
    # Rows are in eights, and approached from below or above.
    assert least - 24 <= pace.rows("colour", 800) <= most + 24
    assert pace.rows("depth", 800) == Pace().rows("depth", 800)  # of its own


def test_a_slow_whole_picture_does_not_shrink_those_while_moving():
    pace = Pace()
    pace.drew("colour", 160, 160 * 160, GOAL)
    before = pace.rows("colour", 800)
    pace.drew("colour", 800, 800 * 800, 25 * GOAL)
    assert pace.rows("colour", 800) == before
    assert pace.parts("colour", 800, 800) == 9  # of 0.3 s
    assert Pace().parts("colour", 800, 800) == 1
    pace.drew("colour", 72, 72 * 72, 1e4)
    assert pace.parts("colour", 800, 100) == 100  # a row each


@pytest.mark.parametrize(
    ("loop", "speed", "passed", "time", "playing"),
    [
        (True, 1, 0.25, 0.75, True),
        (True, 2, 0.5, 0.5, True),
        (False, 2, 0.5, 1.0, False),
        (False, 0.5, 0.5, 0.75, True),
    ],
)
def test_time_passes_by_speed_and_loops_or_ends(loop, speed, passed, time, playing):
    player = Player(speed, loop)
    player.play(0.5, now=10.0)
    assert player.time(10.0 + passed * WHOLE) == pytest.approx(time)
    assert player.playing is playing


def test_another_speed_goes_on_from_where_time_is():
    player = Player()
    player.play(0.2, now=0.0)
    player.set_speed(2.0, now=0.1 * WHOLE)
    assert player.time(0.2 * WHOLE) == pytest.approx(0.5)
    player.pause()
    player.set_speed(1.0, now=5.0)
    player.loop = False
    player.play(1.0, now=0.0)  # at the end: again from the beginning
    assert player.time(0.25 * WHOLE) == pytest.approx(0.25)
