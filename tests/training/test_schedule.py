"""Budget, learning rates and curriculum of a stage."""

import re
from collections import Counter
from functools import partial

import pytest

from forewarp.training.objective import Objective
from forewarp.training.schedule import Curriculum, StagePlan, StageSettings, seconds_after, share_out


def settings(**changes):
    return StageSettings.of(**({"name": "coarse", "lr": {}, "iterations": 100} | changes))


def test_keys_that_the_platform_does_not_know_are_the_methods_own():
    made = settings(lr_hold=0.5, num_voxels=[[0, 8000]], max_gradient=2.0, patches=3)
    assert made.numbers == {"num_voxels": [[0, 8000]], "patches": 3}
    assert (made.lr_hold, made.max_gradient) == (0.5, 2.0)


def test_rates_hold_and_then_fall_exponentially():
    made = settings(lr_hold=0.5, lr_final_factor=0.01)
    assert [made.lr_factor(f, "any") for f in (0, 0.5)] == [1, 1]
    assert made.lr_factor(0.75, "any") == pytest.approx(0.1)
    assert made.lr_factor(1.0, "any") == made.lr_factor(1.5, "any") == pytest.approx(0.01)
    assert settings(lr_hold=1.0).lr_factor(1.0, "any") == 1


def test_groups_may_fall_each_by_itself():
    made = settings(
        lr={"means": 1e-3, "shifts": 1e-3, "color": 1e-3},
        lr_hold={"shifts": 0.5},
        lr_final_factor={"means": 0.01, "shifts": 0.25},
    )
    for fraction, expected in ((0.0, (1, 1, 1)), (0.5, (0.1, 1, 1)), (0.75, (0.01**0.75, 0.5, 1))):
        assert [made.lr_factor(fraction, group) for group in made.lr] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lr": None}, "stage.coarse.lr: expected a rate for each group, but got None"),
        ({"lr": {"grid": "fast"}}, "stage.coarse.lr.grid: expected a number >= 0, but got 'fast'"),
        ({"lr": {"grid": -1e-3}}, "stage.coarse.lr.grid: expected a number >= 0, but got -0.001"),
        ({"lr": {"grid": float("nan")}}, "stage.coarse.lr.grid: expected a number >= 0, but got nan"),
        ({"lr": {"grid": True}}, "stage.coarse.lr.grid: expected a number >= 0, but got True"),
        ({"lr_hold": 1.5}, "stage.coarse.lr_hold: expected a number in [0, 1], but got 1.5"),
        ({"lr_final_factor": 0}, "stage.coarse.lr_final_factor: expected a number > 0, but got 0"),
        (
            {"lr": {"means": 1e-3, "color": 1e-3}, "lr_final_factor": {"meens": 0.1}},
            "stage.coarse.lr_final_factor: expected groups of means, color, but got 'meens'",
        ),
        (
            {"lr": {"means": 1e-3}, "lr_hold": {"means": "late"}},
            "stage.coarse.lr_hold.means: expected a number in [0, 1], but got 'late'",
        ),
    ],
)
def test_rates_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        settings(**changes)


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
    ("bounds", "iterations"),
    [
        ({"steps_per_picture": None, "iterations": None}, None),
        ({"steps_per_picture": 1.5, "iterations": None}, 15),
        ({"steps_per_picture": 2, "iterations": 30}, 20),
        ({"steps_per_picture": 2, "iterations": 8}, 8),
        ({"steps_per_picture": 0.01, "iterations": None}, 1),
    ],
)
def test_steps_for_each_picture_bound_a_stage(bounds, iterations):
    own = settings(minutes=1.0, **bounds)
    assert own.over(10).iterations == iterations
    assert own.over(10).minutes == 1.0


@pytest.mark.parametrize("key", ["iterations", "minutes", "steps_per_picture"])
@pytest.mark.parametrize("value", [0, -1.0, float("inf"), float("nan"), True, "many"])
def test_a_bound_that_is_no_number_is_refused(key, value):
    message = f"stage.coarse.{key}: expected a number > 0, or null, but got {value!r}"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        settings(**{"minutes": 1.0, key: value})


def plan(share=1.0, **changes):
    """Make a stage without its share of the budget."""
    numbers = {"num_voxels": [[0, 64]], "lr": {}}
    return StagePlan(share=share, objective=Objective({"photo": 1.0}), **(numbers | changes))


