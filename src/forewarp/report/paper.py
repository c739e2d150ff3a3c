"""The paper's tables, measured beside printed numbers, and what each part of its method brings.

Functions that write search a folder for measured runs, write to ``out``, and return the files written.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np

from forewarp.files import load_yaml, read_json, read_text, replace_file
from forewarp.media import image_bytes
from forewarp.metrics.registry import metric_of
from forewarp.report import figures, motion_figures
from forewarp.report.results import KINDS, Point, Row, Runs, nothing, refused
from forewarp.report.settings import grouped, scene_of
from forewarp.report.statistics import INTERVALS, LEAST, Estimate, by_chance, paired_change, rank, verdict
from forewarp.report.stored import UNPAIRED, read_any, stored_csv
from forewarp.report.tables import MARKED, Cell, Column, Difference, Section, Table, rendered

PAPER = Path(__file__).with_name("paper.yaml")  # the printed numbers
# What the runs of one row of a table have in common.
BUDGET = "preset", "minutes", "iterations", "held_out", "train_views", "device", "threads", "clock", "tested"
BUDGET += ("image_format",)
ROW = ("ablation", "method", "setting", *BUDGET)
UNPRINTED = ("particles", "backward")  # methods of this project that the paper prints no row of
DATASETS = ("dnerf", "hypernerf", "nhr", "lego_complete")
NO_TYPE = "–"
TYPES = "Type: N without a canonical space, PC with a physical one (flow is 0 at the canonical time), NPC "
TYPES += (
    "with one that need not be physical; – neither (particles: their flow is about 0 at the canonical time)."
)
DEPTH = {"depth_delta_1.25": "δ<1.25", "depth_delta_1.5625": "δ<1.25²"}  # printed as percentages
COSTS = (Column("training, s a run", 0), Column("GiB"), Column("parameters (M)", 3), Column("steps", 0))
COSTS += (Column("protocol"), Column("device"))  # what a measured row says beside its scores
ORDERS = ("holds", "no difference shown", "reversed")  # what may become of the paper's order
AT_REST = "compact"  # the preset whose training comes to rest
OF_REST = re.compile(r"^## At rest$.*?(?=^## |\Z)", re.MULTILINE | re.DOTALL)  # on the page
LAST = 0.2  # of a run's training: what its curve gains there tells whether it was at rest


class Group(NamedTuple):
    """Columns that are a mean over ``scenes`` of a dataset.

    ``ability`` is the kind of test view; None: that of a run's own ``ability``, which its protocol names.
    """

    name: str
    dataset: str
    metrics: tuple[str, ...]
    scenes: tuple[str, ...]
    ability: str | None = None


class Printed(NamedTuple):
    """A printed row: numbers by group and metric, as text, "" for a missing number.

    ``model`` and ``variant`` name the measured runs to compare with the row; others have no variant.
    """

    name: str
    values: Mapping[tuple[Group, str], str]
    variant: str | None = None
    model: str | None = None


@dataclass(frozen=True, eq=False)
class PaperTable:
    """One of the paper's tables.

    ``variants``: the measured variants to show; ``means``: more groups to compute, as name -> scenes;
    ``types``: of methods, by name.
    """

    title: str
    source: str
    variants: Sequence[str]
    groups: Sequence[Group]
    rows: Sequence[Printed]
    notes: Sequence[str]
    means: Mapping[str, tuple[str, ...]]
    types: Mapping[str, str]

    def type_of(self, method: str | None) -> list[str]:
        """Return the cells of the column "type", as of the paper: none in a table of one method alone."""
        several = len({row.model for row in self.rows}) > 1
        return [self.types.get(method, NO_TYPE)] if self.types and several else []

    @property
    def columns(self) -> list[tuple[Group, str]]:
        """The group and metric of every column."""
        return [(group, metric) for group in self.groups for metric in group.metrics]

    @property
    def parts(self) -> list[Printed]:
        """The rows of the paper's own method, the whole one first."""
        return sorted((row for row in self.rows if row.variant), key=lambda row: row.variant != "full")

    def printed(self, run: Row) -> Printed | None:
        """Return the row of a run's method and variant, or None; a plain run is compared with ``full``."""
        wanted = run["method"], run["ablation"] or "full"
        return next((row for row in self.rows if (row.model, row.variant or "full") == wanted), None)


def read_paper(path: Path) -> dict[str, PaperTable]:
    """Read tables by key from a YAML file such as ``PAPER``.

    Raises:
        ValueError: if the file is no YAML or lacks a key, or a row has another length than its table.
    """
    try:
        # All values as text, so that 30.50 stays as printed.
        content = load_yaml(Path(path), texts=True)
        tables, types = content["tables"].items(), content.get("types") or {}
        return {key: _table(key, entry, content["datasets"], types) for key, entry in tables}
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected tables of groups and rows, but got {error!r}") from None


