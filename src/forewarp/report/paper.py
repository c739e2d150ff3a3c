"""Write the paper's tables and figures with measured and printed numbers side by side."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

from forewarp.files import replace_file
from forewarp.report import page, paper_figures
from forewarp.report.collect import Result, collect, machine
from forewarp.report.page import Section
from forewarp.report.paper_printed import PAPER, PaperTable, read_paper
from forewarp.report.paper_tables import comparison, measured, row_of, runs_of, stand_in, with_means
from forewarp.report.protocols import numbered

TITLE = "The paper's tables, measured"
INTRODUCTION = (
    "Written by `forewarp-report kind=paper`. Rows marked measured are runs of this project, those marked "
    "published are what the paper prints. `forward` is the paper's method, `backward` its opponent, "
    "`particles` this project's own; the others are our own versions of the systems they are named after. "
    "The best and the second are marked among measured rows, if all are of the same budget, machine and "
    "test views. Over several seeds: mean ± standard deviation. Of a scene with several kinds of test "
    "views, columns that name no kind show those between the training times. A cell without a run is "
    "empty; a method that gets nowhere in its minutes stands there with what it reached, and a run that "
    "stopped, as at a dead start, is listed as left out. Memory, parameters and steps are means over a "
    "row's runs; the protocol of each row stands below its table. Synthetic counterparts are procedural "
    "scenes in a dataset's format: their numbers are not comparable with those published for real scenes, "
    "which stand in the last columns. Runs as short as those of `make reproduce-tables` without DATA (a "
    "minute of processor time) prove the machinery, not the ranking: only longer runs on real scenes tell "
    "which method is better."
)
COUNTERPART = ": synthetic counterpart"
METHODS = ("particles", "forward", "backward")  # that are compared in pictures
DATASETS = ("dnerf", "hypernerf", "nhr", "lego_complete")


def write_paper(runs: Path, out: Path, published: Path = PAPER, curves: Path | None = None) -> list[Path]:
    """Write ``paper.md``, ``paper.tex``, ``paper.html``, a CSV file a table, and the figures.

    Args:
        runs: folder to search for measured runs.
        out: folder to write to.
        published: file of the printed numbers.
        curves: folder of the pictures drawn by ``kind=accuracy_time``, shown too.

    Returns:
        the files written.
    """
    results, without = collect(runs, ["metrics.json"])
    results, older = newest(results)
    tables = [section for table in read_paper(published).values() for section in sections_of(table, results)]
    figures, drawn = figures_of(results, out, curves)
    sections = [*tables, *figures]
    if lines := [*without, *(f"{run.folder}: another run of the same is newer" for run in older)]:
        sections.append(Section("Left out", facts=lines))
    files = {
        "paper.md": page.markdown(TITLE, INTRODUCTION, sections),
        "paper.html": page.html(TITLE, INTRODUCTION.replace("`", ""), sections),
        "paper.tex": page.latex(tables),
    }
    for name, text in files.items():
        replace_file(out / name, text)
    return [out / name for name in files] + _write_csv(tables, out) + drawn


def newest(results: Sequence[Result]) -> tuple[list[Result], list[Result]]:
    """Of runs with the same table entry select the one measured last; return these runs, and the others."""
    kept: dict[tuple, Result] = {}
    for run in sorted(results, key=lambda run: run.measured_at):
        kept[run.dataset, run.is_counterpart, run.scene, run.seed, row_of(run)] = run
    chosen = {run.folder for run in kept.values()}
    return [r for r in results if r.folder in chosen], [r for r in results if r.folder not in chosen]


def sections_of(table: PaperTable, results: Sequence[Result]) -> list[Section]:
    """Make the paper's table, and a table of the synthetic counterparts if any were measured."""
    real = [run for run in results if not run.is_counterpart]
    made = [run for run in results if run.is_counterpart]
    printed = with_means(table, real)
    source = f"published rows: the paper, {table.source}"
    lines = [source, *facts(runs_of(measured(table, real)))]
    found = [Section(table.title, [comparison(printed, real)], lines, table.notes)]
    if (beside := stand_in(table, made)) is not None:
        found.append(Section(table.title + COUNTERPART, [beside], facts(runs_of(measured(table, made)))))
    return found


