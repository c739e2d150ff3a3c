"""The paper's tables and the page of ablations, from hand-made run folders."""

import base64
import json
import os
import re

import imageio.v3 as iio
import numpy as np
import pytest
import yaml

from forewarp.report.paper import (
    COSTS,
    PAPER,
    comparison,
    measured,
    read_paper,
    stand_in,
    with_means,
    write_ablation,
    write_paper,
)
from forewarp.report.results import Runs, read_runs
from forewarp.report.tables import latex_text
from tests.support.configs import options
from tests.support.runs_on_disk import rows_of, write_run

ALL = ["hellwarrior", "mutant", "hook", "bouncingballs", "lego", "trex", "standup", "jumpingjacks"]


def paper_run(
    root, scene, variant=None, seed=0, *, dataset="dnerf", made=False, warp="forward", protocol=None, **scores
):
    """A run as a sweep of the paper leaves it; ``variant`` None is the plain method."""
    name = f"{variant or 'plain'}-{warp}"
    module = f"forewarp.{'cli.synthetic.Synthetic' if made else 'data.module.'}DataModule"
    config = {"model": {"name": warp}, "data": {"scene": scene, "_target_": module}}
    config["variant"] = {"name": variant, "about": f"the {variant}", "against": "full"} if variant else None
    if sizes := re.search(r"resolution (.*)", variant or ""):
        config["stage"] = {"fine": {"num_voxels": json.loads(sizes[1])}}
    abilities = {k: v for k, v in scores.items() if isinstance(v, dict)}
    metrics = {"test": abilities or {"all": {"psnr": 30.0, "ssim": 0.9, **scores}}}
    metrics["protocol"] = {"dataset": dataset, "resolution": [4, 3], "background": "white"} | (protocol or {})
    return write_run(root, name, seed, scene=scene, curve=None, config=config, metrics=metrics)


def table_of(root, key="dnerf"):
    runs, _ = read_runs(root)
    return comparison(with_means(read_paper(PAPER)[key], runs), runs)


def cells(table, name, kind="measured"):
    rows = [
        i for i, row in enumerate(table.rows) if row[1] == kind and (kind != "measured" or row[0] == name)
    ]
    return table.texts("md")[rows[0]][2 : -len(COSTS)]


def test_a_mean_is_of_all_scenes_or_empty(tmp_path):
    for number, scene in enumerate(ALL[:7]):
        paper_run(tmp_path, scene, psnr=20.0 + number)
    assert cells(table_of(tmp_path), "forewarp: forward (the paper's method), fast, 1 min") == ["", "", ""]
    scenes = table_of(tmp_path, "dnerf_scenes")
    names = [column.name for column in scenes.columns]
    values = dict(zip(names[2:], cells(scenes, "forewarp: forward (the paper's method), fast, 1 min")))
    assert values["Hook PSNR↑"] == "22.00"
    assert values["Hook LPIPS↓"] == values["Mean of 8 PSNR↑"] == values["Jumping Jacks PSNR↑"] == ""
    assert values["Mean of the 7 measured PSNR↑"] == "23.00"
    paper_run(tmp_path, ALL[7], psnr=27.0)
    row = cells(table_of(tmp_path), "forewarp: forward (the paper's method), fast, 1 min")
    assert row == ["23.50", "0.900", ""]
    assert cells(table_of(tmp_path), "", "difference to the paper") == ["-9.18", "-0.070", ""]


def test_seeds_give_a_deviation_where_all_scenes_have_them(tmp_path):
    for seed, psnr in ((0, 20.0), (1, 22.0)):
        for scene in ALL:
            paper_run(tmp_path, scene, seed=seed, psnr=psnr)
    paper_run(tmp_path, "hook", seed=2, psnr=99.0)
    assert (
        cells(table_of(tmp_path), "forewarp: forward (the paper's method), fast, 1 min, 3 seeds")[0]
        == "21.00 ± 1.41"
    )


