"""The paper's tables and the page of ablations, from hand-made run folders."""

import base64
import json
import os
import re
import shutil
import subprocess
import sys
from itertools import product

import imageio.v3 as iio
import numpy as np
import pytest

from forewarp.report.paper import (
    COSTS,
    PAPER,
    comparison,
    incomplete,
    measured,
    read_measured,
    read_paper,
    stand_in,
    with_means,
    write_ablation,
    write_paper,
)
from forewarp.report.results import Runs, read_runs
from forewarp.report.tables import Table, latex_text
from tests.support.configs import options
from tests.support.runs_on_disk import rows_of, write_run, write_views

ALL = ["hellwarrior", "mutant", "hook", "bouncingballs", "lego", "trex", "standup", "jumpingjacks"]
OURS = "forewarp: forward (the paper's method), fast, 1 min"


def paper_run(
    root, scene, variant=None, seed=0, *, dataset="dnerf", made=False, warp="forward", protocol=None, **scores
):
    """A run as a sweep of the paper leaves it; ``variant`` None is the plain method."""
    module = f"forewarp.{'cli.synthetic.Synthetic' if made else 'data.module.'}DataModule"
    config = {"model": {"name": warp}, "data": {"scene": scene, "_target_": module}}
    config["variant"] = {"name": variant, "about": f"the {variant}", "against": "full"} if variant else None
    if sizes := re.search(r"resolution (.*)", variant or ""):
        config["stage"] = {"fine": {"num_voxels": json.loads(sizes[1])}}
    abilities = {k: v for k, v in scores.items() if isinstance(v, dict)}
    metrics = {"test": abilities or {"all": {"psnr": 30.0, "ssim": 0.9, **scores}}}
    metrics["protocol"] = {"dataset": dataset, "resolution": [4, 3], "background": "white"} | (protocol or {})
    name = f"{variant or 'plain'}-{warp}"
    return write_run(root, name, seed, scene=scene, curve=None, config=config, metrics=metrics)


def table_of(root, key="dnerf"):
    runs, _ = read_runs(root)
    return comparison(with_means(read_paper(PAPER)[key], runs), runs)


def cells(table, name=OURS, kind="measured"):
    """The scores of the first row of this kind, of measured ones of this name."""
    rows, of_kind = enumerate(table.rows), [column.name for column in table.columns].index("kind")
    at = next(i for i, row in rows if row[of_kind] == kind and (kind != "measured" or row[0] == name))
    return table.texts("md")[at][of_kind + 1 : -len(COSTS)]


@pytest.mark.slow
def test_a_mean_is_of_all_scenes_or_empty(tmp_path):
    for number, scene in enumerate(ALL[:7]):
        paper_run(tmp_path, scene, psnr=20.0 + number)
    assert cells(table_of(tmp_path)) == ["", "", ""]
    scenes = table_of(tmp_path, "dnerf_scenes")
    values = dict(zip([column.name for column in scenes.columns][3:], cells(scenes)))
    assert values["Hook PSNR↑"] == "22.00"
    assert values["Hook LPIPS↓"] == values["Mean of 8 PSNR↑"] == values["Jumping Jacks PSNR↑"] == ""
    assert values["Mean of the 7 measured PSNR↑"] == "23.00"
    paper_run(tmp_path, ALL[7], psnr=27.0)
    assert cells(table_of(tmp_path)) == ["23.50", "0.900", ""]
    assert cells(table_of(tmp_path), kind="difference to the paper") == ["-9.18", "-0.070", ""]


@pytest.mark.slow
@pytest.mark.parametrize("protocol", [{"half_resolution": True}, {"scale": 4}])
def test_no_mean_is_taken_over_unlike_images(tmp_path, protocol):
    for scene in ALL:
        paper_run(tmp_path, scene, protocol=protocol if scene == "hook" else None)
    name = f"{OURS}, background white"
    assert cells(table_of(tmp_path), name) == ["", "", ""]
    values = cells(table_of(tmp_path, "dnerf_scenes"), name)
    assert (values[6], values[9]) == ("", "30.00")  # of hook, whose images are others; of bouncingballs


@pytest.mark.slow
def test_seeds_give_an_interval_where_all_scenes_have_them(tmp_path):
    for seed, psnr in ((0, 20.0), (1, 22.0), (2, 21.0)):
        for scene in ALL:
            paper_run(tmp_path, scene, seed=seed, psnr=psnr)
    paper_run(tmp_path, "hook", seed=3, psnr=99.0)
    table = table_of(tmp_path)
    assert cells(table, f"{OURS}, 4 seeds")[0] == "21.00 ± 2.48 [3 of 4 seeds]"  # 4.303 / sqrt(3)
    runs, others = read_runs(tmp_path)[0], ", ".join(ALL[:2] + ALL[3:])
    told = f"Table 1, Mean of 8, {OURS}, 4 seeds: seed 3 has no {others}"
    assert incomplete(read_paper(PAPER)["dnerf"], runs) == [told]
    assert f"\n* {told}" in write_paper(tmp_path, tmp_path / "out")[0].read_text()
    assert "95 % confidence interval of a mean (Student's t over the seeds)" in table.caption


