"""Pages of choices, of runs that nobody trained: accuracy against time, the price list, effects."""

import json
import os

import pytest
import yaml

from forewarp.report import figures
from forewarp.report.benchmark import Published
from forewarp.report.choices import (
    choices,
    write_accuracy_time,
    write_effects,
    write_price_list,
    write_search,
)
from forewarp.report.results import read_runs
from tests.support.runs_on_disk import rows_of, write_run

SLOW, QUICK = ((10, 20.0), (20, 24.0), (40, 25.0)), ((5, 24.0), (10, 24.9), (20, 26.0))


@pytest.fixture(autouse=True)
def unsaved(monkeypatch):
    """Pictures are not laid out and written, which takes most of the time."""
    monkeypatch.setattr(figures, "save", lambda figure, path: path)


def test_each_decibel_names_the_first_to_reach_it_in_all_seeds(tmp_path):
    runs = tmp_path / "runs"
    write_run(runs, "base", 0, curve=((10, 24.0), (20, 25.2), (40, 25.5)))
    write_run(runs, "base", 1, curve=((10, 24.5), (30, 25.2), (40, 25.5)))
    write_run(runs, "good", 0, curve=((15, 22.0), (60, 27.0), (61, 27.5)))
    write_run(runs, "lucky", 0, curve=((1, 25.5), (2, 27.0), (3, 27.0)))
    page, picture, table = write_accuracy_time(runs, tmp_path / "out")
    text = page.read_text()
    assert rows_of(text, "24")[0][1:] == ["<= 1.0", "reached before the first evaluation", ""]
    # A third of the dB from 1 to 2 s: 2^(1/3); one seed each, so that no difference is shown.
    assert rows_of(text, "26") == [["26", "1.3", "lucky, good", "`forewarp-train variant=lucky seed=0`"]]
    assert rows_of(text, "27")[0][1:3] == ["2.0", "lucky, good"]
    assert rows_of(text, "28") == []
    assert "seconds to 25 dB" in text  # what the base reaches
    assert rows_of(text, "base")[0][1:] == [
        "1",
        "2",
        "19.9 (17.8, 21.9)",  # 10 * 2^(1/1.2) and 10 * 3^(0.5/0.7)
        "2 of 2",
        "25.50 (25.50, 25.50)",
        "",
        "100 (100, 100)",
    ]
    csv = table.read_text().splitlines()
    assert csv[0].startswith(
        "variant,minutes,seeds,seconds to 25 dB,seconds to 25 dB ci95,seconds to 25 dB n,reached"
    )
    assert (len(csv), picture.name) == (4, "accuracy-time-ball.png")


def test_a_target_of_ones_own_and_what_has_no_curve(tmp_path):
    about = {"protocol": {"dataset": "dnerf", "device": "a cpu", "threads": 2, "versions": {"torch": "2"}}}
    write_run(tmp_path / "runs", epe=0.25, minutes=0.05, metrics=about)
    write_run(tmp_path / "runs", "failed", curve=None)
    write_run(tmp_path / "runs", "killed", psnr=None)
    others = [Published(name, 100.0, 32.0, "a GPU", "its paper", name) for name in ("dnerf", "hypernerf")]
    (tmp_path / "others.yaml").write_text(yaml.safe_dump([other._asdict() for other in others]))
    options = {"target": 20.0, "published": tmp_path / "others.yaml"}
    page = write_accuracy_time(tmp_path / "runs", tmp_path, **options)[0].read_text()
    assert rows_of(page, "base")[0][1:7] == ["0.05", "1", "<= 10.0", "1 of 1", "25.50", "0.2500"]
    assert "* ball/failed-1.0-seed0: no accuracy_time.csv; run its command with data.held_out=8" in page
    assert "* ball/killed-1.0-seed0: no metrics.json; run its command again" in page
    assert not rows_of(page, "killed")
    assert "* dnerf: 32 dB, 100 s, a GPU; its paper" in page
    assert "* hypernerf" not in page  # whose means say nothing of this scene