def test_ranks_are_among_measured_rows_alone(tmp_path):
    four = ["hellwarrior", "mutant", "hook", "bouncingballs"]
    for variant, psnr, lpips in (("full", 25.0, 0.2), ("no_tv", 24.0, 0.1), ("no_view", 20.0, 0.3)):
        for scene in four:
            paper_run(tmp_path, scene, variant, psnr=psnr, lpips_vgg=lpips)
    table = table_of(tmp_path, "losses")
    assert cells(table, "forewarp: the full, fast, 1 min") == ["**25.00**", "**0.900**", "<u>0.200</u>"]
    assert cells(table, "forewarp: the no_tv, fast, 1 min") == ["<u>24.00</u>", "**0.900**", "**0.100**"]
    assert cells(table, "forewarp: the no_view, fast, 1 min")[::2] == ["20.00", "0.300"]
    assert cells(table, "", "published") == ["33.75", "0.979", "0.040"]  # as printed, unmarked
    assert cells(table, "", "difference to the paper") == ["-8.75", "-0.079", "+0.160"]
    # Each published row has its measured one below it.
    kinds = [row[:2] for row in table.rows[:7] if "difference" not in row[1]]
    assert kinds[::2] == [
        ["Ours", "published"],
        ["w/o total variation", "published"],
        ["w/o flow L1", "published"],
    ]
    assert kinds[1::2] == [
        ["forewarp: the full, fast, 1 min", "measured"],
        ["forewarp: the no_tv, fast, 1 min", "measured"],
    ]
    assert table.rules == [3, 6, 10, 13]
    assert table.texts()[1][-len(COSTS) :] == ["50", "1.00", "2.000", "100", "1", "a cpu, 2 threads"]
    assert table.rows[0][-len(COSTS) :] == [None] * len(COSTS)


def test_abilities_and_depth_have_columns_of_their_own(tmp_path):
    by_ability = {
        "space": {"psnr": 20.0, "depth_delta_1.25": 0.5},
        "time": {"psnr": 21.0},
        "canonical": {"psnr": 22.0, "depth_delta_1.5625": 0.25},
    }
    for scene in ("lift", "lift_tilt", "drive"):
        paper_run(tmp_path, scene, dataset="lego_complete", **by_ability)
    row = cells(table_of(tmp_path, "lego_complete"), "forewarp: forward (the paper's method), fast, 1 min")
    assert row == ["20.00", "", "50.000", "", "21.00", "", "", "", "22.00", "", "", "25.000"]


@pytest.fixture
def whole(tmp_path):
    """A folder with every output, of a few runs with pictures."""
    runs = tmp_path / "runs"
    for warp in ("particles", "forward", "backward"):
        folder = paper_run(runs, "hook", warp=warp)
        sheet = np.full((3, 4 * 3 + 8, 3), 255, np.uint8)
        (folder / "images" / "sheets" / "test").mkdir(parents=True)
        for name in ("a", "b"):
            iio.imwrite(folder / "images" / "sheets" / "test" / f"{name}.png", sheet)
        images = [
            {"name": f"test/{v}", "time": t, "scores": {"psnr": 30.0}} for v, t in (("a", 0.9), ("b", 0.0))
        ]
        (folder / "per_image.json").write_text(json.dumps({"images": images}))
    for side, psnr in ((20, 18.0), (40, 20.0)):
        paper_run(runs, "vrig-chicken", f"resolution [[0, {side**3}]]", dataset="hypernerf", psnr=psnr)
    write_run(runs, "failed", psnr=None)
    files = write_paper(runs, tmp_path / "out")
    assert all(file.is_file() for file in files)
    return tmp_path / "out"


