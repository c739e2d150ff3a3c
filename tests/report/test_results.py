"""The table of runs, and tables made of it."""

import pytest

from forewarp.report.choices import against, by_variant
from forewarp.report.results import Point, Runs, read_run, read_runs
from forewarp.report.statistics import Estimate
from forewarp.report.tables import Column, Table
from tests.support.runs_on_disk import write_run

TABLE = Table(
    [Column("name"), Column("PSNR", signed=True), Column("steps", 0), Column("s", prefix="×")],
    [["a|b", Estimate(0.5, 0.25, 3), 10, 1.234], ["c", Estimate(-1.0), None, 2.0]],
    "Of two:",
)


def test_a_run_is_read_whole(tmp_path):
    row = read_run(write_run(tmp_path, "unet_16", 3, epe=0.125, against="grid_64"))
    known = {"scene": "ball", "variant": "unet_16", "seed": 3, "minutes": 1.0, "about": "the unet_16"}
    known |= {"psnr": 30.0, "ssim": 0.9, "lpips": None, "steps": 100, "epe": 0.125, "memory": 1.0}
    known |= {"parameters": 2.0, "step": 0.5, "frame": 0.5}
    known["command"] = "forewarp-train variant=unet_16 seed=3"
    assert {name: row[name] for name in known} == known
    assert row["points"][1] == Point(20.0, 25.0, 20, 0.125)
    assert against(row, Runs([row])) == "grid_64"
    assert Runs([row, row]).machines() == "a cpu, 2 threads, torch 2"
    folder = write_run(tmp_path, ability="time", curve=None, config={"variant": None, "command": None})
    row = read_run(folder)  # named after its choices
    known = {"variant": "forward-fast", "ablation": None, "about": "", "ability": "time", "epe": None}
    assert row["points"] == ()
    assert {name: row[name] for name in known} == known
    assert against(row, Runs([row])) == "forward-fast"  # itself
    assert row["command"] == f"forewarp-train # as {folder}/config.yaml"


def test_names_do_not_depend_on_spaces_within_an_override(tmp_path):
    plain, spaced = "size=[[0,8000]]", "size=[[0, 8000]]"
    for name in ("", spaced, f"rays=64 {plain}", f"data.box=auto {spaced}"):
        write_run(tmp_path, name, against=None)
    runs, _ = read_runs(tmp_path)
    assert sorted(runs.by("variant")) == ["base", f"box=auto {plain}", f"rays=64 {plain}", plain]
    assert {against(row, runs) for row in runs} == {"base", plain}


def test_folders_without_results_are_named_and_the_others_read(tmp_path):
    write_run(tmp_path)
    write_run(tmp_path, "late", psnr=None)
    for name, file, text in (
        ("empty", "metrics.json", "{"),
        ("nested", "config.yaml", "a: " + "[" * 1000),
        ("odd", "config.yaml", "seed: 0\n"),
        ("plan", "plan.yaml", "a: ["),
        ("rough", "accuracy_time.csv", "seconds,psnr\n1,x\n"),
        ("views", "per_image.json", '{"images": [{"name": "a"}]}'),
        ("wide", "config.yaml", "#" * (1 << 20) + "x"),
    ):
        (write_run(tmp_path, name) / file).write_text(text)
    runs, left_out = read_runs(tmp_path)
    assert list(runs.by("variant")) == ["base"]
    found = {line.split("/")[1].split("-")[0]: line for line in left_out}
    assert found.pop("late").endswith("no metrics.json; run its command again")
    assert found["odd"].endswith("cannot be read (no key 'budget')")
    assert found["wide"].endswith("config.yaml: expected at most 1048576 bytes, but got 1048577)")
    assert "line 1: expected JSON, but got Expecting" in found["empty"]
    assert [name for name, line in found.items() if "cannot be read (" not in line] == []
    (tmp_path / "none").mkdir()
    with pytest.raises(ValueError, match="none: expected folders of runs, but got none; make some with"):
        read_runs(tmp_path / "none")
    with pytest.raises(ValueError, match="but got .*/nowhere, which is not there; make some with"):
        read_runs(tmp_path / "nowhere")
    (tmp_path / "page.md").touch()
    with pytest.raises(ValueError, match="but got .*/page.md, a file; make some with"):
        read_runs(tmp_path / "page.md")


def test_debug_runs_are_counted_and_left_out(tmp_path):
    write_run(tmp_path, "base")
    for name in ("fast", "limit"):
        write_run(tmp_path, name, config={"debug": name}, psnr=None if name == "fast" else 30.0)
    runs, left_out = read_runs(tmp_path)
    assert (list(runs.by("variant")), left_out) == (["base"], ["left out: debug runs: 2"])


def test_the_short_fit_of_a_plan_is_no_run(tmp_path):
    beside = write_run(tmp_path, "base")
    (beside.parent / "plan.yaml").write_text("effects: {}\n")
    write_run(tmp_path, "auto").rename(beside.parent / "still")
    assert ([row["folder"] for row in read_runs(tmp_path)[0]], read_runs(tmp_path)[1]) == ([beside], [])


def test_groups_hold_the_seeds_and_the_base_comes_first(tmp_path):
    for variant, seed, minutes in (("a", 1, 1.0), ("a", 0, 1.0), ("base", 0, 1.0), ("a", 0, 3.0)):
        write_run(tmp_path, variant, seed, minutes=minutes)
    runs, _ = read_runs(tmp_path)
    assert list(by_variant(runs)) == ["base", "a"]
    groups = runs.by("variant", "minutes")
    assert list(groups) == [("a", 1.0), ("a", 3.0), ("base", 1.0)]
    assert [row["seed"] for row in groups["a", 1.0]] == [0, 1]


def test_tables_as_markdown_and_as_csv():
    assert str(TABLE).splitlines() == [
        *("Of two:", ""),
        "| name   |         PSNR |   steps |     s |",
        "|:-------|-------------:|--------:|------:|",
        "| a\\|b   | +0.50 ± 0.62 |      10 | ×1.23 |",
        "| c      |        -1.00 |         | ×2.00 |",
    ]
    assert str(Table([Column("a")], [])).splitlines() == ["| a   |", "|-----|"]
    lines = [line.split(",") for line in TABLE.csv().splitlines()]
    assert lines[0] == ["name", "PSNR", "PSNR ci95", "PSNR n", "steps", "s"]
    assert lines[1][:2] + lines[1][3:] == ["a|b", "0.5", "3", "10", "1.234"]
    assert float(lines[1][2]) == pytest.approx(0.62103, abs=1e-5)  # 4.30265 * 0.25 / sqrt(3)
    assert lines[2] == ["c", "-1.0", "", "1", "", "2.0"]
