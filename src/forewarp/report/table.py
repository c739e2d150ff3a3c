"""Make one table of any runs: what its rows, columns and cells are is asked for by name.

A cell is the mean over seeds. Runs that differ in more are refused, never pooled.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from forewarp.files import replace_file
from forewarp.metrics.registry import METRICS, metric_of
from forewarp.report.figures import figure_of, pareto_front, save
from forewarp.report.results import Row, Runs, length, nothing, read_folders, score_of
from forewarp.report.settings import CONDITIONS, grouped, key_of, value_text
from forewarp.report.statistics import INTERVALS, Estimate, rank
from forewarp.report.tables import MARKED, Column, Table, rendered

# What rows and columns may be of, beside keys of config.yaml: name -> column of a row of ``results``.
FIELDS = {"model": "method", "method": "method", "preset": "preset", "scene": "scene", "dataset": "dataset"}
FIELDS |= {"minutes": "minutes", "variant": "variant", "ablation": "ablation", "seed": "seed"}
FIELDS |= {name: name for name in CONDITIONS}
# What runs of a cell share, in the order in which a difference is told.
SHARED = ("scene", "dataset", "method", "preset", "ablation", "minutes", *CONDITIONS, "setting")
# Costs that stand beside metrics: column of a row -> its heading and digits; fewer are better.
COSTS = {"train": ("training (s)", 1), "step": ("s/step", 3), "frame": ("s/image", 3), "memory": ("GiB", 2)}
COSTS |= {"bytes": ("parameters (MB)", 2), "parameters": ("parameters (M)", 3), "steps": ("steps", 0)}
PANELS = {"train": "seconds of training", "memory": "memory (GiB)", "bytes": "parameters (MB)"}


def write_table(
    folders: Sequence[Path],
    out: Path,
    *,
    rows: Sequence[str] = ("variant",),
    columns: Sequence[str] = ("scene",),
    metrics: Sequence[str] = ("psnr",),
    pareto: bool = False,
) -> tuple[str, list[Path]]:
    """Write ``table.md``, ``table.tex`` and ``table.csv``, and with ``pareto`` ``table-pareto.png``.

    Args:
        folders: searched for measured runs.
        out: folder to write to.
        rows, columns: names of ``FIELDS``, or keys of ``config.yaml``, whole or their last parts.
        metrics: names in ``metrics.json``, of the usual test views or as ``space/psnr``; or of ``COSTS``.
        pareto: draw the first metric that a run has against seconds, memory and bytes.

    Returns:
        the table as Markdown, and the files written.

    Raises:
        ValueError: if there is no run, a name is unknown or ambiguous, no run has a metric, or runs of one
            cell differ in more than the seed.
    """
    runs, left_out = read_folders(folders)
    if not runs:
        raise nothing(
            Path(", ".join(map(str, folders))), runs, left_out, "runs with a metrics.json", "make some"
        )
    for row in runs:
        told = (row["metrics"].get("protocol") or {}).get("megabytes")  # of images from elsewhere
        row["bytes"] = told if row["parameters"] is None else 4 * row["parameters"]  # of 32 bits
    cells = runs_by_cell(runs, rows, columns)
    table = table_of(cells, rows, columns, metrics)
    text = f"{table}\n" + "".join(f"\nLeft out: {line}\n" for line in left_out)
    files = {"table.md": text, "table.csv": table.csv()}
    files["table.tex"] = rendered("table.tex.j2", table=table)
    for name, content in files.items():
        replace_file(out / name, content)
    written = [out / name for name in files]
    if pareto:
        present = next(name for name in metrics if any(value_of(run, name) is not None for run in runs))
        written.append(draw_pareto(out / "table-pareto.png", cells, present, rows, columns))
    return text, written


def field(name: str, runs: Sequence[Row], where: str) -> Callable[[Row], object]:
    """Return what tells a row's value of a field.

    Args:
        name: of ``FIELDS``, or a key of the runs' configurations, or its last parts where only one key, or
            only one in which runs differ, ends so.
        runs: all runs.
        where: key of the command, for errors.

    Raises:
        ValueError: if no key, or several, are meant.
    """
    if name in FIELDS:
        return lambda row: row[FIELDS[name]]
    values: dict[str, set] = {}
    for row in runs:
        for key, value in row["configuration"].items():
            values.setdefault(key.removesuffix("._target_"), set()).add(value)
    parts = re.split(r"[./]", name)
    ends = [key for key in values if key.split(".")[-len(parts) :] == parts]
    differing = [key for key in ends if len(values[key]) > 1 or any(key not in _keys(row) for row in runs)]
    matching = [key for key in ends if key == ".".join(parts)] or (differing if len(differing) == 1 else ends)
    expected = f"{', '.join(dict.fromkeys(FIELDS))} or a key of config.yaml"
    if not matching:
        raise ValueError(f"{where}: expected {expected}, but got {name}")
    if len(matching) > 1:
        raise ValueError(
            f"{where}: expected one key, but got {name}, which ends {', '.join(sorted(matching)[:4])}"
        )
    return lambda row: value_text(matching[0], row["configuration"])


def _keys(row: Row) -> set[str]:
    return {key.removesuffix("._target_") for key in row["configuration"]}


def runs_by_cell(runs: Runs, rows: Sequence[str], columns: Sequence[str]) -> dict[tuple[tuple, tuple], Runs]:
    """Group runs by the values of rows and of columns, in the order of these.

    Raises:
        ValueError: if runs of one group differ in more than the seed, naming what to add to ``rows=``.
    """
    sides = [
        [field(name, runs, where) for name in names]
        for where, names in (("rows", rows), ("columns", columns))
    ]
    placed = grouped((tuple(tuple(read(row) for read in side) for side in sides), row) for row in runs)
    for key, of_cell in placed.items():
        name = next((n for n in SHARED if len({key_of(row, (n,)) for row in of_cell}) > 1), None)
        if name is not None:
            values = sorted({_shown(row[name]) for row in of_cell})
            add = {"method": "model", "ablation": "variant", "setting": "variant"}.get(name, name)
            if name == "setting":
                words = [row["words"] for row in of_cell]
                keys = {k for of_run in words for k in of_run if len({other.get(k) for other in words}) > 1}
                values = sorted(
                    {
                        " ".join(of_run[k] for k in sorted(keys) if k in of_run) or "neither"
                        for of_run in words
                    }
                )
                keys = {k for k in keys if all(k in _keys(row) for row in of_cell)}
                add = min(keys, default="variant")
            cell = ", ".join(_shown(value) for side in key for value in side) or "of all"
            expected = f"expected in a cell runs that differ in the seed alone, but got in {cell}"
            more = f"add {add} to rows= or columns=, or name fewer runs"
            raise ValueError(f"rows: {expected} {' and '.join(values[:4])}; {more}")
    order = [sorted({key[side] for key in placed}, key=_order) for side in (0, 1)]
    return {(r, c): Runs(placed[r, c]) for r in order[0] for c in order[1] if (r, c) in placed}


def _order(values: tuple) -> list[tuple]:
    """Sort numbers by their size, and what is none after them by name."""
    order = []
    for value in values:
        try:
            order.append((0, float(value), ""))
        except (TypeError, ValueError):
            order.append((1, 0.0, str(value)))
    return order


def _shown(value: object) -> str:
    if value is None or value == "":
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def value_of(row: Row, metric: str) -> float | None:
    """Return a row's value of a metric or cost; ``KIND/METRIC`` is of that kind of test view."""
    if metric in COSTS:
        return row[metric]
    kind, slash, name = metric.rpartition("/")
    return score_of(row["test"].get(kind if slash else row["ability"], {}), name)