def test_runs_that_miss_the_target_that_all_had_are_counted(tmp_path):
    common = {"config": {"target": {"psnr": 24.5, "plateau": None}}}
    ends = {0: ((10, 20.0), (20, 24.5), (22, 24.7)), 1: ((10, 20.0), (30, 24.5), (33, 24.9))}
    ends |= {2: ((10, 20.0), (40, 24.9), (60, 24.4)), 3: ((10, 20.0), (40, 24.5), (41, 24.5))}
    for seed, curve in ends.items():
        write_run(tmp_path / "runs", "base", seed, curve=curve, **common)
    write_run(tmp_path / "runs", "never", curve=((10, 20.0), (60, 24.4)), **common)
    text = write_accuracy_time(tmp_path / "runs", tmp_path / "out")[0].read_text()
    assert "seconds to 24.5 dB" in text
    # 20, 30 and 40 s: a deviation of 10, times 4.303 / sqrt(3).
    assert rows_of(text, "base")[0][2:5] == ["4", "30.0 ± 24.8", "3 of 4"]
    assert rows_of(text, "never")[0][3:5] == ["", "0 of 1"]
    # All four reach 24 dB, after 18.5, 26.6, 31.0 and 34.3 s: a deviation of 6.83, times 3.182 / 2.
    assert rows_of(text, "24")[0][1:3] == ["27.6 ± 10.9", "base"]


