"""Write the page of what a method reaches on each scene in so many minutes of training."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from forewarp.files import read_rows, replace_file
from forewarp.report import curve
from forewarp.report.by_method import write_by_method
from forewarp.report.collect import left_out
from forewarp.report.curve import Published
from forewarp.report.minutes_sections import (
    SCORES,
    abilities,
    alike,
    beside,
    is_plain,
    labelled,
    larger_pictures,
    made_when,
    minutes_of,
    more_density,
    more_minutes,
)
from forewarp.report.run_rows import (
    CLOCKS,
    NETS,
    commands,
    ended_early,
    estimate,
    length,
    made_on,
    merged,
    of_minutes,
    pairs,
)
from forewarp.report.sheets import figure_of
from forewarp.report.tables import Column, Table

INTRODUCTION = """# What `model={method}` reaches in so many minutes

Written by `forewarp-report kind=minutes` from runs of `sweeps=minutes`. {clocks} PSNR (dB),
SSIM and LPIPS are means over test views; of scenes with several test sets, over views between training times;
± is the standard deviation over the seeds. *Ends*: by how much the mean PSNR of views in the first and last
tenth of the time is below the median of the others. LPIPS is of the first of {nets} whose weights were
there.
"""
COST = """Seconds are of training, by the clock that the minutes are of and by the other beside it.
*ms a step* is all of them by the first, divided by the steps; *s a picture* is for the first of a time, by
the wall clock. GiB is the most memory of the process.
"""
COSTS = (
    *(Column("processor (s)", 0), Column("wall (s)", 0), Column("steps", 0), Column("ms a step", 1)),
    *(Column("s a picture", 3), Column("parameters (M)", 2), Column("GiB", 2)),
)


def write_minutes(runs: Path, out: Path, published: Sequence[Published] = ()) -> list[Path]:
    """Write ``<method>.md``, ``.csv`` (a row a run) and ``.png`` (PSNR by view) of each method in the runs,
    and the page of them all: see ``by_method``.

    Rows of a table that is there already stay, unless a run of the same ``run_rows.KEY``
    replaces them: runs may be made one day after the other. Each page compares its method with the others,
    so that the pages of methods with a table in ``out`` are written anew too.

    Args:
        runs: folder to search for measured runs.
        out: folder to write to.
        published: results of others, drawn beside.

    Returns:
        the files written.
    """
    results, without = of_minutes(runs)
    methods = sorted({result.config["model"]["name"] for result in results} | _known(out))
    tables = {}
    for method in methods:
        own = [result for result in results if result.config["model"]["name"] == method]
        tables[method] = merged(out / f"{method}.csv", own)
    written = []
    for method, rows in tables.items():
        page, picture = out / f"{method}.md", out / f"{method}.png"
        others = [row for other, found in tables.items() if other != method for row in found]
        replace_file(page, "\n".join([*_page(method, rows, others), *left_out("Without numbers", without)]))
        _draw([row for row in labelled(rows) if is_plain(row)], picture)
        written += [page, out / f"{method}.csv", picture]
    return written + write_by_method(tables, out, published)


def _known(out: Path) -> set[str]:
    """The methods that have a table of their own in a folder, by an earlier call."""
    return {
        file.stem
        for file in out.glob("*.csv")
        if file.with_suffix(".md").is_file() and {row.get("method") for row in read_rows(file)} == {file.stem}
    }


def _page(method: str, rows: Sequence[dict], others: Sequence[dict]) -> list[str]:
    """All parts of a method's page but the runs that were left out."""
    named, rivals = labelled(rows), labelled(others)
    plain = [row for row in named if is_plain(row)]
    parts = [INTRODUCTION.format(method=method, clocks=CLOCKS, nets=", ".join(NETS))]
    parts += [f"Machine: {made_on(rows)}.\n", *filter(None, [made_when(rows)])]
    parts += [_by_minutes(plain).markdown(), "## Each\n", _each(plain).markdown()]
    parts += [*beside(method, named, rivals), *abilities([*named, *_of_scenes(named, rivals)])]
    parts += [*more_minutes(named), *more_density(named), *larger_pictures(named)]
    parts += ["## What it costs\n", COST, _costs(plain).markdown()]
    parts += ["## By view\n", f"![PSNR of each test view over time, mean of the seeds]({method}.png)\n"]
    return [*parts, commands(rows, "minutes")]


