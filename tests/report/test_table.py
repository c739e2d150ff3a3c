"""``kind=table`` and ``kind=compare``: every number of a four-job multirun, worked by hand."""

import csv
import json
import os

import pytest

from forewarp.metrics.registry import METRICS, Metric
from forewarp.report.choices import compare
from forewarp.report.results import read_compared
from forewarp.report.table import write_table
from tests.report.test_settings import FOUND, RIGID, multirun
from tests.support.runs_on_disk import rows_of, write_run

# Three seeds of each value; t of two degrees of freedom is 4.3027.
# rigid=1: 30, 31, 32; mean 31, deviation 1, half the interval 4.3027 / sqrt(3) = 2.4841.
# rigid=0: 29, 30.5, 31; mean 30.1667, deviation sqrt(1.08333) = 1.0408, half the interval 2.5856.
# Differences by seed: -1, -0.5, -1; mean -0.8333, deviation 0.288675, half the interval 0.7171.
THREE = {("1", 0): 30.0, ("1", 1): 31.0, ("1", 2): 32.0, ("0", 0): 29.0, ("0", 1): 30.5, ("0", 2): 31.0}


def table(runs, out, **names):
    named = {key: [value] if isinstance(value, str) else value for key, value in names.items()}
    return write_table([runs], out, **named)[0]


def test_a_multirun_is_a_table_with_intervals(tmp_path):
    text = table(
        multirun(tmp_path / "runs", THREE), tmp_path, rows="rigid", metrics=["psnr", "ssim", "lpips"]
    )
    assert rows_of(text, "1") == [["1", "**31.00 ± 2.48**", "**0.9000 ± 0.0000**"]]
    # The difference's interval, -0.83 ± 0.72, leaves out 0; SSIM is a tie.
    assert rows_of(text, "0") == [["0", "<u>30.17 ± 2.59</u>", "**0.9000 ± 0.0000**"]]
    for words in (
        "Means over 3 seeds",
        "1 min (processor clock)",
        "a cpu, 2 threads",
        "background white",
        "fast",
        "The best of a column is bold, the second underlined; ties share a mark.",
    ):
        assert words in text.split("\n|")[0]
    assert "No run has lpips." in text
    assert "The best of a column is bold, the second underlined" in (tmp_path / "table.tex").read_text()
    found = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    numbers = [[float(row[f"ball PSNR (dB)↑{part}"]) for part in ("", " ci95", " n")] for row in found]
    assert numbers[0] == pytest.approx([30.1667, 2.5856, 3], abs=1e-4)
    assert numbers[1] == pytest.approx([31.0, 2.4841, 3], abs=1e-4)
    tex = (tmp_path / "table.tex").read_text()
    assert "31.00 $\\pm$ 2.48" in tex
    assert tex.count("\\toprule") == 1


def test_two_seeds_show_both_values_and_no_mark(tmp_path):
    text = table(multirun(tmp_path / "runs"), tmp_path, rows=RIGID)
    assert rows_of(text, "1") == [["1", "31.00 (30.00, 32.00)"]]
    assert rows_of(text, "0") == [["0", "29.50 (29.00, 30.00)"]]


def test_seeds_are_rows_where_asked_for(tmp_path):
    text = table(multirun(tmp_path / "runs"), tmp_path, rows=["rigid", "seed"])
    assert rows_of(text, "1") == [["1", "0", "30.00"], ["1", "1", "32.00"]]


def test_what_differs_within_a_cell_is_refused_with_the_key_to_add(tmp_path):
    runs = multirun(tmp_path / "runs")
    told = r"got in forward, ball rigid=0 and rigid=1; add objective.fine.weights.rigid to rows= or columns="
    with pytest.raises(
        ValueError, match=f"^rows: expected in a cell runs that differ in the seed alone, but {told}"
    ):
        table(runs, tmp_path, rows="model")
    multirun(tmp_path / "runs" / "long", {("1", 0): 33.0}, minutes=5.0)
    with pytest.raises(ValueError, match="but got in 1, ball 1 and 5; add minutes to rows= or columns="):
        table(runs, tmp_path, rows="rigid")
    text = table(runs, tmp_path, rows=["rigid", "minutes"])
    assert [row[1:] for row in rows_of(text, "1")] == [["1", "31.00 (30.00, 32.00)"], ["5", "33.00"]]
    text = table(runs, tmp_path, rows="variant", columns=["scene", "minutes"])
    assert rows_of(text, "rigid=1") == [["rigid=1", "31.00 (30.00, 32.00)", "33.00"]]
    assert "ball minutes=5 PSNR (dB)↑" in text