@pytest.mark.slow
def test_a_winner_is_named_where_three_seeds_show_it_and_else_who_shares_the_row(tmp_path):
    rows = (2, 20.5), (8, 24.5), (16, 26.0), (20, 26.0)
    for seed, factor in enumerate((100, 110, 90)):
        for variant, times in (("base", factor), ("near", 202 - factor)):
            write_run(tmp_path, variant, seed, curve=[(times * s, psnr) for s, psnr in rows])
        quick = [(factor * s // 2, psnr) for s, psnr in rows[:2]]
        write_run(tmp_path, "quick", seed, curve=[*quick, (9000, 24.5)])
    text = write_accuracy_time(tmp_path, tmp_path / "out")[0].read_text()
    assert rows_of(text, "24")[0][2:] == ["quick", "`forewarp-train variant=quick seed=0`"]
    assert rows_of(text, "25")[0][2] == "base, near"


def test_runs_that_a_target_ended_are_not_at_equal_minutes(tmp_path):
    for variant, reached in (("base", "target.psnr"), ("never", None)):
        target = {"psnr": 24.5, "plateau": None, "reached": reached}
        write_run(tmp_path / "runs", variant, minutes=3.0, metrics={"target": target})
    text = write_accuracy_time(tmp_path / "runs", tmp_path)[0].read_text()
    assert "Budget of at most 3 minutes; runs ended by target.psnr=24.5 after the seconds trained" in text
    assert "At equal minutes" not in text
    assert rows_of(text, "never")[-1][-1] == "50.0"
    write_run(tmp_path / "steps", minutes=None)
    text = write_accuracy_time(tmp_path / "steps", tmp_path)[0].read_text()
    assert "Budget of the steps of each; the steps that were done:" in text


def test_some_training_views_are_no_seed_of_all_of_them(tmp_path):
    few = {"protocol": {"train_views": 16}}
    write_run(tmp_path / "a", "base", 0)
    write_run(tmp_path / "b", "base", 1, metrics=few)
    write_run(tmp_path / "b", "data.train_views=16", 0, metrics=few)  # whose number is the choice
    page, *files = write_accuracy_time(tmp_path, tmp_path / "out")
    _, all_views, some_views = page.read_text().split("## ball")
    assert rows_of(all_views, "base")[0][2] == rows_of(some_views, "base")[0][2] == "1"
    assert rows_of(all_views, "data.train_views=16")
    assert some_views.startswith(" (16 training views)\n")
    assert files[-1].name == "accuracy-time-ball-16-training-views.csv"


def test_changes_are_against_the_same_seed(tmp_path):
    runs = tmp_path / "runs"
    write_run(runs, "base", 0, psnr=30.0, epe=0.2)
    write_run(runs, "base", 1, psnr=28.0, epe=0.2)
    write_run(runs, "base", 2, psnr=29.0, epe=0.2)
    write_run(runs, "grid_64", 0, psnr=29.0, steps=200, epe=0.1)
    write_run(runs, "grid_64", 1, psnr=27.5, steps=200, epe=0.1)
    write_run(runs, "grid_64", 2, psnr=28.25, steps=200, epe=0.1)
    write_run(runs, "unet_16", 0, psnr=30.5, steps=50, against="grid_64")
    # Named by what was typed; what all of them share is no part of their names.
    of_cube = {"scene": "cube", "against": None}
    write_run(runs, "data.box=auto", 4, psnr=20.0, **of_cube)
    write_run(runs, "data.box=auto preset.rays=64", 4, psnr=21.0, **of_cube)
    backward = {"model": {"name": "backward"}}
    write_run(runs, "data.box=auto model=backward preset.rays=64", 4, psnr=21.5, config=backward, **of_cube)
    write_run(runs, "alone", 5)
    write_run(runs, "failed", psnr=None)
    page, file = write_price_list(runs, tmp_path / "out")
    text = page.read_text()
    own, change = rows_of(text, "grid_64")
    # Deviations of 0.75 and, of the changes -1.0, -0.5 and -0.75, of 0.25; times 4.303 / sqrt(3).
    assert own[1:3] == ["3", "28.25 ± 1.86"]
    assert change[1:5] == ["base", "3", "-0.75 ± 0.62", "0.0000 ± 0.0000"]
    # PSNR, SSIM and EPE; the other changes are of one seed.
    assert "3 differences are of three seeds or more; by chance 0.15 of their intervals" in text
    half, same, twice = (f"×{x} (×{x} to ×{x})" for x in ("0.50", "1.00", "2.00"))
    assert change[5:] == ["-0.1000 ± 0.0000", half, same, same, same, twice]
    assert rows_of(text, "unet_16")[0][1:6] == ["grid_64", "1", "+1.50", "0.0000", ""]
    assert rows_of(text, "rays=64")[1][1:4] == ["base", "1", "+1.00"]
    assert rows_of(text, "backward-fast rays=64")[0][1:4] == ["rays=64", "1", "+0.50"]
    assert len(rows_of(text, "base")) == 2  # of each scene
    assert rows_of(text, "alone")[0][2:4] == ["0", ""]  # nothing to compare it with
    assert "Of all test views:" in text
    assert "* ball/failed-1.0-seed0: no metrics.json" in text
    lines = file.read_text().splitlines()
    assert lines[0].startswith("scene,variant,ablation,against,")
    assert len(lines) == 12


def test_scenes_and_minutes_stand_apart_and_the_page_is_named_after_most_runs(tmp_path):
    for scene, minutes, model in (("ball", 1.0, "balls"), ("ball", 3.0, "balls"), ("cube", None, "forward")):
        write_run(tmp_path, scene=scene, minutes=minutes, ability="time", config={"model": {"name": model}})
    page, table = write_price_list(tmp_path, tmp_path / "out")
    assert (page.name, table.name) == ("price-list-balls.md", "price-list-balls.csv")
    text = page.read_text()
    heads = [line for line in text.splitlines() if line.startswith("## ")]
    assert heads == ["## ball, 1 minutes", "## ball, 3 minutes", "## cube, bounded by steps"]
    assert "Of test views between the training times:" in text


def test_a_price_list_says_what_is_true_of_its_runs(tmp_path):
    for seed, seconds in enumerate((0.005, 0.008, 0.008)):
        cost = {"seconds": {"train": 50.0, "render_per_frame": seconds}}
        write_run(tmp_path / "runs", "base", seed, metrics=cost)
    text = write_price_list(tmp_path / "runs", tmp_path)[0].read_text()
    # A deviation of 0.001732, times 4.303 / sqrt(3).
    assert "0.00700 ± 0.00430" in rows_of(text, "base")[0]
    assert "kind=price_list`. Runs have equal minutes of training, so unequal steps. Metrics" in text
    assert "shows no difference; its ends say how large one may be" in text
    write_run(tmp_path / "steps", minutes=None)
    text = write_price_list(tmp_path / "steps", tmp_path)[0].read_text()
    assert "Written by `forewarp-report kind=price_list`. Metrics" in text


def write_choice(root, choice, *, scene="ball", seed=0, on=(), psnr=30.0, model="forward"):
    """A run of a choice; of ``auto`` with its plan."""
    more = {"scene": scene, "psnr": psnr, "against": "base"}
    folder = write_run(root, choice, seed, **more, config={"model": {"name": model}})
    if choice == "auto":
        choices = {name: "x" if name in on else "none" for name in ("motion", "view")}
        effects = {n: {"choice": c, "on": n in on, "because": f"{n}, 3 %"} for n, c in choices.items()}
        plan = {"overrides": [], "effects": effects, "seconds": 12.5, "evidence": {}}
        (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    return folder


def test_the_page_of_effects_compares_with_the_best_and_says_why(tmp_path):
    for seed, gain in ((0, 0.9), (1, 1.1), (2, 1.0)):
        write_choice(tmp_path / "runs", "auto", seed=seed, on=["motion"], psnr=31.0 + gain)
        write_choice(tmp_path / "runs", "base", seed=seed, psnr=31.0)
        write_choice(tmp_path / "runs", "no_effects", seed=seed, psnr=20.0)
    write_choice(tmp_path / "runs", "auto", scene="hook", on=["motion", "view"], psnr=27.0)
    write_choice(tmp_path / "runs", "all_effects", scene="hook", psnr=28.0)
    write_choice(tmp_path / "more", "auto", on=["view"], model="particles")
    page, table, *others = write_effects(tmp_path, tmp_path / "out")
    assert [file.name for file in others] == ["effects-particles.md", "effects-particles.csv"]
    assert others[0].read_text().startswith("# Only the effects a scene calls for: model=particles")
    text = page.read_text()
    (ball,), (hook,) = (rows_of(text.partition("## Why")[0], name) for name in ("ball", "hook"))
    assert ball[3:5] == ["32.00 ± 0.25", "31.00 ± 0.00"]
    assert ball[-3:] == ["+1.00 ± 0.25", "above, the preset", "12.5 ± 0.0"]
    assert hook[-3:] == ["-1.00", "one seed, every effect", "12.5"]
    assert ["hook", "view", "x", "view, 3 %"] in rows_of(text.partition("## Why")[2], "hook")
    assert len(table.read_text().splitlines()) == 12


def test_seeds_are_paired_and_what_is_missing_is_empty(tmp_path):
    for seed, psnr in ((0, 30.0), (1, 30.55)):
        write_choice(tmp_path, "auto", seed=seed, psnr=psnr)
    write_choice(tmp_path, "all_effects", seed=1, psnr=30.5)
    write_choice(tmp_path, "auto", scene="hook")
    ball, hook = choices(read_runs(tmp_path)[0]).rows
    assert (ball[-3].mean, ball[-2]) == (pytest.approx(0.05), "one seed, every effect")
    assert hook[-4:-1] == [None, None, ""]


def test_of_two_runs_of_a_choice_the_last_one_counts(tmp_path):
    write_choice(tmp_path / "a", "auto", psnr=20.0)
    last = write_choice(tmp_path / "b", "auto", psnr=31.0)
    os.utime(last / "metrics.json", (2e9, 2e9))
    text = write_effects(tmp_path, tmp_path / "out")[0].read_text()
    assert rows_of(text, "ball")[0][3] == "31.00"


def write_trial(root, trial, metric, score, views, command):
    """A trial of a search; None for ``score``: it failed."""
    more = {"command": command, "config": {"score": metric}, "steps": 100 + trial}
    run = write_run(root, f"t{trial}", psnr=None, **more)
    if score is not None:
        (run / "score.json").write_text(json.dumps({"views": views, "scores": {metric: score}}))


def test_trials_of_a_search_are_listed_the_best_first(tmp_path, in_tmp):
    runs = tmp_path / "runs"
    for trial, (rate, score) in enumerate([("0.001", 20.0), ("0.01", 25.5), ("3e-3", 22.0), ("0.1", None)]):
        words = f"forewarp-train model=balls preset=demo stage.fine.lr.place={rate} data.root=/home/me/scenes"
        write_trial(runs, trial, "psnr", score, "8 held out views", words)
    page, table = write_search(runs, tmp_path / "out")
    text, lines = page.read_text(), table.read_text().splitlines()
    assert "## ball, forward, by psnr of 8 held out views" in text
    assert rows_of(text, "1") == [["1", "0.01", "25.50", "101", "50.0"]]
    assert [line.split(",")[1] for line in lines[1:]] == ["0.01", "0.003", "0.001"]
    assert lines[0].split(",")[:2] == ["rank", "stage.fine.lr.place"]
    command = f"{words.split(' stage')[0]} stage.fine.lr.place=0.01 data.root=SCENES"
    assert f"\n{command} run=runs/best/ball/forward-fast-seed0\n" in text
    assert "unless one is named; replace SCENES by your folder:\n" in text
    assert "t3-1.0-seed0: no score.json; run its command again" in text


def test_the_best_of_a_search_for_a_small_score_is_the_smallest(tmp_path, in_tmp):
    for trial, score in enumerate([0.3, 0.1]):
        write_trial(tmp_path, trial, "lpips_squeeze", score, "2 views", f"forewarp-train preset.rays={trial}")
    (in_tmp / "runs/best/ball/forward-fast-seed0").mkdir(parents=True)  # an earlier one
    text = write_search(tmp_path, tmp_path / "out")[0].read_text()
    best = "preset.rays=1 model=forward preset=fast run=runs/best/ball/forward-fast-seed0-2\n```"
    assert best in text  # model and preset were the sweep's
    assert "is named:\n" in text
