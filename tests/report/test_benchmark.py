"""Pages of methods under one clock, of runs that nobody trained."""

import csv
import os
import shutil
import sys
from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from forewarp.metrics.registry import METRICS, Metric
from forewarp.report import figures
from forewarp.report.benchmark import Published, read_published, write_methods, write_minutes
from forewarp.report.figures import GAP
from forewarp.report.stored import read_stored
from tests.support.runs_on_disk import rows_of, write_run, write_views

EARLIER = Path(__file__).parent / "earlier"  # tables as written before there were as many columns
PARTICLES = {"config": {"model": {"name": "particles"}}}
TOY = {"protocol": {"dataset": "toy"}}
TIMES = (0.0, 0.05, 0.5, 0.6, 1.0)
OTHER = Published("Other", 600.0, 31.0, "RTX 1", "its paper", "dnerf")
SIDE, SAVE = 60, figures.save


@pytest.fixture(autouse=True)
def unsaved(monkeypatch):
    """Pictures are laid out and written by the tests that look at them alone: it takes most of the time."""
    monkeypatch.setattr(figures, "save", lambda figure, path, colors=None: path.touch() or path)


def write_psnr(folder, *values):
    write_views(folder, {str(time): (time, psnr) for time, psnr in zip(TIMES, values)})


def section(text, title):
    """The part of a page below a heading."""
    (found,) = [part for part in text.split("\n## ") if part.startswith(title + "\n")]
    return found


def pages_of(files):
    return {file.name: file.read_text() for file in files if file.suffix == ".md"}


def test_the_page_has_scenes_by_minutes_and_keeps_what_was_measured_before(tmp_path):
    runs, out = tmp_path / "runs", tmp_path / "out"
    typed = "forewarp-train seed=0 paths.scenes=/home/me/data run=/home/me/run lpips_weights=/home/me"
    for seed, psnr in ((0, 30.0), (1, 32.0)):
        folder = write_run(runs, seed=seed, psnr=psnr, metrics=TOY, command=typed)
        write_psnr(folder, 30, 31, 34, 33, 32)
    page, table, picture = write_minutes(runs, out)
    assert (page.name, table.name, picture.name) == ("forward.md", "forward.csv", "forward.png")
    assert rows_of(page.read_text(), "ball")[0] == ["ball", "31.00 (30.00, 32.00)"]
    assert all("/home/me" not in file.read_text() for file in (page, table))
    assert "paths.scenes=DATASETS" in page.read_text()
    later = tmp_path / "later"
    write_run(later, seed=0, psnr=40.0, minutes=5.0, metrics=TOY)
    write_run(later, seed=1, psnr=33.0, metrics=TOY)  # measured again
    write_run(later, seed=0, psnr=20.0, scene="hook", metrics=TOY)
    write_run(later, scene="endless", minutes=None)
    text = write_minutes(later, out)[0].read_text()
    assert rows_of(text, "ball")[0] == ["ball", "31.50 (30.00, 33.00)", "40.00"]
    assert rows_of(text, "mean of toy") == [["mean of toy", "25.00 [1 of 2 seeds]", ""]]  # hook has seed 0
    (details,) = [row for row in rows_of(section(text, "Each"), "ball") if row[1] == "1"]
    assert details[2:5] == ["2", "31.50 (30.00, 33.00)", "0.9000 (0.9000, 0.9000)"]
    assert details[6] == "2.5"  # dB at the ends
    assert "* endless/base-None-seed0: no budget.minutes" in text
    rows = list(csv.DictReader(table.read_text().splitlines()))
    found = [(row["scene"], row["minutes"], row["seed"], float(row["psnr"])) for row in rows]
    assert found[:2] == [("ball", "1.0", "0", 30.0), ("ball", "1.0", "1", 33.0)]
    assert found[2:] == [("ball", "5.0", "0", 40.0), ("hook", "1.0", "0", 20.0)]


