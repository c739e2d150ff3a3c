"""Write the page that compares planned runs with every effect at once and with the paper's fixed set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from forewarp.files import MOST_CONFIG, read_text, replace_file
from forewarp.metrics.gain import Estimate
from forewarp.report.collect import Result, by_scene, collect, left_out, machine
from forewarp.report.curve import seconds_to
from forewarp.report.run_rows import portable
from forewarp.report.tables import Column, Table

CHOICES = {"auto": "planned", "all_effects": "every effect", "full": "the paper's set", "base": "the preset"}
WITHIN = 0.3  # a planned run should come within this many dB of every effect at once, in less time

INTRODUCTION = """# Only the effects a scene calls for: model={model}

Written by `forewarp-report kind=effects` from runs of `sweeps=effects`. *Planned* is what `effects=auto`
found the scene to call for, *every effect* has all of them on, *the paper's set* is motion, inpainter,
learned up-sampler, view network and all terms of its loss, *the preset* is the method as is. PSNR (dB) is
of test views, which no plan has seen: between the training times where a scene tells its views apart. Minutes
are of training; planning comes before and is listed apart. "Seconds to it": when the planned run's curve, of
validation views, came within {within:g} dB of where every effect ended, "of" so many seconds.
"""


def write_effects(runs: Path, out: Path) -> list[Path]:
    """Write ``effects.md`` and ``effects.csv`` (every run) of ``model=forward``, and ``effects-<model>`` of
    any other method.

    Args:
        runs: folder to search for measured runs.
        out: folder to write to.

    Returns:
        the files written.
    """
    results, without = collect(runs, ["metrics.json"])
    results = [result for result in results if result.variant in CHOICES]
    files = []
    for model in sorted({_model(result) for result in results}) or ["forward"]:
        own = [result for result in results if _model(result) == model]
        name = "effects" if model == "forward" else f"effects-{model}"
        replace_file(out / f"{name}.md", "\n".join(_parts(model, own) + left_out("Without numbers", without)))
        replace_file(out / f"{name}.csv", every_run(own).csv())
        files += [out / f"{name}.md", out / f"{name}.csv"]
    return files


def _parts(model: str, results: Sequence[Result]) -> list[str]:
    """Make the paragraphs of one method's page."""
    parts = [INTRODUCTION.format(within=WITHIN, model=model), f"Machine: {machine(results)}.\n"]
    for title, made in (("Specimens", True), ("Other scenes", False)):
        found = [r for r in results if (r.config.get("calls_for") is not None) == made]
        if found:
            parts += [f"## {title}\n", compared(found).markdown()]
            parts += [called(found).markdown()] if made else []
    trials = gains_of_trials(results)
    parts += ["## What each effect is worth in trials\n", trials.markdown()] if trials.rows else []
    return [*parts, "## Why\n", *reasons(results)]


def plan_of(result: Result) -> dict:
    """Read the plan that a run follows; empty if there is none."""
    path = result.folder / "plan.yaml"
    return yaml.safe_load(read_text(path, MOST_CONFIG)) if path.is_file() else {}


def compared(results: Sequence[Result]) -> Table:
    """List for every scene the numbers of each choice, mean over seeds; then the mean over scenes."""
    rows, columns = [], [Column("scene"), Column("seeds", 0)]
    columns += [Column(_title(results, choice)) for choice in CHOICES if _runs(results, choice)]
    columns += [Column("planned - every effect", signed=True), Column("seconds to it", 0)]
    columns += [Column("of", 0), Column("planning, s", 0)]
    for scene, found in by_scene(results).items():
        rows.append([scene, len(_runs(found, "auto")), *_cells(results, found)])
    means = [_mean([row[i] for row in rows]) for i in range(2, len(columns))]
    return Table(columns, [*rows, ["mean", None, *means]] if len(rows) > 1 else rows, "", rules=[len(rows)])


def _cells(results: Sequence[Result], found: Sequence[Result]) -> list:
    reached = [
        Estimate.of([run.numbers["psnr"] for run in _runs(found, choice)])
        for choice in CHOICES
        if _runs(results, choice)
    ]
    pairs = _pairs(found, "all_effects")
    gain = Estimate.of([a.numbers["psnr"] - b.numbers["psnr"] for a, b in pairs])
    times = [seconds_to(a.curve, b.curve[-1].psnr - WITHIN) for a, b in pairs if a.curve and b.curve]
    quick = Estimate.of(times) if times and None not in times else None
    whole = Estimate.of([b.metrics["seconds"]["train"] for _, b in pairs])
    planning = Estimate.of([plan_of(run)["seconds"] for run in _runs(found, "auto") if plan_of(run)])
    return [*reached, gain, quick, whole and whole.mean, planning]


