import json
import shutil

import imageio.v3 as iio
import numpy as np
import pytest

from forewarp.metrics import registry
from forewarp.metrics.registry import METRICS, Metric, metric_of
from forewarp.report.choices import compare
from forewarp.report.results import Runs, read_compared, read_runs
from forewarp.report.stored import read_stored, stored_csv
from tests.support.runs_on_disk import write_run, write_views


@pytest.fixture
def runs(in_tmp):
    """Call with folder -> what differs in its metrics.json; the current directory holds the folders."""

    def write(**contents):
        for folder, metrics in contents.items():
            (in_tmp / folder).parent.mkdir(exist_ok=True)
            write_run("made", folder.replace("/", "-"), metrics=metrics).rename(in_tmp / folder)
        return list(contents)

    return write


def of(method, scores=None, protocol=None, **more):
    about = {"protocol": {"method": method} | (protocol or {}), "test": {"all": scores or {"psnr": 30.0}}}
    return about | more


@pytest.mark.slow
def test_runs_side_by_side_with_their_difference(ok, runs, monkeypatch):
    monkeypatch.setitem(METRICS, "mean_error", Metric("mean_error", "Mean error", 3))
    scores = {"psnr": 30.0, "lpips_vgg": 0.1, "mean_error": 0.25, "depth_delta_1.25": 1.0}
    flow = {"flow": {"epe_moving": 0.1, "motion_mean": 0.4}}
    runs(one=of("forward", scores | {"psnr": 31.5}, **flow), two=of("backward", scores, **flow))
    done = ok("report", "kind=compare", "runs=[one,two]")
    head, _, *rows = (line.split("  ") for line in done.out.splitlines())
    heads = ["PSNR (dB) of test views", "forward", "backward", "forward - backward"]
    assert [word.strip() for word in head if word] == heads
    assert [[word.strip() for word in row if word] for row in rows] == [
        ["all", "31.50", "30.00", "+1.50"],
        ["LPIPS (vgg), all", "0.1000", "0.1000", "0.0000"],
        ["Mean error, all", "0.250", "0.250", "0.000"],
        ["moving points' error, % of motion", "25", "25", "0"],
        ["steps", "100", "100"],
        ["seconds of training", "50", "50"],
        ["seconds per image", "0.500", "0.500"],
    ]


def test_which_way_is_better_is_read_with_the_run(runs, monkeypatch):
    monkeypatch.setattr(registry, "_STORED", {})
    about = {"metrics": {"mean_error": {"title": "Mean error", "digits": 3, "higher_is_better": False}}}
    folders = runs(one=of("forward", {"psnr": 30.0, "mean_error": 0.25}, **about))
    read_compared(folders)
    assert not metric_of("mean_error").higher_is_better
    assert metric_of("mean_error").heading == "Mean error"


def test_conditions_in_which_runs_differ_are_told_and_what_one_lacks_has_no_row(runs):
    some = {"threads": 1, "held_out": 8, "measured": "5 of 20 test views"}
    folders = runs(one=of("forward", {"psnr": 30.0, "ssim": 0.9}), two=of("backward", protocol=some))
    rows = {row[0]: row[1:] for row in compare(read_compared(folders)).rows}
    measures = ["all", "steps", "seconds of training", "seconds per image"]
    assert list(rows) == [*measures, "threads", "test views", "views held out"]
    assert rows["all"] == ["30.00", "30.00", None]  # of other views
    assert rows["threads"] == ["2", "1", None]
    assert rows["views held out"] == ["none named", "8", None]


@pytest.mark.slow
def test_other_scenes_have_no_difference_and_other_kinds_of_view_no_metrics(ok, in_tmp):
    flow = {"flow": {"epe_moving": 0.1, "motion_mean": 0.4}}
    space = {"test": {"space": {"psnr": 20.0}}}
    few = of("backward", protocol={"train_views": 16}, **flow)
    for scene, metrics in {"ball": of("forward", **flow), "cube": few, "cone": of("forward") | space}.items():
        write_run(in_tmp, scene=scene, metrics=metrics)
    _, _, *rows, why = ok("report", "kind=compare", "runs=[ball/*,cube/*]").out.splitlines()
    cells = {row[: row.index("  ")]: row.split()[-2:] for row in rows}
    assert (cells["all"], cells["moving points' error, % of motion"]) == (["30.00", "30.00"], ["25", "25"])
    assert (cells["scene"], cells["training views"]) == (["ball", "cube"], ["all", "16"])
    assert why == "no differences: the runs are of different scenes"
    last = ok("report", "kind=compare", "runs=[ball/*,cone/*]").out.splitlines()[-1]
    assert last.endswith("measured in all runs (ball/base-1.0-seed0: all; cone/base-1.0-seed0: space)")


