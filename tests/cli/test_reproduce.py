"""``forewarp-reproduce`` and the targets of the Makefile that call it."""

import shlex
import subprocess

import pytest

from forewarp.cli import reproduce
from forewarp.cli.reproduce import Keys, plan_of
from tests.support.configs import ROOT


def planned(line):
    """Return the sweeps, as sets of overrides, and the commands after them."""
    kind, *typed = shlex.split(line)
    job = plan_of(kind, Keys.typed(typed))
    return [set(sweep) for lane in job.lanes for sweep in lane], job.then


def test_tables_without_data_fit_all_methods_on_two_counterparts():
    sweeps, ((*_, out, curves),) = planned("tables")
    assert (out, curves) == ("out=runs/paper/results", "curves=docs/results")
    common = {"preset=demo", "budget.minutes=1", "seeds=1", "threads=1", "budget.clock=processor"}
    names = "methods:hypernerf methods:dnerf flow:drive nhr:nhr lego_complete:lego_complete"
    pairs = [pair.split(":") for pair in names.split()]
    for sweep, (name, data) in zip(sweeps, pairs, strict=True):
        assert sweep > common | {f"sweeps={name}", f"scene=counterpart_{data}"}


@pytest.mark.parametrize("more", ["", " DATA=there SWEEPS=methods SCENES=hook"])
def test_the_published_numbers_are_not_cut_short_by_minutes(more):
    sweeps, _ = planned("tables PRESET=faithful" + more)
    assert all({"preset=faithful", "budget.minutes=null"} < sweep for sweep in sweeps)


def test_real_scenes_are_fitted_by_the_methods_named():
    line = "tables DATA=there METHODS=tnerf,dnerf SCENES=hook,lego SWEEPS=dnerf,ablations SEEDS=4,7 VIEWS=9"
    (fits, *ablations), _ = planned(line)
    scenes = {"paths.scenes=there", "dataset=dnerf", "data.scene=hook,lego", "absent=refuse"}
    common = {"preset=fast", "budget.minutes=5", "seed=4,7", "views=9", *scenes}
    assert fits == common | {"sweeps=dnerf", "model=tnerf,dnerf", "score=null"}
    names = ["ablation_modules", "ablation_losses"]
    assert ablations == [common | {f"sweeps={name}", "score=null"} for name in names]


def test_all_methods_are_those_of_their_sweep():
    (sweep, *_), _ = planned("tables DATA=there METHODS=all SWEEPS=dnerf")
    (methods,) = [word for word in sweep if word.startswith("model=")]
    assert len(methods.split(",")) == 12


def test_ablations_are_run_for_equal_minutes_and_equal_steps():
    sweeps, ((*_, out),) = planned("ablations MINUTES=0.1 STEPS=30")
    assert out == "out=docs/results"
    for until in ({"budget.minutes=0.1"}, {"budget.minutes=null", "budget.iterations=30"}):
        alike = [sweep for sweep in sweeps if sweep >= until]
        assert len(alike) == 4
        in_room = [sweep for sweep in alike if any(word.startswith("stage.coarse.") for word in sweep)]
        assert in_room == [sweep for sweep in alike if "scene=counterpart_hypernerf" in sweep]


def test_ablations_at_rest_take_a_lane_a_seed_and_end_by_the_presets_steps():
    sweeps, ((*_, out),) = planned("ablations PRESET=compact DATA=there")
    assert out == "out=docs/results"
    common = {"sweeps=ablation_converged", "score=null", "paths.runs=runs/ablations", "paths.scenes=there"}
    assert sweeps == [common | {"seed=0"}, common | {"seed=1"}]
    sweeps, _ = planned("ablations PRESET=compact SEEDS=4,7 STEPS=30")
    for sweep, seed in zip(sweeps, ("seed=4", "seed=7"), strict=True):
        assert sweep >= {"budget.iterations=30", seed}


def test_changes_are_compared_with_the_reference():
    (reference, changed), _ = planned('accuracy-time MODEL=forward CHANGES="preset.rays=1024,2048"')
    assert changed == reference | {"preset.rays=1024,2048"}
    assert "model=forward" in reference
    sweeps, _ = planned("price-list DATA=there SCENES=hook MORE='views=2 sheets=0'")
    assert [("data.scene=hook" in sweep) for sweep in sweeps] == [False, True]
    assert all({"sweeps=price_list_particles", "views=2", "sheets=0"} < sweep for sweep in sweeps)


