"""Budget, learning rates and curriculum of a stage."""

import re
from collections import Counter
from functools import partial

import pytest

from forewarp.training.objective import Objective
from forewarp.training.schedule import Curriculum, StagePlan, StageSettings, seconds_after, share_out

NAN, INF = float("nan"), float("inf")


def settings(**changes):
    return StageSettings.of(**({"name": "coarse", "lr": {}, "iterations": 100} | changes))


def test_keys_that_the_platform_does_not_know_are_the_methods_own():
    made = settings(lr_hold=0.5, num_voxels=[[0, 8000]], max_gradient=2.0, patches=3)
    assert made.numbers == {"num_voxels": [[0, 8000]], "patches": 3}
    assert (made.lr_hold, made.max_gradient) == (0.5, 2.0)


def test_a_stage_without_rates_is_refused_by_their_key():
    with pytest.raises(ValueError, match="^stage.fine.lr: expected a learning rate of each group"):
        StageSettings.of("fine", iterations=1)


@pytest.mark.parametrize(
    ("schedule", "expected"),
    [
        ({"lr_hold": 0.5, "lr_final_factor": 0.01}, {0: 1, 0.5: 1, 0.75: 0.1, 1.0: 0.01, 1.5: 0.01}),
        ({"lr_hold": 1.0}, {1.0: 1}),
        ({"lr_final_factor": {"means": 0.01}}, {0: 1, 0.5: 0.1, 0.75: 0.01**0.75}),
        ({"lr_hold": {"means": 0.5}, "lr_final_factor": {"means": 0.25}}, {0: 1, 0.5: 1, 0.75: 0.5}),
        ({"lr_hold": {"color": 0.5}, "lr_final_factor": {"color": 0.25}}, {0: 1, 0.75: 1}),
    ],
)
def test_rates_hold_and_then_fall_exponentially_perhaps_each_group_by_itself(schedule, expected):
    made = settings(lr={"means": 1e-3, "color": 1e-3}, **schedule)
    assert {at: made.lr_factor(at, "means") for at in expected} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("bounds", "fraction"),
    [
        ({"iterations": 100, "minutes": None}, 0.25),
        ({"iterations": None, "minutes": 1.0}, 0.5),
        ({"iterations": 100, "minutes": 1.0}, 0.5),
        ({"iterations": 10, "minutes": 1.0}, 1.0),
    ],
)
def test_the_fraction_is_of_what_comes_first(bounds, fraction):
    assert settings(**bounds).fraction(25, 30.0) == fraction


@pytest.mark.parametrize(
    ("per_picture", "most", "iterations"),
    [(None, None, None), (1.5, None, 15), (2, 30, 20), (2, 8, 8), (0.01, None, 1)],
)
def test_steps_for_each_picture_bound_a_stage(per_picture, most, iterations):
    bounded = settings(minutes=1.0, steps_per_picture=per_picture, iterations=most).over(10)
    assert (bounded.iterations, bounded.minutes) == (iterations, 1.0)


def plan(share=1.0, **changes):
    """Make a stage without its share of the budget."""
    numbers = {"num_voxels": [[0, 64]], "lr": {}}
    return StagePlan(share=share, objective=Objective({"photo": 1.0}), **(numbers | changes))


def shared(plans=None, minutes=1, iterations=None):
    return share_out({"a": plan()} if plans is None else plans, minutes=minutes, iterations=iterations)


def test_minutes_and_iterations_go_by_share():
    stages = shared({"a": plan(1), "b": plan(3)}, minutes=2.0, iterations=10)
    bounds = [(stage.settings.name, stage.settings.minutes, stage.settings.iterations) for stage in stages]
    assert bounds == [("a", 0.5, 2), ("b", 1.5, 8)]


def test_what_the_stages_after_one_may_take():
    stages = shared({"a": plan(1), "b": plan(2), "c": plan(1)}, minutes=2.0, iterations=10)
    assert [seconds_after(stages, name) for name in "abc"] == [90, 30, 0]
    steps = shared({"a": plan(1), "b": plan(999)}, minutes=None, iterations=10)
    assert [seconds_after(steps, name) for name in "ab"] == [None, 0]
    assert [(s.settings.minutes, s.settings.iterations) for s in steps] == [(None, 1), (None, 10)]
    assert seconds_after(shared({"a": plan(1), "b": plan(1, steps_per_picture=9)}, minutes=2.0), "a") is None


TIMES = [0.0, 0.9, 0.5, 0.2, 0.7, 1.0, 0.4, 0.6, 0.1, 0.3]