def called(results: Sequence[Result]) -> Table:
    """List for every plan the effects switched on, and the effects that the scene was made to call for."""
    rows = []
    for run in _runs(results, "auto"):
        wanted = sorted(run.config.get("calls_for") or [])
        on = sorted(name for name, decision in plan_of(run).get("effects", {}).items() if decision["on"])
        verdict = "as made" if on == wanted else "**otherwise**"
        rows.append(
            [run.scene, run.seed, ", ".join(wanted) or "nothing", ", ".join(on) or "nothing", verdict]
        )
    rows.sort(key=lambda row: (row[0], row[1]))
    right = sum(row[-1] == "as made" for row in rows)
    columns = [Column("scene"), Column("seed", 0), Column("made to call for"), Column("planned"), Column("")]
    return Table(columns, rows, f"{right} of {len(rows)} plans turn on what is called for and nothing else:")


def gains_of_trials(results: Sequence[Result]) -> Table:
    """List for every plan what its trials gained by each effect, ± two standard errors."""
    plans = [(run, _trials(run)) for run in _runs(results, "auto")]
    names = list(dict.fromkeys(name for _, trials in plans for name in trials))
    rows = []
    for run, trials in sorted(plans, key=lambda one: (one[0].scene, one[0].seed)):
        gains = [trials.get(name) for name in names]
        cells = [gain and f"{gain['psnr']:+.2f} ± {gain['noise']:.2f}" for gain in gains]
        rows += [[run.scene, run.seed, *cells]] if trials else []
    columns = [Column("scene"), Column("seed", 0), *(Column(name.replace("_", " ")) for name in names)]
    caption = "dB on held-out training views that a trial with the effect has more; empty: not tried."
    return Table(columns, rows, caption)


def _model(run: Result) -> str:
    return run.config["model"]["name"]


def _trials(run: Result) -> dict[str, dict]:
    """What each trial of a run's plan gained, by effect."""
    return plan_of(run).get("evidence", {}).get("trials", {})


def reasons(results: Sequence[Result]) -> list[str]:
    """List for every scene the decisions of its first plan."""
    parts = []
    for scene, found in by_scene(_runs(results, "auto")).items():
        plan = plan_of(min(found, key=lambda run: run.seed))
        lines = [f"* {e}: **{d['choice']}**. {d['because']}" for e, d in plan.get("effects", {}).items()]
        parts.append(f"### {scene}\n\n" + "\n".join(lines) + "\n")
    return parts


def every_run(results: Sequence[Result]) -> Table:
    """List the numbers of every run."""
    columns = [Column(name) for name in ("scene", "choice", "seed")]
    columns += [Column("minutes", 1), Column("PSNR", 3), Column("steps", 0), Column("planning, s", 1)]
    rows = [
        [
            run.scene,
            run.variant,
            str(run.seed),
            run.minutes,
            run.numbers["psnr"],
            run.numbers["steps"],
            plan_of(run).get("seconds"),
            portable(run.command),
        ]
        for run in sorted(results, key=lambda run: (run.scene, run.variant, run.seed))
    ]
    return Table([*columns, Column("command")], rows)


def _runs(results: Sequence[Result], choice: str) -> list[Result]:
    """Select the runs of a choice; for each scene and seed the one measured last."""
    found = [result for result in results if result.variant == choice]
    found.sort(key=lambda run: (run.folder / "metrics.json").stat().st_mtime_ns)
    return list({(run.scene, run.seed): run for run in found}.values())


def _pairs(results: Sequence[Result], choice: str) -> list[tuple[Result, Result]]:
    """Pair each planned run with the run of ``choice`` that has the same scene and seed."""
    others = {(run.scene, run.seed): run for run in _runs(results, choice)}
    own = [(run, others.get((run.scene, run.seed))) for run in _runs(results, "auto")]
    return [(run, other) for run, other in own if other is not None]


def _title(results: Sequence[Result], choice: str) -> str:
    minutes = sorted({run.minutes for run in _runs(results, choice) if run.minutes})
    return CHOICES[choice] + (f", {' or '.join(f'{m:g}' for m in minutes)} min" if minutes else "")


def _mean(cells: Sequence) -> float | None:
    values = [cell.mean if isinstance(cell, Estimate) else cell for cell in cells]
    return None if None in values or not values else sum(values) / len(values)
