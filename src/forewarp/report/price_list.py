"""Write the price list: what each choice changes, compared with the same run without the choice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import mode

from forewarp.files import replace_file
from forewarp.metrics.gain import FACTORS, Estimate, measure_effect
from forewarp.report.collect import Result, by_scene, collect, grouped, left_out, machine
from forewarp.report.run_rows import portable
from forewarp.report.tables import Column, Table

# The columns of a run's numbers.
MEASURES = {
    "psnr": Column("PSNR (dB)"),
    "ssim": Column("SSIM", 4),
    "epe": Column("EPE", 4),
    "step": Column("s/step", 3),
    "frame": Column("s/frame", 2),
    "memory": Column("GiB", 2),
    "parameters": Column("parameters (M)", 3),
    "steps": Column("steps", 0),
}

INTRODUCTION = """# What each choice costs and brings

Written by `make price-list`. One change at a time, at equal minutes of training, so at unequal steps: both
are listed. Of PSNR, SSIM and EPE (error of moving points, world units, where the truth is known) the table
gives the difference, of all else the quotient, against the run named there with the same seed; ± is the
standard deviation over the seeds. A change smaller than its spread says nothing.
"""


def write_price_list(runs: Path, out: Path) -> list[Path]:
    """Write ``price-list-<model>.md`` and ``.csv`` (every run's own numbers), of ``forward`` ``price-list``.

    The model is that of most runs: what is changed one at a time, beside which whole methods may stand.

    Args:
        runs: folder to search for measured runs.
        out: folder to write to.

    Returns:
        the files written.
    """
    results, without = collect(runs, ["metrics.json"])
    parts = [INTRODUCTION, f"Machine: {machine(results)}.\n"]
    for scene, found in by_scene(results).items():
        for minutes in sorted({result.minutes for result in found}, key=lambda value: value or 0):
            equal = [result for result in found if result.minutes == minutes]
            bound = f"{minutes:g} minutes" if minutes else "bounded by steps"
            parts += [f"## {scene}, {bound}\n", references(equal).markdown(), changes(equal).markdown()]
    parts += left_out("Without numbers", without)
    models = [result.config["model"]["name"] for result in results] or ["forward"]
    name = "price-list" if (most := mode(models)) == "forward" else f"price-list-{most}"
    page, file = out / f"{name}.md", out / f"{name}.csv"
    replace_file(page, "\n".join(parts))
    replace_file(file, every_run(results).csv())
    return [page, file]


def references(results: Sequence[Result]) -> Table:
    """List the numbers of the reference runs."""
    variants = {result.variant for result in results}
    names = {result.against(variants) for result in results}
    rows = []
    for (variant, _), group in grouped(results).items():
        if variant in names:
            values = [Estimate.of(_known(group, measure)) for measure in MEASURES]
            rows.append([variant, len(group), *values])
    columns = [Column("compared with"), Column("seeds", 0)]
    kind = {"all": "all test views", "time": "test views between the training times"}
    views = ", ".join(sorted({kind[result.ability] for result in results}))
    return Table([*columns, *MEASURES.values()], rows, f"Of {views}:")


def changes(results: Sequence[Result]) -> Table:
    """List the changes of every other variant against its reference."""
    own = {(result.variant, result.seed): result for result in results}
    variants, rows = sorted({result.variant for result in results}), []
    for (variant, _), group in grouped(results).items():
        against = group[0].against(variants)
        if variant == against:
            continue
        pairs = [(result, own.get((against, result.seed))) for result in group]
        numbers = [(result.numbers, before.numbers) for result, before in pairs if before is not None]
        values = [measure_effect(numbers, measure) for measure in MEASURES]
        rows.append([variant, against, len(numbers), *values])
    columns = [Column("variant"), Column("against"), Column("seeds", 0)]
    for measure, column in MEASURES.items():
        signed = Column(column.name, column.digits, signed=True)
        columns.append(Column(column.name, prefix="×") if measure in FACTORS else signed)
    return Table(columns, rows, "Changes:")


def every_run(results: Sequence[Result]) -> Table:
    """List the numbers of every run."""
    rows = []
    for result in results:
        numbers = result.numbers
        about = [result.scene, result.variant, result.minutes, result.seed, result.ability]
        end = [result.effects, portable(result.command)]
        rows.append([*about, *(numbers.get(measure) for measure in MEASURES), *end])
    columns = [Column(name) for name in ("scene", "variant", "minutes", "seed", "views")]
    return Table([*columns, *MEASURES.values(), Column("effects"), Column("command")], rows)


def _known(group: Sequence[Result], measure: str) -> list[float]:
    return [result.numbers[measure] for result in group if measure in result.numbers]
