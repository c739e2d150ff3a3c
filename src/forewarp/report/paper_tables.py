"""Put measured runs beside the paper's printed rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import NamedTuple

from forewarp.metrics.gain import Estimate
from forewarp.report.collect import Result, machines
from forewarp.report.paper_printed import Group, PaperTable
from forewarp.report.paper_printed import Row as PrintedRow
from forewarp.report.protocols import numbered, protocol_of
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
UNPRINTED = ("particles", "backward")  # methods of this project that the paper prints no row of
# What a measured row says beside its scores.
COSTS = (
    *(Column("training, s a run", 0), Column("GiB"), Column("parameters (M)", 3), Column("steps", 0)),
    *(Column("protocol"), Column("device")),
)


@dataclass(frozen=True)
class Measured:
    """The runs of one table row, equal in all but scene and seed."""

    name: str
    row: Row
    runs: tuple[Result, ...]

    def by_seed(self, group: Group, metric: str) -> dict[int, float]:
        """Average a metric over the scenes of a group, for each seed that all scenes have.

        Empty if there is no such seed, or the scenes' images differ in size or background.
        """
        found, conditions = {}, set()
        for run in self.runs:
            scores = run.metrics["test"].get(group.ability or run.ability, {})
            if run.dataset == group.dataset and metric in scores:
                found[run.scene, run.seed] = scores[metric] * METRICS[metric][3]
                conditions |= {_conditions(run)} if run.scene in group.scenes else set()
        if len(conditions) > 1:
            return {}
        seeds = sorted({seed for _, seed in found})
        whole = [seed for seed in seeds if all((scene, seed) in found for scene in group.scenes)]
        return {seed: fmean(found[scene, seed] for scene in group.scenes) for seed in whole}

    def cell(self, group: Group, metric: str) -> Estimate | None:
        """Estimate a metric's mean over the seeds of ``by_seed``; None if it is empty."""
        return Estimate.of(list(self.by_seed(group, metric).values()))

    def costs(self, numbers: Mapping[str, str]) -> list[Cell]:
        """Return the cells of ``COSTS``: means over the runs, and the numbers of their protocols."""
        protocols = {numbers[protocol_of(run)] for run in self.runs}
        names = ("memory", "parameters", "steps")
        known = ([run.numbers[name] for run in self.runs if name in run.numbers] for name in names)
        seconds = fmean(run.metrics["seconds"]["train"] for run in self.runs)
        means = [fmean(of) if of else None for of in known]
        return [seconds, *means, ", ".join(sorted(protocols, key=int)), machines([(*self.row.machine, None)])]


class Row(NamedTuple):
    """What the runs of one row have in common."""

    variant: str
    model: str
    preset: str
    minutes: float | None
    iterations: int | None
    held_out: int
    device: str | None
    threads: int | None
    clock: str = "wall"
    views: int | None = None  # that were measured; None: all

    @property
    def machine(self) -> tuple[str | None, int | None]:
        """The device and its threads."""
        return self.device, self.threads


def row_of(run: Result) -> Row:
    """Return the row that a run belongs to."""
    budget = run.config["budget"]
    known, protocol = (run.config.get("variant") or {}).get("name", "plain"), run.metrics.get("protocol", {})
    bounds = run.config["preset"]["name"], budget["minutes"], budget.get("iterations")
    machine = protocol.get("device"), protocol.get("threads")
    conditions = protocol.get("held_out", 0), *machine, run.clock
    views = str(protocol.get("measured", "")).split(" ")[0]  # "10 of 30 test views, evenly spread"
    return Row(known, run.config["model"]["name"], *bounds, *conditions, int(views) if views else None)


def measured(table: PaperTable, results: Sequence[Result]) -> list[Measured]:
    """Return the table's measured rows: by its variants, then as printed, then ``UNPRINTED``, then others."""
    rows = {}
    datasets = {group.dataset for group in table.groups}
    for run in results:
        key = row_of(run)
        if key.variant in table.variants and run.dataset in datasets:
            rows.setdefault(key, []).append(run)
    systems = list(dict.fromkeys([*(row.model for row in table.rows), *UNPRINTED]))

    def place(key: Row) -> tuple:
        by_model = systems.index(key.model) if key.model in systems else len(systems)
        return table.variants.index(key.variant), by_model, *(str(value or "") for value in key)

    return [Measured(_name(key, rows[key]), key, tuple(rows[key])) for key in sorted(rows, key=place)]


def runs_of(rows: Sequence[Measured]) -> list[Result]:
    """Return the runs of all rows."""
    return [run for row in rows for run in row.runs]