def test_some_training_views_neither_replace_nor_join_all_of_them(tmp_path):
    old = paper_run(tmp_path / "all", "toy", made=True, psnr=30.0)
    os.utime(old / "metrics.json", (1, 1))
    for seed in (0, 1):
        paper_run(tmp_path / "some", "toy", seed=seed, made=True, psnr=20.0, protocol={"train_views": 16})
    write_paper(tmp_path, tmp_path / "out")
    text = re.sub(" +", " ", (tmp_path / "out" / "paper.md").read_text())
    assert f"| {OURS} | PC | 30.00 |" in text
    assert f"| {OURS}, 2 seeds, 16 training views | PC | 20.00 (20.00, 20.00) |" in text
    assert "is newer" not in text


@pytest.mark.slow
def test_ranks_are_among_measured_rows_alone(tmp_path):
    for variant, psnr, lpips in (("full", 25.0, 0.2), ("no_tv", 24.0, 0.1), ("no_view", 20.0, 0.3)):
        for scene, seed in product(ALL[:4], range(3)):
            paper_run(tmp_path, scene, variant, seed, psnr=psnr, lpips_vgg=lpips)
    table = table_of(tmp_path, "losses")
    names = [f"forewarp: the {variant}" for variant in ("full", "no_tv", "no_view")]
    assert cells(table, names[0]) == ["**25.00 ± 0.00**", "**0.900 ± 0.000**", "<u>0.200 ± 0.000</u>"]
    assert cells(table, names[1]) == ["<u>24.00 ± 0.00</u>", "**0.900 ± 0.000**", "**0.100 ± 0.000**"]
    assert cells(table, names[2])[::2] == ["20.00 ± 0.00", "0.300 ± 0.000"]
    assert cells(table, kind="published") == ["33.75", "0.979", "0.040"]  # as printed, unmarked
    assert cells(table, kind="difference to the paper") == ["-8.75", "-0.079", "+0.160"]
    # Each published row has its measured one below it.
    shown = [row[0] for row in table.rows[:7] if "difference" not in row[1]]
    assert shown == ["Ours", names[0], "w/o total variation", names[1], "w/o flow L1"]
    assert table.rules == [3, 6, 10, 13]
    assert table.texts()[1][-len(COSTS) :] == ["50", "1.00", "2.000", "100", "1", "a cpu, 2 threads"]
    assert table.rows[0][-len(COSTS) :] == [None] * len(COSTS)


def test_rows_that_cannot_be_told_apart_share_the_mark(tmp_path):
    # 30.07 ± 0.12 and 30.04 ± 0.20 (deviations of 0.05 and 0.08): by rounding, the first alone was marked.
    for variant, psnr in (("full", (30.02, 30.07, 30.12)), ("no_tv", (30.12, 29.96, 30.04))):
        for scene, seed in product(ALL[:4], range(3)):
            paper_run(tmp_path, scene, variant, seed, psnr=psnr[seed])
    table = table_of(tmp_path, "losses")
    shown = [cells(table, f"forewarp: the {variant}")[0] for variant in ("full", "no_tv")]
    assert shown == ["**30.07 ± 0.12**", "**30.04 ± 0.20**"]


def test_abilities_and_depth_have_columns_of_their_own(tmp_path):
    by_ability = {"space": {"psnr": 20.0, "depth_delta_1.25": 0.5}, "time": {"psnr": 21.0}}
    by_ability["canonical"] = {"psnr": 22.0, "depth_delta_1.5625": 0.25}
    for scene in ("lift", "lift_tilt", "drive"):
        paper_run(tmp_path, scene, dataset="lego_complete", **by_ability)
    row = cells(table_of(tmp_path, "lego_complete"))
    assert row == ["20.00", "", "50.000", "", "21.00", "", "", "", "22.00", "", "", "25.000"]


@pytest.fixture
def whole(tmp_path):
    """A folder with every output, of a few runs with pictures."""
    runs = tmp_path / "runs"
    for warp in ("particles", "forward", "backward"):
        folder = paper_run(runs, "hook", warp=warp)
        sheet = np.full((3, 4 * 3 + 8, 3), 255, np.uint8)
        write_views(folder, {"test/a": (0.9, 30.0), "test/b": (0.0, 30.0)}, sheet)
    for side, psnr in ((20, 18.0), (40, 20.0)):
        paper_run(runs, "vrig-chicken", f"resolution [[0, {side**3}]]", dataset="hypernerf", psnr=psnr)
    paper_run(runs, "broom2", "resolution [[0, 8000]]", dataset="hypernerf")  # one size is no line
    write_run(runs, "failed", psnr=None)
    (tmp_path / "curves").mkdir()
    iio.imwrite(tmp_path / "curves" / "accuracy-time-hook.png", np.zeros((2, 2, 3), np.uint8))
    files = write_paper(runs, tmp_path / "out", curves=tmp_path / "curves")
    assert all(file.is_file() for file in files)
    return tmp_path / "out"