def draws(curriculum, fraction, count=2000):
    curriculum.fraction = fraction
    return Counter(curriculum() for _ in range(count))


def test_frames_come_in_from_the_canonical_time_outwards():
    curriculum, played = Curriculum(TIMES, 0.5, start=3), []
    for curriculum.fraction in (0, 0.3, 0.6):
        played.append([TIMES[i] for i in curriculum.frames()])
    assert played[:2] == [[0.5, 0.4, 0.6], [0.5, 0.4, 0.6, 0.7, 0.3, 0.2]]  # halfway in at 0.3
    assert sorted(played[2]) == sorted(TIMES)


def test_frames_of_one_time_come_in_together():
    times = [t for _ in range(3) for t in (0.0, 0.25, 0.5, 0.75, 1.0)]  # three cameras
    curriculum, played = Curriculum(times, 0.5, start=2, all_in=1.0), []
    for curriculum.fraction in (0.0, 0.34, 0.67, 1.0):
        played.append([times[i] for i in curriculum.frames()])
    assert played[:2] == [[0.5] * 3 + [0.25] * 3, [0.5] * 3 + [0.25] * 3 + [0.75] * 3]
    assert [len(frames) for frames in played] == [6, 9, 12, 15]


AS_IF_FROM_NONE = {"start": 3, "all_in": 0.125, "from_zero": True}


@pytest.mark.parametrize(
    ("count", "options", "expected"),
    [
        (100, {"all_in": 0.0, "most": 7}, {0: 7, 1: 7}),
        # D-NeRF's max(int(i / 100k * count), 3)
        (50, AS_IF_FROM_NONE, {0: 3, 0.01: 4, 0.0625: 25, 0.125: 50, 1: 50}),
        (200, AS_IF_FROM_NONE, {0: 3, 0.01: 16, 0.0625: 100, 0.125: 200, 1: 200}),
    ],
)
def test_times_come_in_as_if_from_none_on(count, options, expected):
    curriculum, played = Curriculum([i / count for i in range(count)], 0.0, **options), {}
    for curriculum.fraction in expected:
        played[curriculum.fraction] = curriculum.in_play
    assert played == expected


PRINTED = {"iterations_per_time": 60, "newest_share": 0.0}
NDVGS = {"iterations_per_time": 30, "from_zero": True}  # its max(10, i // 30)


@pytest.mark.parametrize(
    ("count", "options", "expected"),
    [
        *((count, PRINTED, {0: 10, 59: 10, 60: 11, 60 * (count - 10): count}) for count in (28, 100, 135)),
        (135, PRINTED, {60 * 125 - 1: 134, 20_000: 135}),
        (200, NDVGS, {0: 10, 329: 10, 330: 11, 4999: 166}),
        (100, NDVGS, {0: 10, 329: 10, 330: 11, 4999: 100}),
        (4, PRINTED, {0: 4, 600: 4}),
    ],
)
@pytest.mark.parametrize("fraction", [0.0, 0.7])  # of the stage, which does not matter
def test_times_come_in_after_so_many_steps_however_many_there_are(count, options, expected, fraction):
    curriculum, played = Curriculum([i / count for i in range(count)], 0.0, **options), {}
    curriculum.fraction = fraction
    for curriculum.step in expected:
        played[curriculum.step] = curriculum.in_play
    assert played == expected


def test_the_newest_get_their_share_while_frames_come_in():
    curriculum = Curriculum(TIMES, 0.5, start=8, newest_share=0.5, newest_part=0.125)
    newest = curriculum.frames()[-1]
    assert draws(curriculum, 0.0)[newest] / 2000 == pytest.approx(0.5 + 0.5 / 8, abs=0.04)
    assert max(draws(curriculum, 1.0).values()) < 300  # even, once all are in


def test_the_ends_of_time_get_their_share_once_all_frames_are_in():
    times, ends = [i / 39 for i in range(40)], [0, 1, 38, 39]
    curriculum = Curriculum(times, 0.5, start=30, all_in=0.5, newest_share=0.0, ends_share=0.5)
    assert not draws(curriculum, 0.0, 500).keys() & set(ends)
    counts = draws(curriculum, 1.0)
    assert [counts[frame] / 2000 for frame in ends] == pytest.approx([0.5 / 4 + 0.5 / 40] * 4, abs=0.03)
    assert Curriculum([0.3], 0.3, all_in=0.0, ends_share=1.0)() == 0