def table_of(
    cells: Mapping[tuple[tuple, tuple], Runs],
    rows: Sequence[str],
    columns: Sequence[str],
    metrics: Sequence[str],
) -> Table:
    """Make the table; in each column the best, with all whose difference from it is not shown, is marked.

    Args:
        cells: as of ``runs_by_cell``.
        rows, columns, metrics: as of ``write_table``.

    Raises:
        ValueError: if no run has a metric.
    """
    heads = list(dict.fromkeys(column for _, column in cells))
    titles = list(dict.fromkeys(row for row, _ in cells))
    every = Runs(run for of_cell in cells.values() for run in of_cell)
    absent = [name for name in metrics if all(value_of(run, name) is None for run in every)]
    if len(absent) == len(metrics) or not {*absent} <= {"lpips", *METRICS, *COSTS}:
        tested = (run["test"].get(run["ability"], {}) for run in every)
        scores = (name for of_run in tested for name, value in of_run.items() if value is not None)
        choices = dict.fromkeys([*scores, *COSTS])
        kinds = dict.fromkeys(kind for run in every for kind in run["test"])
        expected = f"{', '.join(choices)}, or {'/, '.join(kinds)}/ before one"
        raise ValueError(f"metric: expected {expected}, but got {', '.join(absent)}, which no run has")
    lines: list[list] = [[_shown(value) for value in title] for title in titles]
    shown, marks = [Column(name, None) for name in rows], {}
    for head in heads:
        for metric in (name for name in metrics if name not in absent):
            kind, _, name = metric.rpartition("/")
            heading, digits, higher = _heading(name if metric not in COSTS else metric)
            words = [*_labels(columns, head), *([kind] if kind else [])]
            shown.append(Column(" ".join([*words, f"{heading}{'↑' if higher else '↓'}"]), digits))
            values = {}
            for i, title in enumerate(titles):
                of_cell = {run["seed"]: value_of(run, metric) for run in cells.get((title, head), ())}
                values[i] = {seed: value for seed, value in of_cell.items() if value is not None}
                lines[i].append(Estimate.of(values[i].values()))
            ranked = {i: of_cell for i, of_cell in values.items() if of_cell and _alike(cells, head, rows)}
            places = rank(ranked, higher)
            for place, mark in zip(places, ("best", "second")):
                marks |= {(i, len(shown) - 1): mark for i in place}
    without = f" No run has {', '.join(absent)}." if absent else ""
    return Table(shown, lines, caption(every, cells) + without, marks=marks)