@pytest.mark.slow
def test_pages_tell_how_numbers_came_about(whole):
    text = (whole / "paper.md").read_text()
    for line in (
        "* protocol 1: dnerf, 4x3, background white",
        "* machine: a cpu, 2 threads, torch 2",
        "* budget: fast, 1 min a run",
        "* no measured row: Table 2, Table 3, Table 4, ",
        "* Table 1: T-NeRF's printed mean PSNR is 29.51; its printed scenes average 28.78",
        "* ball/failed-1.0-seed0: no metrics.json; run its command again",
        "](accuracy-time-hook.png)",
    ):
        assert line in text
    assert re.search(r"\* date: \d{4}-\d\d-\d\d\n\* command, one of \d runs: forewarp-train variant=", text)
    assert "## Table 3" not in text
    lines = re.sub(" +", " ", text)
    for method, kind in (("particles", "–"), ("forward (the paper's method)", "PC"), ("backward", "PC")):
        assert f"| forewarp: {method} | {kind} | measured |" in lines
    assert "| Ours (80^3) | PC | published | 32.68 | 0.97 | 0.04 |" in lines
    names = {path.name for path in whole.glob("paper-*.png")}
    assert names == {"paper-resolution.png", "paper-views-dnerf-hook.png"}
    assert "# machine: a cpu, 2 threads" in (whole / "paper-table-1-d-nerf.csv").read_text()
    page = (whole / "paper.html").read_text()  # needs nothing else
    sources = [source.split(",") for source in re.findall(r'src="([^"]*)"', page)]
    assert [kind for kind, _ in sources] == ["data:image/png;base64"] * 3
    assert all(base64.b64decode(content).startswith(b"\x89PNG") for _, content in sources)
    assert not re.search(r"https?://|<script|<link", page)
    assert "<td class=n>30.00" in page
    latex = (whole / "paper.tex").read_text()
    escaped = r"2026-11-25, a\_b\textasciicircum{}c: $-$2.5 \& \$$\pm$"
    assert latex_text("2026-11-25, a_b^c: -2.5 & $±") == escaped
    assert r"Ours (80$^{3}$) & PC & published" in latex
    assert "textasciicircum" not in latex
    assert r"\caption{D-NeRF, mean of eight scenes (table 1 of the paper). Type: N without" in latex
    for name in ("table", "tabular", "document"):
        assert latex.count(rf"\begin{{{name}}}") == latex.count(rf"\end{{{name}}}") > 0
    assert r"\footnotesize machine: a cpu, 2 threads, torch 2" in latex


def test_published_numbers_of_a_dataset_stand_beside_its_runs_alone(tmp_path):
    paper_run(tmp_path, "hook", "no_tv")
    table = table_of(tmp_path, "modules")
    scores = [column.name for column in table.columns][2 : -len(COSTS)]
    assert scores == ["D-NeRF PSNR↑", "D-NeRF LPIPS↓"]
    assert cells(table, kind="published") == ["33.09", "0.046"]


def test_wide_tables_are_cut_for_latex(tmp_path):
    for scene in ALL:
        paper_run(tmp_path, scene)
    write_paper(tmp_path, tmp_path / "out")
    latex = (tmp_path / "out" / "paper.tex").read_text()
    heads = re.findall(r"\\toprule\n(.*)", latex)
    assert [head.count("&") for head in heads] == [11, 14, 14, 14]
    assert latex.count(r"(supplement of table 1 of the paper), part") == 3
    assert all(head.startswith("method & type & kind & ") for head in heads)
    assert r"\shortstack[r]{Hell Warrior\\PSNR$\uparrow$}" in heads[1]
    marked = Table(["a", "x", "y", "z"], [["r", 1, 2, 3]], marks={(0, 3): "best"}).cut(2)[1]
    assert marked.texts("md") == [["r", "**3.00**"]]


def test_a_new_folder_takes_pictures_alone(tmp_path):
    (tmp_path / "curves").mkdir()
    iio.imwrite(tmp_path / "curves" / "accuracy-time-hook.png", np.zeros((2, 2, 3), np.uint8))
    paper_run(tmp_path / "runs", "toy", dataset="mine")  # of no table
    write_paper(tmp_path / "runs", tmp_path / "new" / "out", curves=tmp_path / "curves")
    assert "](accuracy-time-hook.png)" in (tmp_path / "new" / "out" / "paper.md").read_text()


def test_without_matplotlib_the_page_says_why_it_has_no_figure(tmp_path, monkeypatch):
    for side in (20, 40):
        paper_run(tmp_path, "broom2", f"resolution [[0, {side**3}]]", dataset="hypernerf")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    write_paper(tmp_path, tmp_path / "out")
    assert "install forewarp[plots]" in (tmp_path / "out" / "paper.md").read_text().split("## Figures")[1]


def test_a_scene_with_one_kind_of_view_is_measured_by_it(tmp_path):
    for number, scene in enumerate(("sport_1", "sport_2", "sport_3", "basketball")):
        protocol = {"resolution": [[512, 384], [1024, 768]], "canonical_time": 0.0} if number == 3 else {}
        paper_run(tmp_path, scene, dataset="nhr", protocol=protocol, space={"psnr": 20.0 + number})
    table = table_of(tmp_path, "nhr")
    assert cells(table)[::3] == ["20.00", "21.00", "22.00", "23.00", "21.50"]
    protocols = read_runs(tmp_path)[0].by("protocol")
    assert "nhr, 512x384 and 1024x768, background white, canonical time 0.0" in protocols