def comparison(table: PaperTable, results: Sequence[Result]) -> Table:
    """Make a table of each published row with the measured ones of its method below it, then the others.

    After each measured row comes its difference from the published one. In each column the best and the
    second best of the measured rows are marked, if all may be compared.

    Args:
        table: the paper's table.
        results: the runs of the table's scenes.
    """
    found = measured(table, results)
    numbers = numbered(runs_of(found))
    rows, ranked, rules, absent = [], [], [], [None] * len(COSTS)

    def add(one: Measured, printed: PrintedRow | None) -> None:
        cells = [one.cell(group, metric) for group, metric in table.columns]
        ranked.append(len(rows))
        rows.append([one.name, "measured", *cells, *one.costs(numbers)])
        if printed is not None and any(cells):
            rows.append(["", "difference to the paper", *map(_difference, cells, printed.values), *absent])

    own = {one.row: table.printed(one.row.model, one.row.variant) for one in found}
    for printed in table.rows:
        below = [one for one in found if own[one.row] is printed]
        rules += [len(rows)] if below or (rows and rows[-1][1] != "published") else []
        rows.append([printed.name, "published", *printed.values, *absent])
        for one in below:
            add(one, printed)
    others = [one for one in found if own[one.row] is None]
    rules += [len(rows)] if others else []
    for one in others:
        add(one, None)
    columns = [Column("method"), Column("kind"), *(_column(*pair) for pair in table.columns), *COSTS]
    marks = _marks(table, rows, ranked) if _comparable(found) else {}
    return Table(columns, rows, marks=marks, rules=[rule for rule in rules if rule])


def stand_in(table: PaperTable, results: Sequence[Result]) -> Table | None:
    """Make a table of the runs on synthetic counterparts, with what was published for real scenes at its end.

    None if there are no such runs.
    """
    made = counterpart(table, results)
    found = measured(table, results)
    if made is None or not found:
        return None
    numbers, datasets = numbered(runs_of(found)), {run.dataset for run in runs_of(found)}
    shown = [
        (number, group)
        for number, (group, metric) in enumerate(table.columns)
        if metric == "psnr" and group.dataset in datasets and len(group.scenes) > 1
    ]
    rows = []
    for one in found:
        cells = [one.cell(group, metric) for group, metric in made.columns]
        printed = table.printed(one.row.model, one.row.variant)
        beside = [printed.values[number] if printed else "" for number, _ in shown]
        rows.append([one.name, *cells, *one.costs(numbers), printed.name if printed else "", *beside])
    columns = [Column("measured"), *(_column(*pair) for pair in made.columns), *COSTS]
    columns += [
        Column("published as"),
        *(Column(f"published: {group.name} PSNR") for _, group in shown),
    ]
    marks = _marks(made, rows, range(len(rows)), 1) if _comparable(found) else {}
    return Table(columns, rows, marks=marks)


def counterpart(table: PaperTable, results: Sequence[Result]) -> PaperTable | None:
    """Return the table for the measured synthetic scenes, without printed rows, or None.

    A table scene by scene has none: its scenes are those of another table.
    """
    if table.means:
        return None
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


def _comparable(rows: Sequence[Measured]) -> bool:
    """Tell whether rows differ in method and variant alone: same budget, machine and test views."""
    return len({one.row._replace(variant="", model="") for one in rows}) == 1


def _conditions(run: Result) -> tuple:
    protocol = run.metrics.get("protocol", {})
    return tuple(protocol.get(key) for key in ("half_resolution", "scale", "background"))


def _name(row: Row, runs: Sequence[Result]) -> str:
    minutes, steps = f"{row.minutes or 0:g} min", f"{row.iterations} steps"
    minutes += " of processor time" * (row.clock == "processor")
    bounds = [minutes if row.minutes else "", steps if row.iterations else ""]
    about = row.model if row.variant == "plain" else (runs[0].about or row.variant)
    about += " (the paper's method)" * (about == "forward")
    seeds = len({run.seed for run in runs})
    parts = [f"forewarp: {about}", row.preset, *bounds, f"{seeds} seeds" if seeds > 1 else ""]
    parts.append(f"{row.held_out} views held out" if row.held_out else "")
    parts.append(f"{row.views} test views" if row.views else "")
    return ", ".join(part for part in parts if part)


def _column(group: Group, metric: str) -> Column:
    title, digits, more, _ = METRICS[metric]
    return Column(f"{group.name} {title}{'↑' if more else '↓'}", digits)


def _difference(cell: Estimate | None, printed: str) -> Difference | None:
    return None if cell is None or not printed else Difference(cell.mean - float(printed))


def _marks(table: PaperTable, rows: Sequence[Sequence[Cell]], ranked: Sequence[int], first: int = 2) -> dict:
    """Mark the best and the second best of each column from ``first`` on; equal texts tie."""
    marks = {}
    for number, (_, metric) in enumerate(table.columns, first):
        _, digits, more, _ = METRICS[metric]
        values = {i: round(rows[i][number].mean, digits) for i in ranked if rows[i][number] is not None}
        order = sorted(set(values.values()), reverse=more)
        if len(values) > 1:
            for i, value in values.items():
                if value in order[:2]:
                    marks[i, number] = ("best", "second")[order.index(value)]
    return marks