def _labels(names: Sequence[str], values: Sequence[object]) -> list[str]:
    """Write values of fields; a number, and what a key of ``config.yaml`` has, with its name.

    >>> _labels(["scene", "objective.fine.weights.rigid"], ["hook", "0"]), _labels(["minutes"], [1.0])
    (['hook', 'rigid=0'], ['minutes=1'])
    """
    pairs = [(re.split(r"[./]", name)[-1], name, _shown(value)) for name, value in zip(names, values)]
    plain = {name for name, column in FIELDS.items() if column not in (*CONDITIONS, "minutes")}
    return [text if name in plain else f"{short}={text}" for short, name, text in pairs]


def _heading(metric: str) -> tuple[str, int, bool]:
    if metric in COSTS:
        return *COSTS[metric], False
    described = metric_of(metric)
    return described.heading, described.digits, described.higher_is_better


def _alike(cells: Mapping, head: tuple, rows: Sequence[str]) -> bool:
    """Tell whether the cells of a column may be ranked: they differ in no condition but those of the rows."""
    names = [name for name in ("scene", "dataset", "minutes", *CONDITIONS) if name not in rows]
    return len({key_of(of_cell[0], names) for (_, column), of_cell in cells.items() if column == head}) == 1


def caption(runs: Runs, cells: Mapping) -> str:
    """Say how many seeds cells are of, the budget, the machine, and what was measured."""
    counts = sorted({len(of_cell) for of_cell in cells.values()})
    seeds = (
        f"{counts[0]} seed{'s' * (counts[-1] > 1)}"
        if len(counts) == 1
        else f"{counts[0]} to {counts[-1]} seeds"
    )
    several = counts[-1] > 1
    first = f"Means over {seeds}: {INTERVALS}" if several else "One seed each"
    parts = {"budget": _budget(runs), "presets": ", ".join(sorted({row["preset"] for row in runs}))}
    parts |= {"machine": runs.machines(), "days": runs.days()}
    measured = dict.fromkeys(filter(None, (row["measured"] for row in runs)))
    kinds = dict.fromkeys(row["ability"] for row in runs)
    parts |= {"test views": "; ".join([*measured] or [*kinds])}
    if [*kinds] != ["all"]:
        others = sorted({kind for row in runs for kind in row["test"]} - {*kinds})
        parts["scores"] = f"means over the test views of kind {', '.join(kinds)}"
        parts["scores"] += f" (metric={others[0]}/psnr: those of kind {others[0]})" if others else ""
    parts |= {"images": "; ".join(dict.fromkeys(filter(None, (row["pictures"] for row in runs))))}
    conditions = "; ".join(f"{name}: {text}" for name, text in parts.items() if text)
    marked = "" if max(counts) < 3 else f" {MARKED}"
    return f"{first}. {conditions[:1].upper()}{conditions[1:]}.{marked}"


