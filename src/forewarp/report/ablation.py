"""Write the page of what each part of the paper's method brings, and whether the paper's order holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from forewarp.files import replace_file
from forewarp.metrics.gain import Estimate, pooled_deviation
from forewarp.report import page
from forewarp.report.collect import Result, collect
from forewarp.report.page import Section
from forewarp.report.paper import facts, newest
from forewarp.report.paper_printed import PAPER, Group, PaperTable, read_paper
from forewarp.report.paper_printed import Row as PrintedRow
from forewarp.report.paper_tables import Measured, Row, counterpart, measured, runs_of
from forewarp.report.price_list import every_run
from forewarp.report.tables import Cell, Column, Table

TITLE = "What each part of the paper's method brings"
LEAST = 0.1  # dB; of two seeds both may err alike
ORDERS = ("holds", "within noise", "reversed", "one seed")
INTRODUCTION = (
    "Written by `forewarp-report kind=ablation`; `make ablations` makes its runs. Each row of the paper's "
    "tables of ablations takes one thing from its whole method (`Ours`). PSNR (dB) is of test views, mean "
    "± standard deviation over the seeds. A difference is to `Ours` with the same seed, scene and budget; "
    "beside it stands the difference of the numbers that the paper prints, for real scenes. *Noise* is the "
    "pooled standard deviation of the differences over seeds: of all rows, of all tables, with the same "
    "scene and budget, each around its own mean. A mean difference no larger than that, or than "
    f"{LEAST:g} dB, is *within noise*; else the paper's order *holds* if both differences have the same "
    "sign, and is *reversed* if not. With two seeds, one row in four to six that changes nothing would "
    "still exceed the noise, and all rows share the runs of `Ours`, so they err together. A row with fewer "
    "seeds than `Ours` says so. Seconds a step are of training, all stages together. At equal minutes a "
    "cheaper step means more steps; at equal steps it counts for nothing."
)


def write_ablation(runs: Path, out: Path, published: Path = PAPER) -> list[Path]:
    """Write ``ablation.md`` and ``ablation.csv`` (every run).

    Args:
        runs: folder to search for measured runs of ``sweeps=ablation_modules`` and ``ablation_losses``.
        out: folder to write to.
        published: file of the printed numbers.

    Returns:
        the files written.

    Raises:
        ValueError: if no run is of an ablation.
    """
    results, without = collect(runs, ["metrics.json"])
    results, older = newest(results)
    tables = [table for table in read_paper(published).values() if _of_parts(table)]
    own = [run for run in results if run.variant in {row.variant for t in tables for row in t.rows} - {None}]
    if not own:
        raise ValueError(f"{runs}: expected runs of ablations, but got none; make some with make ablations")
    sections = [section for table in tables for section in sections_of(table, own)]
    sections.insert(0, Section("In short", [in_short(sections)]))
    if lines := [*without, *(f"{run.folder}: another run of the same is newer" for run in older)]:
        sections.append(Section("Left out", facts=lines))
    replace_file(out / "ablation.md", page.markdown(TITLE, INTRODUCTION, sections))
    replace_file(out / "ablation.csv", every_run(own).csv())
    return [out / "ablation.md", out / "ablation.csv"]


def sections_of(table: PaperTable, results: Sequence[Result]) -> list[Section]:
    """Make a section for each scene, or mean of scenes, on which the table's rows were measured."""
    found = []
    for is_made in (False, True):
        runs = [run for run in results if run.is_counterpart == is_made]
        shown = counterpart(table, runs) if is_made else table
        for group in shown.groups if shown else ():
            if not (of_group := [run for run in runs if run.scene in group.scenes]):
                continue
            group = _measured_part(group, of_group)
            if (parts := changes(table, group, of_group)) is not None:
                scene = f", {group.scenes[0]}" * (is_made and group.name != group.scenes[0])
                used = [run for run in of_group if run.variant in table.variants]
                found.append(
                    Section(f"{table.title}: {group.name}{scene}", [parts], facts(used), table.notes)
                )
    return found


def in_short(sections: Sequence[Section]) -> Table:
    """Count for each budget in how many rows of all tables the paper's order holds, and in how many not."""
    found: dict[str, list[str]] = {}
    for table in (table for section in sections for table in section.tables):
        for i, column in enumerate(table.columns):
            if column.name == "order":
                label = table.columns[i - 2].name.removesuffix(": PSNR")
                found.setdefault(label, []).extend(str(row[i]) for row in table.rows if row[i])
    rows = [
        [label, len(orders), *(sum(order.startswith(kind) for order in orders) for kind in ORDERS)]
        for label, orders in found.items()
    ]
    columns = [Column("budget of a run"), Column("rows", 0), *(Column(kind, 0) for kind in ORDERS)]
    return Table(columns, rows, "Rows of all tables below, by what became of the paper's order:")


