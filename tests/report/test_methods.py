"""The page of all methods, of runs that nobody trained."""

import csv
import json
import os
import sys

import numpy as np
import pytest
import yaml
from PIL import Image

from forewarp.report.methods import write_methods
from forewarp.report.methods_figures import MARGIN, subject
from forewarp.report.sheets import GAP
from tests.support.runs_on_disk import rows_of, write_run

SIDE = 60


def method_run(root, name, psnr, *, seed=0, minutes=5.0, sheets=True, **protocol):
    """A run of a method, with sheets of two views at 0.2 and 0.8; how red its pictures are tells its PSNR."""
    config = {"model": {"name": name}, "variant": None}
    command = f"forewarp-train seed={seed} scene=ball model={name} run=runs/{name}"
    views = {"measured": "5 of 20 test views, evenly spread"}
    metrics = {"protocol": {"clock": "processor", **views, **protocol}}
    named = {"seed": seed, "minutes": minutes, "psnr": psnr, "command": command}
    curve = ((10, psnr - 5), (100, psnr))
    folder = write_run(root, name, config=config, metrics=metrics, curve=curve, **named)
    if sheets:
        scores = {"scores": {"psnr": psnr}, "rendering": "rendered"}
        images = [{"name": f"test/{view}", "time": time} | scores for view, time in (("a", 0.2), ("b", 0.8))]
        (folder / "per_image.json").write_text(json.dumps({"images": images}))
        (folder / "images" / "sheets" / "test").mkdir(parents=True)
        parts = np.full((SIDE, 3 * SIDE + 2 * GAP, 3), 255, np.uint8)
        for i, red in enumerate((0, 7 * psnr, 0)):
            parts[20:40, 20 + i * (SIDE + GAP) : 40 + i * (SIDE + GAP)] = (red, 0, 0)
        for view in "ab":
            Image.fromarray(parts).save(folder / "images" / "sheets" / "test" / f"{view}.png")
    return folder