def _budget(runs: Runs) -> str:
    budgets = {}
    for row in runs:
        minutes = [f"{length(row['minutes'])} ({row['clock']} clock)"] if row["minutes"] else []
        steps = [f"{row['iterations']:g} steps"] if row["iterations"] else []
        budgets[" or ".join([*minutes, *steps]) or "of the preset"] = None
    return ", ".join(budgets)


def draw_pareto(
    path: Path,
    cells: Mapping[tuple[tuple, tuple], Runs],
    metric: str,
    rows: Sequence[str] = (),
    columns: Sequence[str] = (),
) -> Path:
    """Draw a metric against seconds of training, memory and bytes: a point a cell, and the front that no
    other point beats in both.

    Args:
        path: file of the picture.
        cells: as of ``runs_by_cell``; a row of panels for each of the columns.
        metric, rows, columns: as of ``write_table``; the last two name what the values are of.
    """
    heads = list(dict.fromkeys(column for _, column in cells))
    titles = list(dict.fromkeys(row for row, _ in cells))
    heading, _, higher = _heading(metric.rpartition("/")[2] if metric not in COSTS else metric)
    figure, axes = figure_of(len(heads), len(PANELS), (4.4 * len(PANELS), 3.6 * len(heads) + 0.6))
    colors = {title: f"C{number % 10}" for number, title in enumerate(titles)}
    signs = dict(zip(titles, "osD^vP*X" * len(titles)))
    for head, line in zip(heads, axes):
        for axis, (cost, label) in zip(line, PANELS.items()):
            points = {}
            for title in titles:
                of_cell = cells.get((title, head), Runs())
                at, score = (Estimate.of(value_of(row, name) for row in of_cell) for name in (cost, metric))
                if at is not None and score is not None:
                    points[title] = at, score
            for title, (at, score) in points.items():
                style = {"color": colors[title], "marker": signs[title], "linestyle": "none", "capsize": 2}
                bars = {"xerr": at.error_bar, "yerr": score.error_bar, "elinewidth": 1, "markersize": 6}
                axis.errorbar(at.mean, score.mean, label=", ".join(_labels(rows, title)), **bars, **style)
            sign = 1 if higher else -1
            means = [(at.mean, sign * score.mean) for at, score in points.values()]
            front = [means[i] for i in pareto_front(means)]
            if front:
                steps = [(x, sign * y) for x, y in front]
                axis.step(*zip(*steps), "k--", where="post", linewidth=1, zorder=0, label="Pareto front")
            axis.set(
                xlabel=label,
                ylabel=heading if axis is line[0] else "",
                title=", ".join(_labels(columns, head)),
            )
            axis.grid(alpha=0.3)
    handles = {
        label: handle for axis in axes.flat for handle, label in zip(*axis.get_legend_handles_labels())
    }
    handles |= {label: handles.pop(label) for label in ("Pareto front",) if label in handles}  # last
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize="small")
    return save(figure, path)
