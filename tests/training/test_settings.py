import pytest

from forewarp.training.settings import StageSettings


def settings(**changes):
    return StageSettings(
        **({"name": "coarse", "voxels": [[0, 8000]], "rates": {}, "iterations": 100} | changes)
    )


def test_schedules_hold_until_the_next_entry():
    made = settings(voxels=[[0, 10], [0.5, 20], [0.75, 30]])
    assert [made.at("voxels", f) for f in (0, 0.49, 0.5, 0.74, 0.75, 1)] == [10, 10, 20, 20, 30, 30]
    assert made.at("bases", 0.5) is None
    assert settings(voxels=[[0.2, 10]]).at("voxels", 0.0) == 10  # the first holds from the beginning


def test_rates_hold_and_then_fall_exponentially():
    made = settings(hold=0.5, final_rate=0.01)
    assert [made.rate_factor(f) for f in (0, 0.5)] == [1, 1]
    assert made.rate_factor(0.75) == pytest.approx(0.1)
    assert made.rate_factor(1.0) == made.rate_factor(1.5) == pytest.approx(0.01)
    assert settings(hold=1.0).rate_factor(1.0) == 1


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
        ({"voxels": []}, r"stage.coarse.voxels: expected \[\[fraction, count\], ...\], but got \[\]"),
        ({"voxels": [[2, 100]]}, "stage.coarse.voxels: expected"),
        ({"voxels": [[0, 0]]}, "stage.coarse.voxels: expected"),
        ({"bases": [[0, 1, 2]]}, "stage.coarse.bases: expected"),
        (
            {"effects": ["motion", "shine"]},
            r"stage.coarse.effects: expected some of motion, view, .* got \['motion', 'shine'\]",
        ),
        ({"start": "points"}, "stage.coarse.start: expected auto, box or hull, but got 'points'"),
        ({"confine": 1.5}, r"stage.coarse.confine: expected a fraction in \[0, 1\], but got 1.5"),
        ({"start_alpha": 1.0}, r"stage.coarse.start_alpha: expected a number in \(0, 1\), but got 1.0"),
        ({"box_alpha": 0.0}, r"stage.coarse.box_alpha: expected a number in \(0, 1\), but got 0.0"),
        ({"birth_alpha": 1e-2}, "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1"),
        ({"birth_alpha": 0.0}, "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1"),
        ({"keep_alpha": 1.0}, "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1"),
    ],
)
def test_refuses_by_the_name_of_the_key(wrong, text):
    with pytest.raises(ValueError, match=text):
        settings(**wrong)


@pytest.mark.parametrize("name", ["/tmp/x", "..", "../x", "a/b", "a\\b", "", "-a", "a b", "a\n", 7])
def test_a_stage_has_no_name_that_leads_out_of_the_run(name):
    with pytest.raises(ValueError, match="stage: expected names of letters, digits, _ and -"):
        settings(name=name)
