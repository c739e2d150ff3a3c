"""Which runs belong together: two settings are never pooled as seeds, and none is dropped without a word."""

import os
import re
import shlex
import time

import pytest
import yaml

from forewarp.report.benchmark import write_methods, write_minutes
from forewarp.report.choices import write_accuracy_time, write_effects, write_price_list
from forewarp.report.paper import write_ablation, write_paper
from forewarp.report.results import read_runs
from forewarp.report.settings import NOT_COUNTED, configuration, typed, words_of
from tests.support.configs import ROOT
from tests.support.runs_on_disk import rows_of, write_run

# PSNR of --multirun objective.fine.weights.rigid=1,0 seeds=2. By hand: the means are 31 and 29.5 dB, the
# differences by seed are -1 and -2, and their mean -1.5. Of two seeds both values stand in brackets.
FOUND = {("1", 0): 30.0, ("1", 1): 32.0, ("0", 0): 29.0, ("0", 1): 30.0}
RIGID = "objective.fine.weights.rigid"


def multirun(root, found=FOUND, key=RIGID, metrics=None, **more):
    """The runs of a sweep over the values of a key and seeds; the first value is measured first."""
    for at, ((value, seed), psnr) in enumerate(found.items()):
        config = {}
        for part in reversed(key.split(".")):
            config = {part: config or yaml.safe_load(value)}
        ablation = more.get("ablation")
        named = {"name": ablation, "about": f"the {ablation}", "against": "full"} if ablation else None
        config |= {"variant": named, "data": {"scene": "ball", "seed": seed}, **more.get("config", {})}
        about = {"dataset": "dnerf", "synthetic": True, "background": "white", "clock": "processor"}
        words = f"forewarp-train seed={seed} {key}={value} paths.runs=here logger=none"
        named = {"psnr": psnr, "command": words, "minutes": more.get("minutes", 1.0)}
        folder = write_run(
            root / value / str(ablation),
            "run",
            seed,
            config=config,
            **named,
            metrics={"protocol": about} | (metrics or {}),
        )
        os.utime(folder / "metrics.json", (at, at))
    return root


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_accuracy_time, write_paper, write_minutes, write_methods])
def test_two_settings_are_two_rows_of_two_seeds(tmp_path, write):
    text = write(multirun(tmp_path / "runs"), tmp_path / "out")[0].read_text()
    rows = [line for line in text.splitlines() if re.search(r"\brigid=[01]\b", line) and line[0] == "|"]
    for value, mean in (("1", "31.00 (30.00, 32.00)"), ("0", "29.50 (29.00, 30.00)")):
        if write is write_accuracy_time:  # whose PSNR is of the curve, the same for all
            assert rows_of(text, f"rigid={value}")[0][2] == "2"
        else:
            assert [line for line in rows if f"rigid={value}" in line and mean in line], (value, text)
    assert "is newer" not in text


def test_the_price_list_compares_with_what_was_measured_first(tmp_path):
    text = write_price_list(multirun(tmp_path / "runs"), tmp_path / "out")[0].read_text()
    assert rows_of(text, "rigid=1")[0][1:3] == ["2", "31.00 (30.00, 32.00)"]
    assert rows_of(text, "rigid=0")[0][1:4] == ["rigid=1", "2", "-1.50 (-2.00, -1.00)"]


def test_choices_and_parts_of_the_method_are_not_pooled_either(tmp_path):
    for ablation in ("auto", "base"):
        multirun(tmp_path / "effects", ablation=ablation)
    text = write_effects(tmp_path / "effects", tmp_path)[0].read_text()
    assert rows_of(text, "ball, rigid=1")[0][1:5] == ["2", "1", *["31.00 (30.00, 32.00)"] * 2]
    assert rows_of(text, "ball, rigid=0")[0][1:5] == ["2", "1", *["29.50 (29.00, 30.00)"] * 2]
    multirun(tmp_path / "parts", ablation="full")
    multirun(tmp_path / "parts", {key: psnr - 1 for key, psnr in FOUND.items()}, ablation="no_tv")
    text = write_ablation(tmp_path / "parts", tmp_path)[0].read_text()
    (row,) = {tuple(row) for row in rows_of(text, "Ours, no total variation")} or [()]
    assert [cell for cell in row if "00)" in cell] == [
        *("28.50 (28.00, 29.00)", "-1.00 (-1.00, -1.00)"),  # rigid=0
        *("30.00 (29.00, 31.00)", "-1.00 (-1.00, -1.00)"),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_accuracy_time, write_price_list])
def test_runs_of_other_steps_or_views_are_no_seeds(tmp_path, write):
    for seed, more in enumerate(({"iterations": 100}, {"iterations": 200}, {"threads": 1})):
        budget = {"budget": {"minutes": None, "iterations": more.get("iterations", 200)}}
        protocol = {"threads": more.get("threads", 2)}
        write_run(
            tmp_path / "runs",
            "x",
            seed,
            against=None,
            config=budget | {"variant": None},
            command="forewarp-train",
            metrics={"protocol": protocol},
            psnr=30.0 + seed,
        )
    text = write(tmp_path / "runs", tmp_path)[0].read_text()
    cells = {cell.strip() for line in text.splitlines() for cell in line.split("|")}
    names = {cell for cell in cells if cell.count(" at most") == 1}  # several share a row of the cheapest
    steps = "forward-fast, threads: {}, {} steps at most"
    assert names == {steps.format(2, 100), steps.format(2, 200), steps.format(1, 200)}


