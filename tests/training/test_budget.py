import pytest

from forewarp.training.objective import Objective
from forewarp.training.schedule import StagePlan, seconds_after, share_out


def plan(share=1.0, **changes):
    """A stage that waits for its budget."""
    numbers = {"num_voxels": [[0, 64]], "lr": {}}
    return StagePlan(share=share, objective=Objective({"photo": 1.0}), **(numbers | changes))


def test_minutes_and_iterations_go_by_share():
    first, second = share_out({"a": plan(1), "b": plan(3)}, minutes=2.0, iterations=10)
    assert (first.settings.name, first.settings.minutes, first.settings.iterations) == ("a", 0.5, 2)
    assert (second.settings.name, second.settings.minutes, second.settings.iterations) == ("b", 1.5, 8)


def test_what_the_stages_after_one_may_take():
    stages = share_out({"a": plan(1), "b": plan(2), "c": plan(1)}, minutes=2.0, iterations=10)
    assert [seconds_after(stages, name) for name in "abc"] == [90, 30, 0]
    steps = share_out({"a": plan(), "b": plan()}, minutes=None, iterations=10)
    assert [seconds_after(steps, name) for name in "ab"] == [None, 0]


def test_a_bound_may_be_left_to_the_other():
    (only,) = share_out({"a": plan(), "b": None}, minutes=None, iterations=7)
    assert (only.settings.minutes, only.settings.iterations) == (None, 7)


def test_a_stage_has_at_least_one_step():
    first, _ = share_out({"a": plan(1), "b": plan(999)}, minutes=None, iterations=3)
    assert first.settings.iterations == 1


@pytest.mark.parametrize(
    ("plans", "minutes", "match"),
    [
        ({}, 1, "stage: expected at least one stage, but got none"),
        ({"a": plan(0)}, 1, r"stage\.a\.share: expected a number > 0, but got 0"),
        ({"a": plan()}, 0, r"budget\.minutes: expected a number > 0 or null, but got 0"),
        ({"a": plan()}, "soon", r"budget\.minutes: expected a number > 0 or null, but got soon"),
        ({"a": plan()}, None, r"stage\.a: expected iterations or minutes, but got neither"),
    ],
)
def test_refusals(plans, minutes, match):
    with pytest.raises(ValueError, match=match):
        share_out(plans, minutes=minutes, iterations=None)


def test_keys_that_the_platform_does_not_know_are_handed_to_the_method():
    (only,) = share_out({"a": plan(voxel=1)}, minutes=1, iterations=None)  # Run.fit refuses what is none
    assert only.settings.numbers == {"num_voxels": [[0, 64]], "voxel": 1}
