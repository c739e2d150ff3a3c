"""Write the page of what a method reaches on each scene in so many minutes of training."""

from __future__ import annotations

import statistics
from pathlib import Path

from forewarp.files import replace_file
from forewarp.report import curve
from forewarp.report.collect import left_out
from forewarp.report.run_rows import (
    CLOCKS,
    CONDITIONS,
    NETS,
    commands,
    estimate,
    made_on,
    merged,
    of_minutes,
    pairs,
    telling,
)
from forewarp.report.sheets import figure_of
from forewarp.report.tables import Column, Table

INTRODUCTION = """# What `model={method}` reaches in so many minutes

Written by `forewarp-report kind=minutes` from runs of `sweeps=minutes`. {clocks} PSNR (dB),
SSIM and LPIPS are means over test views; ± is the standard deviation over the seeds. *Ends*: by how much the
mean PSNR of views in the first and last tenth of the time is below the median of the others. LPIPS is of the
first of {nets} whose weights were there.
"""


def write_minutes(runs: Path, out: Path) -> list[Path]:
    """Write ``<method>.md``, ``.csv`` (a row a run) and ``.png`` (PSNR by view) of each method in the runs.

    Rows of a table that is there already stay, unless a run of the same ``run_rows.KEY``
    replaces them: runs may be made one day after the other.

    Args:
        runs: folder to search for measured runs.
        out: folder to write to.

    Returns:
        the files written.
    """
    results, without = of_minutes(runs)
    written = []
    for method in sorted({result.config["model"]["name"] for result in results}):
        own = [result for result in results if result.config["model"]["name"] == method]
        page, table, picture = (out / f"{method}.{kind}" for kind in ("md", "csv", "png"))
        rows = merged(table, own)
        about = INTRODUCTION.format(method=method, clocks=CLOCKS, nets=", ".join(NETS))
        parts = [about, f"Machine: {made_on(rows)}.\n"]
        named = _named(rows)
        parts += [_by_minutes(named).markdown(), "## Each\n", _details(named).markdown()]
        parts += ["## By view\n", f"![PSNR of each test view over time]({picture.name})\n"]
        parts += [commands(rows, "minutes")]
        parts += left_out("Without numbers", without)
        replace_file(page, "\n".join(parts))
        _draw(named, picture)
        written += [page, table, picture]
    return written


def _named(rows: list[dict]) -> list[dict]:
    """The rows; where those of a scene differ in preset or ``CONDITIONS``, its name says in what."""
    found = []
    for row in rows:
        others = [other for other in rows if other["scene"] == row["scene"]]
        words = telling(row, others, ("preset", *CONDITIONS))
        found.append(row | {name: ", ".join([row[name] or "", *words]) for name in ("scene", "dataset")})
    return found


def _by_minutes(rows: list[dict]) -> Table:
    """PSNR by scene and minutes, and its mean over a dataset's scenes where all are there."""
    scenes, minutes = (sorted({row[name] for row in rows}) for name in ("scene", "minutes"))
    cells = {
        (scene, m): estimate([r for r in rows if (r["scene"], r["minutes"]) == (scene, m)], "psnr")
        for scene in scenes
        for m in minutes
    }
    lines = [[scene, *(cells[scene, m] for m in minutes)] for scene in scenes]
    for dataset in sorted({row["dataset"] for row in rows}):
        own = sorted({row["scene"] for row in rows if row["dataset"] == dataset})
        found = [[cells[scene, m] for scene in own] for m in minutes]
        means = [None if None in of else statistics.fmean(cell.mean for cell in of) for of in found]
        lines += [[f"mean of {dataset}", *means]] if len(own) > 1 else []
    columns = [Column("scene"), *(Column(f"{m:g} min") for m in minutes)]
    return Table(columns, lines, caption="PSNR (dB) of test views.")


def _details(rows: list[dict]) -> Table:
    """All numbers by scene and minutes."""
    columns = [
        *(Column("scene"), Column("minutes", 0), Column("seeds", 0), Column("PSNR"), Column("SSIM", 4)),
        *(
            Column("LPIPS", 4),
            Column("ends (dB)", 1),
            Column("steps", 0),
            Column("parameters (M)", 2),
            Column("GiB", 2),
        ),
    ]
    names = ("psnr", "ssim", "lpips", "ends", "steps", "parameters", "memory")
    lines = []
    for scene, minutes in sorted({(row["scene"], row["minutes"]) for row in rows}):
        own = [row for row in rows if (row["scene"], row["minutes"]) == (scene, minutes)]
        found = {name: estimate(own, name) for name in names}
        plain = {n: found[n] and found[n].mean for n in ("ends", "steps", "parameters", "memory")}
        lines.append([scene, minutes, len(own), *(v for v in (found | plain).values())])
    return Table(columns, lines)


def _draw(rows: list[dict], picture: Path) -> None:
    """Draw PSNR over time, a panel a scene, a line for each length of training; of the first seed."""
    scenes = sorted({row["scene"] for row in rows})
    figure, axes = figure_of(-(-len(scenes) // 3), min(3, len(scenes)), (12, 3 * -(-len(scenes) // 3)))
    for axis in axes.flat[len(scenes) :]:
        axis.set_axis_off()
    for axis, scene in zip(axes.flat, scenes):
        own = [row for row in rows if row["scene"] == scene]
        for row in own:
            if row["seed"] == min(r["seed"] for r in own) and row["views"]:
                axis.plot(*zip(*pairs(row["views"])), marker=".", label=f"{row['minutes']:g} min")
        axis.set(title=scene, xlabel="time", ylabel="PSNR (dB)")
        if axis.lines:
            axis.legend(fontsize="small")
    curve._save(figure, picture)