@pytest.mark.slow
def test_frames_with_large_errors_come_more_often_and_those_without_count_as_the_worst():
    curriculum = Curriculum(TIMES, 0.0, all_in=0.0, error_share=1.0)
    assert len(draws(curriculum, 0.0, 500)) == 10
    for frame in range(9):
        curriculum.report(frame, 0.9 if frame == 4 else 0.1)
    counts = draws(curriculum, 0.0)
    assert [counts[frame] / 2000 for frame in (4, 9)] == pytest.approx([0.9 / 2.6] * 2, abs=0.04)
    for error in (0.1, NAN, INF, -INF):  # halfway to the new error, and nowhere
        curriculum.report(4, error)
    assert curriculum.errors[4] == 0.5


def test_goes_on_where_it_was_saved():
    first, second = (Curriculum(TIMES, 0.5, seed=seed, error_share=0.3) for seed in (1, 2))
    draws(first, 0.4, 17)
    first.report(3, 0.2)
    first.step = 7
    state = first.state_dict()
    second.load_state_dict(state)
    assert (second.fraction, second.step) == (0.4, 7)
    assert [first() for _ in range(50)] == [second() for _ in range(50)]
    first.report(5, 0.2)
    assert state["errors"][5].isnan()  # a saved state does not change afterwards


NAMES = ("/tmp/x", "..", "a/b", "a\\b", "", "-a", "a b", "a\n", 7)
BAD_SHARES = {"start": 0, "all_in": 1.5, "newest_share": -0.1, "newest_part": 0.0, "error_share": NAN}
BAD_SHARES |= {"ends_share": 1.5}
RATES, RATE = {"means": 1e-3, "color": 1e-3}, ("fast", -1e-3, NAN, True)
BOUND, FREE = "expected a number > 0, or null, but got", "a number > 0 or null, but got"
curriculum = partial(Curriculum, TIMES, 0.0, where="x")
of_rates = partial(settings, lr=RATES)
REFUSED = [
    (settings, {"iterations": None}, "stage.coarse: expected iterations or minutes, but got neither"),
    *((settings, {"name": name}, "stage: expected names of letters, digits, _ and -") for name in NAMES),
    *((settings, {"minutes": 1.0, "iterations": n}, f"stage.coarse.iterations: {BOUND}") for n in (0, INF)),
    *((settings, {"minutes": n}, f"stage.coarse.minutes: {BOUND}") for n in (-1.0, NAN, True, "many")),
    (settings, {"steps_per_picture": 0}, f"stage.coarse.steps_per_picture: {BOUND} 0"),
    (settings, {"lr": None}, "stage.coarse.lr: expected a rate for each group, but got None"),
    *((settings, {"lr": {"x": r}}, "stage.coarse.lr.x: expected a number >= 0, but") for r in RATE),
    (settings, {"lr_hold": 1.5}, "stage.coarse.lr_hold: expected a number in [0, 1], but got 1.5"),
    (settings, {"lr_final_factor": 0}, "stage.coarse.lr_final_factor: expected a number > 0, but got 0"),
    (of_rates, {"lr_final_factor": {"meens": 0.1}}, "stage.coarse.lr_final_factor: expected groups of means"),
    (of_rates, {"lr_hold": {"means": "late"}}, "stage.coarse.lr_hold.means: expected a number in [0, 1]"),
    (shared, {"plans": {}}, "stage: expected at least one stage, but got none"),
    (shared, {"plans": {"a": plan(0)}}, "stage.a.share: expected a number > 0, or ~stage.a to drop it, but"),
    (shared, {"minutes": "soon"}, f"budget.minutes: expected {FREE} 'soon'"),
    (shared, {"iterations": 0}, f"budget.iterations: expected {FREE} 0"),
    (shared, {"minutes": None}, "stage.a: expected iterations or minutes, but got neither"),
    (curriculum, {"iterations_per_time": 0}, "x.iterations_per_time: expected a whole number >= 1, but got"),
    (curriculum, {"most": 0}, "x.most: expected a whole number >= 1, but got 0"),
    *((curriculum, {key: value}, "x: expected start >= 1, ") for key, value in BAD_SHARES.items()),
    (curriculum, {"newest_part": "\x1b[31m"}, "x: expected start >= 1, newest_part in"),
]


@pytest.mark.parametrize(("make", "wrong", "text"), REFUSED)
def test_refuses_by_the_name_of_the_key(make, wrong, text):
    with pytest.raises(ValueError, match=f"^{re.escape(text)}"):
        make(**wrong)
