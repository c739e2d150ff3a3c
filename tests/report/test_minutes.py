"""The page of minutes, of runs that nobody trained."""

import csv
import json
import shutil
from pathlib import Path

import pytest

from forewarp.report import minutes
from forewarp.report.minutes import write_minutes
from tests.support.runs_on_disk import rows_of, write_run

EARLIER = Path(__file__).parent / "earlier"  # tables as written before there were as many columns
PARTICLES = {"config": {"model": {"name": "particles"}}}
TOY = {"protocol": {"dataset": "toy"}}
TIMES = (0.0, 0.05, 0.5, 0.6, 1.0)


def write_views(folder, values):
    images = [
        {"time": time, "rendering": "warped", "scores": {"psnr": psnr}} for time, psnr in zip(TIMES, values)
    ]
    (folder / "per_image.json").write_text(json.dumps({"images": images}))


def test_the_page_has_scenes_by_minutes_and_keeps_what_was_measured_before(tmp_path):
    runs, out = tmp_path / "runs", tmp_path / "out"
    for seed, psnr in ((0, 30.0), (1, 32.0)):
        write_views(write_run(runs, seed=seed, psnr=psnr, metrics=TOY), (30, 31, 34, 33, 32))
    page, table, picture = write_minutes(runs, out)
    assert (page.name, table.name, picture.name) == ("forward.md", "forward.csv", "forward.png")
    assert rows_of(page.read_text(), "ball")[0] == ["ball", "31.00 ± 1.41"]
    later = tmp_path / "later"
    write_run(later, seed=0, psnr=40.0, minutes=5.0, metrics=TOY)
    write_run(later, seed=1, psnr=33.0, metrics=TOY)  # measured again
    write_run(later, seed=0, psnr=20.0, scene="hook", metrics=TOY)
    text = write_minutes(later, out)[0].read_text()
    assert rows_of(text, "ball")[0] == ["ball", "31.50 ± 2.12", "40.00"]
    assert rows_of(text, "mean of toy") == [
        ["mean of toy", "25.75", ""]
    ]  # nobody trained hook for five minutes
    (details,) = [row for row in rows_of(section(text, "Each"), "ball") if row[1] == "1"]
    assert details[2:5] == ["2", "31.50 ± 2.12", "0.9000 ± 0.0000"]
    assert details[6] == "2.5"  # dB at the ends
    rows = list(csv.DictReader(table.read_text().splitlines()))
    found = [(row["scene"], row["minutes"], row["seed"], float(row["psnr"])) for row in rows]
    assert found[:2] == [("ball", "1.0", "0", 30.0), ("ball", "1.0", "1", 33.0)]
    assert found[2:] == [("ball", "5.0", "0", 40.0), ("hook", "1.0", "0", 20.0)]


def test_each_method_has_its_page(tmp_path):
    write_run(tmp_path / "runs")
    write_run(tmp_path / "runs", scene="hook", config={"model": {"name": "particles"}})
    written = write_minutes(tmp_path / "runs", tmp_path / "out")
    assert [file.name for file in written if file.suffix == ".md"] == ["forward.md", "particles.md"]


def test_it_is_a_kind_of_report(tmp_path, ok):
    write_run(tmp_path / "runs")
    done = ok("report", "kind=minutes", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}")
    assert done.out.count("written: ") == 3
    write_run(tmp_path / "runs", scene="endless", minutes=None)
    page = write_minutes(tmp_path / "runs", tmp_path / "out")[0].read_text()
    assert "* endless/base-None-seed0: no budget.minutes" in page
    with pytest.raises(ValueError, match="expected folders of runs"):
        write_minutes(tmp_path / "none", tmp_path / "out")


def section(text, title):
    """The part of a page below a heading."""
    (found,) = [part for part in text.split("\n## ") if part.startswith(title + "\n")]
    return found