def test_pages_tell_how_numbers_came_about(whole):
    text = (whole / "paper.md").read_text()
    for line in (
        "* protocol 1: dnerf, 4x3, background white",
        "* machine: a cpu, 2 threads, torch 2",
        "* budget: fast, 1 min a run",
        "* measured: nothing yet",
        "1. T-NeRF's printed mean PSNR is 29.51; its printed scenes average 28.78",
        "* ball/failed-1.0-seed0: no metrics.json; run its command again",
    ):
        assert line in text
    assert re.search(r"\* date: \d{4}-\d\d-\d\d\n\* command, one of 3 runs: forewarp-train variant=", text)
    lines = re.sub(" +", " ", text)
    for method in ("particles", "forward (the paper's method)", "backward"):
        assert f"| forewarp: {method}, fast, 1 min | measured |" in lines
    assert "| Ours (80^3) | published | 32.68 | 0.97 | 0.04 |" in lines
    names = {path.name for path in whole.iterdir()}
    assert {"paper-resolution.png", "paper-canonical-hook.png"} <= names
    assert {"paper-views-dnerf-forward.png", "paper-views-dnerf-particles.png"} <= names
    assert "# machine: a cpu, 2 threads" in (whole / "paper-table-1-d-nerf.csv").read_text()
    page = (whole / "paper.html").read_text()  # needs nothing else
    sources = [source.split(",") for source in re.findall(r'src="([^"]*)"', page)]
    assert [kind for kind, _ in sources] == ["data:image/png;base64"] * 4
    assert all(base64.b64decode(content).startswith(b"\x89PNG") for _, content in sources)
    assert not re.search(r"https?://|<script|<link", page)
    latex = (whole / "paper.tex").read_text()
    assert latex_text("a_b & 5 %^2") == r"a\_b \& 5 \%\textasciicircum{}2"
    for name in ("table", "tabular", "document"):
        assert latex.count(rf"\begin{{{name}}}") == latex.count(rf"\end{{{name}}}") > 0
    assert r"\underline{" in latex or r"\textbf{" in latex
    assert r"\footnotesize machine: a cpu, 2 threads, torch 2" in latex


def test_a_scene_with_one_kind_of_view_is_measured_by_it(tmp_path):
    for number, scene in enumerate(("sport_1", "sport_2", "sport_3", "basketball")):
        sizes = [[512, 384], [1024, 768]] if number == 3 else [4, 3]
        space = {"psnr": 20.0 + number}
        paper_run(tmp_path, scene, dataset="nhr", protocol={"resolution": sizes}, space=space)
    row = cells(table_of(tmp_path, "nhr"), "forewarp: forward (the paper's method), fast, 1 min")
    assert row == ["20.00", "", "", "21.00", "", "", "22.00", "", "", "23.00", "", "", "21.50", "", ""]
    write_paper(tmp_path, tmp_path / "out")
    text = (tmp_path / "out" / "paper.md").read_text()
    assert "* protocol 1: nhr, 512x384 and 1024x768, background white" in text


def test_counterparts_never_meet_printed_numbers(tmp_path):
    paper_run(tmp_path, "vehicle", made=True, psnr=28.0)
    paper_run(tmp_path, "lift", dataset="lego_complete", protocol={"synthetic": True})  # however it is read
    results, _ = read_runs(tmp_path)
    made = stand_in(read_paper(PAPER)["dnerf"], results)
    names = [column.name for column in made.columns]
    assert names[1:4] == [f"vehicle {m}" for m in ("PSNR↑", "SSIM↑", "LPIPS↓")]
    assert names[-2:] == ["published as", "published: Mean of 8 PSNR"]
    assert made.texts()[0][1] == "28.00"
    assert made.rows[0][-2:] == ["Ours (80^3)", "32.68"]
    assert stand_in(read_paper(PAPER)["dnerf_scenes"], results) is None
    write_paper(tmp_path, tmp_path / "out")
    text = (tmp_path / "out" / "paper.md").read_text()
    first, second = text.split("## Table 1: D-NeRF, mean of eight scenes")[1:3]
    assert "28.00" not in first
    assert "| published |" not in second.split("## ")[0]
    assert "## Table 4: Lego Complete, by ability: synthetic counterpart" in text
    assert "| difference to the paper |" not in text


SYSTEMS = {
    "dnerf": {"tnerf", "tineuvox_s", "tineuvox_b", "dnerf", "ndvg", "forward"},
    "hypernerf": {
        "nerf",
        "neural_volumes",
        "nerfies",
        "hypernerf",
        "tineuvox_s",
        "tineuvox_b",
        "ndvg",
        "forward",
    },
    "nhr": {"tineuvox_s", "tineuvox_b", "ndvg", "forward"},
    "lego_complete": {"dnerf", "ndvg", "forward"},
}