def shared(plans=None, minutes=1):
    return share_out({"a": plan()} if plans is None else plans, minutes=minutes, iterations=None)


def test_minutes_and_iterations_go_by_share():
    first, second = share_out({"a": plan(1), "b": plan(3)}, minutes=2.0, iterations=10)
    assert (first.settings.name, first.settings.minutes, first.settings.iterations) == ("a", 0.5, 2)
    assert (second.settings.name, second.settings.minutes, second.settings.iterations) == ("b", 1.5, 8)


def test_what_the_stages_after_one_may_take():
    stages = share_out({"a": plan(1), "b": plan(2), "c": plan(1)}, minutes=2.0, iterations=10)
    assert [seconds_after(stages, name) for name in "abc"] == [90, 30, 0]
    steps = share_out({"a": plan(1), "b": plan(999), "c": None}, minutes=None, iterations=10)
    assert [seconds_after(steps, name) for name in "ab"] == [None, 0]
    bounded = {"a": plan(1), "b": plan(1, steps_per_picture=9)}
    assert seconds_after(share_out(bounded, minutes=2.0, iterations=None), "a") is None
    assert [(s.settings.minutes, s.settings.iterations) for s in steps] == [(None, 1), (None, 10)]


TIMES = [0.0, 0.9, 0.5, 0.2, 0.7, 1.0, 0.4, 0.6, 0.1, 0.3]


def draws(curriculum, fraction, count=2000):
    curriculum.fraction = fraction
    return Counter(curriculum() for _ in range(count))


def test_frames_come_in_from_the_canonical_time_outwards():
    curriculum = Curriculum(TIMES, 0.5, start=3)
    assert curriculum.frames() == [2, 6, 7]  # 0.5, then 0.4 and 0.6
    curriculum.fraction = 0.3  # half of the way in
    assert [TIMES[i] for i in curriculum.frames()] == [0.5, 0.4, 0.6, 0.7, 0.3, 0.2]
    curriculum.fraction = 0.6
    assert sorted(curriculum.frames()) == list(range(10))


def test_the_newest_get_their_share_while_frames_come_in():
    curriculum = Curriculum(TIMES, 0.5, start=8, newest_share=0.5, newest_part=0.125)
    counts = draws(curriculum, 0.0)
    newest = curriculum.frames()[-1]
    assert counts[newest] / 2000 == pytest.approx(0.5 + 0.5 / 8, abs=0.04)
    counts = draws(curriculum, 1.0)
    assert max(counts.values()) < 300  # even, once all are in


def test_frames_with_large_errors_come_more_often():
    curriculum = Curriculum(TIMES, 0.0, all_in=0.0, error_share=1.0)
    for frame in range(10):
        curriculum.report(frame, 0.9 if frame == 4 else 0.1)
    assert draws(curriculum, 0.0)[4] / 2000 == pytest.approx(0.5, abs=0.04)
    curriculum.report(4, 0.1)  # halfway to the new error
    assert draws(curriculum, 0.0)[4] / 2000 == pytest.approx(0.5 / 1.4, abs=0.04)


def test_the_ends_of_time_get_their_share_once_all_frames_are_in():
    times = [i / 39 for i in range(40)]
    curriculum = Curriculum(times, 0.5, start=30, all_in=0.5, newest_share=0.0, ends_share=0.5)
    assert max(draws(curriculum, 0.0).values()) < 150  # of 30 frames, none at an end
    counts = draws(curriculum, 1.0)
    ends = [0, 1, 38, 39]
    for frame in ends:
        assert counts[frame] / 2000 == pytest.approx(0.5 / 4 + 0.5 / 40, abs=0.03)
    assert max(count for frame, count in counts.items() if frame not in ends) < 60
    assert Curriculum([0.3], 0.3, all_in=0.0, ends_share=1.0)() == 0


def test_frames_without_an_error_count_as_the_worst():
    curriculum = Curriculum(TIMES, 0.0, all_in=0.0, error_share=1.0)
    assert len(draws(curriculum, 0.0)) == 10
    for frame in range(9):
        curriculum.report(frame, 1e-9)
    curriculum.report(0, 1.0)
    assert draws(curriculum, 0.0)[9] > 500


