"""Write the page of accuracy against training time: the cheapest way to each PSNR."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from forewarp.files import replace_file
from forewarp.metrics.gain import Estimate
from forewarp.report.collect import Result, by_scene, collect, grouped, left_out, machine
from forewarp.report.curve import Published, draw_scene, seconds_to
from forewarp.report.run_rows import portable
from forewarp.report.tables import Column, Table

Groups = Mapping[tuple[str, float | None], Sequence[Result]]

INTRODUCTION = """# Accuracy against training time

Written by `forewarp-report kind=accuracy_time`. Seconds are of training alone: evaluation, logging and
checkpoints are left out. PSNR is of training views held out (`data.held_out`; without any, of validation
views), each estimated from the same random pixels of the whole image; a value counts as reached once two
evaluations in a row reach it. Over several seeds: mean ± standard deviation, and only where every seed gets
there. A schedule follows the share of its minutes that is spent, so a run of ten minutes is not at its best
after one.
"""


def write_accuracy_time(
    runs: Path, out: Path, *, target: float | None = None, published: Sequence[Published] = ()
) -> list[Path]:
    """Write ``accuracy-time.md``, and a picture and a CSV file a scene.

    Args:
        runs: folder to search for runs.
        out: folder to write to.
        target: list each variant's seconds to this PSNR (dB); None: the last whole dB that the base, or else
            the best run, reached.
        published: results of others, drawn as stars.

    Returns:
        the files written.
    """
    results, without = collect(runs, ["accuracy_time.csv", "metrics.json"])
    written, parts = [], [INTRODUCTION, f"Machine: {machine(results)}.\n"]
    for scene, found in by_scene(results).items():
        groups = grouped(found)
        beside = [p for p in published if (p.dataset, False) == (found[0].dataset, found[0].is_counterpart)]
        picture = draw_scene(out / f"accuracy-time-{scene}.png", groups, scene, beside)
        every = variants(groups, _target(groups) if target is None else target)
        file = out / f"accuracy-time-{scene}.csv"
        replace_file(file, every.csv())
        parts += [f"## {scene}\n", f"![PSNR against seconds]({picture.name})\n"]
        parts += [cheapest(groups).markdown(), every.markdown()]
        written += [picture, file]
    if published:
        lines = [f"* {p.name}: {p.psnr:g} dB, {p.seconds:g} s, {p.hardware}; {p.source}" for p in published]
        about = "Means over a dataset's scenes, by protocols of their own: for orientation.\n"
        parts += ["## Published by others\n", about, "\n".join(lines) + "\n"]
    parts += left_out("Without a curve", without)
    page = out / "accuracy-time.md"
    replace_file(page, "\n".join(parts))
    return [page, *written]


def reached(group: Sequence[Result], psnr: float) -> Estimate | None:
    """Return the seconds to a PSNR over the seeds; None if a seed does not reach this PSNR."""
    times = [seconds_to(result.curve, psnr) for result in group]
    return None if None in times else Estimate.of(times)


def cheapest(groups: Groups) -> Table:
    """List for every whole dB the variant that reaches it first, with the command."""
    rows = []
    values = [point.psnr for group in groups.values() for result in group for point in result.curve]
    for psnr in range(math.ceil(min(values)), math.floor(max(values)) + 1):
        found = [(reached(group, psnr), group[0]) for group in groups.values()]
        found = [(seconds, result) for seconds, result in found if seconds is not None]
        if found:
            seconds, result = min(found, key=lambda pair: pair[0].mean)
            rows.append([str(psnr), seconds, result.variant, f"`{portable(result.command)}`"])
    columns = [Column("for dB"), Column("seconds", 1), Column("variant"), Column("command")]
    return Table(columns, rows, "The cheapest way to each PSNR:")


def variants(groups: Groups, target: float) -> Table:
    """List for every variant the seconds to the target PSNR and the final numbers."""
    rows = []
    for (variant, minutes), group in groups.items():
        last = [result.curve[-1] for result in group if result.curve]
        errors = [point.epe for point in last if point.epe is not None]
        rows.append(
            [
                variant,
                minutes,
                len(group),
                reached(group, target),
                Estimate.of([point.psnr for point in last]),
                Estimate.of(errors),
                Estimate.of([sum(d["steps"] for d in result.stages.values()) for result in group]),
            ]
        )
    columns = [Column("variant"), Column("minutes", 1), Column("seeds", 0)]
    columns += [Column(f"seconds to {target:g} dB", 1), Column("PSNR at the end"), Column("EPE", 4)]
    return Table([*columns, Column("steps", 0)], rows, "At equal minutes; the steps that were done in them:")


def _target(groups: Groups) -> float:
    curves = [result.curve for (variant, _), group in groups.items() if variant == "base" for result in group]
    curves = curves or [result.curve for group in groups.values() for result in group]
    return float(math.floor(max(min(a.psnr, b.psnr) for c in curves for a, b in zip(c, c[1:] or c))))