@pytest.mark.parametrize("dataset", SYSTEMS)
def test_every_system_stands_beside_its_published_row(tmp_path, dataset):
    table = read_paper(PAPER)[dataset]
    models = set(options("model"))
    assert {row.model for row in table.rows} == SYSTEMS[dataset] < models
    real, made = tmp_path / "real", tmp_path / "made"
    for model in models:
        kinds = {group.ability for group in table.groups}
        scores = {kind: {"psnr": 25.0} for kind in kinds if kind} or {"psnr": 25.0}
        paper_run(real, table.groups[0].scenes[0], dataset=dataset, warp=model, **scores)
        paper_run(made, "toy", dataset=dataset, warp=model, made=True, **scores)
    rows = table_of(real, dataset).rows
    for row in table.rows:
        if row.variant in (None, "full"):
            at = next(i for i, cells in enumerate(rows) if cells[:2] == [row.name, "published"])
            assert rows[at + 1][0].startswith(f"forewarp: {row.model}")
    at_the_end = [row[0].split(",")[0].split(": ")[1] for row in rows[-len(models - SYSTEMS[dataset]) :]]
    assert set(at_the_end) == models - SYSTEMS[dataset]
    shown = stand_in(table, read_runs(made)[0])
    first = len(shown.columns) - 1 - len([g for g in table.groups if len(g.scenes) > 1])
    beside = {
        row[0].split(",")[0].split(" (")[0].removeprefix("forewarp: "): row[first:] for row in shown.rows
    }
    assert {model for model, cells in beside.items() if all(cells)} == SYSTEMS[dataset]
    assert all(cells == [""] * len(cells) for model, cells in beside.items() if model not in SYSTEMS[dataset])


def test_rows_of_other_views_or_another_clock_stand_apart(tmp_path):
    few = {"measured": "5 of 20 test views, evenly spread"}
    for seed, protocol in enumerate(({}, few)):
        for model in ("particles", "forward"):
            paper_run(tmp_path / str(seed), "toy", warp=model, made=True, protocol=protocol)
    table = read_paper(PAPER)["dnerf"]
    both, one = (stand_in(table, read_runs(folder)[0]) for folder in (tmp_path, tmp_path / "1"))
    names = [row[0] for row in both.rows]
    assert names[:2] == [
        f"forewarp: forward (the paper's method), fast, 1 min{more}" for more in ("", ", 5 test views")
    ]
    assert names[2] == "forewarp: particles, fast, 1 min"
    assert [bool(shown.marks) for shown in (both, one)] == [False, True]
    folder = paper_run(tmp_path / "2", "toy", made=True)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["budget"]["clock"] = "processor"
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    write_paper(tmp_path, tmp_path / "out")
    text = (tmp_path / "out" / "paper.md").read_text()
    assert "| forewarp: forward (the paper's method), fast, 1 min of processor time |" in re.sub(
        " +", " ", text
    )
    assert "fast, 1 min a run by the processor clock" in text


def test_of_runs_alike_the_newest_counts(tmp_path):
    old, new = paper_run(tmp_path / "a", "hook", psnr=10.0), paper_run(tmp_path / "b", "hook", psnr=20.0)
    os.utime(old / "metrics.json", (1, 1))
    write_paper(tmp_path, tmp_path / "out")
    text = (tmp_path / "out" / "paper.md").read_text()
    assert f"* {old}: another run of the same is newer" in text
    assert "20.00" in text
    assert str(new) not in text


def test_no_mean_is_taken_over_unlike_images(tmp_path):
    for scene in ALL:
        paper_run(tmp_path, scene, protocol={"half_resolution": scene == "hook"})
    assert cells(table_of(tmp_path), "forewarp: forward (the paper's method), fast, 1 min") == ["", "", ""]
    names = [column.name for column in table_of(tmp_path, "dnerf_scenes").columns]
    row = dict(
        zip(
            names[2:],
            cells(table_of(tmp_path, "dnerf_scenes"), "forewarp: forward (the paper's method), fast, 1 min"),
        )
    )
    assert row["Hook PSNR↑"] == "30.00"