def _table(key: str, entry: dict, datasets: dict, types: dict) -> PaperTable:
    groups, rows = [], []
    for group in entry["groups"]:
        scenes = tuple(group.get("scenes", datasets[group["dataset"]]))
        about = group["name"], group["dataset"], tuple(group["metrics"]), scenes
        groups.append(Group(*about, group.get("ability")))
    columns = [(group, metric) for group in groups for metric in group.metrics]
    for row in entry["rows"]:
        values = ["" if value == "null" else value for value in row["values"]]
        if len(values) != len(columns):
            raise ValueError(f"{key}: {row['name']}: expected {len(columns)} values, but got {len(values)}")
        values = dict(zip(columns, values))
        variant = row.get("variant", "full" if row["name"].split(" (")[0] == "Ours" else None)
        rows.append(Printed(row["name"], values, variant, row.get("model", "forward" if variant else None)))
    means = {name: tuple(scenes) for name, scenes in entry.get("means", {}).items()}
    of_table = entry["title"], entry["source"], entry["variants"], groups, rows
    return PaperTable(*of_table, entry["notes"], means, types)


def measured(table: PaperTable, runs: Runs, variants: Sequence[str] = ()) -> list[Runs]:
    """Return the runs of each measured row: by variant, then as printed, then ``UNPRINTED``, then others.

    Args:
        table: the paper's table.
        runs: runs of its datasets, and others.
        variants: in place of the table's own.
    """
    variants, datasets = variants or table.variants, {group.dataset for group in table.groups}
    methods = list(dict.fromkeys([*(row.model for row in table.rows), *UNPRINTED]))

    def place(of_row: Runs) -> tuple:
        run = of_row[0]
        by_method = methods.index(run["method"]) if run["method"] in methods else len(methods)
        return variants.index(run["ablation"] or "plain"), by_method, *(str(run[name] or "") for name in ROW)

    fitting = (run for run in runs.where(origin=datasets) if (run["ablation"] or "plain") in variants)
    return sorted(Runs(fitting).by(*ROW).values(), key=place)


def by_seed(runs: Runs, group: Group, metric: str) -> dict[int, float]:
    """Average a metric over the scenes of a group, for each seed that all scenes have.

    Empty if there is no such seed.
    """
    scores = {}
    for run in runs.where(origin=group.dataset, scene=group.scenes):
        of_run = run["test"].get(group.ability or run["ability"], {})
        if metric in of_run:
            scores[run["scene"], run["seed"]] = of_run[metric] * (100 if metric in DEPTH else 1)
    seeds = sorted({seed for _, seed in scores})
    whole = [seed for seed in seeds if all((scene, seed) in scores for scene in group.scenes)]
    return {seed: fmean(scores[scene, seed] for scene in group.scenes) for seed in whole}


def cells_of(runs: Runs, table: PaperTable) -> list[Estimate | None]:
    """Estimate every column's mean over the seeds of ``by_seed``; None where these are none."""
    cells = []
    for group, metric in table.columns:
        asked = len(runs.where(origin=group.dataset, scene=group.scenes).by("seed"))
        cell = Estimate.of(by_seed(runs, group, metric).values())
        cells.append(cell and replace(cell, asked=asked))
    return cells


def incomplete(table: PaperTable, runs: Runs) -> list[str]:
    """List the seeds that a mean over scenes leaves out, as they lack some of these."""
    lines, found = {}, measured(table, runs)
    for of_row, group in product(found, table.groups):
        of_seed = of_row.where(origin=group.dataset, scene=group.scenes).by("seed")
        absent = {seed: [s for s in group.scenes if not own.where(scene=s)] for seed, own in of_seed.items()}
        if len(set(map(tuple, absent.values()))) > 1:  # else no seed has these scenes
            for seed, scenes in absent.items():
                about = f"{table.title.partition(':')[0]}, {group.name}, {name_of(of_row, found)}"
                lines |= {f"{about}: seed {seed} has no {', '.join(scenes)}": None} if scenes else {}
    return [*lines]


def numbered(runs: Iterable[Row]) -> dict[str, int]:
    """Number each protocol from 1, in the order of the runs."""
    return {text: i for i, text in enumerate(dict.fromkeys(run["protocol"] for run in runs), 1)}


def costs_of(runs: Runs, numbers: Mapping[str, int]) -> list[Cell]:
    """Return the cells of ``COSTS``: means over the runs, and the numbers of their protocols."""
    means = [runs.mean(name) for name in ("train", "memory", "parameters", "steps")]
    protocols = sorted({numbers[run["protocol"]] for run in runs})
    return [*means, ", ".join(map(str, protocols)), Runs(runs[:1]).machines("")]


