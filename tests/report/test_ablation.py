"""The page of ablations, of runs that nobody trained."""

import json
import os

import pytest
import yaml

from forewarp.metrics.gain import pooled_deviation
from forewarp.report.ablation import write_ablation
from tests.support.runs_on_disk import rows_of, write_run


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


def test_noise_is_pooled_around_each_rows_own_mean():
    assert pooled_deviation([[0.0, 2.0], [10.0, 12.0]]) == pytest.approx(2**0.5)
    assert pooled_deviation([[1.0], []]) is None