def _of_scenes(rows: Sequence[dict], others: Sequence[dict]) -> list[dict]:
    """Those of the other rows whose scene and minutes the rows have too."""
    known = {(row["scene"], row["minutes"]) for row in rows}
    return [row for row in others if (row["scene"], row["minutes"]) in known]


def _by_minutes(rows: Sequence[dict]) -> Table:
    """PSNR by scene and minutes, and its mean over a dataset's scenes where all are there."""
    scenes, minutes = (sorted({row[name] for row in rows}) for name in ("label", "minutes"))
    cells = {
        (scene, m): estimate([r for r in rows if (r["label"], r["minutes"]) == (scene, m)], "psnr")
        for scene in scenes
        for m in minutes
    }
    lines = [[scene, *(cells[scene, m] for m in minutes)] for scene in scenes]
    for dataset in sorted({row["dataset"] for row in rows}):
        own = sorted({row["label"] for row in rows if row["dataset"] == dataset})
        found = [[cells[scene, m] for scene in own] for m in minutes]
        means = [None if None in of else statistics.fmean(cell.mean for cell in of) for of in found]
        lines += [[f"mean of {dataset}", *means]] if len(own) > 1 else []
    columns = [Column("scene"), *(Column(length(m)) for m in minutes)]
    early = any(ended_early(group) is not None for group in alike(rows))
    about = " Some runs ended by their steps, before their minutes: see *Each*." * early
    return Table(columns, lines, caption="PSNR (dB) of test views." + about)


def _each(rows: Sequence[dict]) -> Table:
    """What each scene reaches by minutes, with the number of particles or voxels."""
    columns = [Column("scene"), Column("minutes", 0), Column("seeds", 0), *SCORES, Column("ends (dB)", 1)]
    columns += [Column(_counted(rows), 0)]
    lines = []
    for group in alike(rows):
        means = [_mean(group, name) for name in ("ends", "size")]
        scores = [estimate(group, name) for name in ("psnr", "ssim", "lpips")]
        lines.append([group[0]["label"], minutes_of(group), len(group), *scores, *means])
    return Table(columns, lines)


def _counted(rows: Sequence[dict]) -> str:
    """What a method's size counts."""
    return "particles" if {row["method"] for row in rows} == {"particles"} else "voxels or parameters"


def _costs(rows: Sequence[dict]) -> Table:
    """What each scene costs by minutes: seconds by both clocks, steps, memory."""
    lines = []
    for group in alike(rows):
        step = _mean(group, "step")
        means = [_mean(group, name) for name in ("processor", "wall", "steps")]
        means += [step and 1000 * step, *(_mean(group, name) for name in ("frame", "parameters", "memory"))]
        lines.append([group[0]["label"], minutes_of(group), *means])
    return Table([Column("scene"), Column("minutes", 0), *COSTS], lines)


def _mean(group: Sequence[dict], name: str) -> float | None:
    """The mean of a number over the rows that have it; None if none has."""
    found = estimate(group, name)
    return found and found.mean


def _draw(rows: Sequence[dict], picture: Path) -> None:
    """Draw PSNR over time, a panel a scene, a line for each length of training; the mean of the seeds."""
    scenes = sorted({row["label"] for row in rows})
    height = max(1, -(-len(scenes) // 3))
    figure, axes = figure_of(height, max(1, min(3, len(scenes))), (12, 3 * height))
    for axis in axes.flat[len(scenes) :]:
        axis.set_axis_off()
    for axis, scene in zip(axes.flat, scenes):
        for group in alike(row for row in rows if row["label"] == scene):
            if line := mean_by_time(group):
                about = f"{length(group[0]['minutes'])}, {len(group)} seed{'s' * (len(group) > 1)}"
                axis.plot(*zip(*line), marker=".", label=about)
        axis.set(title=scene, xlabel="time", ylabel="PSNR (dB)")
        if axis.lines:
            axis.legend(fontsize="small")
    curve._save(figure, picture)


def mean_by_time(rows: Sequence[dict]) -> list[tuple[float, float]]:
    """The mean PSNR (dB) of the views of each time, over all rows.

    >>> mean_by_time([{"views": "0:30 0.5:31"}, {"views": "0:32 0.5:34"}])
    [(0.0, 31.0), (0.5, 32.5)]
    """
    found: dict[float, list[float]] = {}
    for time, psnr in (pair for row in rows for pair in pairs(row["views"])):
        found.setdefault(time, []).append(psnr)
    return [(time, statistics.fmean(found[time])) for time in sorted(found)]