def comparison(table: PaperTable, runs: Runs, numbers: Mapping[str, int] | None = None) -> Table:
    """Make a table of each published row with the measured ones of its method below it, then the others.

    After each measured row comes its difference from the published one. Columns are of the datasets that the
    runs are of. In each column the best and the second best of the measured rows are marked, with all that
    tie, if all may be compared.

    Args:
        table: the paper's table.
        runs: those of the table's scenes.
        numbers: of the page's protocols, as of ``numbered``; None: those of ``runs`` alone.
    """
    found = measured(table, runs)
    datasets = {run["origin"] for of_row in found for run in of_row}
    table = replace(table, groups=[group for group in table.groups if group.dataset in datasets])
    numbers, no_costs = numbers or numbered(runs), [None] * len(COSTS)
    typed = ["type"] * len(table.type_of(None))
    lines, rules, places = [], [], {}
    for printed in [*table.rows, None]:
        of_method = [of_row for of_row in found if table.printed(of_row[0]) is printed]
        rules += [len(lines)] if of_method or (printed and lines and "published" not in lines[-1]) else []
        values = [printed.values[column] for column in table.columns] if printed else []
        kind = [*table.type_of(printed.model), "published"] if printed else []
        lines += [[printed.name, *kind, *values, *no_costs]] if printed else []
        for of_row in of_method:
            cells = cells_of(of_row, table)
            places[len(lines)] = of_row
            kind = [*table.type_of(of_row[0]["method"]), "measured"]
            lines.append([name_of(of_row, found), *kind, *cells, *costs_of(of_row, numbers)])
            if printed and any(cells):
                both = zip(cells, values)
                differences = [Difference(cell.mean - float(v)) if cell and v else None for cell, v in both]
                lines.append(["", *[""] * len(typed), "difference to the paper", *differences, *no_costs])
    columns = ["method", *typed, "kind", *(_column(*column) for column in table.columns), *COSTS]
    rules = [rule for rule in rules if rule]
    marks = _marks(places, table, 2 + len(typed))
    caption = " ".join(filter(None, [TYPES * len(typed), _caption(lines, marks)]))
    return Table(columns, lines, caption, marks, rules)


def stand_in(table: PaperTable, runs: Runs, numbers: Mapping[str, int] | None = None) -> Table | None:
    """Make a table of the runs on synthetic counterparts, with what was published for the same dataset's real
    scenes at its end.

    None if there are no such runs; ``numbers`` as of ``comparison``.
    """
    made, found = counterpart(table, runs), measured(table, runs)
    if made is None or not found:
        return None
    numbers, datasets = numbers or numbered(runs), {run["origin"] for of_row in found for run in of_row}
    scores = [group for group in table.groups if "psnr" in group.metrics and len(group.scenes) > 1]
    shown = [group for group in scores if group.dataset in datasets]
    lines = []
    for of_row in found:
        printed, own = table.printed(of_row[0]), {run["origin"] for run in of_row}
        values = [printed.values[of, "psnr"] if printed and of.dataset in own else "" for of in shown]
        beside = [printed.name if printed else "", *values]
        first = [name_of(of_row, found), *table.type_of(of_row[0]["method"])]
        lines.append([*first, *cells_of(of_row, made), *costs_of(of_row, numbers), *beside])
    typed = ["type"] * len(table.type_of(None))
    columns = ["measured", *typed, *(_column(*column) for column in made.columns), *COSTS, "published as"]
    columns += [f"published: {group.name} PSNR" for group in shown]
    marks = _marks(dict(enumerate(found)), made, 1 + len(typed))
    caption = " ".join(filter(None, [TYPES * len(typed), _caption(lines, marks)]))
    return Table(columns, lines, caption, marks).filled()


def counterpart(table: PaperTable, runs: Runs) -> PaperTable | None:
    """Return the table for the measured synthetic scenes, without printed rows, or None.

    A table scene by scene has none: its scenes are those of another table.
    """
    groups = {}
    for group in table.groups if not table.means else ():
        for scene in runs.where(origin=group.dataset).by("scene"):
            name = group.name if group.ability else scene
            groups[scene, group.ability, group.metrics] = group._replace(name=name, scenes=(scene,))
    return replace(table, groups=list(groups.values()), rows=[], means={}) if groups else None


def with_means(table: PaperTable, runs: Runs) -> PaperTable:
    """Add the means that the table asks for, and the mean of the measured scenes if these are others.

    A mean is a group of several scenes' groups; printed rows keep their digits.
    """
    scenes = max(({run["scene"] for run in row} for row in measured(table, runs)), key=len, default=set())
    asked = dict(table.means)
    order = tuple(group.scenes[0] for group in table.groups if group.scenes[0] in scenes)
    if asked and order and order not in asked.values():
        asked[f"Mean of the {len(order)} measured"] = order
    groups, rows = list(table.groups), list(table.rows)
    for name, scenes in asked.items():
        own = [group for group in table.groups if len(group.scenes) == 1 and group.scenes[0] in scenes]
        groups.append(of_all := own[0]._replace(name=name, scenes=scenes))
        for i, row in enumerate(rows):
            means = {}
            for metric in of_all.metrics:
                texts = [row.values[group, metric] for group in own]
                digits = max(len(text.partition(".")[2]) for text in texts)
                means[of_all, metric] = "" if "" in texts else f"{fmean(map(float, texts)):.{digits}f}"
            rows[i] = row._replace(values=row.values | means)
    return replace(table, groups=groups, rows=rows)


def name_of(runs: Runs, among: Sequence[Runs]) -> str:
    """Name a measured row: method or variant, and its conditions where those of the table differ."""
    run = runs[0]
    about = run["method"] if run["ablation"] is None else run["about"] or run["ablation"]
    name, own = f"forewarp: {about}" + " (the paper's method)" * (about == "forward"), _conditions(runs)
    name = " ".join([name, *run["words"].values()])
    if len({other[0]["image_format"] for other in among}) > 1:
        own.append(run["image_format"])
    alike = len(among) > 1 and all(_conditions(other) == own for other in among)
    return name if alike else ", ".join([name, *own])


