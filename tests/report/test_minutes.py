"""The page of minutes, of runs that nobody trained."""

import csv
import json

import pytest

from forewarp.report.minutes import write_minutes
from tests.support.runs_on_disk import rows_of, write_run

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
    (details,) = [row for row in rows_of(text, "ball") if row[1] == "1" and len(row) > 3]
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