def test_small_runs_are_kept_apart():
    for line in ("ablations SMALL=1", "tables SMALL=1", "effects SMALL=1", "gpu SMALL=1", "demo SMALL=1"):
        sweeps, commands = planned(line)
        of_ablations = {"budget.minutes=0.02", "budget.iterations=8"}  # whose page has rows by kind of view
        short = of_ablations if "ablations" in line else {"budget.minutes=0.01", "budget.iterations=4"}
        assert all(len(sweep & short) == 1 for sweep in sweeps)
        assert all("runs/small" in " ".join(words) for words in [*sweeps, *commands])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("nothing", "expected one of demo, tables, .*, but got 'nothing'"),
        ("tables SCENE=hook", "a known key, but got 'SCENE=hook'; did you mean scenes="),
        ("tables hook", "expected key=value"),
        ("tables SCENES=hook", "scenes: expected data=<folder that holds dnerf/> beside it"),
        ("tables SWEEPS=dnerf", "sweeps: expected all or ablations without data=, but got dnerf"),
        ("tables DATA=there SWEEPS=methods", "scenes: expected scenes=hook,... beside sweeps=methods"),
        ("ablations PRESET=compact MINUTES=1", "expected none beside preset=compact"),
        ("ablations DATA=there", "forewarp-reproduce tables data=there sweeps=ablations"),
        ("price-list", "data: expected data=<folder"),
        ("price-list DATA=there MODEL=nerf", "model: expected particles or forward, but got 'nerf'"),
        ("effects MODEL=nerf", "model: expected particles or forward, but got 'nerf'"),
    ],
)
def test_words_that_would_have_no_effect_are_refused(line, expected):
    with pytest.raises(ValueError, match=expected):
        planned(line)


def test_a_failed_sweep_stops_no_other_and_its_status_is_kept(monkeypatch):
    called = []

    def call(name, arguments, prefix=""):
        called.append((name, prefix))
        return 2 if arguments == ["b"] else 0

    monkeypatch.setattr(reproduce, "_call", call)
    assert reproduce.run(reproduce.Job([[["a"], ["b"], ["c"]], [["d"]]], [["report", "kind=paper"]], 2)) == 2
    assert sorted(called) == sorted([("train", "1 | ")] * 3 + [("train", "2 | "), ("report", "")])


@pytest.mark.slow
def test_what_a_page_costs_lists_each_run_where_that_is_asked_for(in_tmp):
    job = plan_of("accuracy-time", Keys.typed(["changes=stage.fine.density=45,90", "more=trainer=cpu"]))
    first, *lines = reproduce.cost_of(job, listed=True)
    assert first == "3 jobs; 1 at a time"
    assert ["runs/accuracy_time/vehicle/" in line for line in lines].count(True) == 3
    assert not any("runs/accuracy_time" in line for line in reproduce.cost_of(job))


def test_make_hands_over_what_was_typed():
    words = ["make", "-n", "-C", str(ROOT), "reproduce-tables", "DATA=there", "SCENES=hook lego", "SEEDS=3"]
    said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    assert "forewarp-reproduce tables DATA='there' SCENES='hook lego' SEEDS='3'" in " ".join(said.split())


# Scenes as small as they may be, not in the checkout, where the demo would find them.
TINY = "paths.data=data data.synthesis.size=32 data.synthesis.frames=8 data.synthesis.test_views=[1,1,1] "
TINY += "data.held_out=2"
AT_REST = "scene=counterpart_dnerf preset=compact"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "page"),
    [
        ("gpu DEVICE=cpu", "bench-gpu/results/price-list.md"),
        (f"effects SEEDS=1 MORE='scene=specimen_still {TINY}'", "effects/results/effects-particles.md"),
        (f"ablations PRESET=compact SEEDS=1 MORE='{AT_REST} {TINY}'", "results/ablation.md"),
        (f"tables SEEDS=1 METHODS=nerf MORE='{TINY}'", "paper/results/paper.md"),
    ],
)
def test_the_small_form_writes_the_page(line, page, ok, in_tmp, monkeypatch):
    """In this process, and of one sweep where all of them would take minutes."""
    monkeypatch.setattr(reproduce, "COUNTERPARTS", "methods:dnerf ablation_losses:dnerf")
    kind, *typed = shlex.split(line)
    job = plan_of(kind, Keys.typed([*typed, "SMALL=1"]))
    for sweep in (sweep for lane in job.lanes for sweep in lane):
        ok("train", *(["--multirun"] if not any(word.startswith("run=") for word in sweep) else []), *sweep)
    for command in job.then:
        ok(*command)
    assert (in_tmp / "runs" / "small" / page).is_file()