def test_rows_of_earlier_versions_stay(tmp_path):
    out, before = tmp_path / "out", {}
    out.mkdir()
    for method in ("particles", "forward"):  # as committed, forward's with fewer columns
        shutil.copy(EARLIER / f"{method}.csv", out)
        (out / f"{method}.md").write_text("a page\n")
        before[method] = list(csv.DictReader((out / f"{method}.csv").read_text().splitlines()))
    (out / "other.csv").write_text("method,psnr\nforward,3\n")  # of another page
    write_run(tmp_path / "runs", scene="anew", metrics=TOY, **PARTICLES)
    written = write_minutes(tmp_path / "runs", out)
    assert len(written) == 6  # the page of the other method, which compares too
    kept = itemgetter("scene", "seed", "psnr", "views", "command")
    for method, rows in before.items():
        now = list(csv.DictReader((out / f"{method}.csv").read_text().splitlines()))
        assert {*map(kept, rows)} <= {*map(kept, now)}
        assert len(now) == len(rows) + (method == "particles")
    text = (out / "forward.md").read_text()
    assert "| mean of" not in text  # counterparts of four datasets
    assert rows_of(section(text, "Each"), "lift_tilt")


def test_methods_are_compared_after_equal_minutes(tmp_path):
    runs = tmp_path / "runs"
    for seed in (0, 1, 2):
        own = {"test": {"all": {"psnr": 32 + seed, "ssim": 0.95, "lpips_vgg": 0.1}}}
        other = {"test": {"all": {"psnr": 30, "ssim": 0.96, "lpips_vgg": 0.2}}}
        write_run(runs, "p", seed, metrics={**TOY, **own}, **PARTICLES)
        write_run(runs, "v", seed, metrics={**TOY, **other})
    write_run(runs, "v", 2, metrics=TOY, minutes=5.0)
    write_run(runs, "w", 3, metrics={"protocol": {"threads": 1}})
    pages = pages_of(write_minutes(runs, tmp_path / "out"))
    (row,) = rows_of(section(pages["particles.md"], "Beside `forward`"), "ball")
    assert row[1:5] == ["1", "3 and 3", "33.00 ± 2.48", "30.00 ± 0.00"]  # 4.303 / sqrt(3) = 2.484
    assert row[5:] == ["+3.00 ± 2.48 dB, above", "-0.0100 ± 0.0000, below", "-0.1000 ± 0.0000, better"]
    beside = section(pages["forward.md"], "Beside `particles`")
    assert "-3.00 ± 2.48 dB, below" in beside
    assert "3 differences are of three seeds or more; by chance 0.15 of their intervals" in beside


def test_kinds_of_views_and_moving_points_stand_beside_each_other(tmp_path):
    runs = tmp_path / "runs"
    scores = {kind: {"psnr": 30 + i, "ssim": 0.9} for i, kind in enumerate(("space", "time", "canonical"))}
    for share, more in ((0.13, PARTICLES), (0.21, {})):
        flow = {"epe_moving": 2 * share, "motion_mean": 2.0}
        write_run(runs, f"{share}", metrics={**TOY, "test": scores, "flow": flow}, **more)
    text = pages_of(write_minutes(runs, tmp_path / "out"))["particles.md"]
    found = [(row[2], row[-1]) for row in rows_of(section(text, "Space, time, motion"), "ball")]
    assert found == [("`forward`", "21.0"), ("`particles`", "13.0")]
    assert rows_of(section(text, "Space, time, motion"), "ball")[0][3:-1] == ["1", "30.00", "31.00", "32.00"]