@pytest.mark.parametrize("error", [float("nan"), float("inf"), -float("inf")])
def test_an_error_that_is_not_finite_tells_nothing(error):
    curriculum = Curriculum(TIMES, 0.0, all_in=0.0, error_share=1.0)
    curriculum.report(3, 0.5)
    curriculum.report(3, error)
    curriculum.report(4, error)
    assert curriculum.errors[3] == 0.5
    assert len(draws(curriculum, 0.0)) == 10


def test_frames_of_one_time_come_in_together():
    times = [t for _ in range(3) for t in (0.0, 0.25, 0.5, 0.75, 1.0)]  # three cameras
    curriculum = Curriculum(times, 0.5, start=2, all_in=1.0)
    played = []
    for fraction in (0.0, 0.34, 0.67, 1.0):
        curriculum.fraction = fraction
        played.append([times[i] for i in curriculum.frames()])
        assert curriculum.in_play == len(played[-1])
    assert played[0] == [0.5] * 3 + [0.25] * 3
    assert [len(p) for p in played] == [6, 9, 12, 15]
    assert played[1] == played[0] + [0.75] * 3


def test_goes_on_where_it_was_saved():
    first, second = (Curriculum(TIMES, 0.5, seed=s, error_share=0.3) for s in (1, 2))
    draws(first, 0.4, 17)
    first.report(3, 0.2)
    second.load_state_dict(first.state_dict())
    assert second.fraction == 0.4
    assert [first() for _ in range(50)] == [second() for _ in range(50)]


def test_a_saved_state_does_not_change_afterwards():
    curriculum = Curriculum(TIMES, 0.5)
    state = curriculum.state_dict()
    curriculum.report(3, 0.2)
    assert state["errors"].isnan().all()


NAMES = ("/tmp/x", "..", "../x", "a/b", "a\\b", "", "-a", "a b", "a\n", 7)


def test_a_pace_ignores_how_many_times_there_are():
    for count, expected in ((200, [10, 10, 11, 166]), (100, [10, 10, 11, 100])):
        curriculum, found = Curriculum([i / count for i in range(count)], 0.0, pace=166.67), []
        for step in (0, 300, 330, 4999):
            curriculum.fraction = step / 5000
            found.append(curriculum.in_play)
        assert found == expected


def test_times_come_in_as_if_from_none_on():
    for count in (50, 100, 200):  # D-NeRF's max(int(i / 100k * count), 3)
        curriculum = Curriculum([i / count for i in range(count)], 0.0, start=3, all_in=0.125, from_zero=True)
        found = []
        for step in (0, 8_000, 50_000, 100_000, 800_000):
            curriculum.fraction = step / 800_000
            found.append(curriculum.in_play)
        assert found == [3, 8 * count // 100, count // 2, count, count]


ODD = (
    {"start": 0},
    {"all_in": 1.5},
    {"newest_share": -0.1},
    {"newest_part": 0.0},
    {"newest_part": 2.0},
)
REFUSED = [
    (settings, {"iterations": None}, "stage.coarse: expected iterations or minutes, but got neither"),
    (settings, {"iterations": 0}, "stage.coarse.iterations: expected a number > 0, or null, but got 0"),
    (settings, {"minutes": -1.0}, "stage.coarse.minutes: expected a number > 0, or null, but got -1.0"),
    *((settings, {"name": name}, "stage: expected names of letters, digits, _ and -") for name in NAMES),
    (shared, {"plans": {}}, "stage: expected at least one stage, but got none"),
    (shared, {"plans": {"a": plan(0)}}, r"stage\.a\.share: expected a number > 0, but got 0"),
    (shared, {"minutes": 0}, r"budget\.minutes: expected a number > 0 or null, but got 0"),
    (shared, {"minutes": "soon"}, r"budget\.minutes: expected a number > 0 or null, but got soon"),
    (shared, {"minutes": None}, r"stage\.a: expected iterations or minutes, but got neither"),
    (partial(Curriculum, TIMES, 0.0), {"pace": -1.0}, "pace: expected a number >= 0 or null, but got -1.0"),
    *(
        (partial(Curriculum, TIMES, 0.0), wrong, r"stage.curriculum: expected start >= 1, .*but got")
        for wrong in (*ODD, {"error_share": 1.5}, {"ends_share": 1.5}, {"error_share": float("nan")})
    ),
]


@pytest.mark.parametrize(("make", "wrong", "text"), REFUSED)
def test_refuses_by_the_name_of_the_key(make, wrong, text):
    with pytest.raises(ValueError, match=text):
        make(**wrong)