def test_of_the_same_run_again_the_newest_stands_and_the_other_is_named(tmp_path):
    multirun(tmp_path / "runs" / "old")
    for folder in multirun(tmp_path / "runs" / "new", {("1", 0): 40.0}).rglob("metrics.json"):
        os.utime(folder, (99, 99))
    runs, left_out = read_runs(tmp_path / "runs")
    assert sorted(row["psnr"] for row in runs.where(variant="rigid=1")) == [32.0, 40.0]
    assert left_out == ["old/1/None/ball/run-1.0-seed0: another run of the same is newer"]


def test_a_difference_that_nobody_typed_is_named_by_the_fewest_keys(tmp_path):
    model = {"name": "forward", "parts": {"_target_": "theirs.Wide", "width": 8, "depth": 2}, "gain": 0.5}
    changes = [{}, {"parts": None}, {"parts": {"_target_": "theirs.Thin", "width": 4}}, {"gain": 1}]
    for number, change in enumerate(changes):
        config = {"model": model | change, "variant": None}
        write_run(tmp_path / str(number), command="forewarp-train", config=config)
    runs, _ = read_runs(tmp_path)
    assert [row["variant"] for row in runs] == [
        *("gain=0.5 parts=Wide", "gain=0.5 parts=null", "gain=0.5 parts=Thin", "gain=1 parts=Wide"),
    ]


def test_what_does_not_count(tmp_path):
    train = yaml.safe_load((ROOT / "conf" / "train.yaml").read_text()).keys()
    known = {key.split(".")[0] for key in NOT_COUNTED} - {"data", "trainer"}
    elsewhere = {"paths", "logger", "variant", "capture"}  # groups, and the key of ablations
    elsewhere |= {"renders"}  # of forewarp-evaluate
    assert known - elsewhere <= train
    counted = {"defaults", "start", "target", "budget", "hydra"}
    assert train - known - counted == set()
    config = {"seed": 3, "run": "a", "data": {"scene": "x", "root": "/a", "seed": 3}, "stage": None}
    config |= {"callbacks": {"scalars": {"_target_": "forewarp.training.callbacks.Scalars", "every": 20}}}
    own = configuration(config)
    assert own == {"data.scene": "x"}
    for same in (
        {"run": "b"},
        {"seed": 4, "data": {"scene": "x", "root": "/b", "seed": 4}},
        {"logger": {"a": 1}},
    ):
        assert configuration(config | same) == own
    others = [{"data": config["data"] | {"seed": 5}}, {"stage": {"fine": {"share": 1}}}, {"theirs": 1}]
    others += [{"callbacks": {"mean": {"_target_": "theirs.Mean"}}}, {"start": "a/seed3-still"}]
    for other in others:
        assert configuration(config | other) != own
    assert configuration({"seed": 0, "start": "x-seed0/still"}) == configuration(
        {"seed": 1, "start": "x-seed1/still"}
    )
    drawn = [{"root": f"/a/seed{seed}", "synthesis": {"seed": seed}} for seed in (0, 1)]
    specimens = [
        configuration({"seed": n, "data": data}, {"texts": {"a": n}}) for n, data in enumerate(drawn)
    ]
    assert specimens == [{}, {}]  # whose cameras are other ones for each seed
    fixed = [configuration({"seed": n, "data": {"root": "/a", "synthesis": {"seed": 0}}}) for n in (0, 1)]
    assert fixed == [{"data.synthesis.seed": 0.0}] * 2
    assert configuration(config, {"texts": {}}) != configuration(config, {"texts": {"a": "b"}}) != own


def planned(root, seed=0, motion="spline", **more):
    """A run that planned its motion, and nothing else."""
    model = {"name": "particles", "motion": {"name": motion}, **more}
    command = f"forewarp-train seed={seed} effects=auto experiment={root.name}"
    config = {"effects": "auto", "model": model, "variant": None}
    folder = write_run(root, "auto", seed, command=command, config=config)
    (folder / "plan.yaml").write_text(f"overrides: [model=particles, model/motion={motion}]\n")


def test_a_plan_may_choose_otherwise_from_seed_to_seed(tmp_path):
    for seed, motion in enumerate(("spline", "none")):
        planned(tmp_path, seed, motion)
    runs, _ = read_runs(tmp_path)
    assert [row["setting"] for row in runs] == ["", ""]


def test_what_a_plan_leaves_alone_tells_planned_runs_apart(tmp_path):
    for width, name in ((64.0, "a"), (32.0, "b")):  # of two experiments
        for seed in range(2):
            planned(tmp_path / name, seed, ("spline", "none")[seed], renderer={"width": width})
    runs, _ = read_runs(tmp_path)
    assert {row["folder"].parts[-3]: row["variant"] for row in runs} == {"a": "width=64", "b": "width=32"}
    assert len(runs) == 4


@pytest.mark.parametrize("word", ["", " ", "~stage.coarse"])
def test_an_empty_word_of_a_command_sets_nothing(word):
    assert [*typed(shlex.join(["forewarp-train", word, "seed=0"])).values()] == [word] * (word[:1] == "~")


def test_a_command_of_many_spaces_is_split_in_a_moment():
    began = time.perf_counter()
    assert words_of("a=1" + " " * 300_000 + "b") == ["a=1b"]
    assert time.perf_counter() - began < 5