def test_rows_of_earlier_versions_stay(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    before = {}
    for method in ("particles", "forward"):  # as committed, forward's with fewer columns
        shutil.copy(EARLIER / f"{method}.csv", out)
        (out / f"{method}.md").write_text("a page\n")
        before[method] = list(csv.DictReader((out / f"{method}.csv").read_text().splitlines()))
    (out / "other.csv").write_text("method,psnr\nforward,3\n")  # of another page
    write_run(tmp_path / "runs", scene="anew", metrics=TOY, **PARTICLES)
    written = write_minutes(tmp_path / "runs", out)
    assert len(written) == 6  # the page of the other method, which compares too
    for method, rows in before.items():
        now = list(csv.DictReader((out / f"{method}.csv").read_text().splitlines()))
        kept = [
            {key: row[key] for key in rows[0] if key in ("scene", "seed", "psnr", "views")} for row in now
        ]
        for row in rows:
            assert {key: row[key] for key in kept[0]} in kept
        assert len(now) == len(rows) + (method == "particles")
    text = (out / "forward.md").read_text()
    assert "| mean of" not in text  # counterparts of four datasets
    assert rows_of(section(text, "Each"), "lift_tilt")


def test_methods_are_compared_after_equal_minutes(tmp_path):
    runs = tmp_path / "runs"
    for seed in (0, 1):
        own = {
            "protocol": TOY["protocol"],
            "test": {"all": {"psnr": 32 + seed, "ssim": 0.95, "lpips_vgg": 0.1}},
        }
        other = {"protocol": TOY["protocol"], "test": {"all": {"psnr": 30, "ssim": 0.96, "lpips_vgg": 0.2}}}
        write_run(runs, "p", seed, metrics=own, **PARTICLES)
        write_run(runs, "v", seed, metrics=other)
    write_run(runs, "v", 2, metrics=TOY, minutes=5.0)
    write_run(runs, "w", 3, metrics={"protocol": {"threads": 1}})
    write_minutes(runs, tmp_path / "out")
    text = (tmp_path / "out" / "particles.md").read_text()
    (row,) = rows_of(section(text, "Beside `forward`"), "ball")
    assert row[1:5] == ["1", "2 and 2", "32.50 ± 0.71", "30.00 ± 0.00"]
    assert row[5:] == ["above by 2.50 dB", "below by 0.0100", "better by 0.1000"]
    text = (tmp_path / "out" / "forward.md").read_text()
    assert "below by 2.50 dB" in section(text, "Beside `particles`")


def test_kinds_of_views_and_moving_points_stand_beside_each_other(tmp_path):
    runs = tmp_path / "runs"
    scores = {kind: {"psnr": 30 + i, "ssim": 0.9} for i, kind in enumerate(("space", "time", "canonical"))}
    for share, more in ((0.13, PARTICLES), (0.21, {})):
        flow = {"epe_moving": 2 * share, "motion_mean": 2.0}
        write_run(runs, f"{share}", metrics={**TOY, "test": scores, "flow": flow}, **more)
    write_minutes(runs, tmp_path / "out")
    found = rows_of(section((tmp_path / "out" / "particles.md").read_text(), "Space, time, motion"), "ball")
    assert found == [
        ["ball", "1", "`particles`", "1", "30.00", "31.00", "32.00", "13.0"],
        ["ball", "1", "`forward`", "1", "30.00", "31.00", "32.00", "21.0"],
    ]


def test_more_minutes_and_more_particles_hold_or_fall(tmp_path):
    runs = tmp_path / "runs"
    for length, psnr in ((1.0, 30.0), (5.0, 31.0), (20.0, 30.7)):
        write_run(runs, psnr=psnr, minutes=length, metrics={**TOY, "size": {"particles": 12000}}, **PARTICLES)
    for density, psnr in ((45, 29.9), (180, 29.85)):
        command = f"forewarp-train stage.fine.density={density} seed=0"
        more = {**TOY, "size": {"particles": 12000 * density // 90}}
        write_run(runs, f"{density}", psnr=psnr, command=command, metrics=more, **PARTICLES)
    (page, *_) = write_minutes(runs, tmp_path / "out")
    text = page.read_text()
    assert rows_of(text, "ball")[0] == ["ball", "30.00", "31.00", "30.70"]  # of the preset's density alone
    told = [row[-1] for row in rows_of(section(text, "More minutes"), "ball")]
    assert told == ["", "holds (+1.00 dB)", "falls by 0.30 dB"]
    assert [row[1] for row in rows_of(section(text, "Each"), "ball")] == ["1", "5", "20"]
    found = rows_of(section(text, "More particles"), "ball")
    assert [(row[3], row[4], row[5]) for row in found] == [
        ("45", "6000", "29.90"),
        ("", "12000", "30.00"),
        ("180", "24000", "29.85"),
    ]
    assert [row[-1] for row in found] == ["", "holds (+0.10 dB)", "holds (-0.15 dB)"]


def test_larger_pictures_are_compared_at_the_size_of_small_ones(tmp_path):
    runs = tmp_path / "runs"
    for name, psnr, side, more in (("s", 33.0, 400, {}), ("l", 33.4, 800, {"reduced": 2})):
        protocol = {"dataset": "toy", "resolution": [side, side], "background": "white", **more}
        write_run(runs, name, psnr=psnr, minutes=3.0, metrics={"protocol": protocol}, **PARTICLES)
    text = write_minutes(runs, tmp_path / "out")[0].read_text()
    assert rows_of(text, "ball")[0] == ["ball", "33.00"]
    large, small = rows_of(section(text, "Larger pictures"), "ball")
    assert large[3:5] == ["800x800 reduced 2x2, background white", "33.40"]
    assert large[-1] == "above by 0.40 dB the run that learned from 400x400"
    assert small[3:5] == ["400x400, background white", "33.00"]
    assert "Beside" not in text


def test_both_clocks_and_versions_of_the_code_are_told(tmp_path, monkeypatch):
    runs, drawn = tmp_path / "runs", {}
    for seed, commit in ((0, "aaa"), (1, "bbb")):
        more = {"protocol": {"dataset": "toy", "commit": commit}, "clocks": {"wall": 70.0, "processor": 60.0}}
        write_views(write_run(runs, seed=seed, metrics=more), (30 + 2 * seed, 31, 34, 33, 32))
    monkeypatch.setattr(minutes, "_draw", lambda rows, picture: drawn.update({picture.stem: list(rows)}))
    text = write_minutes(runs, tmp_path / "out")[0].read_text()
    (row,) = rows_of(section(text, "What it costs"), "ball")
    assert row[2:6] == ["60", "70", "100", "500.0"]
    (line,) = [line for line in text.splitlines() if line.startswith("The runs may be of different versions")]
    assert line.endswith("1 min of commit aaa, commit bbb.")
    assert minutes.mean_by_time(drawn["forward"])[:2] == [(0.0, 31.0), (0.05, 31.0)]


def test_tables_hold_no_folder_of_whoever_typed(tmp_path):
    typed = "forewarp-train seed=0 paths.scenes=/home/me/data run=/home/me/run lpips_weights=/home/me"
    write_run(tmp_path / "runs", command=typed)
    for file in write_minutes(tmp_path / "runs", tmp_path / "out"):
        if file.suffix in (".md", ".csv"):
            assert "/home/me" not in file.read_text()
            assert "paths.scenes=DATASETS" in file.read_text()