def _conditions(runs: Runs) -> list[str]:
    run, seeds = runs[0], len(runs.by("seed"))
    more = {"seeds": seeds if seeds > 1 else 0, "views held out": run["held_out"]}
    more |= {"training views": run["train_views"], f"test view{'s' * (run['tested'] != 1)}": run["tested"]}
    numbers = [f"{number} {words}" for words, number in more.items() if number]
    return budget_of(run, by_processor=" of processor time") + numbers


def _column(group: Group, metric: str) -> Column:
    known = metric_of(metric)
    title = DEPTH.get(metric) or known.title.partition(" (")[0]
    return Column(f"{group.name} {title}{'↑' if known.higher_is_better else '↓'}", min(known.digits, 3))


def _marks(found: Mapping[int, Runs], table: PaperTable, first: int) -> dict:
    """Mark the best and the second best measured scores of each column from ``first`` on, with all that tie.

    None where rows differ in more than method and variant: in budget, machine or test views.

    Args:
        found: line -> runs of the measured row there.
        table: whose columns these are.
        first: column of the first score.
    """
    marks = {}
    comparable = len(Runs(of_row[0] for of_row in found.values()).by(*BUDGET)) == 1
    for j, (group, metric) in enumerate(table.columns if comparable else (), first):
        scores = {i: by_seed(of_row, group, metric) for i, of_row in found.items()}
        for mark, lines in zip(("best", "second"), rank(scores, metric_of(metric).higher_is_better)):
            marks |= {(i, j): mark for i in lines}
    return marks


def _caption(lines: Sequence[Sequence[Cell]], marks: Mapping) -> str:
    """Say what stands beside means, where there are any of several seeds, and what marks mean."""
    several = any(isinstance(cell, Estimate) and cell.count > 1 for line in lines for cell in line)
    return " ".join([f"{INTERVALS}."] * several + [MARKED] * bool(marks))


def write_paper(
    folder: Path, out: Path, published: Path | None = None, curves: Path | None = None
) -> list[Path]:
    """Write ``paper.md``, ``paper.tex``, ``paper.html``, a CSV file a table, and the figures.

    Tables without a measured row are left out.

    Args:
        folder, out: see above.
        published: file of the printed numbers; None: ``PAPER``.
        curves: folder of the pictures drawn by ``kind=accuracy_time``, shown too.
    """
    paper = read_paper(published or PAPER).values()
    runs, left_out = read_measured(folder, paper)
    if not runs:
        raise nothing(
            folder, runs, left_out, "runs with a metrics.json", "make some with make reproduce-tables"
        )
    for dataset, found in runs.by("origin").items():
        if dataset not in {group.dataset for table in paper for group in table.groups}:
            count = f"{dataset or 'no dataset'}, {len(found)} run{'s' * (len(found) > 1)}"
            left_out.append(f"{count}: not in any table of the paper; use kind=compare or kind=accuracy_time")
            print(left_out[-1])
    real, made = runs.where(counterpart=False), runs.where(counterpart=True)
    shown_runs = {table: [Runs(chain(*measured(table, kind))) for kind in (real, made)] for table in paper}
    used = Runs(run for kinds in shown_runs.values() for kind in kinds for run in kind)
    numbers, tables, files = numbered(used), [], []
    for table, (of_real, of_made) in shown_runs.items():
        name = "-".join(re.findall(r"\w+", table.title.split(",")[0].lower()))
        if of_real:
            shown = comparison(with_means(table, real), real, numbers)
            left_out += incomplete(with_means(table, real), real)
            notes = [f"published rows: the paper, {table.source}", *table.notes]
            tables.append(Section(table.title, [shown], facts(of_real, numbers), notes))
            files.append(out / f"paper-{name}.csv")
        if (shown := stand_in(table, made, numbers)) is not None:
            title = f"{table.title}: synthetic counterpart"
            tables.append(Section(title, [shown], facts(of_made, numbers)))
            files.append(out / f"paper-{name}-counterpart.csv")
    if absent := [table.title.split(":")[0] for table, kinds in shown_runs.items() if not any(kinds)]:
        left_out.append(f"no measured row: {', '.join(absent)}")
    for section, file in zip(tables, files):
        replace_file(file, section.tables[0].csv() + "".join(f"# {line}\n" for line in section.facts))
    drawn, figure_files = _figures(paper, runs, out, curves)
    sections = [*tables, *drawn, _about(tables, used, numbers)]
    sections += [Section("Left out", facts=left_out)] if left_out else []
    for kind in ("md", "html", "tex"):
        parts = {"sections": sections, "tables": tables, "figures": drawn}
        replace_file(out / f"paper.{kind}", rendered(f"paper.{kind}.j2", **parts))
    return [*(out / f"paper.{kind}" for kind in ("md", "html", "tex")), *files, *figure_files]


