from collections import Counter

import pytest
import torch

from forewarp.training.schedule import Curriculum

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


def test_nothing_is_drawn_before_it_is_in_play():
    assert set(draws(Curriculum(TIMES, 0.5, start=3), 0.0)) == {2, 6, 7}
    assert set(draws(Curriculum(TIMES, 0.5, start=3), 1.0)) == set(range(10))


def test_all_at_once():
    curriculum = Curriculum(TIMES, 0.0, start=1, all_in=0.0)
    assert curriculum.in_play == 10


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


def test_fewer_frames_than_the_start():
    curriculum = Curriculum([0.3], 0.0, start=10)
    assert (curriculum(), curriculum.in_play) == (0, 1)


@pytest.mark.parametrize(
    "wrong",
    [
        {"start": 0},
        {"all_in": 1.5},
        {"newest_share": -0.1},
        {"newest_part": 0.0},
        {"newest_part": 2.0},
        {"error_share": 1.5},
        {"error_share": float("nan")},
    ],
)
def test_refuses(wrong):
    with pytest.raises(ValueError, match=r"stage.curriculum: expected start >= 1, .*but got"):
        Curriculum(TIMES, 0.0, **wrong)


def test_the_draws_are_plain_integers():
    assert type(Curriculum(TIMES, 0.0)()) is int
    assert not isinstance(Curriculum(TIMES, 0.0)(), torch.Tensor)