def changes(table: PaperTable, group: Group, results: Sequence[Result]) -> Table | None:
    """List what each row changes on the scenes of ``group``, for each budget; None if nothing was measured.

    Args:
        table: the paper's table.
        group: the scenes and the kind of test view; of the table, or of its counterpart.
        results: runs of the group's scenes, and others.
    """
    by_budget: dict[Row, dict[str, Measured]] = {}
    every = tuple(dict.fromkeys(run.variant for run in results))  # the noise is of other tables' rows, too
    for one in measured(replace(table, variants=every), results):
        if one.row.model == "forward" and one.by_seed(group, "psnr"):
            by_budget.setdefault(one.row._replace(variant=""), {})[one.row.variant] = one
    own = {row.variant for row in _in_order(table)} - {"full"}
    budgets = [budget for budget, found in by_budget.items() if "full" in found and own & set(found)]
    budgets.sort(key=lambda row: (row.minutes is None, row.minutes or 0, row.iterations or 0))
    if not budgets:
        return None
    printed = _printed(table, group)
    columns, notes = [Column("row of the paper"), Column("paper, dB", signed=True)], []
    rows: list[list[Cell]] = [[row.name, printed.get(row.variant)] for row in _in_order(table)]
    for budget in budgets:
        found, label = by_budget[budget], _label(budget, budgets)
        noise = pooled_deviation([list(differences(found, v, group).values()) for v in found])
        columns += [Column(f"{label}: PSNR"), Column("difference", signed=True), Column("order")]
        columns += [Column("s a step", 3), Column("of a step of Ours", prefix="×")]
        seeds = len(found["full"].by_seed(group, "psnr"))
        spread = f"noise {noise:.2f} dB" if noise is not None else "noise unknown"
        notes.append(f"{label}, {seeds} seed{'s' * (seeds != 1)}: {spread}")
        for row, cells in zip(_in_order(table), rows):
            cells += _cells(found, row, group, printed, noise)
    kept = [row for row in rows if any(cell is not None for cell in row[2:])]
    return Table(columns, kept, "; ".join(notes) + ".")


def differences(found: Mapping[str, Measured], variant: str, group: Group) -> dict[int, float]:
    """Return by seed by how many dB a variant is better than ``full``; none for ``full`` itself."""
    if variant == "full" or variant not in found:
        return {}
    whole = found["full"].by_seed(group, "psnr")
    return {s: v - whole[s] for s, v in found[variant].by_seed(group, "psnr").items() if s in whole}


def verdict(change: float, printed: float | None, noise: float | None) -> str:
    """Say whether the paper's order of a row and ``Ours`` holds.

    >>> verdict(-0.5, -1.0, 0.2), verdict(0.5, -1.0, 0.2), verdict(-0.1, -1.0, 0.2)
    ('holds', 'reversed', 'within noise')
    >>> verdict(-0.5, -1.0, None), verdict(-0.5, None, 0.2)
    ('one seed', '')
    """
    if not printed:
        return ""
    if noise is None:
        return "one seed"
    if abs(change) <= max(noise, LEAST):
        return "within noise"
    return "holds" if change * printed > 0 else "reversed"


def _cells(
    found: Mapping[str, Measured],
    row: PrintedRow,
    group: Group,
    printed: Mapping[str, float],
    noise: float | None,
) -> list[Cell]:
    """Return PSNR, difference, order, seconds a step and their quotient of one row with one budget."""
    if row.variant not in found:
        return [None] * 5
    change = Estimate.of(list(differences(found, row.variant, group).values()))
    step, whole = (_step(found[variant], group) for variant in (row.variant, "full"))
    order = verdict(change.mean, printed.get(row.variant), noise) if change else None
    seeds, all_seeds = (len(found[variant].by_seed(group, "psnr")) for variant in (row.variant, "full"))
    if order and seeds < all_seeds:
        order += f" ({seeds} of {all_seeds} seeds)"
    times = step / whole if step and whole else None
    return [found[row.variant].cell(group, "psnr"), change, order, step, times]


def _step(one: Measured, group: Group) -> float | None:
    """The mean seconds of a step of the runs on the group's scenes; None if no run tells its steps."""
    numbers = [run.numbers for run in runs_of([one]) if run.scene in group.scenes]
    known = [found["step"] for found in numbers if "step" in found]
    return fmean(known) if known else None


def _measured_part(group: Group, runs: Sequence[Result]) -> Group:
    """Return the group of those scenes that were measured, named if some of a mean's are absent."""
    known = {run.scene for run in runs}
    if known >= set(group.scenes):
        return group
    scenes = tuple(scene for scene in group.scenes if scene in known)
    return replace(group, name=f"{group.name}, of which {', '.join(scenes)}", scenes=scenes)


def _printed(table: PaperTable, group: Group) -> dict[str, float]:
    """Return by variant the printed difference to ``Ours``, in the widest mean of this kind of view."""
    same = [g for g in table.groups if (g.dataset, g.ability) == (group.dataset, group.ability)]
    widest = group if group in same else max(same, key=lambda g: len(g.scenes))
    at = table.columns.index((widest, "psnr"))
    values = {row.variant: row.values[at] for row in table.rows if row.variant}
    numbers = {variant: float(value) for variant, value in values.items() if value}
    return {v: number - numbers["full"] for v, number in numbers.items() if v != "full" and "full" in numbers}


def _in_order(table: PaperTable) -> list[PrintedRow]:
    """The rows of the paper's own method, the whole one first."""
    return sorted((row for row in table.rows if row.variant), key=lambda row: row.variant != "full")


def _of_parts(table: PaperTable) -> bool:
    """Tell whether a table takes the method apart; a table scene by scene repeats another."""
    return not table.means and len(_in_order(table)) > 1


def _label(budget: Row, others: Sequence[Row]) -> str:
    """Name a budget, with what else tells it from the others."""
    parts = [f"{budget.minutes:g} min" if budget.minutes else ""]
    parts += [f"{budget.iterations} steps" if budget.iterations else ""]
    for name in ("preset", "device", "threads", "clock", "views", "held_out"):
        several = len({getattr(other, name) for other in others}) > 1
        parts.append(f"{name.replace('_', ' ')} {getattr(budget, name)}" if several else "")
    return ", ".join(part for part in parts if part)