def facts(runs: Sequence[Result]) -> list[str]:
    """State protocol, machine, budget, date and command of the runs."""
    if not runs:
        return ["measured: nothing yet"]
    days = sorted({run.day for run in runs})
    budgets = sorted({_budget(run) for run in runs})
    return [
        *(f"protocol {number}: {text}" for text, number in numbered(runs).items()),
        f"machine: {machine(runs)}",
        f"budget: {'; '.join(budgets)}",
        f"date: {' to '.join(dict.fromkeys((days[0], days[-1])))}",
        f"command, one of {len(runs)} runs: {runs[0].command}",
    ]


def figures_of(results: Sequence[Result], out: Path, curves: Path | None) -> tuple[list[Section], list[Path]]:
    """Draw what these runs allow, and add the pictures in ``curves``; say if matplotlib is missing."""
    try:
        found = _draw(results, out)
    except ImportError as error:
        return [Section("Figures", facts=[str(error)])], []
    found = [(title, path, facts(runs)) for title, path, runs in found if path is not None]
    sections = [Section(title, facts=lines, pictures=[path]) for title, path, lines in found]
    for path in sorted(curves.glob("accuracy-time-*.png")) if curves is not None else ():
        if path.parent.resolve() != out.resolve():
            shutil.copyfile(path, out / path.name)
    if drawn := sorted(out.glob("accuracy-time-*.png")):
        lines = ["separate runs, with views held out: forewarp-report kind=accuracy_time"]
        sections.append(Section("Accuracy against training time", facts=lines, pictures=drawn))
    return sections, [path for _, path, _ in found]


def _draw(results: Sequence[Result], out: Path) -> list[tuple[str, Path | None, list[Result]]]:
    sides = [run for run in results if paper_figures.RESOLUTION.match(run.variant)]
    found = [("Resolution", paper_figures.draw_resolution(out / "paper-resolution.png", sides), sides)]
    plain = [run for run in results if row_of(run).variant == "plain"]
    for scene, rivals in _rivals(plain).items():
        path = paper_figures.draw_canonical(out / f"paper-canonical-{scene}.png", rivals)
        found.append((f"Canonical comparison: {scene}", path, list(rivals.values())))
    for dataset, method in product(DATASETS, METHODS[:2]):
        runs = [r for r in plain if r.dataset == dataset and r.config["model"]["name"] == method]
        runs = list({run.scene: run for run in runs}.values())
        path = paper_figures.draw_sheet(out / f"paper-views-{dataset}-{method}.png", runs)
        found.append((f"Views: {dataset}, {method}", path, runs))
    return found


def _rivals(runs: Sequence[Result]) -> dict[str, dict[str, Result]]:
    """Return for each scene runs of several methods by their names, equal in preset, budget and seed."""
    equal: dict[tuple, dict[str, Result]] = {}
    for run in runs:
        row = row_of(run)
        equal.setdefault((run.scene, run.seed, row._replace(model="")), {})[row.model] = run
    several = {key[0]: rivals for key, rivals in equal.items() if len(rivals.keys() & set(METHODS)) > 1}
    return {scene: {m: found[m] for m in METHODS if m in found} for scene, found in sorted(several.items())}


def _write_csv(sections: Sequence[Section], out: Path) -> list[Path]:
    files = []
    for section in sections:
        title = section.title.removesuffix(COUNTERPART)
        name = "".join(c if c.isalnum() else "-" for c in title.split(",")[0].lower())
        name += "-counterpart" * (title != section.title)
        files.append(out / f"paper-{'-'.join(part for part in name.split('-') if part)}.csv")
        about = "".join(f"# {line}\n" for line in section.facts)
        replace_file(files[-1], replace(section.tables[0], marks={}).csv() + about)
    return files


def _budget(run: Result) -> str:
    budget = run.config["budget"]
    minutes = f"{budget['minutes']:g} min a run" if budget["minutes"] else ""
    minutes += " by the processor clock" if minutes and run.clock == "processor" else ""
    steps = f"{budget['iterations']} steps" if budget.get("iterations") else ""
    return ", ".join(word for word in (run.config["preset"]["name"], minutes, steps) if word)
