"""Pages written anew from their own tables, without the runs."""

from functools import partial

import pytest
import yaml

from forewarp.metrics import registry
from forewarp.metrics.registry import Metric, metric_of
from forewarp.report import figures
from forewarp.report.benchmark import write_methods, write_minutes
from forewarp.report.choices import write_effects, write_price_list
from forewarp.report.paper import write_ablation
from tests.support.runs_on_disk import write_run

REST = {"preset": {"name": "compact"}, "budget": {"minutes": None, "iterations": 9}}
CURVE = ((0, 20.0), (80, 25.0), (90, 25.5), (100, 25.25))
LEGO = {"dataset": "lego_complete", "synthetic": True, "clock": "processor"}
TOY = {"dataset": "dnerf", "synthetic": True}


@pytest.fixture(autouse=True)
def unsaved(monkeypatch):
    """Pictures are not written."""
    monkeypatch.setattr(figures, "save", lambda figure, path, *rest: path)


def ablation(root, made):
    """Runs at rest, and others, whose page keeps the part of the first."""
    for variant, change in (("full", 0.0), ("no_inpainter", 0.5)):
        for seed in range(3):
            psnr = 25.0 + seed + change * (1 + seed)
            tests = {kind: {"psnr": psnr + i} for i, kind in enumerate(("space", "time", "canonical"))}
            rest = {"protocol": TOY, "test": {"all": {"psnr": psnr}, "canonical": {"psnr": 20.0}}}
            write_run(root / "rest", variant, seed, curve=CURVE, config=REST, metrics=rest)
            protocol = {"protocol": LEGO, "test": tests}
            write_run(root / "lego", variant, seed, scene="lift", curve=None, metrics=protocol)
    write_ablation(root / "rest", made)
    return root / "lego", write_ablation


def effects(root, made):
    for seed in range(3):
        for choice, psnr in (("auto", 31.5), ("base", 31.0 + seed / 10)):
            folder = write_run(root, choice, seed, psnr=psnr)
            plan = {"motion": {"choice": "none", "on": False, "because": "still, 3 %"}}
            plan = {"effects": plan, "seconds": 2.5} if choice == "auto" else {}
            (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    return root, write_effects


def price_list(root, made):
    for seed in range(3):
        write_run(root, "base", seed, psnr=30.0 + seed, epe=0.25)
        write_run(root, "unet_16", seed, psnr=31.0 - seed, against="base")
    return root, write_price_list


def timed(write, root, made):
    for method in ("particles", "forward"):
        for seed in range(3):
            config = {"model": {"name": method}, "variant": None}
            write_run(root, method, seed, psnr=30.0 + seed, config=config, metrics={"protocol": TOY})
    return root, write


TABLES = {"effects.csv": effects, "price-list.csv": price_list, "ablation.csv": ablation}
TABLES |= {"ablation-at-rest.csv": ablation, "forward.csv": partial(timed, write_minutes)}
TABLES["methods.csv"] = partial(timed, write_methods)


@pytest.mark.slow
@pytest.mark.parametrize("table", TABLES)
def test_a_page_is_the_same_from_its_table(tmp_path, table):
    made = tmp_path / "made"
    made.mkdir()
    runs, write = TABLES[table](tmp_path / "runs", made)
    write(runs, made)
    texts = {file: file.read_text() for file in made.glob("*.md")}
    for file, text in texts.items():
        file.write_text(text if "ablation" in table else "of before\n")
    for _ in range(2):  # the second time from what the first wrote
        write(made / table, made)
        assert {file.name: file.read_text() for file in texts} == {f.name: text for f, text in texts.items()}
    assert "±" in "".join(texts.values())


def test_a_table_of_something_else_is_refused_in_one_line(tmp_path):
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    for name in ("other.csv; name a folder", "none.csv, which is not there"):
        with pytest.raises(ValueError, match=f"runs: expected a CSV file of a page, .*but got .*{name}"):
            write_effects(tmp_path / name[: name.index(".csv") + 4], tmp_path)


@pytest.mark.parametrize("table", ["price-list.csv", "forward.csv", "methods.csv"])
def test_a_table_keeps_which_way_a_metric_of_another_package_is_better(tmp_path, monkeypatch, table):
    about = {"title": "Blur", "digits": 1, "higher_is_better": False, "unit": "px", "summary": True}
    made = tmp_path / "made"
    made.mkdir()
    for seed in range(3):
        for variant, value in (("base", 3.0), ("unet_16", 2.0)):
            config = {} if table == "price-list.csv" else {"variant": None, "model": {"name": "forward"}}
            test = {"all": {"psnr": 30.0, "own_blur": value}}
            more = {"test": test, "metrics": {"own_blur": about}, "protocol": TOY}
            write_run(tmp_path / "runs", variant, seed, config=config, metrics=more)
    write = {"price-list.csv": write_price_list, "forward.csv": write_minutes, "methods.csv": write_methods}[
        table
    ]
    write(tmp_path / "runs", made)
    monkeypatch.setattr(registry, "_STORED", {})  # as where the table is read later
    write(made / table, made)
    assert metric_of("own_blur") == Metric("own_blur", **about)
    assert "Blur" in (made / table).with_suffix(".md").read_text()
