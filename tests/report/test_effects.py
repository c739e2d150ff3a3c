"""The page of effects, of runs that nobody trained."""

import os

import yaml

from forewarp.report.collect import collect
from forewarp.report.effects import called, compared, plan_of, write_effects
from tests.support.runs_on_disk import write_run

SLOW, QUICK = ((10, 20.0), (20, 24.0), (40, 25.0)), ((5, 24.0), (10, 24.9), (20, 26.0))


def write_choice(
    root, choice, *, scene="ball", seed=0, calls_for=None, on=(), psnr=30.0, curve=SLOW, model="forward"
):
    """A run of a choice; of ``auto`` with its plan."""
    own = {"calls_for": calls_for, "model": {"name": model}}
    more = {"scene": scene, "psnr": psnr, "curve": curve, "against": "all_effects"}
    folder = write_run(root, choice, seed, **more, config=own)
    if choice == "auto":
        effects = {
            name: {"choice": "x" if name in on else "none", "on": name in on, "because": f"{name}, 3 %"}
            for name in ("motion", "view")
        }
        trials = {name: {"psnr": 1.25, "noise": 0.5} for name in on}
        plan = {"typed": [], "overrides": [], "effects": effects, "seconds": 12.5}
        plan["evidence"] = {"trials": trials}
        (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    return folder


def lines_of(text, word):
    return [line for line in text.splitlines() if line.startswith(f"| {word} ")]


def test_the_page_compares_and_says_why(tmp_path):
    write_choice(tmp_path / "runs", "auto", calls_for=["motion"], on=["motion"], psnr=31.0, curve=QUICK)
    write_choice(tmp_path / "runs", "all_effects", calls_for=["motion"], psnr=30.0)
    write_choice(tmp_path / "runs", "auto", scene="hook", on=["motion", "view"], psnr=27.0)
    page, table = write_effects(tmp_path / "runs", tmp_path / "out")
    text = page.read_text()
    (row,) = lines_of(text.partition("## Other")[0], "ball")[:1]
    cells = [cell.strip() for cell in row.split("|")[2:-1]]
    assert cells == ["1", "31.00", "30.00", "+1.00", "10", "50", "12"]
    assert "1 of 1 plans turn on what is called for and nothing else" in text
    assert "* view: **x**. view, 3 %" in text.partition("### hook")[2]
    assert text.index("## Specimens") < text.index("## Other scenes") < text.index("## Why")
    assert len(table.read_text().splitlines()) == 4


def test_a_plan_that_turns_on_more_is_told(tmp_path):
    write_choice(tmp_path, "auto", calls_for=["motion"], on=["motion", "view"])
    write_choice(tmp_path, "auto", calls_for=[], on=[], seed=1)
    results, _ = collect(tmp_path)
    found = called(results)
    assert "1 of 2 plans" in found.caption
    assert [row[-1] for row in found.rows] == ["**otherwise**", "as made"]
    assert found.rows[1][2:4] == ["nothing", "nothing"]


def test_seeds_are_paired_and_what_is_missing_is_empty(tmp_path):
    for seed in (0, 1):
        write_choice(tmp_path, "auto", seed=seed, psnr=30.0 + seed)
    write_choice(tmp_path, "all_effects", seed=1, psnr=30.5)
    write_choice(tmp_path, "auto", scene="hook")
    results, _ = collect(tmp_path)
    rows = compared(results).rows
    assert rows[0][4].mean == 0.5  # of the second seed alone
    assert rows[1][3:7] == [None, None, None, None]
    assert rows[2][3] is None
    assert [plan_of(run).get("seconds") for run in results if run.variant == "auto"] == [12.5] * 3


def test_of_two_runs_of_a_kind_the_last_one_counts(tmp_path):
    write_choice(tmp_path / "a", "auto", psnr=20.0)
    last = write_choice(tmp_path / "b", "auto", psnr=31.0)
    os.utime(last / "metrics.json", (2e9, 2e9))
    results, _ = collect(tmp_path)
    assert compared(results).rows[0][2].mean == 31.0


def test_each_method_has_a_page_with_what_its_trials_gained(tmp_path):
    write_choice(tmp_path / "a", "auto", calls_for=[], on=["view"])
    write_choice(tmp_path / "b", "auto", calls_for=["motion"], on=["motion"], model="particles")
    files = write_effects(tmp_path, tmp_path / "out")
    assert [file.name for file in files] == [
        *("effects.md", "effects.csv"),
        *("effects-particles.md", "effects-particles.csv"),
    ]
    text = files[2].read_text()
    assert text.startswith("# Only the effects a scene calls for: model=particles")
    assert "1 of 1 plans" in text
    assert lines_of(text.partition("## What each effect is worth")[2], "ball")[0].split("|")[3].strip() == (
        "+1.25 ± 0.50"
    )
