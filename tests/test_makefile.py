"""The commands that make's targets for the paper's tables and ablations would run."""

import shlex
import subprocess

import pytest
import yaml

from tests.support.configs import ROOT, options

FAKE = '#!/bin/sh\nprintf "%s" "$(basename $0)" >> "$SAID"\nprintf " %s" "$@" >> "$SAID"\necho >> "$SAID"\n'


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Run make with commands that only write down how they were called; return their calls."""
    for name in ("forewarp-train", "forewarp-report"):
        (tmp_path / name).write_text(FAKE)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("SAID", str(tmp_path / "said"))
    for word in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS"):  # of a make that runs the tests
        monkeypatch.delenv(word, raising=False)

    def run(line):
        words = ["make", "-C", str(ROOT), f"BIN={tmp_path}", "JOBS=1", *shlex.split(line)]
        subprocess.run(words, check=True, capture_output=True, text=True)
        return [set(call.split()) for call in (tmp_path / "said").read_text().splitlines()]

    return run


def called(calls, *words):
    """The calls that have all these words."""
    return [call for call in calls if call.issuperset(words)]


def test_tables_without_data_fit_all_methods_on_two_counterparts(made):
    *fits, report = made("reproduce-tables")
    assert report == {"forewarp-report", "kind=paper", "out=runs/paper/results", "curves=docs/results"}
    common = {"preset=demo", "budget.minutes=1", "seeds=1", "threads=1", "budget.clock=processor"}
    pairs = [
        ("methods", "dnerf"),
        ("nhr", "nhr"),
        ("methods", "hypernerf"),
        ("lego_complete", "lego_complete"),
    ]
    assert len(called(fits, *common)) == len(fits) == len(pairs)
    for sweep, dataset in pairs:
        assert len(called(fits, f"sweeps={sweep}", f"scene=counterpart_{dataset}")) == 1


@pytest.mark.parametrize("more", ["", " DATA=there SWEEPS=methods SCENES=hook"])
def test_the_published_numbers_are_not_cut_short_by_minutes(made, more):
    *fits, _ = made("reproduce-tables PRESET=faithful" + more)
    assert len(called(fits, "preset=faithful", "budget.minutes=null")) == len(fits) > 0


def test_methods_seeds_minutes_and_views_are_named_by_key(made):
    *fits, _ = made('reproduce-tables METHODS="dnerf ndvg" MINUTES=3 SEEDS=4,7 VIEWS=9 SWEEPS=all')
    assert len(called(fits, "budget.minutes=3", "seed=4,7", "views=9")) == len(fits) == 9
    own = called(fits, "model=dnerf,ndvg")
    assert [word for call in own for word in call if word.startswith("sweeps=")] == [
        *("sweeps=methods", "sweeps=nhr", "sweeps=methods", "sweeps=lego_complete")
    ]


def test_real_scenes_are_fitted_by_the_methods_named(made):
    words = (
        'reproduce-tables DATA=there METHODS="tnerf dnerf" SCENES="hook lego" SWEEPS="dnerf ablation_losses"'
    )
    own, ablations, report = made(words)
    common = {
        "preset=fast",
        "budget.minutes=5",
        "paths.scenes=there",
        "dataset=dnerf",
        "data.scene=hook,lego",
    }
    assert own > common | {"sweeps=dnerf", "model=tnerf,dnerf"}
    assert ablations > common | {"sweeps=ablation_losses", "absent=refuse"}
    assert not [word for word in ablations if word.startswith("model=")]
    assert "kind=paper" in report


def test_all_methods_are_those_of_their_sweep(made):
    own, _ = made("reproduce-tables DATA=there METHODS=all SWEEPS=dnerf")
    sweep = yaml.safe_load((ROOT / "sweeps" / "methods.yaml").read_text())
    assert f"model={sweep['hydra']['sweeper']['params']['model']}" in own


def test_scenes_alone_are_of_one_sweep(made):
    fit, _ = made('reproduce-tables DATA=there SCENES="hook lego"')
    assert fit > {"sweeps=dnerf", "dataset=dnerf", "data.scene=hook,lego", "absent=refuse"}


def test_ablations_of_real_scenes_are_both_sweeps(made):
    *fits, _ = made("reproduce-tables DATA=there SWEEPS=ablations")
    assert [fit & {"sweeps=ablation_modules", "sweeps=ablation_losses"} for fit in fits] == [
        {"sweeps=ablation_modules"},
        {"sweeps=ablation_losses"},
    ]


def test_ablations_are_run_for_equal_minutes_and_equal_steps(made):
    *fits, report = made("ablations MINUTES=0.1 STEPS=30")
    assert report == {"forewarp-report", "kind=ablation", "out=docs/results"}
    by_time = called(fits, "budget.minutes=0.1", "seeds=2")
    by_steps = called(fits, "budget.minutes=null", "budget.iterations=30", "seeds=2")
    assert len(by_time) == len(by_steps) == 4
    common = {
        "preset=demo",
        "threads=1",
        "budget.clock=processor",
        "stage.fine.share=2",
        "paths.runs=runs/ablations",
    }
    assert len(called(fits, *common)) == len(fits) == 8
    for group in (by_time, by_steps):
        (in_room,) = called(group, "scene=counterpart_hypernerf")  # no_coarse has no such stage
        others = [call for call in group if call is not in_room]
        assert [word for word in in_room if word.startswith("stage.coarse.")]
        assert not [word for call in others for word in call if word.startswith("stage.coarse.")]
        assert {word for call in group for word in call if word.startswith(("sweeps=", "scene="))} == {
            *("sweeps=ablation_losses", "sweeps=ablation_modules"),
            *(f"scene=counterpart_{dataset}" for dataset in ("dnerf", "hypernerf", "lego_complete")),
        }


def test_effects_of_particles_are_planned_on_all_specimens(made):
    fit, report = made("effects MODEL=particles")
    scenes = {name for name in options("scene") if name.startswith("specimen_")}
    assert {"sweeps=effects", "model=particles", "ablation=auto", "seeds=2"} < fit
    assert {scene for word in fit if word.startswith("scene=") for scene in word[6:].split(",")} == scenes
    assert report == {"forewarp-report", "kind=effects"}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("reproduce-tables SCENES=hook", "SCENES: expected DATA=<folder that holds dnerf/> beside it"),
        ("reproduce-tables SWEEPS=dnerf", "SWEEPS: expected all or ablations without DATA, but got dnerf"),
        ("reproduce-tables DATA=there SWEEPS=methods", 'SCENES: expected SCENES="hook ..." beside'),
        ("ablations DATA=there", "make reproduce-tables DATA=there SWEEPS="),
        ("ablations METHODS=ndvg", "DATA, METHODS: not for ablations"),
        ("effects MODEL=nerf", "MODEL: expected forward or particles, which can be planned, but got nerf"),
    ],
)
def test_words_that_would_have_no_effect_are_refused(made, line, expected):
    with pytest.raises(subprocess.CalledProcessError) as caught:
        made(line)
    assert expected in caught.value.stderr


def test_the_commands_choose_what_there_is(made):
    calls = made("reproduce-tables SWEEPS=all")
    words = {word for call in calls for word in call if word.startswith(("sweeps=", "scene="))}
    known = {f"{group}={name}" for group in ("sweeps", "scene") for name in options_of(group)}
    assert words
    assert words <= known


def options_of(group):
    return [path.stem for path in (ROOT / "sweeps").glob("*.yaml")] if group == "sweeps" else options(group)