def read_measured(folder: Path, tables: Iterable[PaperTable]) -> tuple[Runs, list[str]]:
    """Read the measured runs, and a line for each other run, also of scenes of other files than most runs of
    that name have.

    A protocol names the kind of test view that is shown where columns of ``tables`` name none.
    """
    runs, left_out = read_any(folder)
    for same in grouped(((run["dataset"], scene_of(run)), run) for run in runs).values():
        named = Counter(run["scene"] for run in same if run["scene"] != scene_of(run))
        for name, count in named.most_common()[1:]:
            of_others = f"most runs of {scene_of(same[0])} are of other files"
            left_out.append(f"{name}: {count} run{'s' * (count > 1)}; {of_others}")
            print(left_out[-1])
            runs = Runs(run for run in runs if run["scene"] != name or run["dataset"] != same[0]["dataset"])
    for run in runs:
        run["scene"] = scene_of(run)
    open_kind = {group.dataset for table in tables for group in table.groups if group.ability is None}
    for run in runs:
        run.setdefault("late", late_gain(run["points"]))
        if run["origin"] in open_kind and run["ability"] != "all" and ", scores of " not in run["protocol"]:
            run["protocol"] += f", scores of test views {KINDS.get(run['ability'], run['ability'])}"
    return runs, left_out


def _about(tables: Iterable[Section], runs: Runs, numbers: Mapping[str, int]) -> Section:
    """Gather what a page tells once: how the runs were made, and each footnote with its tables."""
    notes = grouped((note, section.title.partition(":")[0]) for section in tables for note in section.notes)
    lines = [f"{', '.join(dict.fromkeys(titles))}: {note}" for note, titles in notes.items()]
    return Section("How they were measured", facts=[*facts(runs, numbers), *lines])


def facts(runs: Runs, numbers: Mapping[str, int]) -> list[str]:
    """State protocols by their numbers on the page, machine, budget, date and a command of the runs."""
    if not runs:
        return ["measured: nothing yet"]
    budgets = {", ".join(budget_of(run, " a run", " by the processor clock")) for run in runs}
    protocols = sorted((numbers[text], text) for text in runs.by("protocol"))
    count = len({run["folder"] for run in runs})
    return [
        *(f"protocol {number}: {text}" for number, text in protocols),
        f"machine: {runs.machines()}",
        f"budget: {'; '.join(sorted(budgets))}",
        f"date: {runs.days()}",
        f"command{f', one of {count} runs' * (count > 1)}: {runs[0]['command']}",
    ]


def budget_of(run: Row, each: str = "", by_processor: str = "") -> list[str]:
    """Name a run's preset, and the minutes and steps that bound it."""
    clock = by_processor if run["clock"] == "processor" else ""
    minutes = [f"{run['minutes']:g} min{each}{clock}"] if run["minutes"] else []
    return [run["preset"], *minutes, *([f"{run['iterations']} steps"] if run["iterations"] else [])]


def _figures(
    paper: Iterable[PaperTable], runs: Runs, out: Path, curves: Path | None
) -> tuple[list[Section], list[Path]]:
    """Draw what these runs allow, and add the pictures in ``curves``; say if matplotlib is missing.

    Also return the files written, without those copied.
    """
    runs = Runs(run for run in runs if run["folder"].is_dir())  # rows of a CSV file have no pictures
    plain = runs.where(ablation=None)
    try:
        sections, files = motion_figures.sections_of(runs, out)
        found = _views(paper, plain, out), _ablations(paper, runs, out), _resolutions(runs, out)
        others = [*chain(*found), *_networks(runs, out)]
    except ImportError as error:
        return [Section("Figures", facts=[str(error)])], []
    others = [section for section in others if None not in section.pictures]
    files += [path for section in others for path in section.pictures]
    sections += others
    for path in sorted(curves.glob("accuracy-time-*.png")) if curves is not None else ():
        if path.parent.resolve() != out.resolve():
            replace_file(out / path.name, image_bytes(path))
    if pictures := sorted(out.glob("accuracy-time-*.png")):
        told = "Separate runs, with views held out, of forewarp-report kind=accuracy_time."
        sections.append(Section("Accuracy against training time", pictures=pictures, caption=told))
    return sections, files


def _rivals(runs: Runs, name: str, order: Iterable[str]) -> dict[str, Row]:
    """Choose runs of one seed and budget to stand beside each other, where there are most: label -> row. A
    label is what ``name`` says, and the run's setting where several are there.

    Args:
        runs: of one scene.
        name: in what they differ.
        order: of what it says; others come last.
    """
    groups = runs.by("seed", *BUDGET).values()
    most = max(groups, key=lambda same: len(same.by(name, "setting")), default=Runs())
    places = {value: place for place, value in enumerate(order)}
    found = {}
    for run in sorted(most, key=lambda run: places.get(run[name], len(places))):
        several = len(most.where(**{name: run[name]}).by("setting")) > 1
        found[" ".join([run[name], *(run["words"].values() if several else ())])] = run
    return found


def _file(out: Path, *words: object) -> Path:
    """Name a picture; what could not stand in LaTeX or a link becomes a hyphen."""
    return out / f"paper-{'-'.join(re.sub(r'[^A-Za-z0-9_-]+', '-', str(word)) for word in words)}.png"


def _views(paper: Iterable[PaperTable], plain: Runs, out: Path) -> Iterator[Section]:
    """Draw, of each scene, a test view by all methods."""
    order = dict.fromkeys(chain(["forward"], *(table.types for table in paper)))
    for dataset, scene in product(DATASETS, plain.by("scene")):
        if rivals := _rivals(plain.where(origin=dataset, scene=scene), "method", order):
            drawn = figures.draw_details(_file(out, "views", dataset, scene), rivals)
            caption = f"{_seen(rivals)} by each method; {_BOXED}."
            yield Section(f"Test view: {dataset}, {scene}", pictures=[drawn], caption=caption)