def test_a_column_that_names_no_kind_of_view_has_its_kind_in_the_protocol(tmp_path):
    both = {"space": {"psnr": 20.0}, "canonical": {"psnr": 21.0}}
    few = {"measured": "2 of 20 test views, evenly spread"}
    paper_run(tmp_path / "2", "toy", made=True, protocol=few, **both)
    paper_run(tmp_path / "all", "toy", made=True, time={"psnr": 22.0}, **both)
    paper_run(tmp_path, "lift", dataset="lego_complete", made=True, **both)  # whose columns name theirs
    write_paper(tmp_path, tmp_path / "out")
    text = re.sub(" +", " ", (tmp_path / "out" / "paper.md").read_text())
    assert f"| {OURS} | PC | 22.00 |" in text
    assert f"| {OURS}, 2 test views | PC | 20.00 |" in text
    of_kinds = re.findall(r"\* protocol \d: (\w+),.* scores of test views (.*)", text)
    assert of_kinds == [("dnerf", "between training times"), ("dnerf", "at training times")]


def test_runs_of_no_table_are_said_to_be_left_out(tmp_path, capsys):
    for seed in (0, 1):
        paper_run(tmp_path, "toy", seed=seed, dataset="mine")
    write_paper(tmp_path, tmp_path / "out")
    line = "mine, 2 runs: not in any table of the paper; use kind=compare or kind=accuracy_time"
    assert capsys.readouterr().out == f"{line}\n"
    assert f"* {line}\n" in (tmp_path / "out" / "paper.md").read_text().split("## Left out")[1]


def test_runs_on_other_files_than_most_are_left_out_by_name(tmp_path):
    folders = [
        paper_run(tmp_path, "hook", warp=warp) for warp in ("forward", "particles", "backward", "nerfies")
    ]
    for folder, files in zip(folders, "aab"):  # the last is of an earlier version, which stored none
        (folder / "data.json").write_text(json.dumps({"texts": {"transforms_train.json": files}}))
    runs, left_out = read_measured(tmp_path, read_paper(PAPER).values())
    assert [row["method"] for row in runs] == ["forward", "nerfies", "particles"]
    assert {row["scene"] for row in runs} == {"hook"}
    assert re.fullmatch(r"hook \(files \w{8}\): 1 run; most runs of hook are of other files", *left_out)


@pytest.mark.slow
def test_counterparts_never_meet_printed_numbers(tmp_path):
    paper_run(tmp_path, "vehicle", made=True, psnr=28.0)
    paper_run(tmp_path, "lift", dataset="lego_complete", protocol={"synthetic": True})  # however it is read
    runs, _ = read_runs(tmp_path)
    made = stand_in(read_paper(PAPER)["dnerf"], runs)
    names = [column.name for column in made.columns]
    assert names[1:5] == ["type", "vehicle PSNR↑", "vehicle SSIM↑", "training, s a run"]  # nothing has LPIPS
    assert names[-2:] == ["published as", "published: Mean of 8 PSNR"]
    assert made.texts()[0][1:3] == ["PC", "28.00"]
    assert made.rows[0][-2:] == ["Ours (80^3)", "32.68"]
    assert stand_in(read_paper(PAPER)["dnerf_scenes"], runs) is None
    paper_run(tmp_path / "two", "vehicle", "full", made=True)
    paper_run(tmp_path / "two", "rig", "no_tv", dataset="hypernerf", made=True)
    both = stand_in(read_paper(PAPER)["modules"], read_runs(tmp_path / "two")[0])
    ends = [["Ours", "32.68", ""], ["Ours, no total variation", "", "23.84"]]
    assert [row[-3:] for row in both.rows] == ends
    write_paper(tmp_path, tmp_path / "out")
    text = (tmp_path / "out" / "paper.md").read_text()
    (table,) = text.split("## Table 1: D-NeRF, mean of eight scenes")[1:]
    assert table.startswith(": synthetic counterpart")
    assert "| published |" not in text
    assert "## Table 4: Lego Complete, by ability: synthetic counterpart" in text
    assert "| difference to the paper |" not in text


GRIDS = {"tineuvox_s", "tineuvox_b", "ndvg", "forward"}
SYSTEMS = {"dnerf": GRIDS | {"tnerf", "dnerf"}, "nhr": GRIDS, "lego_complete": {"dnerf", "ndvg", "forward"}}
SYSTEMS["hypernerf"] = GRIDS | {"nerf", "neural_volumes", "nerfies", "hypernerf"}


@pytest.mark.slow
@pytest.mark.parametrize("dataset", SYSTEMS)
def test_every_system_stands_beside_its_published_row(tmp_path, dataset):
    table, models = read_paper(PAPER)[dataset], set(options("model"))
    assert {row.model for row in table.rows} == SYSTEMS[dataset] < models
    for model in models:
        kinds = {group.ability for group in table.groups}
        scores = {kind: {"psnr": 25.0} for kind in kinds if kind} or {"psnr": 25.0}
        paper_run(tmp_path / "real", table.groups[0].scenes[0], dataset=dataset, warp=model, **scores)
        paper_run(tmp_path / "made", "toy", dataset=dataset, warp=model, made=True, **scores)
    rows = table_of(tmp_path / "real", dataset).rows
    for row in (row for row in table.rows if row.variant in (None, "full")):
        at = next(i for i, line in enumerate(rows) if [line[0], line[2]] == [row.name, "published"])
        assert rows[at + 1][0].startswith(f"forewarp: {row.model}")
    at_the_end = [row[0].split(",")[0].split(": ")[1] for row in rows[-len(models - SYSTEMS[dataset]) :]]
    assert set(at_the_end) == models - SYSTEMS[dataset]
    shown = stand_in(table, read_runs(tmp_path / "made")[0])
    first = len(shown.columns) - 1 - len([g for g in table.groups if len(g.scenes) > 1])
    for line in shown.rows:
        model = line[0].split(",")[0].split(" (")[0].removeprefix("forewarp: ")
        assert all(line[first:]) == any(line[first:]) == (model in SYSTEMS[dataset]), model