def test_methods_are_ranked_and_what_they_depart_from_is_listed_once(tmp_path):
    runs, out = tmp_path / "runs", tmp_path / "out"
    method_run(runs, "forward", 27.0)
    for seed, psnr in ((0, 30.0), (1, 32.0)):
        method_run(runs, "particles", psnr, seed=seed)
    method_run(runs, "ndvg", 22.0, departures="rays of one picture; no pool", faults="padded")
    method_run(runs, "tnerf", 21.0, departures="rays of one picture", sheets=False)
    write_run(runs, "full", config={"variant": {"name": "full"}})
    page, table, curves, views = write_methods(runs, out)
    text = page.read_text()
    first = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| `")]
    assert first == ["`particles`", "`forward` (the paper's)", "`ndvg`", "`tnerf`"]
    assert rows_of(text, "`particles`")[0][1:6] == ["2", "31.00 ± 1.41", "0.9000 ± 0.0000", "", "100"]
    assert rows_of(text, "rays of one picture") == [["rays of one picture", "`ndvg`, `tnerf`"]]
    assert rows_of(text, "kept fault: padded") == [["kept fault: padded", "`ndvg`"]]
    assert "**ball, 5 minutes, 5 of 20 test views, evenly spread**" in text
    assert "* ball/full-1.0-seed0: an ablation" in text
    models = "model=forward,ndvg,particles,tnerf"
    assert f"\nforewarp-train --multirun scene=ball {models} budget.clock=processor threads=2\n" in text
    assert "minutes: particles 30.00, forward 27.00, ndvg 22.00](methods-ball-views.png)" in text
    curve = next(csv.DictReader(table.read_text().splitlines()))["curve"]
    assert curve == "10.0:22.00 100.0:27.00"
    assert (curves.name, views.name) == ("methods-ball.png", "methods-ball-views.png")
    with Image.open(views) as picture:
        assert picture.mode == "P"  # few colours
        reds = [red for _, (red, green, _) in picture.convert("RGB").getcolors() if green < 8]
    for psnr, there in ((27, True), (30, True), (22, True), (21, False)):
        assert any(abs(red - 7 * psnr) < 4 for red in reds) == there, psnr  # tnerf has no sheets


def test_later_runs_are_added_and_the_longest_are_drawn(tmp_path):
    method_run(tmp_path / "runs", "forward", 27.0, sheets=False)
    write_methods(tmp_path / "runs", tmp_path / "out")
    method_run(tmp_path / "later", "forward", 29.0, minutes=20.0, sheets=False)
    (tmp_path / "out" / "faithful-step.md").touch()
    text = write_methods(tmp_path / "later", tmp_path / "out")[0].read_text()
    assert [row[2] for row in rows_of(text, "`forward` (the paper's)")] == ["27.00", "29.00"]
    assert "](faithful-step.md)" in text


def test_runs_under_other_conditions_have_a_table_of_their_own(tmp_path):
    runs, out = tmp_path / "runs", tmp_path / "out"
    conditions = (
        {},
        {"clock": None},
        {"threads": None},
        {"device": "other"},
        {"measured": "9 of 20 test views"},
        {"resolution": [[90, 60], [80, 60]], "background": "white"},
        {"held_out": 8},
        {"iterations": 300},
    )
    for number, more in enumerate(conditions):
        steps = more.pop("iterations", None)
        folder = method_run(runs / str(number), "forward", 20.0 + number, sheets=False, **more)
        if steps:
            config = yaml.safe_load((folder / "config.yaml").read_text())
            config["budget"]["iterations"] = steps
            (folder / "config.yaml").write_text(yaml.safe_dump(config))
    for _ in range(2):  # the second time the rows come from the table, too
        text = write_methods(runs, out)[0].read_text()
        found = [row[2] for row in rows_of(text, "`forward` (the paper's)")]
        assert sorted(found) == [f"{20 + number}.00" for number in range(len(conditions))]
    for words in ("wall clock", "90x60 and 80x60, background white", "8 views held out", "300 steps at most"):
        assert sum(f", {words}" in line for line in text.splitlines()) == 1
    method_run(tmp_path / "again", "forward", 30.0, sheets=False)
    text = write_methods(tmp_path / "again", out)[0].read_text()
    found = [row[2] for row in rows_of(text, "`forward` (the paper's)")]
    assert sorted(found) == [f"{20 + number}.00" for number in (1, 2, 3, 4, 5, 6, 7, 10)]  # again


def test_a_picture_of_more_methods_stays(tmp_path):
    for name in ("forward", "ndvg"):
        method_run(tmp_path / "runs", name, 25.0)
    write_methods(tmp_path / "runs", tmp_path / "out")
    picture = tmp_path / "out" / "methods-ball-views.png"
    before = picture.read_bytes()
    method_run(tmp_path / "later", "ndvg", 20.0)
    text = write_methods(tmp_path / "later", tmp_path / "out")[0].read_text()
    assert picture.read_bytes() == before
    assert "after 5 minutes: forward 25.00, ndvg 25.00](methods-ball-views.png)" in text
    assert text.count("The picture is of runs before the table's of `ndvg`.") == 1  # curves are of the table
    again = write_methods(tmp_path / "later", tmp_path / "out")[0].read_text()
    assert "The picture is of runs before the table's of `ndvg`." in again


def test_of_equal_runs_the_newest_counts_and_the_other_is_named(tmp_path):
    old = method_run(tmp_path / "runs" / "old", "forward", 25.0, sheets=False)
    os.utime(old / "metrics.json", (0, 0))
    method_run(tmp_path / "runs" / "new", "forward", 26.0, sheets=False)
    text = write_methods(tmp_path / "runs", tmp_path / "out")[0].read_text()
    assert [row[2] for row in rows_of(text, "`forward` (the paper's)")] == ["26.00"]
    assert f"* {old.relative_to(tmp_path / 'runs')}: another run of the same is newer" in text


def test_without_matplotlib_the_page_says_why_it_has_no_picture(tmp_path, monkeypatch):
    method_run(tmp_path / "runs", "forward", 25.0)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib.image", None)
    written = write_methods(tmp_path / "runs", tmp_path / "out")
    assert [file.name for file in written] == ["methods.md", "methods.csv"]
    assert "install forewarp[plots]" in written[0].read_text()


def test_a_page_without_any_row_is_refused(tmp_path):
    write_run(tmp_path / "runs", minutes=None)
    with pytest.raises(ValueError, match="expected measured runs that ended after minutes"):
        write_methods(tmp_path / "runs", tmp_path / "out")


def test_runs_without_curves_and_pictures_have_a_table(tmp_path, ok):
    write_run(tmp_path / "runs", curve=None)
    done = ok("report", "kind=methods", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}")
    assert done.out.count("written: ") == 2
    with pytest.raises(ValueError, match="expected folders of runs"):
        write_methods(tmp_path / "none", tmp_path / "out")


def test_a_picture_is_cut_to_its_subject():
    picture = np.ones((100, 80, 3))
    assert subject(picture) == (slice(0, 100), slice(0, 80))
    picture[50:60, 75] = 0
    assert subject(picture) == (slice(50 - MARGIN, 60 + MARGIN), slice(75 - MARGIN, 80))