@pytest.mark.parametrize(
    ("names", "line"),
    [
        ({"rows": "nodes"}, "rows: expected model, method, .* or a key of config.yaml, but got nodes"),
        (
            {"columns": "deep"},
            "columns: expected one key, but got deep, which ends model.a.deep, model.b.deep",
        ),
        (
            {"metrics": "sharpness"},
            "metric: expected psnr, ssim, train, .*, or all/ before one, but got sharpness",
        ),
        ({"metrics": "lpips"}, "metric: expected .*, but got lpips, which no run has"),
    ],
)
def test_a_wrong_name_is_told(tmp_path, names, line):
    model = {"model": {"name": "forward", "a": {"deep": 1}, "b": {"deep": 2}}}
    with pytest.raises(ValueError, match=f"^{line}"):
        table(multirun(tmp_path / "runs", config=model), tmp_path, **{"rows": "rigid"} | names)
    assert not (tmp_path / "table.md").exists()


def test_ones_own_metrics_and_datasets_are_taken(tmp_path, monkeypatch):
    monkeypatch.setitem(METRICS, "blur", Metric("blur", "Blur", 1, higher_is_better=False))
    scores = {"time": {"psnr": 25.0, "blur": 0.25, "haze": 2.0}, "space": {"psnr": 26.0}}
    for seed in range(2):
        write_run(
            tmp_path / "runs",
            "x",
            seed,
            against=None,
            config={"variant": None},
            command="forewarp-train",
            metrics={"test": scores, "protocol": {"dataset": "mine"}},
        )
    names = {"rows": ["model", "dataset"], "metrics": ["blur", "haze", "space/psnr", "bytes", "train"]}
    text = table(tmp_path / "runs", tmp_path, **names)
    head = [cell.strip() for cell in text.split("\n|")[1].split("|")]
    assert head[2:7] == [
        *("ball Blur↓", "ball haze↑", "ball space PSNR (dB)↑", "ball parameters (MB)↓", "ball training (s)↓"),
    ]
    (row,) = rows_of(text, "forward")
    assert [cell.split(" ")[0] for cell in row[1:]] == ["mine", "0.2", "2.0000", "26.00", "8.00", "50.0"]


def test_a_metric_of_any_kind_and_net_is_found(tmp_path):
    scores = {"psnr": 25.0, "ms_ssim": 0.75, "lpips_vgg": 0.25, "lpips_alex": 0.5, "depth_rmse": 0.125}
    metrics = {"test": {"time": scores, "all": scores | {"lpips_vgg": 0.375}}}
    write_run(tmp_path / "runs", metrics=metrics)
    names = ["ms_ssim", "lpips_vgg", "lpips", "all/lpips", "time/lpips", "lpips_alex"]
    (row,) = rows_of(table(tmp_path / "runs", tmp_path, rows="model", metrics=names), "forward")
    assert [float(cell) for cell in row[1:]] == [0.75, 0.375, 0.375, 0.375, 0.25, 0.5]


def test_the_picture_is_of_the_first_metric_that_a_run_has(tmp_path, monkeypatch):
    from forewarp.report import table as module

    drawn = []
    monkeypatch.setattr(module, "save", lambda figure, path: drawn.append(figure) or path)
    write_run(tmp_path / "runs")
    _, written = write_table([tmp_path / "runs"], tmp_path, metrics=["lpips", "ssim"], pareto=True)
    assert (written[-1].name, drawn[0].axes[0].get_ylabel()) == ("table-pareto.png", "SSIM")
    for numbers in (tmp_path / "runs").rglob("metrics.json"):  # without any cost
        costs = {"seconds": {"train": None}, "peak_memory_bytes": None, "parameters": 0}
        numbers.write_text(json.dumps(json.loads(numbers.read_text()) | costs))
    (tmp_path / "runs" / "ball" / "base-1.0-seed0" / "coarse" / "done.json").unlink()
    write_table([tmp_path / "runs"], tmp_path, pareto=True)
    assert len(drawn[1].axes[0].lines) == 0


