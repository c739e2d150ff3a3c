import json
import shutil

import imageio.v3 as iio
import numpy as np
import pytest

from forewarp.metrics.registry import METRICS, Metric
from forewarp.report.compare import compare, read_metrics


def metrics(method, psnr=30.0, **more):
    return {
        "protocol": {"method": method},
        "seconds": {"train": 60.0},
        "test": {"all": {"psnr": psnr}},
    } | more


@pytest.fixture
def runs(in_tmp):
    """Call with folder -> content of its metrics.json; the current directory holds the folders."""

    def write(**contents):
        for name, content in contents.items():
            (in_tmp / name).mkdir(parents=True, exist_ok=True)
            text = content if isinstance(content, str) else json.dumps(content)
            (in_tmp / name / "metrics.json").write_text(text)
        return list(contents)

    return write


def test_two_runs_side_by_side_with_their_difference(ok, runs):
    more = {"flow": {"epe_moving": 0.1, "motion_mean": 0.4}, "steps": {"coarse": 400, "fine": 900}}
    more["seconds"] = {"train": 60.0, "render_per_frame": 0.0123}
    runs(one=metrics("forward", 31.5, **more), two=metrics("backward", 30.0, **more))
    done = ok("report", "kind=compare", "runs=[one,two]")
    head, _, *rows = (line.split() for line in done.out.splitlines())
    assert head == ["PSNR", "(dB)", "of", "test", "views", "forward", "backward", "difference"]
    assert rows == [
        ["all", "31.50", "30.00", "+1.50"],
        ["moving", "points'", "error,", "%", "of", "motion", "25", "25", "+0"],
        ["steps", "1300", "1300"],
        ["seconds", "of", "training", "60", "60"],
        ["seconds", "a", "picture", "0.012", "0.012"],
    ]


def test_conditions_in_which_runs_differ_are_told(runs):
    told = {"clock": "wall", "threads": 2, "device": "a cpu"}
    runs(
        **{
            name: metrics("forward", protocol={"method": "forward", **told} | more)
            for name, more in (("one", {}), ("two", {"threads": 1, "held_out": 8}))
        }
    )
    rows = {row[0]: row[1:] for row in compare(["one", "two"]).rows}
    assert rows["threads"] == ["2", "1", None]
    assert rows["views held out"] == ["none named", "8", None]
    assert not {"computed on", "clock of the minutes"} & rows.keys()


def test_a_view_is_drawn_by_every_run_that_has_it(ok, runs, in_tmp):
    for run in runs(one=metrics("particles"), two=metrics("forward"), three=metrics("backward")):
        for name in ("a", "b") if run != "three" else "b":
            sheet = in_tmp / run / "images" / "sheets" / "test" / f"{name}.png"
            sheet.parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(sheet, np.zeros((3, 4 * 3 + 8, 3), np.uint8))
    done = ok("report", "kind=compare", "runs=[one,two,three]", "out=out")
    assert done.out.splitlines()[-1] == "written: out/compare.png"
    assert iio.imread("out/compare.png").shape[2] == 4
    shutil.rmtree("three/images")
    assert "written" not in ok("report", "kind=compare", "runs=[one,two,three]", "out=other").out


def test_a_measure_that_a_run_lacks_has_no_row(runs):
    folders = runs(new=metrics("forward", steps={"coarse": 4}), old=metrics("forward"), other=metrics("x"))
    table = compare(folders)
    assert [row[0] for row in table.rows] == ["all", "seconds of training"]
    assert [column.name for column in table.columns[1:]] == folders


@pytest.mark.parametrize(
    ("folders", "methods", "names"),
    [
        (["a/x", "b/y"], ["forward", "backward"], ["forward", "backward"]),
        (["a/x", "b/y"], ["forward", "forward"], ["x", "y"]),
        (["a/x", "b/x"], ["forward", "forward"], ["a/x", "b/x"]),
        (["a/x", "a/x"], ["forward", "forward"], ["1 a/x", "2 a/x"]),
    ],
)
def test_columns_are_named_as_far_as_needed(runs, folders, methods, names):
    runs(**{folder: metrics(method) for folder, method in zip(folders, methods)})
    assert list(read_metrics(folders)) == names


def test_every_metric_of_the_list_has_a_row(runs, monkeypatch):
    monkeypatch.setitem(METRICS, "mean_error", Metric("mean_error", "Mean error", 3))
    scores = {"psnr": 30.0, "lpips_vgg": 0.1, "mean_error": 0.25, "depth_delta_1.25": 1.0}
    rows = compare(runs(one=metrics("x", test={"all": scores}), two=metrics("y", test={"all": scores}))).rows
    assert rows[1:3] == [
        ["LPIPS (vgg), all", "0.1000", "0.1000", "+0.0000"],
        ["Mean error, all", "0.250", "0.250", "+0.000"],
    ]
    assert rows[3][0] == "seconds of training"


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "run/metrics.json: expected a run's numbers, but got none; make them with forewarp-evaluate"),
        ("[]", "run/metrics.json: expected the key protocol, but got none; make it anew with forewarp-eval"),
        ({"protocol": {}, "test": {}}, "run/metrics.json: expected the key seconds, but got none"),
    ],
)
def test_what_is_no_run_is_refused(runs, content, line):
    if content is not None:
        runs(run=content)
    with pytest.raises(ValueError, match=line):
        compare(["run"])


def test_no_runs_are_refused():
    with pytest.raises(ValueError, match="runs: expected folders of runs, but got none; set runs="):
        compare([])