@pytest.mark.slow
def test_rows_of_other_views_or_another_clock_stand_apart(tmp_path):
    few = {"measured": "5 of 20 test views, evenly spread"}
    for seed, protocol in enumerate(({}, few)):
        for model, again in product(("particles", "forward"), range(3)):
            paper_run(tmp_path / str(seed), "toy", warp=model, seed=again, made=True, protocol=protocol)
    table = read_paper(PAPER)["dnerf"]
    both, one = (stand_in(table, read_runs(folder)[0]) for folder in (tmp_path, tmp_path / "1"))
    names = [row[0] for row in both.rows]
    assert names[:2] == [f"{OURS}, 3 seeds", f"{OURS}, 3 seeds, 5 test views"]
    assert names[2] == "forewarp: particles, fast, 1 min, 3 seeds"
    assert [bool(shown.marks) for shown in (both, one)] == [False, True]
    old = paper_run(tmp_path / "2", "toy", made=True, protocol={"clock": "processor"})
    os.utime(old / "metrics.json", (1, 1))
    new = paper_run(tmp_path / "3", "toy", made=True, protocol={"clock": "processor"}, psnr=20.0)
    write_paper(tmp_path, tmp_path / "out")
    text = re.sub(" +", " ", (tmp_path / "out" / "paper.md").read_text())
    assert f"| {OURS} of processor time | PC | 20.00 |" in text
    assert "fast, 1 min a run by the processor clock" in text
    assert f"* {old.relative_to(tmp_path)}: another run of the same is newer" in text
    assert str(new) not in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "marked"),
    [({}, True), ({"threads": 1}, False), ({"clock": "processor"}, False), ({"device": "a gpu"}, False)],
)
def test_rows_of_other_conditions_are_not_ranked(tmp_path, change, marked):
    for scene, seed in product(ALL, range(3)):
        paper_run(tmp_path, scene, seed=seed, psnr=31.0)
        paper_run(tmp_path, scene, seed=seed, warp="backward", psnr=30.0, protocol=change)
    found = table_of(tmp_path)
    assert bool(found.marks) is ("bold, the second underlined" in found.caption) is marked


def test_measured_rows_keep_the_order_of_the_variants(tmp_path):
    for variant in ("no_inpainter", "full", "no_tv"):
        paper_run(tmp_path, "hook", variant)
    found = measured(read_paper(PAPER)["modules"], read_runs(tmp_path)[0])
    assert [runs[0]["ablation"] for runs in found] == ["full", "no_tv", "no_inpainter"]


def test_the_papers_slips_are_footnotes_that_its_numbers_bear_out():
    tables = read_paper(PAPER)
    scenes = with_means(tables["dnerf_scenes"], Runs())
    means = {row.name: (*row.values.values(),)[-6::3] for row in scenes.rows}
    assert (means["T-NeRF"][0], means["D-NeRF"][0]) == ("28.78", "30.44")
    assert means["Ours"] == ("32.68", "33.74")
    assert means["Ours, no total variation"][0] == "33.09"
    notes = " ".join(note for table in tables.values() for note in table.notes)
    assert [number for number in ("28.78", "30.44", "23.45", "33.09", "33.30") if number not in notes] == []
    ndvg = next(row for row in tables["hypernerf"].rows if row.name.startswith("NDVG"))
    assert sum(map(float, [*ndvg.values.values()][:8:2])) / 4 == pytest.approx(23.45)


def test_a_row_of_another_length_is_named(tmp_path):
    path = tmp_path / "paper.yaml"
    path.write_text(
        "datasets: {d: [a]}\ntables:\n  t: {title: t, source: s, variants: [], notes: [],\n"
        "    groups: [{name: A, dataset: d, metrics: [psnr]}], rows: [{name: x, values: [1, 2]}]}\n"
    )
    with pytest.raises(ValueError, match="t: x: expected 1 values, but got 2"):
        read_paper(path)
    for text, says in (("tables: []\n", "tables of groups and rows, but got A"), ("[", "YAML, but got")):
        path.write_text(text)
        with pytest.raises(ValueError, match=f"paper.yaml: expected {says}"):
            read_paper(path)


def part(root, variant, seed, psnr, *, scene="vehicle", dataset="dnerf", steps=None, seconds=50.0, made=True):
    """A run of an ablation, of minutes or of so many steps; ``psnr`` also by kind of test view."""
    budget = {"minutes": None if steps else 4.0, "iterations": steps, "clock": "processor"}
    metrics = {"protocol": {"dataset": dataset, "synthetic": made}}
    metrics["seconds"] = {"train": seconds, "render_per_frame": 0.5}
    by_kind = psnr if isinstance(psnr, dict) else {"all": psnr}
    metrics["test"] = {kind: {"psnr": value} for kind, value in by_kind.items()}
    named = {"scene": scene, "curve": None, "steps": steps or 100}
    return write_run(root / str(steps), variant, seed, **named, config={"budget": budget}, metrics=metrics)


