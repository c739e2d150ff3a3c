"""``windows=N`` stands for two commands; the scores of windows are those of their film."""

import pytest

from forewarp.files import write_json
from forewarp.runs.windows import commands_of, scores_of


def test_other_commands_stand_for_themselves():
    for words in (["seed=1"], ["windows=still"], ["windows=each", "data.window=[0,1]"], ["windows=null"]):
        assert commands_of(words) == [words]


def test_a_folder_is_that_of_all_windows_and_of_what_stands_still():
    still, each = commands_of(["windows=3", "run='my film'", "launcher=joblib", "--multirun"])
    assert still == ["windows=still", "run=my film/still", "launcher=joblib", "--multirun"]
    assert each[:2] == ["windows=each", "data.window=[0,0.333333],[0.333333,0.666667],[0.666667,1]"]
    assert each[2:] == ["run='my film/{hash}'", "start=my film/still", "launcher=joblib", "--multirun"]


def test_what_stands_still_may_be_another_run():
    (each,) = commands_of(["windows=2", "start=long/still", "run=film"])
    assert each[2:] == ["run='film/{hash}'", "start=long/still", "--multirun"]


def test_the_config_that_is_shown_is_the_first_windows():
    shown = ["windows=each", "data.window=[0,0.25]", "--cfg", "job"]
    assert commands_of(["windows=4", "--cfg", "job"]) == [shown]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["windows=1"], "windows: expected a whole number from 2 to 1000, still or each, but got 1"),
        (["windows=two"], "windows: expected a whole number from 2"),
        (["windows=2", "data.window=[0,1]"], "data.window: expected none beside windows=2"),
        (["windows=2", "preset=demo,fast"], "preset: expected one value beside windows=2, but got several"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(words, line):
    with pytest.raises(ValueError, match=f"^{line}"):
        commands_of(words)


def test_scores_are_means_over_the_test_views_of_all_windows(tmp_path):
    for name, window, values in (("b", [0.5, 1], [20.0]), ("a", [0, 0.5], [30.0, 31.0]), ("c", None, [9])):
        write_json(tmp_path / name / "metrics.json", {"protocol": {"window": window} if window else {}})
        views = [{"scores": {"psnr": value}} for value in values]
        write_json(tmp_path / name / "per_image.json", {"images": views})
    assert scores_of([tmp_path / name for name in ("b", "c", "nowhere", "a")]) == [
        "2 windows of a film, means over their test views:",
        "  0 to 0.5     2 views  psnr 30.5000",
        "  0.5 to 1     1 views  psnr 20.0000",
        "  all          3 views  psnr 27.0000",
    ]
    assert scores_of([tmp_path / "a"]) == []