def test_the_front_is_drawn_of_three_costs(tmp_path, monkeypatch):
    from forewarp.report import table as module

    drawn = []
    monkeypatch.setattr(module, "save", lambda figure, path: drawn.append(figure) or path)
    for number, (psnr, seconds) in enumerate(((30.0, 10.0), (29.0, 20.0), (31.0, 30.0))):
        metrics = {"seconds": {"train": seconds}}
        write_run(
            tmp_path / "runs",
            f"m{number}",
            psnr=psnr,
            metrics=metrics,
            config={"variant": None, "model": {"name": f"m{number}"}},
            command="forewarp-train",
        )
    _, written = write_table([tmp_path / "runs"], tmp_path, rows=["model"], pareto=True)
    assert written[-1].name == "table-pareto.png"
    axes = drawn[0].axes
    assert [axis.get_xlabel() for axis in axes] == ["seconds of training", "memory (GiB)", "parameters (MB)"]
    front = axes[0].lines[-1]
    assert (list(front.get_xdata()), list(front.get_ydata())) == ([10.0, 30.0], [30.0, 31.0])  # m1 is beaten
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["m0", "m1", "m2", "Pareto front"]


def test_seeds_are_one_column_and_differences_are_paired(tmp_path):
    folders = sorted(path.parent for path in multirun(tmp_path, THREE).rglob("config.yaml"))
    groups = read_compared(folders)
    assert {name: len(own) for name, own in groups.items()} == {"rigid=0": 3, "rigid=1": 3}
    found = compare(groups)
    (row,) = [row for row in found.rows if row[0] == "all"]
    assert row[1:] == ["30.17 ± 2.59", "31.00 ± 2.48", "-0.83 ± 0.72, below"]
    assert found.columns[-1].name == "rigid=0 - rigid=1"
    # PSNR and SSIM, which is the same for all.
    assert "2 differences are of three seeds or more; by chance 0.1 of their intervals" in found.caption
    assert "rigid=0: seeds 0, 1, 2; rigid=1: seeds 0, 1, 2" in found.caption
    assert "differences are paired by seed" in found.caption


@pytest.mark.slow
def test_commas_and_lists_are_typed_as_they_are(ok, in_tmp):
    multirun(in_tmp / "runs" / "mine", FOUND)
    for typed in ("metric=psnr,ssim", "metric=[psnr,ssim]"):
        done = ok("report", "kind=table", "rows=model,rigid", "columns=scene", typed, "runs=runs/mine")
        assert "31.00 (30.00, 32.00)" in done.out
        assert done.out.splitlines()[-3:] == [
            f"written: {os.path.join('runs', 'mine', 'results', name)}"
            for name in ("table.md", "table.csv", "table.tex")
        ]


@pytest.mark.slow
def test_of_a_pattern_what_holds_no_run_is_left_out(ok, in_tmp):
    for seed in range(2):
        write_run("runs", "x", seed)
    (in_tmp / "runs" / "notes").mkdir()
    ok("report", "kind=table", "runs=runs/ball")  # writes runs/ball/results
    assert (in_tmp / "runs" / "ball" / "results" / "table.md").is_file()
    assert "seeds 0, 1" in ok("report", "kind=compare", "runs=[runs/ball/*]").out
    assert "30.00 (30.00, 30.00)" in ok("report", "kind=table", "runs=runs/*").out


@pytest.mark.slow
def test_a_report_of_nothing_says_what_it_looked_for(refused, in_tmp):
    write_run("runs", psnr=None)
    (in_tmp / "runs" / "ball" / "base-1.0-seed0" / "accuracy_time.csv").unlink()
    for kind in ("table", "price_list", "accuracy_time", "paper", "effects", "minutes", "methods", "search"):
        line = refused("report", f"kind={kind}", "runs=runs", "out=out")
        assert line.startswith("runs: expected runs "), kind
        assert "but got none among 1 folder of a run" in line, kind