def page_of(root):
    page, table = write_ablation(root, root / "out")
    return page.read_text(), table.read_text()


def test_the_page_says_which_of_the_papers_orders_hold(tmp_path):
    # Printed in table 5: no coarse stage -2.12, middle +0.34, flow L1 -0.01, total variation -0.45.
    changes = {"no_coarse": (-1.0, -1.2, -1.1), "canonical_middle": (-0.4, -0.4, -0.4)}
    changes |= {"no_flow": (0.1, -0.1, 0.0), "no_tv": (1, 1.1, 1.2)}
    for seed, whole in enumerate((25.0, 26.0, 27.0)):
        part(tmp_path, "full", seed, whole)
        part(tmp_path, "full", seed, whole - 5, steps=600)
        for variant, change in changes.items():
            part(tmp_path, variant, seed, whole + change[seed], seconds=25.0)
        part(tmp_path, "no_tv", seed, whole - 6, steps=600)
    text, table = page_of(tmp_path)
    assert rows_of(text.split("## Table 5")[0], "4 min") == [["4 min", "5", "2", "1", "2", "0"]]
    section = text.split("## Table 5")[1].split("## ")[0]
    ours, no_tv, no_flow = (rows_of(section, n)[0] for n in ("Ours", "w/o total variation", "w/o flow L1"))
    # Deviations of 1.0, 1.1 and 0.1, times 4.303 / sqrt(3) = 2.484.
    assert ours[1:6] == ["", "26.00 ± 2.48", "", "", "0.500"]
    assert ours[6:] == ["×1.00", "21.00 ± 2.48", "", "", "0.083", "×1.00"]
    assert no_tv[1:7] == ["-0.45", "27.10 ± 2.73", "+1.10 ± 0.25", "reversed", "0.250", "×0.50"]
    assert no_tv[7:10] == ["20.00 ± 2.48", "-1.00 ± 0.00", "holds"]
    assert no_flow[1:2] + no_flow[3:7] == ["-0.01", "0.00 ± 0.25", "no difference shown", "0.250", "×0.50"]
    assert no_flow[7:] == [""] * 5
    assert rows_of(section, "w/o coarse stage")[0][3:5] == ["-1.10 ± 0.25", "holds"]
    assert rows_of(section, "canonical time in the middle")[0][3:5] == ["-0.40 ± 0.00", "reversed"]
    assert not rows_of(section, "w/o view direction")  # nobody ran it
    assert "4 min, 3 seeds; 600 steps, 3 seeds." in section
    assert "budget: fast, 4 min a run by the processor clock; fast, 600 steps" in text
    other = text.split("## Table 6: modules: vehicle")[1]  # has one of these rows
    assert not rows_of(other, "w/o coarse stage")
    assert len(table.splitlines()) == 1 + 3 * 7


@pytest.mark.slow
def test_runs_at_rest_stand_above_what_the_page_has_already(tmp_path):
    def rest(variant, seed, psnr, method="forward"):
        config = {"preset": {"name": "compact"}, "model": {"name": method}, "budget": {"iterations": 9}}
        config["budget"]["minutes"] = None
        metrics = {"test": {"all": {"psnr": psnr}, "canonical": {"psnr": 20.0}}}
        metrics["protocol"] = {"dataset": "dnerf", "synthetic": True}
        about = {"scene": "vehicle", "curve": ((0, 20.0), (80, 25.0), (90, 25.5), (100, 25.1))}
        write_run(tmp_path / "rest", variant, seed, **about, config=config, metrics=metrics)

    for seed in range(2):
        part(tmp_path / "first", "full", seed, 25.0)
        part(tmp_path / "first", "no_tv", seed, 24.0)
    for seed in range(3):
        rest("full", seed, 23.0 + seed)
        rest("no_inpainter", seed, 22.5 + seed)
        rest("base", seed, 24.0 + seed, "backward")
    out = tmp_path / "out"
    write_ablation(tmp_path / "first", out)
    before = (out / "ablation.md").read_text()
    assert "## At rest" not in before
    for _ in range(2):
        written = write_ablation(tmp_path / "rest", out)
        assert [path.name for path in written] == ["ablation.md", "ablation-at-rest.csv"]
        text = (out / "ablation.md").read_text()
        assert text.count("## At rest") == 1
        assert text.index("## At rest") < text.index("## In short")
        assert text[text.index("## In short") :] == before[before.index("## In short") :]
    section = text.split("## At rest")[1].split("## ")[0]
    ours, without, backward = rows_of(section, "vehicle")
    assert ours[1:6] == ["Ours", "", "24.00 ± 2.48", "", ""]
    assert without[2:6] == ["-0.90", "23.50 ± 2.48", "-0.50 ± 0.00", "holds"]
    assert without[6:8] == ["20.00 ± 0.00", "+0.10 ± 0.00"]
    assert backward[2:6] == ["", "25.00 ± 2.48", "+1.00 ± 0.00", ""]
    assert "2 differences are of three seeds or more" in section
    write_ablation(tmp_path / "first", out)  # the others anew
    assert (out / "ablation.md").read_text() == text