def test_more_minutes_and_more_particles_are_compared_with_fewer(tmp_path):
    runs = tmp_path / "runs"
    for length, psnr in ((1.0, 30.0), (5.0, 31.0), (20.0, 30.7)):
        write_run(runs, psnr=psnr, minutes=length, metrics={**TOY, "size": {"particles": 12000}}, **PARTICLES)
    for density, psnr in ((45, 29.9), (180, 29.85)):
        command = f"forewarp-train stage.fine.density={density} seed=0"
        more = {**TOY, "size": {"particles": 12000 * density // 90}}
        write_run(runs, f"{density}", psnr=psnr, command=command, metrics=more, **PARTICLES)
    text = write_minutes(runs, tmp_path / "out")[0].read_text()
    assert rows_of(text, "ball")[0] == ["ball", "30.00", "31.00", "30.70"]  # of the preset's density alone
    told = [row[-1] for row in rows_of(section(text, "More minutes"), "ball")]
    assert told == ["", "+1.00 dB", "-0.30 dB"]
    assert [row[1] for row in rows_of(section(text, "Each"), "ball")] == ["1", "5", "20"]
    found = [(*row[3:6], row[-1]) for row in rows_of(section(text, "More particles"), "ball")]
    assert found == [
        ("45", "6000", "29.90", ""),
        ("", "12000", "30.00", "+0.10 dB"),
        ("180", "24000", "29.85", "-0.15 dB"),
    ]


def test_larger_pictures_are_compared_at_the_size_of_small_ones(tmp_path):
    runs = tmp_path / "runs"
    for name, psnr, side, more in (("s", 33.0, 400, {}), ("l", 33.4, 800, {"reduced": 2})):
        protocol = {"dataset": "toy", "resolution": [side, side], "background": "white", **more}
        write_run(runs, name, psnr=psnr, minutes=3.0, metrics={"protocol": protocol}, **PARTICLES)
    text = write_minutes(runs, tmp_path / "out")[0].read_text()
    assert rows_of(text, "ball")[0] == ["ball", "33.00"]
    large, small = rows_of(section(text, "Larger images"), "ball")
    assert large[3:5] == ["800x800 reduced 2x2, background white", "33.40"]
    assert large[-1] == "+0.40 dB, to the run that learned from 400x400"
    assert small[3:5] == ["400x400, background white", "33.00"]
    assert "Beside" not in text


def test_both_clocks_and_versions_of_the_code_are_told(tmp_path, monkeypatch):
    runs, drawn = tmp_path / "runs", []
    for seed, commit in ((0, "aaa"), (1, "bbb")):
        more = {"protocol": {"dataset": "toy", "commit": commit}, "clocks": {"wall": 70.0, "processor": 60.0}}
        write_psnr(write_run(runs, seed=seed, metrics=more), 30 + 2 * seed, 31, 34, 33, 32)
    monkeypatch.setattr(figures, "draw_by_time", lambda path, scenes: drawn.append(scenes))
    text = write_minutes(runs, tmp_path / "out")[0].read_text()
    (row,) = rows_of(section(text, "What it costs"), "ball")
    assert row[2:6] == ["60", "70", "100", "500.0"]
    (line,) = [line for line in text.splitlines() if line.startswith("The runs are of 2 versions")]
    assert "commits" in line
    assert drawn[0]["ball"]["1 min, 2 seeds"][:2] == [(0.0, 31.0), (0.05, 31.0)]


def timed(runs, method, minutes, *found, scene="ball", clock="wall", took=None):
    for seed, psnr in enumerate(found):
        clocks = {} if took is None else {"clocks": {clock: took}}
        metrics = {"protocol": {"dataset": "dnerf", "clock": clock}, **clocks}
        named = {"seed": seed, "psnr": psnr, "minutes": minutes, "scene": scene}
        write_run(runs / method, **named, metrics=metrics, config={"model": {"name": method}})


@pytest.mark.slow
def test_methods_are_compared_over_lengths(tmp_path, monkeypatch):
    out, beside, draw = tmp_path / "out", [], figures.draw_lengths
    monkeypatch.setattr(figures, "draw_lengths", lambda *given: beside.append(given[3]) or draw(*given))
    timed(tmp_path / "runs", "particles", 1 / 30, 20.0, 22.0)
    timed(tmp_path / "runs", "particles", 1.0, 30.0)
    timed(tmp_path / "runs", "forward", 1 / 30, 19.0)
    timed(tmp_path / "runs", "forward", 1.0, 24.0)
    assert "accuracy-time.md" not in pages_of(write_minutes(tmp_path / "runs", out))  # two are no curve
    timed(tmp_path / "later", "particles", 5.0, 33.0)
    assert "accuracy-time.md" not in pages_of(write_minutes(tmp_path / "later", out))
    timed(tmp_path / "later", "forward", 5.0, 29.5)
    toy = Published("Toy", 60.0, 20.0, "a CPU", "a page", "toy")
    (tmp_path / "others.yaml").write_text(yaml.safe_dump([other._asdict() for other in (OTHER, toy)]))
    written = write_minutes(tmp_path / "later", out, tmp_path / "others.yaml")
    text = pages_of(written)["accuracy-time.md"]
    assert rows_of(text, "method")[0][1:] == ["2 s", "1 min", "5 min", "seeds", "passed by `particles` after"]
    assert rows_of(text, "`particles`")[0][1:] == ["21.00 (20.00, 22.00)", "30.00", "33.00", "2, 1, 1", ""]
    assert rows_of(text, "`forward`")[0][1:] == ["19.00", "24.00", "29.50", "1, 1, 1", "1 min"]
    assert "| Other | 31 | 600 s | RTX 1 | dnerf | its paper |" in text
    assert ("Toy" in text, beside) == (False, [[OTHER]])  # of no scene's dataset
    assert (out / "accuracy-time-ball.png") in written
    assert "](accuracy-time-ball.png)" in text


def test_what_was_measured_otherwise_is_not_compared(tmp_path):
    for method, clock in (("particles", "processor"), ("forward", "wall"), ("backward", "wall")):
        for minutes in (0.5, 1.0, 5.0):
            timed(tmp_path / "runs", method, minutes, 30.0, clock=clock)
    text = pages_of(write_minutes(tmp_path / "runs", tmp_path / "out"))["accuracy-time.md"]
    assert "## ball, wall clock\n" in text
    assert "](accuracy-time-ball-wall-clock.png)" in text
    assert not rows_of(text, "`particles`")


def test_runs_that_ended_early_or_late_stand_where_they_ended(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "draw_lengths", lambda path, points, *rest: drawn.append(points))
    for method in ("particles", "forward"):
        timed(tmp_path / "runs", method, 0.5, 29.0, took=50.0 if method == "forward" else 30.0)
        timed(tmp_path / "runs", method, 1.0, 30.0, took=60.0)
        timed(tmp_path / "runs", method, 20.0, 31.0, took=300.0 if method == "particles" else 1200.0)
    pages = pages_of(write_minutes(tmp_path / "runs", tmp_path / "out"))
    text = pages["accuracy-time.md"]
    assert rows_of(text, "`particles`")[0][2:4] == ["30.00", "31.00 (ended after 5 min)"]
    assert rows_of(text, "`forward`")[0][1:4] == ["29.00 (took 50 s)", "30.00", "31.00"]
    assert drawn[0]["particles"] == [[(30.0, 29.0)], [(60.0, 30.0)], [(300.0, 31.0)]]
    assert "Some runs ended by their steps" in pages["particles.md"]
    assert "20 (ended after 5 min)" in pages["particles.md"]
    assert "Some runs ended" not in pages["forward.md"]


def test_published_points_are_read_and_checked(tmp_path):
    path = tmp_path / "published.yaml"
    path.write_text("- {name: a, seconds: 60, psnr: 30.5, hardware: g, source: s, dataset: dnerf}\n")
    assert read_published(path) == [Published("a", 60, 30.5, "g", "s", "dnerf")]
    for text in ("- {name: a}\n", "name: a\n"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"published.yaml: expected entries with the keys name, seconds"):
            read_published(path)
    path.write_text("[")
    with pytest.raises(
        ValueError, match="published.yaml: expected YAML, but got did not find expected node content"
    ):
        read_published(path)


def method_run(root, name, psnr, *, seed=0, minutes=5.0, steps=None, sheets=False, **protocol):
    """A run of a method; with sheets of views at 0.2 and 0.8, of which how red they are tells the PSNR."""
    config = {"model": {"name": name}, "variant": None, "budget": {"minutes": minutes, "iterations": steps}}
    command = f"forewarp-train seed={seed} scene=ball model={name} run=runs/{name}"
    views = {"measured": "5 of 20 test views, evenly spread"}
    metrics = {"protocol": {"clock": "processor", **views, **protocol}}
    named = {"seed": seed, "minutes": minutes, "psnr": psnr, "command": command}
    curve = ((10, psnr - 5), (100, psnr)) if sheets else None
    folder = write_run(root, name, config=config, metrics=metrics, curve=curve, **named)
    if sheets:
        parts = np.full((SIDE, 3 * SIDE + 2 * GAP, 3), 255, np.uint8)
        for i, red in enumerate((0, 7 * psnr, 0)):
            parts[20:40, 20 + i * (SIDE + GAP) : 40 + i * (SIDE + GAP)] = (red, 0, 0)
        write_views(folder, {"test/a": (0.2, psnr), "test/b": (0.8, psnr)}, parts)
    return folder


@pytest.mark.slow
def test_methods_are_ranked_and_what_they_depart_from_is_listed_once(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "save", SAVE)
    runs, out = tmp_path / "runs", tmp_path / "out"
    method_run(runs, "forward", 27.0, sheets=True)
    for seed, psnr in ((0, 30.0), (1, 32.0)):
        method_run(runs, "particles", psnr, seed=seed, sheets=True)
    method_run(runs, "ndvg", 22.0, departures="rays of one picture; no pool", faults="padded", sheets=True)
    method_run(runs, "tnerf", 21.0, departures="rays of one picture")
    write_run(runs, "full", config={"variant": {"name": "full"}})
    page, table, curves, views = write_methods(runs, out)
    text = page.read_text()
    first = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| `")]
    assert first == ["`particles`", "`forward` (the paper's)", "`ndvg`", "`tnerf`"]
    assert rows_of(text, "`particles`")[0][1:6] == [
        "2",
        "31.00 (30.00, 32.00)",
        "0.9000 (0.9000, 0.9000)",
        "",
        "100",
    ]
    assert rows_of(text, "rays of one picture") == [["rays of one picture", "`ndvg`, `tnerf`"]]
    assert rows_of(text, "kept fault: padded") == [["kept fault: padded", "`ndvg`"]]
    assert "**ball, 5 minutes, 5 of 20 test views, evenly spread**" in text
    assert "* ball/full-1.0-seed0: an ablation" in text
    assert "some of `model=forward,ndvg,particles,tnerf`" in text
    assert "\nforewarp-train scene=ball budget.clock=processor threads=2\n" in text
    assert "minutes: particles 30.00, forward 27.00, ndvg 22.00](methods-ball-views.png)" in text
    assert next(csv.DictReader(table.read_text().splitlines()))["curve"] == "10.0:22.00 100.0:27.00"
    assert (curves.name, views.name) == ("methods-ball.png", "methods-ball-views.png")
    with Image.open(views) as picture:
        assert picture.mode == "P"  # few colours
        reds = [red for _, (red, green, _) in picture.convert("RGB").getcolors() if green < 8]
    for psnr, there in ((27, True), (30, True), (22, True), (21, False)):
        assert any(abs(red - 7 * psnr) < 4 for red in reds) == there, psnr  # tnerf has no sheets


@pytest.mark.slow
def test_methods_that_cannot_be_told_apart_share_the_mark_of_the_best(tmp_path):
    found = {"forward": (30.0, 30.1, 30.2), "particles": (30.1, 30.0, 30.2), "ndvg": (20.0, 20.1, 20.2)}
    for name, psnr in (found | {"tnerf": (40.0,)}).items():  # one seed, however good, is not ranked
        for seed, value in enumerate(psnr):
            method_run(tmp_path / "runs", name, value, seed=seed)
    text = write_methods(tmp_path / "runs", tmp_path / "out")[0].read_text()
    names = ("`forward` (the paper's)", "`particles`", "`ndvg`", "`tnerf`")
    assert [rows_of(text, name)[0][2].startswith("**") for name in names] == [True, True, False, False]


def test_later_runs_are_added_and_runs_under_other_conditions_have_their_own_table(tmp_path):
    runs, out = tmp_path / "runs", tmp_path / "out"
    size = {"resolution": [[90, 60], [80, 60]], "background": "white"}
    more = ({}, {"clock": None}, {"threads": None}, {"device": "other"}, {"measured": "9 of 20 test views"})
    for number, conditions in enumerate((*more, size, {"held_out": 8}, {"steps": 300})):
        method_run(runs / str(number), "forward", 20.0 + number, **conditions)
    for _ in range(2):  # the second time the rows come from the table, too
        text = write_methods(runs, out)[0].read_text()
        found = [row[2] for row in rows_of(text, "`forward` (the paper's)")]
        assert sorted(found) == [f"{20 + number}.00" for number in range(8)]
    for words in ("wall clock", "90x60 and 80x60, background white", "8 views held out", "300 steps at most"):
        assert sum(f", {words}" in line for line in text.splitlines()) == 1
    old = method_run(tmp_path / "later" / "old", "forward", 25.0)
    os.utime(old / "metrics.json", (0, 0))
    method_run(tmp_path / "later" / "new", "forward", 30.0)
    (out / "faithful-step.md").touch()
    text = write_methods(tmp_path / "later", out)[0].read_text()
    found = [row[2] for row in rows_of(text, "`forward` (the paper's)")]
    assert sorted(found) == [f"{20 + number}.00" for number in (1, 2, 3, 4, 5, 6, 7, 10)]
    assert f"* {old.relative_to(tmp_path / 'later')}: another run of the same is newer" in text
    assert "](faithful-step.md)" in text


@pytest.mark.slow
def test_a_picture_of_more_methods_stays(tmp_path):
    for name in ("forward", "ndvg"):
        method_run(tmp_path / "runs", name, 25.0, sheets=True)
    write_methods(tmp_path / "runs", tmp_path / "out")
    picture = tmp_path / "out" / "methods-ball-views.png"
    picture.write_text("as it was")
    method_run(tmp_path / "later", "ndvg", 20.0, sheets=True)
    for _ in range(2):
        text = write_methods(tmp_path / "later", tmp_path / "out")[0].read_text()
        assert picture.read_text() == "as it was"
        assert "after 5 minutes: forward 25.00, ndvg 25.00](methods-ball-views.png)" in text
        # Curves are of the table.
        assert text.count("The image is of runs before the table's of `ndvg`.") == 1


def test_without_matplotlib_the_page_says_why_it_has_no_picture(tmp_path, monkeypatch):
    method_run(tmp_path / "runs", "forward", 25.0, sheets=True)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    written = write_methods(tmp_path / "runs", tmp_path / "out")
    assert [file.name for file in written] == ["methods.md", "methods.csv"]
    assert "install forewarp[plots]" in written[0].read_text()


def test_a_page_without_any_row_is_refused(tmp_path):
    write_run(tmp_path / "runs", minutes=None)
    with pytest.raises(
        ValueError,
        match=r"expected runs of budget.minutes with .*, but got none among 1 folder of a run \(ball/base",
    ):
        write_methods(tmp_path / "runs", tmp_path / "out")


def test_a_metric_that_was_added_has_a_column_and_stays_in_the_table(tmp_path, monkeypatch):
    runs, out = tmp_path / "runs", tmp_path / "out"
    for model, error in (("forward", 0.25), ("particles", 0.125)):
        metrics = {**TOY, "test": {"all": {"psnr": 30.0, "mean_error": error}}}
        write_run(runs, model, metrics=metrics, config={"model": {"name": model}, "variant": None})
    monkeypatch.setitem(METRICS, "mean_error", Metric("mean_error", "Mean error", 3, higher_is_better=False))
    text = pages_of(write_minutes(runs, out))["particles.md"]
    assert rows_of(section(text, "Each"), "scene")[0][6] == "Mean error"
    assert rows_of(section(text, "Each"), "ball")[0][6] == "0.125"
    assert rows_of(section(text, "Beside `forward`"), "ball")[0][-1] == "-0.125"
    assert rows_of(write_methods(runs, out)[0].read_text(), "`forward` (the paper's)")[0][5] == "0.250"
    write_run(tmp_path / "later", scene="hook", config={"model": {"name": "forward"}})
    text = pages_of(write_minutes(tmp_path / "later", out))["forward.md"]
    assert [rows_of(section(text, "Each"), scene)[0][6] for scene in ("ball", "hook")] == ["0.250", ""]


def test_writing_twice_changes_no_table(tmp_path):
    typed = ("rigid=1", "")  # the first typed the default
    for seed, word in enumerate(typed):
        write_run(tmp_path / "runs", "x", seed, metrics=TOY, against=None, command=f"forewarp-train {word}")
    first = [write_minutes(tmp_path / "runs", tmp_path / "out")[1].read_text() for _ in range(2)]
    again = write_methods(tmp_path / "runs", tmp_path / "out")[1].read_text()
    assert again == write_methods(tmp_path / "runs", tmp_path / "out")[1].read_text()
    assert first[0] == first[1]
    assert [row["overrides"] for row in csv.DictReader(first[1].splitlines())] == ["", ""]


@pytest.mark.parametrize("word", ["experiment", "scene"])  # the second tells neither apart
def test_experiments_reported_on_different_days_are_not_pooled(tmp_path, word):
    for _ in range(2):
        for name, psnr in (("a", 30.0), ("b", 34.0)):
            runs = tmp_path / name
            if not runs.is_dir():
                config = {"variant": None, "objective": {"weight": psnr}}
                command = f"forewarp-train {word}={name}"
                write_run(runs, "x", psnr=psnr, metrics=TOY, command=command, config=config)
            page, table, _ = write_minutes(runs, tmp_path / "out")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert sorted(row["psnr"] for row in rows) == ["30.0", "34.0"]
    names = {row["overrides"] for row in rows}
    digests = {f"configuration={row['digest']}" for row in rows}
    assert names == ({"experiment=a", "experiment=b"} if word == "experiment" else digests)
    assert len(digests) == 2
    assert "32.00" not in page.read_text()


def test_a_row_without_a_digest_is_replaced_by_its_run(tmp_path):
    runs, out = tmp_path / "runs", tmp_path / "out"
    write_run(runs, metrics=TOY)
    _, table, _ = write_minutes(runs, out)
    text = table.read_text()
    rows = list(csv.DictReader(text.splitlines()))
    table.write_text(text.replace(rows[0]["digest"], "").replace("30.0", "29.0"))
    write_minutes(runs, out)
    assert table.read_text() == text


def test_a_column_of_another_version_is_refused_by_name(tmp_path):
    _, table, _ = write_minutes(write_run(tmp_path / "runs", metrics=TOY).parent, tmp_path / "out")
    lines = table.read_text().splitlines()
    table.write_text("\n".join([f"{lines[0]},kind", f"{lines[1]},time"]))
    told = r"forward.csv:2: expected a number in the column kind, but got 'time'; where an earlier version"
    with pytest.raises(ValueError, match=told):
        write_minutes(tmp_path / "runs", tmp_path / "out")
    table.write_text("scene,variant,minutes,seed,views\nball,base,1,0,time\n")
    with pytest.raises(ValueError, match=r"forward.csv:2: .* in the column views, but got 'time'"):
        read_stored(table)


def test_a_note_of_a_row_is_on_the_page_until_the_row_is_measured_again(tmp_path):
    for method in ("forward", "nerfies"):
        write_run(tmp_path / "runs", method, config={"model": {"name": method}, "variant": None}, metrics=TOY)
    page, table, *_ = write_methods(tmp_path / "runs", tmp_path)
    head, *lines = table.read_text().splitlines()
    assert head.endswith(",note")
    noted = [line + "of before." * line.startswith("nerfies") for line in lines]
    for _ in range(2):  # the second time from what the first wrote
        table.write_text("\n".join([head, *noted]))
        assert "\n\n`nerfies`: of before.\n\n" in write_methods(table, tmp_path)[0].read_text()
        head, *noted = table.read_text().splitlines()
    assert "of before" not in write_methods(tmp_path / "runs", tmp_path)[0].read_text()
