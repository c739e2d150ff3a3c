"""Put measured runs beside the paper's printed rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import NamedTuple

from forewarp.metrics.gain import Estimate
from forewarp.report.collect import Result
from forewarp.report.paper_printed import Group, PaperTable
from forewarp.report.tables import Cell, Column, Difference, Table

# Title, digits, whether more is better, and the factor to the printed unit.
METRICS = {
    "psnr": ("PSNR", 2, True, 1),
    "ssim": ("SSIM", 3, True, 1),
    "ms_ssim_legacy": ("MS-SSIM", 3, True, 1),
    "lpips_vgg": ("LPIPS", 3, False, 1),
    "depth_delta_1.25": ("δ<1.25", 3, True, 100),
    "depth_delta_1.5625": ("δ<1.25²", 3, True, 100),
}


@dataclass(frozen=True)
class Measured:
    """The runs of one table row, equal in all but scene and seed."""

    name: str
    row: Row
    runs: tuple[Result, ...]

    def cell(self, group: Group, metric: str) -> Estimate | None:
        """Estimate a metric's mean over the scenes of a group, over the seeds that all scenes have.

        Return None if there is no such seed, or the scenes' images differ in size or background.
        """
        found, conditions = {}, set()
        for run in self.runs:
            scores = run.metrics["test"].get(group.ability or run.ability, {})
            if run.dataset == group.dataset and metric in scores:
                found[run.scene, run.seed] = scores[metric] * METRICS[metric][3]
                conditions |= {_conditions(run)} if run.scene in group.scenes else set()
        if len(conditions) > 1:
            return None
        seeds = sorted({seed for _, seed in found})
        whole = [seed for seed in seeds if all((scene, seed) in found for scene in group.scenes)]
        return Estimate.of([fmean(found[scene, seed] for scene in group.scenes) for seed in whole])

    @property
    def seconds(self) -> float:
        """The mean training seconds of the runs."""
        return fmean(run.metrics["seconds"]["train"] for run in self.runs)


class Row(NamedTuple):
    """What the runs of one row have in common."""

    variant: str
    model: str
    preset: str
    minutes: float | None
    iterations: int | None
    held_out: int
    device: str | None


def row_of(run: Result) -> Row:
    """Return the row that a run belongs to."""
    budget = run.config["budget"]
    known, protocol = (run.config.get("variant") or {}).get("name", "plain"), run.metrics.get("protocol", {})
    bounds = run.config["preset"]["name"], budget["minutes"], budget.get("iterations")
    conditions = protocol.get("held_out", 0), protocol.get("device")
    return Row(known, run.config["model"]["name"], *bounds, *conditions)


def measured(table: PaperTable, results: Sequence[Result]) -> list[Measured]:
    """Return the table's measured rows, in the order of its variants."""
    rows = {}
    datasets = {group.dataset for group in table.groups}
    for run in results:
        key = row_of(run)
        if key.variant in table.variants and run.dataset in datasets:
            rows.setdefault(key, []).append(run)
    order = sorted(rows, key=lambda k: (table.variants.index(k.variant), *map(str, k)))
    machines = {key.device for key in rows}
    return [Measured(_name(key, rows[key], len(machines) > 1), key, tuple(rows[key])) for key in order]


def comparison(table: PaperTable, results: Sequence[Result], *, difference: bool = True) -> Table:
    """Make a table of the measured rows, then the published ones.

    In each column mark the best and the second best of the measured rows.

    Args:
        table: the paper's table.
        results: the runs of the table's scenes.
        difference: after each measured row add the difference from the paper's row.
    """
    rows, ranked, kinds = [], [], ["measured", "difference to the paper", "published"]
    for row in measured(table, results):
        cells = [row.cell(group, metric) for group, metric in table.columns]
        ranked.append(len(rows))
        rows.append([row.name, kinds[0], *cells, row.seconds])
        papers_own = row.row.model == "forward"
        printed = _ours(table, row.row.variant) if papers_own else None
        if difference and printed is not None and any(cells):
            rows.append(["", kinds[1], *map(_difference, cells, printed), None])
    rules = [len(rows)] if rows else []
    rows += [[row.name, kinds[2], *row.values, None] for row in table.rows]
    columns = [
        Column("method"),
        Column("kind"),
        *(_column(*pair) for pair in table.columns),
        Column("training, s a run", 0),
    ]
    return Table(columns, rows, marks=_marks(table, rows, ranked), rules=rules)


def counterpart(table: PaperTable, results: Sequence[Result]) -> PaperTable | None:
    """Return the table for the measured synthetic scenes, without printed rows, or None."""
    groups = {}
    for group in table.groups:
        for scene in sorted({run.scene for run in results if run.dataset == group.dataset}):
            name = group.name if group.ability else scene
            more = Group(name, group.dataset, group.metrics, (scene,), group.ability)
            groups[scene, group.ability, group.metrics] = more
    return replace(table, groups=tuple(groups.values()), rows=(), means=()) if groups else None


def with_means(table: PaperTable, results: Sequence[Result]) -> PaperTable:
    """Add the means that the table asks for, and the mean of the measured scenes if these are others."""
    if not table.means:
        return table
    scenes = max(
        ({run.scene for run in row.runs} for row in measured(table, results)), key=len, default=set()
    )
    asked = dict(table.means)
    order = tuple(group.scenes[0] for group in table.groups if group.scenes[0] in scenes)
    if order and order not in asked.values():
        asked[f"Mean of the {len(order)} measured"] = order
    for name, those in asked.items():
        table = table.with_mean(name, those)
    return table


def _conditions(run: Result) -> tuple:
    protocol = run.metrics.get("protocol", {})
    return protocol.get("half_resolution"), protocol.get("background")


def _name(row: Row, runs: Sequence[Result], tell_device: bool) -> str:
    minutes, steps = f"{row.minutes or 0:g} min", f"{row.iterations} steps"
    bounds = [minutes if row.minutes else "", steps if row.iterations else ""]
    about = row.model if row.variant == "plain" else (runs[0].about or row.variant)
    about += " (the paper's method)" * (about == "forward")
    seeds = len({run.seed for run in runs})
    parts = [f"forewarp: {about}", row.preset, *bounds, f"{seeds} seeds" if seeds > 1 else ""]
    parts.append(f"{row.held_out} views held out" if row.held_out else "")
    parts.append(str(row.device) if tell_device else "")
    return ", ".join(part for part in parts if part)


def _column(group: Group, metric: str) -> Column:
    title, digits, more, _ = METRICS[metric]
    return Column(f"{group.name} {title}{'↑' if more else '↓'}", digits)


def _ours(table: PaperTable, variant: str) -> tuple[str, ...] | None:
    wanted = "full" if variant == "plain" else variant
    return next((row.values for row in table.rows if row.variant == wanted), None)


def _difference(cell: Estimate | None, printed: str) -> Difference | None:
    return None if cell is None or not printed else Difference(cell.mean - float(printed))


def _marks(table: PaperTable, rows: Sequence[Sequence[Cell]], ranked: Sequence[int]) -> dict:
    """Mark the best and the second best of each column; numbers that round to the same text tie."""
    marks = {}
    for number, (_, metric) in enumerate(table.columns, 2):
        _, digits, more, _ = METRICS[metric]
        values = {i: round(rows[i][number].mean, digits) for i in ranked if rows[i][number] is not None}
        order = sorted(set(values.values()), reverse=more)
        if len(values) > 1:
            for i, value in values.items():
                if value in order[:2]:
                    marks[i, number] = ("best", "second")[order.index(value)]
    return marks