def test_a_row_with_fewer_seeds_says_so(tmp_path):
    for seed, whole in enumerate((25.0, 26.0, 27.0, 28.0)):
        part(tmp_path, "full", seed, whole)
        part(tmp_path, "no_flow", seed, whole + 0.1 * seed)
    part(tmp_path, "no_tv", 1, 24.0)
    for seed in range(3):
        part(tmp_path, "no_coarse", seed, 24.0 + seed)
    rows = page_of(tmp_path)[0].split("## Table 5")[1]
    assert rows_of(rows, "w/o total variation")[0][2:5] == ["24.00", "-2.00", "one seed"]
    assert rows_of(rows, "w/o coarse stage")[0][3:5] == ["-1.00 ± 0.00", "holds (3 of 4 seeds)"]
    # 0.0, 0.1, 0.2 and 0.3: a deviation of 0.129, 3.182 of its halves.
    assert rows_of(rows, "w/o flow L1")[0][3:5] == ["+0.15 ± 0.21", "no difference shown"]


@pytest.mark.slow
def test_scores_of_unknown_seeds_are_not_paired(tmp_path):
    for seed in range(3):
        for variant, change in (("full", 0.0), ("no_tv", -1.0)):
            psnr = {"time": 25.0 + seed + change, "space": 26.0 + seed + change}
            part(tmp_path, variant, seed, psnr, scene="lift", dataset="lego_complete")
    _, table = write_ablation(tmp_path, tmp_path / "out")
    lines = table.read_text().splitlines()
    marked = [lines[0] + ",unpaired", *(f"{line},space; late" for line in lines[1:])]
    table.write_text("\n".join(marked))
    for _ in range(2):  # the second time from what the first wrote
        text = write_ablation(table, tmp_path / "out")[0].read_text()
        sections = {part.partition("\n")[0]: part for part in text.split("\n## ")}
        rows = {name: rows_of(part, "Ours, no total variation (80^3)") for name, part in sections.items()}
        ((space,),) = (found for name, found in rows.items() if found and ": Space" in name)
        ((time,),) = (found for name, found in rows.items() if found and ": Time" in name)
        assert space[2:5] == ["26.00 ± 2.48", "", ""]
        assert time[2:5] == ["25.00 ± 2.48", "-1.00 ± 0.00", "holds"]
        assert text.count("Which seed has which score was not kept") == 1


@pytest.mark.slow
def test_kinds_of_test_views_and_scenes_have_sections_of_their_own(tmp_path):
    for variant, changes in (("full", (0.0, 0.0, 0.0)), ("no_inpainter", (-1.0, 1.0, 0.5))):
        views = {kind: 25.0 + change for kind, change in zip(("space", "time", "canonical"), changes)}
        part(tmp_path, variant, 0, views, scene="lift", dataset="lego_complete")
    for number, scene in enumerate(("vrig-3dprinter", "broom2", "vrig-chicken", "vrig-peel-banana")):
        for variant, psnr in (("full", 25.0), ("no_inpainter", 25.0 + number)):
            part(tmp_path, variant, 0, psnr, scene=scene, dataset="hypernerf", made=False)
    for scene in ("hook", "mutant"):
        part(tmp_path, "full", 0, 25.0, scene=scene, made=False)
        part(tmp_path, "no_inpainter", 0, 24.0, scene=scene, made=False)
    old = part(tmp_path / "again", "no_inpainter", 0, 29.0, scene="hook", made=False)
    os.utime(old / "metrics.json", (0, 0))
    text, _ = page_of(tmp_path)
    sections = dict(section.split("\n", 1) for section in text.split("\n## ")[1:])
    names = ("Ours, no inpainter", "Ours, no inpainter (80^3)")
    rows = {title: [row for name in names for row in rows_of(part, name)] for title, part in sections.items()}
    lego = "Table 4: Lego Complete, by ability"
    assert {title: lines[0][1:4] for title, lines in rows.items() if lines} == {
        f"{lego}: Space interpolation, lift": ["-0.97", "24.00", "-1.00"],
        f"{lego}: Time interpolation, lift": ["-0.95", "26.00", "+1.00"],
        f"{lego}: Canonical interpolation, lift": ["-1.72", "25.50", "+0.50"],
        "Table 6: modules: HyperNeRF": ["-0.98", "26.50", "+1.50"],  # a mean of four scenes
        "Table 6: modules: D-NeRF, of which mutant, hook": ["-0.90", "24.00", "-1.00"],
    }
    assert {lines[0][4] for lines in rows.values() if lines} == {"one seed"}
    assert "No difference here is of three seeds or more, so that there is no verdict." in text
    assert f"{old.relative_to(tmp_path)}: another run of the same is newer" in sections["Left out"]
    with pytest.raises(
        ValueError,
        match="expected runs of ablation=full, .*, but got none among 1 .*; make some with make ab",
    ):
        write_ablation(write_run(tmp_path / "other").parent, tmp_path / "out")