def test_machines_have_rows_of_their_own(tmp_path):
    machines = {"device": "a gpu"}, {"device": "a cpu"}, {"threads": 1}
    for number, scene in enumerate(ALL):
        paper_run(tmp_path, scene, protocol=machines[number // 3])
    rows = [row for row in table_of(tmp_path).rows if row[1] == "measured"]
    assert {row[-1] for row in rows} == {"a cpu, 2 threads", "a gpu, 2 threads", "a cpu, 1 thread"}
    assert all(row[2] is None for row in rows)


@pytest.mark.parametrize(
    ("change", "marked"),
    [({}, True), ({"protocol": {"threads": 1}}, False), ({"protocol": {"clock": "processor"}}, False)],
)
def test_rows_of_other_conditions_are_not_ranked(tmp_path, change, marked):
    for scene in ALL:
        paper_run(tmp_path, scene, psnr=31.0)
        paper_run(tmp_path, scene, warp="backward", psnr=30.0, **change)
    assert bool(table_of(tmp_path).marks) is marked


def test_curves_that_were_drawn_before_are_shown(tmp_path):
    paper_run(tmp_path / "runs", "hook")
    (tmp_path / "curves").mkdir()
    iio.imwrite(tmp_path / "curves" / "accuracy-time-hook.png", np.zeros((2, 2, 3), np.uint8))
    for folder in ("absent", "curves"):
        write_paper(tmp_path / "runs", tmp_path / "out", curves=tmp_path / folder)
        shown = "accuracy-time-hook.png" in (tmp_path / "out" / "paper.md").read_text()
        assert shown is (folder == "curves")


def test_only_runs_of_the_resolution_sweep_are_in_its_figure(tmp_path):
    for variant in ("resolution [[0, 8000]]", "full", "voxels_all"):
        paper_run(tmp_path / "runs", "ball", variant, dataset="hypernerf")
    files = write_paper(tmp_path / "runs", tmp_path / "out")
    assert tmp_path / "out" / "paper-resolution.png" not in files  # one size is no figure


def test_the_other_method_is_not_held_against_the_papers_own(tmp_path):
    for scene in ALL:
        paper_run(tmp_path, scene, warp="backward")
    assert [row[1] for row in table_of(tmp_path).rows] == ["published"] * 6 + ["measured"]


def test_measured_rows_keep_the_order_of_the_variants(tmp_path):
    for variant in ("no_inpainter", "full", "no_tv"):
        paper_run(tmp_path, "hook", variant)
    results, _ = read_runs(tmp_path)
    found = measured(read_paper(PAPER)["modules"], results)
    assert [runs[0]["ablation"] for runs in found] == ["full", "no_tv", "no_inpainter"]


def test_the_papers_slips_are_footnotes_that_its_numbers_bear_out():
    tables = read_paper(PAPER)
    scenes = with_means(tables["dnerf_scenes"], Runs())
    means = {row.name: row.values[-6::3] for row in scenes.rows}
    assert means["T-NeRF"][0] == "28.78"
    assert means["D-NeRF"][0] == "30.44"
    assert means["Ours"] == ("32.68", "33.74")
    assert means["Ours, no total variation"][0] == "33.09"
    notes = " ".join(note for table in tables.values() for note in table.notes)
    for number in ("28.78", "30.44", "23.45", "33.09", "33.30"):
        assert number in notes
    ndvg = next(row for row in tables["hypernerf"].rows if row.name.startswith("NDVG"))
    assert sum(map(float, ndvg.values[:8:2])) / 4 == pytest.approx(23.45)


def test_a_row_of_another_length_is_named(tmp_path):
    path = tmp_path / "paper.yaml"
    path.write_text(
        "datasets: {d: [a]}\ntables:\n  t: {title: t, source: s, variants: [], notes: [],\n"
        "    groups: [{name: A, dataset: d, metrics: [psnr]}], rows: [{name: x, values: [1, 2]}]}\n"
    )
    with pytest.raises(ValueError, match="t: x: expected 1 values, but got 2"):
        read_paper(path)
    path.write_text("tables: []\n")
    with pytest.raises(ValueError, match="paper.yaml: expected tables of groups and rows, but got A"):
        read_paper(path)


def part(root, variant, seed, psnr, *, scene="vehicle", dataset="dnerf", steps=None, seconds=50.0, made=True):
    """A run of an ablation, of minutes or of so many steps."""
    folder = write_run(
        root / str(steps), variant, seed, scene=scene, psnr=psnr, curve=None, steps=steps or 100
    )
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["budget"] = {"minutes": None if steps else 4.0, "iterations": steps, "clock": "processor"}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["protocol"] |= {"dataset": dataset, "synthetic": made}
    metrics["seconds"]["train"] = seconds
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def page_of(root):
    page, table = write_ablation(root, root / "out")
    return page.read_text(), table.read_text()


def test_the_page_says_which_of_the_papers_orders_hold(tmp_path):
    # Printed in table 5: no coarse stage -2.12, middle +0.34, flow L1 -0.01, total variation -0.45.
    changes = {
        "no_coarse": (-1.0, -1.2),
        "canonical_middle": (-0.4, -0.4),
        "no_flow": (0.1, -0.1),
        "no_tv": (1, 1.1),
    }
    for seed, whole in enumerate((25.0, 26.0)):
        part(tmp_path, "full", seed, whole)
        part(tmp_path, "full", seed, whole - 5, steps=600)
        for variant, change in changes.items():
            part(tmp_path, variant, seed, whole + change[seed], seconds=25.0)
        part(tmp_path, "no_tv", seed, whole - 6, steps=600)
    text, table = page_of(tmp_path)
    assert rows_of(text.split("## Table 5")[0], "4 min") == [["4 min", "5", "2", "1", "2", "0"]]
    section = text.split("## Table 5")[1].split("## ")[0]
    rows = {name: rows_of(section, name)[0][1:] for name in ("Ours", "w/o total variation", "w/o flow L1")}
    assert rows["Ours"] == [
        "",
        "25.50 ± 0.71",
        "",
        "",
        "0.500",
        "×1.00",
        "20.50 ± 0.71",
        "",
        "",
        "0.083",
        "×1.00",
    ]
    assert rows["w/o total variation"][:6] == [
        "-0.45",
        "26.55 ± 0.78",
        "+1.05 ± 0.07",
        "reversed",
        "0.250",
        "×0.50",
    ]
    assert rows["w/o total variation"][6:9] == ["19.50 ± 0.71", "-1.00 ± 0.00", "holds"]
    assert rows["w/o flow L1"] == [
        "-0.01",
        "25.50 ± 0.57",
        "+0.00 ± 0.14",
        "within noise",
        "0.250",
        "×0.50",
        *[""] * 5,
    ]
    assert rows_of(section, "w/o coarse stage")[0][3:5] == ["-1.10 ± 0.14", "holds"]
    assert rows_of(section, "canonical time in the middle")[0][3:5] == ["-0.40 ± 0.00", "reversed"]
    assert not rows_of(section, "w/o view direction")  # nobody ran it
    # Both deviations of 0.14 and one of 0.07 and of 0: the root of the mean of their squares.
    assert "4 min, 2 seeds: noise 0.11 dB; 600 steps, 2 seeds: noise 0.00 dB." in section
    assert "budget: fast, 4 min a run by the processor clock; fast, 600 steps" in section
    other = text.split("## Table 6: modules: vehicle")[1]  # has one of these rows, and the same noise
    assert "4 min, 2 seeds: noise 0.11 dB" in other
    assert not rows_of(other, "w/o coarse stage")
    assert len(table.splitlines()) == 1 + 2 * 7


def test_a_row_with_fewer_seeds_says_so(tmp_path):
    for seed, whole in enumerate((25.0, 26.0)):
        part(tmp_path, "full", seed, whole)
        part(tmp_path, "no_flow", seed, whole + 0.1 * seed)
    part(tmp_path, "no_tv", 1, 24.0)
    rows = page_of(tmp_path)[0].split("## Table 5")[1]
    assert rows_of(rows, "w/o total variation")[0][2:5] == ["24.00", "-2.00", "holds (1 of 2 seeds)"]
    assert rows_of(rows, "w/o flow L1")[0][4] == "within noise"


def test_kinds_of_test_views_have_sections_of_their_own(tmp_path):
    for variant, changes in (("full", (0.0, 0.0, 0.0)), ("no_inpainter", (-1.0, 1.0, 0.5))):
        folder = part(tmp_path, variant, 0, 25.0, scene="lift", dataset="lego_complete")
        metrics = json.loads((folder / "metrics.json").read_text())
        kinds = zip(("space", "time", "canonical"), changes, strict=True)
        metrics["test"] = {kind: {"psnr": 25.0 + change} for kind, change in kinds}
        (folder / "metrics.json").write_text(json.dumps(metrics))
    text, _ = page_of(tmp_path)
    head, rows = "## Table 4: Lego Complete, by ability: {} interpolation, lift\n", []
    for kind in ("Space", "Time", "Canonical"):
        section = text.split(head.format(kind))[1].split("## ")[0]
        rows += [rows_of(section, "Ours, no inpainter (80^3)")[0][1:4]]
    assert rows == [["-0.97", "24.00", "-1.00"], ["-0.95", "26.00", "+1.00"], ["-1.72", "25.50", "+0.50"]]


def test_scenes_have_sections_of_their_own(tmp_path):
    for name, dataset, made in (("rig", "hypernerf", True), ("hook", "dnerf", True)):
        for variant, psnr in (("full", 25.0), ("no_inpainter", 24.0)):
            part(tmp_path, variant, 0, psnr, scene=name, dataset=dataset, made=made)
    for number, scene in enumerate(("vrig-3dprinter", "broom2", "vrig-chicken", "vrig-peel-banana")):
        for variant, psnr in (("full", 25.0), ("no_inpainter", 25.0 + number)):
            part(tmp_path, variant, 0, psnr, scene=scene, dataset="hypernerf", made=False)
    text, _ = page_of(tmp_path)
    heads = [line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")]
    assert heads.pop(0) == "In short"
    assert heads == ["Table 6: modules: HyperNeRF", "Table 6: modules: hook", "Table 6: modules: rig"]
    printed = {head: rows_of(text.split(f"## {head}\n")[1], "Ours, no inpainter")[0][1:5] for head in heads}
    assert printed[heads[0]] == ["-0.98", "26.50", "+1.50", "one seed"]  # a mean of four scenes
    assert printed[heads[1]] == ["-0.90", "24.00", "-1.00", "one seed"]
    assert printed[heads[2]] == ["-0.98", "24.00", "-1.00", "one seed"]
    assert "noise unknown" in text


def test_some_scenes_of_a_mean_are_beside_its_printed_row(tmp_path):
    for scene in ("hook", "mutant"):
        part(tmp_path, "full", 0, 25.0, scene=scene, made=False)
        part(tmp_path, "no_tv", 0, 24.0, scene=scene, made=False)
    old = part(tmp_path / "again", "no_tv", 0, 29.0, scene="hook", made=False)
    os.utime(old / "metrics.json", (0, 0))
    text, _ = page_of(tmp_path)
    section = text.split("of which mutant, hook\n")[1].split("## ")[0]
    assert rows_of(section, "w/o total variation")[0][1:5] == ["-0.45", "24.00", "-1.00", "one seed"]
    assert f"{old}: another run of the same is newer" in text.split("## Left out")[1]


def test_without_ablations_there_is_no_page(tmp_path):
    write_run(tmp_path, "plain")
    with pytest.raises(
        ValueError, match="expected runs of ablations, but got none; make some with make ablations"
    ):
        write_ablation(tmp_path, tmp_path / "out")