def test_scenes_of_one_name_and_other_files_are_told_apart_where_files_are_known(in_tmp):
    scores = {"one": 0, "two": 1, "three": 0, "old": 1}
    folders = {name: write_run(name, seed=seed, metrics=of("forward")) for name, seed in scores.items()}
    for name in ("one", "two", "three"):
        (folders[name] / "data.json").write_text(
            json.dumps({"texts": {"a.json": "0" if name == "one" else "1"}})
        )

    def said(first, second):
        groups = read_compared([folders[first], folders[second]])
        return len(groups), compare(groups).caption

    apart = "no differences: the runs are of different scenes"
    assert said("one", "two") == (2, apart)
    assert apart not in said("one", "old")[1]
    assert said("two", "three")[0] == 1  # seeds of one
    runs = read_runs(in_tmp)[0]
    assert sorted(map(len, runs.by("scene").values())) == [1, 1, 2]
    stored = in_tmp / "stored.csv"
    stored.write_text(stored_csv(Runs(row for row in runs if row["files"])))
    assert sorted(map(len, read_stored(stored).by("scene").values())) == [1, 2]


@pytest.mark.slow
def test_a_view_is_drawn_by_every_run_that_has_it(ok, runs, in_tmp):
    for run in runs(one=of("particles"), two=of("forward"), three=of("backward")):
        views = {f"test/{name}": (0.5, 30.0) for name in ("ab" if run != "three" else "b")}
        write_views(in_tmp / run, views, np.zeros((3, 4 * 3 + 8, 3), np.uint8))
    done = ok("report", "kind=compare", "runs=[one,t*]", "out=out")
    assert done.out.splitlines()[-1] == "written: out/compare.png"
    assert iio.imread("out/compare.png").shape[2] == 4
    shutil.rmtree("three/images")
    assert "written" not in ok("report", "kind=compare", "runs=[one,two,three]", "out=other").out


@pytest.mark.parametrize(
    ("folders", "methods", "names"),
    [
        (["a/x", "b/y"], ["forward", "backward"], ["forward", "backward"]),
        (["a/x", "b/y"], ["forward", "forward"], ["x", "y"]),
        (["a/x", "b/x"], ["forward", "forward"], ["a/x", "b/x"]),
        (["a/x", "a/x"], ["forward"], ["1 a/x", "2 a/x"]),
    ],
)
def test_columns_are_named_as_far_as_needed(runs, folders, methods, names):
    runs(**{folder: of(method) for folder, method in zip(folders, methods)})
    assert list(read_compared(folders)) == names


def test_what_is_no_run_is_refused(runs, in_tmp):
    runs(run={})
    (in_tmp / "begun").mkdir()
    (in_tmp / "run" / "metrics.json").write_text(json.dumps({"protocol": {}, "test": {}}))
    for folders, line in (
        (["run"], "run: expected a measured run, but got no key 'seconds'; measure it"),
        (["none"], "runs: expected folders of runs, but got none, which is not there"),
        (["begun"], "begun/metrics.json: expected a run's numbers, but got none; make them"),
        ([], "runs: expected folders of runs, but got none; set runs="),
    ):
        with pytest.raises(ValueError, match=f"^{line}"):
            read_compared(folders)


def test_differences_are_in_pairs_by_seed_and_view_and_say_where_no_seed_is_shared(in_tmp):
    def table_of(first, second):
        shutil.rmtree("runs", ignore_errors=True)
        for method, seeds in (("forward", first), ("backward", second)):
            for seed in seeds:
                metrics = of(method, {"psnr": 30.0, "lpips_alex": 0.1 * (1 + (method == "forward"))})
                made = write_run("runs", method, seed, config={"model": {"name": method}}, metrics=metrics)
                lpips = {"a": 0.5, "b": 0.1} if method == "forward" else {"a": 0.1}
                scores = {name: {"psnr": 30.0, "lpips_alex": value} for name, value in lpips.items()}
                images = [{"name": n, "time": 0.5, "ability": "all", "scores": s} for n, s in scores.items()]
                (made / "per_image.json").write_text(json.dumps({"images": images}))
        table = compare(read_compared(sorted(in_tmp.glob("runs/**/*seed*"))))
        return {row[0]: row[-1] for row in table.rows}, table.caption

    rows, caption = table_of((0, 1, 2), (0, 1, 2))
    assert rows["LPIPS (alex), all"] == "-0.4000 ± 0.0000, better"  # of view a, which both have
    assert rows["all"] == "0.00 ± 0.00, no difference shown"
    assert "\ndifferences are paired by seed\n2 differences are of three seeds or more; by" in caption
    rows, caption = table_of((0, 1), (2, 3))
    assert (rows["all"], rows["steps"], "paired" in caption) == ("no seed in common", None, False)
    rows, caption = table_of((0,), (2,))
    assert (rows["all"], caption) == ("0.00", "differences are of one run each, of other seeds")