_BOXED = "below it enlarged what is in the box, where methods differ most; under it the view's PSNR"


def _seen(rivals: Mapping[str, Row]) -> str:
    run = next(iter(rivals.values()))
    about = ", ".join([*budget_of(run), f"seed {run['seed']}"])
    return f"The test view nearest to the middle of the time ({about})"


def _ablations(paper: Iterable[PaperTable], runs: Runs, out: Path) -> Iterator[Section]:
    """Draw images and depth by ablation, of the scenes of the table by kind of view (Lego Complete)."""
    for table in (table for table in paper if any(group.ability for group in table.groups)):
        names = {row.variant or row.model: row.name.split(" (")[0] for row in [*table.parts, *table.rows]}
        others = {row.model for row in table.rows if row.variant is None}
        of_table = runs.where(origin={group.dataset for group in table.groups}, ablation={None, *names})
        shown = (run for run in of_table if run["ablation"] or run["method"] in others)
        labelled = Runs(run | {"label": names[run["ablation"] or run["method"]]} for run in shown)
        for scene, of_scene in labelled.by("scene").items():
            rivals = _rivals(of_scene, "label", names.values())
            if sum(run["ablation"] is not None for run in rivals.values()) > 1:
                drawn = figures.draw_details(_file(out, "ablation", scene), rivals, depth=True)
                caption = f"{_seen(rivals)} by the whole method and without each part; {_BOXED}; at last the "
                caption += "depth, in the colours of the true one, if that is known."
                yield Section(f"Images and depth by ablation: {scene}", pictures=[drawn], caption=caption)


def _resolutions(runs: Runs, out: Path) -> Iterator[Section]:
    """Draw PSNR over voxels along a side, and of each scene a test view by them."""
    lines = figures.by_side(run for run in runs if str(run["ablation"]).startswith("resolution "))
    drawn = figures.draw_resolution(_file(out, "resolution"), lines)
    told = "PSNR by the voxels along a side of the moving grid; bars: as ± in the tables."
    yield Section("Performance with different resolutions", pictures=[drawn], caption=told)
    for label, sides in lines.items():
        sized = Runs(run | {"label": f"{side}³"} for side, of_side in sides.items() for run in of_side)
        rivals, scene = _rivals(sized, "label", [f"{side}³" for side in sides]), sized[0]["scene"]
        drawn = figures.draw_details(_file(out, "resolution", *label.split(", ")), rivals)
        caption = f"{_seen(rivals)} by the number of voxels of the moving grid; {_BOXED}."
        yield Section(f"Test view by resolution: {scene}", pictures=[drawn], caption=caption)


def _networks(runs: Runs, out: Path) -> Iterator[Section]:
    """Draw each network that runs describe once, whichever runs have it."""
    known: dict[tuple[str, str], Row] = {}
    for run in runs:
        for name, steps in (read_json(run["folder"] / "networks.json") or {}).items():
            known.setdefault((name, json.dumps(steps)), run)
    for number, ((name, text), run) in enumerate(known.items(), 1):
        with refused(f"{run['folder'] / 'networks.json'}: expected steps of networks, but got "):
            steps = json.loads(text)
            drawn = figures.draw_network(_file(out, name, *[number] * (number > 1)), steps)
            count = sum(step["parameters"] for step in steps)
        caption = f"Read off the module of {run['method']}, preset {run['preset']}: {count:,} parameters. "
        caption += "A box is a volume, the number above it its channels; N voxels along a side are given."
        yield Section(f"Network: {name}", pictures=[drawn], caption=caption)


def write_ablation(folder: Path, out: Path, published: Path | None = None) -> list[Path]:
    """Write ``ablation.md`` and ``ablation.csv`` (every run), of runs at rest ``ablation-at-rest.csv``.

    The part of a page already there that these runs do not fill, at rest or not, stays.

    Args:
        folder: of runs of ``sweeps=ablation_modules``, ``ablation_losses`` and ``ablation_converged``.
        out: see above.
        published: file of the printed numbers; None: ``PAPER``.

    Raises:
        ValueError: if no run is of an ablation.
    """
    paper = read_paper(published or PAPER).values()
    runs, left_out = read_measured(folder, paper)
    # Tables that take the method apart; a table scene by scene repeats another.
    tables = [table for table in paper if not table.means and len(table.parts) > 1]
    known, read = {row.variant for table in tables for row in table.parts}, runs
    rest = Runs(r for r in runs.where(preset=AT_REST) if r["ablation"] in known or r["method"] == "backward")
    runs = Runs(run for run in runs.where(ablation=known) if run["preset"] != AT_REST)
    if not runs and not rest:
        takes = "runs of ablation=full, no_tv, no_inpainter, ... with a metrics.json"
        raise nothing(folder, read, left_out, takes, "make some with make ablations")
    page, files = out / "ablation.md", [out / "ablation.md"]
    earlier = read_text(page) if page.is_file() else ""
    kept = OF_REST.search(earlier)
    part = rendered("at_rest.md.j2", **_at_rest(tables, rest)) if rest else kept[0] if kept else ""
    text = OF_REST.sub("", earlier if earlier and not runs else _page(tables, runs, left_out))
    before, heading, after = text.partition("\n## ")
    replace_file(page, f"{before.rstrip()}\n\n{part.strip()}\n{heading}{after}" if part else text)
    for found, name in ((runs, "ablation.csv"), (rest, "ablation-at-rest.csv")):
        if found:
            replace_file(out / name, stored_csv(found))
            files.append(out / name)
    return files