@pytest.mark.parametrize("model", [*options("model"), "theirs"])
def test_every_method_has_the_papers_type(model):
    types = {
        "N": {"nerf", "tnerf"},
        "PC": {"dnerf", "ndvg", "forward", "backward"},
        "–": {"particles", "theirs"},
    }
    types["NPC"] = {"neural_volumes", "nerfies", "hypernerf", "tineuvox_s", "tineuvox_b"}
    tables = read_paper(PAPER)
    (expected,) = (name for name, methods in types.items() if model in methods)
    assert tables["dnerf"].type_of(model) == [expected]
    assert tables["modules"].type_of(model) == []  # as in the paper, whose rows are all its own method


def test_a_type_stands_behind_each_method_and_is_explained(tmp_path):
    for model in ("forward", "nerfies", "particles"):
        paper_run(tmp_path, "hook", warp=model)
    table = table_of(tmp_path, "dnerf_scenes")
    found = {row[0]: row[1] for row in table.rows if row[0]}
    own = {"forward (the paper's method)": "PC", "nerfies": "NPC", "particles": "–"}
    expected = {"T-NeRF": "N", "TiNeuVox-S (100^3)": "NPC", "NDVG": "PC"}
    expected |= {f"forewarp: {name}": kind for name, kind in own.items()}
    assert {name: found[name] for name in expected} == expected
    assert table.caption.startswith("Type: N without a canonical space, PC with a physical one")


def sheet(colour, folder, views, kind="sheets"):
    """Sheets of a white truth with a dot, and a picture of one colour."""
    truth = np.full((9, 12, 3), 255, np.uint8)
    truth[4, 6] = 0
    white, picture = np.full((9, 4, 3), 255, np.uint8), np.full((9, 12, 3), colour, np.uint8)
    for view in views:
        file = folder / "images" / kind / f"{view}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(file, np.concatenate([truth, white, picture, white, picture], 1))


@pytest.fixture
def illustrated(tmp_path):
    """A folder with every kind of figure, and what was written."""
    runs, views = tmp_path / "runs", {"test/a": (0.5, 30.0)}
    of_scene = {"both": ("vrig-chicken", "hypernerf"), "lift": ("lift", "lego_complete")}
    for colour, (variant, model, where) in enumerate(
        [(None, "forward", "both"), (None, "tineuvox_s", "both"), (None, "dnerf", "lift")]
        + [("full", "forward", "lift"), ("no_inpainter", "forward", "lift")]
        + [(f"resolution [[0, {side**3}]]", "forward", "both") for side in (20, 40)]
    ):
        scene, dataset = of_scene[where]
        scores = {"space": {"psnr": 20.0}} if where == "lift" else {"psnr": 20.0 + colour}
        folder = paper_run(runs, scene, variant, dataset=dataset, warp=model, **scores)
        write_views(folder, views)
        sheet(30 * colour, folder, views)
        sheet(30 * colour, folder, views, "depth")
    steps = [{"does": "input", "from": [], "shape": [2, 8, 8, 8], "parameters": 0}]
    steps.append(
        {"does": "conv3d", "from": [0], "shape": [3, 8, 8, 8], "kernel": [3, 3, 3], "parameters": 165}
    )
    (folder / "networks.json").write_text(json.dumps({"inpainter": steps}))
    return tmp_path / "out", write_paper(runs, tmp_path / "out")


@pytest.mark.slow
def test_every_figure_stands_on_each_page_with_a_caption(illustrated):
    out, files = illustrated
    scenes = ("views-hypernerf-vrig-chicken", "views-lego_complete-lift", "ablation-lift", "inpainter")
    names = {*scenes, "resolution", "resolution-vrig-chicken-forward-fast-1-min"}
    assert {path.stem.removeprefix("paper-") for path in files if path.suffix == ".png"} == names
    text, latex, page = ((out / f"paper.{kind}").read_text() for kind in ("md", "tex", "html"))
    for name in names:
        assert f"![paper-{name}](paper-{name}.png)" in text
        assert f"{{paper-{name}.png}}" in latex
        assert f'alt="paper-{name}"' in page
    assert latex.count(r"\begin{figure}") == latex.count(r"\label{fig:paper-") == len(names)
    caption = "Read off the module of forward, preset fast: 165 parameters."
    assert all(caption in whole for whole in (text, latex, page))
    assert r"\caption{Test view by resolution: vrig-chicken. The test view nearest to the middle" in latex


def test_a_broken_description_of_a_network_is_named(tmp_path):
    folder = paper_run(tmp_path, "hook")
    (folder / "networks.json").write_text('{"inpainter": [{"does": "conv3d"}]}')
    with pytest.raises(ValueError, match="networks.json: expected steps of networks, but got no key"):
        write_paper(tmp_path, tmp_path / "out")


@pytest.mark.slow
def test_the_latex_page_compiles_without_overfull_boxes(illustrated):
    if shutil.which("pdflatex") is None:
        pytest.skip("pdflatex is not installed (texlive-latex-recommended)")
    words = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(words, cwd=illustrated[0], capture_output=True, text=True, errors="replace")
    assert done.returncode == 0, done.stdout[-2000:]
    for fault in ("Overfull", "Missing character", "undefined", "multiply defined"):
        assert fault not in done.stdout
    assert (illustrated[0] / "paper.pdf").read_bytes().startswith(b"%PDF")
