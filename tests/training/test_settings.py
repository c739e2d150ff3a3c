import pytest

from forewarp.training.schedule import StageSettings


def settings(**changes):
    return StageSettings.of(**({"name": "coarse", "lr": {}, "iterations": 100} | changes))


def test_keys_that_the_platform_does_not_know_are_the_methods_own():
    made = settings(lr_hold=0.5, num_voxels=[[0, 8000]], max_gradient=2.0, patches=3)
    assert made.numbers == {"num_voxels": [[0, 8000]], "patches": 3}
    assert (made.lr_hold, made.max_gradient) == (0.5, 2.0)


def test_rates_hold_and_then_fall_exponentially():
    made = settings(lr_hold=0.5, lr_final_factor=0.01)
    assert [made.lr_factor(f) for f in (0, 0.5)] == [1, 1]
    assert made.lr_factor(0.75) == pytest.approx(0.1)
    assert made.lr_factor(1.0) == made.lr_factor(1.5) == pytest.approx(0.01)
    assert settings(lr_hold=1.0).lr_factor(1.0) == 1


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
    ("wrong", "text"),
    [
        ({"iterations": None}, "stage.coarse: expected iterations or minutes, but got neither"),
        ({"iterations": 0}, "stage.coarse.iterations: expected a number > 0, but got 0"),
        ({"minutes": -1.0}, "stage.coarse.minutes: expected a number > 0, but got -1.0"),
    ],
)
def test_refuses_by_the_name_of_the_key(wrong, text):
    with pytest.raises(ValueError, match=text):
        settings(**wrong)


@pytest.mark.parametrize("name", ["/tmp/x", "..", "../x", "a/b", "a\\b", "", "-a", "a b", "a\n", 7])
def test_a_stage_has_no_name_that_leads_out_of_the_run(name):
    with pytest.raises(ValueError, match="stage: expected names of letters, digits, _ and -"):
        settings(name=name)