def _page(tables: Sequence[PaperTable], runs: Runs, left_out: Sequence[str]) -> str:
    """Make the page of all runs that are not at rest."""
    numbers = numbered(runs)
    orders: dict[str, list[tuple[str, Estimate]]] = {}  # by budget: each row's order, and its difference
    sections = [section for table in tables for section in _ablated(table, runs, orders, numbers)]
    lines = []
    for budget, rows in orders.items():
        counts = [sum(order.startswith(kind) for order, _ in rows) for kind in ORDERS]
        lines.append([budget, len(rows), *counts, len(rows) - sum(counts)])
    columns = ["budget of a run", *(Column(kind, 0) for kind in ("rows", *ORDERS, "too few seeds"))]
    chance = by_chance(change for rows in orders.values() for _, change in rows)
    caption = f"Rows of all tables below, by what became of the paper's order. {chance}"
    used = runs.where(ablation={variant for table in tables for variant in table.variants})
    about = _about(sections, used, numbers)
    sections = [Section("In short", [Table(columns, lines, caption)]), *sections, about] if runs else []
    sections += [Section("Left out", facts=left_out)] if left_out else []
    return rendered("ablation.md.j2", sections=sections)


def _at_rest(tables: Sequence[PaperTable], runs: Runs) -> dict:
    """Make what ``at_rest.md.j2`` shows: what each part changes where training has come to rest."""
    columns = ["scene", "row of the paper", Column("paper, dB", signed=True), "PSNR"]
    columns += [Column("difference", signed=True), "order", "canonical", Column("last fifth", signed=True)]
    columns += [Column("steps", 0, spread=False), Column("minutes", 1)]
    lines: list[list[Cell]] = []
    for table in tables:
        known = runs.by("setting", *BUDGET).values() if "no_upsampling" in table.variants else ()
        for group, own, _ in chain(*(_groups(table, same) for same in known)):
            printed, scene = _printed_changes(table, group), ", ".join(group.scenes)
            rows = [(row.name, row.variant, own.where(ablation=row.variant)) for row in table.parts]
            rows.append(("a backward warp (not in the paper)", None, own.where(method="backward")))
            psnr = [by_seed(of_row, group, "psnr") for *_, of_row in rows]
            for (name, variant, of_row), scores in zip(rows, psnr, strict=True):
                if scores:
                    change = _change(of_row, rows[0][-1], group) if variant != "full" else None
                    order = order_of(change, printed.get(variant))
                    late = of_row.estimate("late")
                    line = [scene, name, printed.get(variant), Estimate.of(scores.values()), change, order]
                    took = of_row.mean("train")
                    line += [of_row.estimate("psnr_canonical"), late]
                    lines.append([*line, of_row.mean("steps"), took and took / 60])
    table = Table(columns, lines, by_chance(line[4] for line in lines))
    return {"table": table, "facts": facts(runs, numbered(runs))}


def late_gain(points: Sequence[Point]) -> float | None:
    """Return by how much PSNR (dB) rises in the last fifth of a run's training; None without a curve."""
    if len(points) < 2:
        return None
    seconds, psnr = zip(*((point.seconds, point.psnr) for point in points))
    return psnr[-1] - float(np.interp((1 - LAST) * seconds[-1], seconds, psnr))


def _groups(table: PaperTable, runs: Runs) -> Iterator[tuple[Group, Runs, bool]]:
    """Give each scene, or mean of scenes, of which there are runs, with these and whether they are of a
    counterpart.
    """
    for made in (False, True):
        of_kind = runs.where(counterpart=made)
        shown = counterpart(table, of_kind) if made else table
        for group in shown.groups if shown else ():
            own = of_kind.where(scene=group.scenes, origin=group.dataset)
            if scenes := tuple(scene for scene in group.scenes if own.where(scene=scene)):
                yield group._replace(scenes=scenes), own, made


def _ablated(
    table: PaperTable, runs: Runs, orders: dict[str, list[tuple[str, Estimate]]], numbers: Mapping[str, int]
) -> list[Section]:
    """Make a section for each scene, or mean of scenes, on which the table's rows were measured."""
    sections = []
    for group, own, made in _groups(table, runs):
        changes = _changes(table, group, own, orders)
        if changes is not None:
            whole = next((of.scenes for of in table.groups if of.name == group.name), group.scenes)
            title = f"{table.title}: {group.name}"
            title += f", of which {', '.join(group.scenes)}" if not made and group.scenes != whole else ""
            title += f", {group.scenes[0]}" if made and group.name != group.scenes[0] else ""
            used = own.where(ablation=set(table.variants))
            sections.append(Section(title, [changes], facts(used, numbers), table.notes))
    return sections


def _changes(
    table: PaperTable, group: Group, runs: Runs, orders: dict[str, list[tuple[str, Estimate]]]
) -> Table | None:
    """List what each row changes on the scenes of ``group``, for each budget; None if nothing was measured.

    Args:
        table: the paper's table.
        group: the scenes and the kind of test view; of the table, or of its counterpart.
        runs: of the group's scenes.
        orders: what became of the paper's order is added here, by budget, with the difference.
    """
    variants = list(runs.by("ablation"))
    by_budget: dict[tuple, dict[str, Runs]] = {}
    for of_row in measured(table, runs.where(method="forward"), variants):
        if by_seed(of_row, group, "psnr"):
            budget = tuple(of_row[0][name] for name in ("setting", *BUDGET))
            by_budget.setdefault(budget, {})[of_row[0]["ablation"]] = of_row
    own = {row.variant for row in table.parts} - {"full"}
    budgets = [found for found in by_budget.values() if "full" in found and own & set(found)]
    budgets.sort(key=lambda found: [found["full"][0][name] or math.inf for name in ("minutes", "iterations")])
    if not budgets:
        return None
    printed = _printed_changes(table, group)
    columns, captions = ["row of the paper", Column("paper, dB", signed=True)], []
    lines: list[list[Cell]] = [[row.name, printed.get(row.variant)] for row in table.parts]
    for found in budgets:
        label = _label(found["full"][0], [other["full"][0] for other in budgets])
        psnr = {variant: by_seed(of_row, group, "psnr") for variant, of_row in found.items()}
        whole = psnr["full"]
        columns += [f"{label}: PSNR", Column("difference", signed=True), "order"]
        columns += [Column("s a step", 3), Column("of a step of Ours", prefix="×")]
        captions.append(f"{label}, {len(whole)} seed{'s' * (len(whole) != 1)}")
        for row, line in zip(table.parts, lines):
            if row.variant not in found:
                line += [None] * 5
                continue
            of_full = found[row.variant], found["full"], group
            change = _change(*of_full) if row.variant != "full" else None
            if order := order_of(change, printed.get(row.variant)):
                fewer = LEAST <= change.count < len(whole)
                order += f" ({change.count} of {len(whole)} seeds)" * fewer
                orders.setdefault(label, []).append((order, change))
            step, of_whole = found[row.variant].mean("step"), found["full"].mean("step")
            times = step / of_whole if step and of_whole else None
            line += [Estimate.of(psnr[row.variant].values()), change, order, step, times]
    kept = [line for line in lines if any(cell is not None for cell in line[2:])]
    about = "; ".join(captions) + "."
    if any(group.ability in (row.get(UNPAIRED) or "").split("; ") for row in runs):
        about += " Which seed has which score was not kept, so that there are no differences in pairs."
    return Table(columns, kept, about)


def _change(runs: Runs, whole: Runs, group: Group) -> Estimate | None:
    """Estimate how PSNR by seed differs from that of ``Ours`` with the same seeds; None where these share
    none, or a table does not know which seed has which score.
    """
    if any(group.ability in (row.get(UNPAIRED) or "").split("; ") for row in (*runs, *whole)):
        return None
    now, before = ({s: {"psnr": v} for s, v in by_seed(own, group, "psnr").items()} for own in (runs, whole))
    return paired_change([(now[seed], before[seed]) for seed in now if seed in before], "psnr")


def order_of(change: Estimate | None, printed: float | None) -> str:
    """Say whether a row's order to ``Ours`` is the one that the paper prints; "" where it prints none.

    >>> [order_of(Estimate(mean, 0.1, 3), -1.0) for mean in (-0.5, 0.5, -0.1)]
    ['holds', 'reversed', 'no difference shown']
    >>> order_of(Estimate(-0.5, 0.1, 2), -1.0), order_of(Estimate(-0.5, 0.1, 3), None)
    ('two seeds', '')
    """
    if change is None or not printed:
        return ""
    return verdict(change, *(("holds", "reversed") if printed > 0 else ("reversed", "holds")))


def _printed_changes(table: PaperTable, group: Group) -> dict[str, float]:
    """Return by variant the printed difference to ``Ours``, in the widest mean of this kind of view."""
    same = [g for g in table.groups if (g.dataset, g.ability) == (group.dataset, group.ability)]
    widest = group if group in same else max(same, key=lambda g: len(g.scenes))
    texts = {row.variant: row.values[widest, "psnr"] for row in table.parts}
    numbers = {variant: float(text) for variant, text in texts.items() if text}
    whole = numbers.pop("full", None)
    return {variant: number - whole for variant, number in numbers.items()} if whole is not None else {}


def _label(run: Row, others: Sequence[Row]) -> str:
    """Name a run's budget, with what else tells it from the others."""
    parts = [*budget_of(run)[1:], *run["words"].values()]
    for name in ("preset", "device", "threads", "clock", "tested", "held_out", "train_views", "image_format"):
        several = len({other[name] for other in others}) > 1
        parts += [f"{name.replace('_', ' ').replace('tested', 'views')} {run[name]}"] if several else []
    return ", ".join(parts)
