"""Write the page of what a method reaches on each scene in so many minutes of training."""

from __future__ import annotations

import csv
import io
import re
import statistics
from collections.abc import Sequence
from pathlib import Path

from forewarp.files import read_json, read_text, replace_file
from forewarp.metrics.gain import Estimate
from forewarp.report import curve
from forewarp.report.collect import Result, collect, left_out
from forewarp.report.sheets import figure_of
from forewarp.report.tables import Column, Table

KEY = ("method", "preset", "scene", "minutes", "seed")  # what tells rows apart
NUMBERS = ("psnr", "ssim", "lpips", "steps", "parameters", "memory", "ends", "threads")
FIELDS = (*KEY, *NUMBERS, "clock", "dataset", "device", "views", "command")
NETS = ("vgg", "alex", "squeeze")  # LPIPS is of the first whose weights were there
_ENDS = 0.1  # share of the time that counts as its first and last part
_MOST = 1 << 24  # bytes of a table that is read back

INTRODUCTION = """# What `model={method}` reaches in so many minutes

Written by `forewarp-report kind=minutes` from runs of `sweeps=minutes`. Minutes are of training, by the
platform's clock: it counts all that a method does to begin with (a visual hull, a plane sweep), and leaves
out reading pictures and compiling. The processor clock counts processor time of the process, which is the
same beside other work on the machine and, with one thread, equals the wall clock on an idle one. PSNR (dB),
SSIM and LPIPS are means over test views; ± is the standard deviation over the seeds. *Ends*: by how much the
mean PSNR of views in the first and last tenth of the time is below the median of the others. LPIPS is of the
first of {nets} whose weights were there.
"""


def write_minutes(runs: Path, out: Path) -> list[Path]:
    """Write ``<method>.md``, ``.csv`` (a row a run) and ``.png`` (PSNR by view) of each method in the runs.

    Rows of a table that is there already stay, unless a run of the same preset, scene, minutes and seed
    replaces them: runs may be made one day after the other.

    Args:
        runs: folder to search for measured runs.
        out: folder to write to.

    Returns:
        the files written.
    """
    results, without = collect(runs, ["metrics.json"])
    endless = [result for result in results if result.minutes is None]
    without += [f"{result.folder.relative_to(runs)}: no budget.minutes" for result in endless]
    results = [result for result in results if result.minutes is not None]
    written = []
    for method in sorted({result.config["model"]["name"] for result in results}):
        own = [result for result in results if result.config["model"]["name"] == method]
        rows = _merged(out / f"{method}.csv", [row_of(result) for result in own])
        page, table, picture = (out / f"{method}.{kind}" for kind in ("md", "csv", "png"))
        replace_file(table, _csv(rows))
        parts = [INTRODUCTION.format(method=method, nets=", ".join(NETS)), f"Machine: {_machine(rows)}.\n"]
        parts += [_by_minutes(rows).markdown(), "## Each\n", _details(rows).markdown()]
        parts += ["## By view\n", f"![PSNR of each test view over time]({picture.name})\n"]
        parts += [
            "## Commands\n",
            "Each with its `seed=`.\n",
            "```bash",
            *sorted({re.sub(r"\bseed=\d+ | run=\S+$", "", row["command"]) for row in rows}),
            "```\n",
        ]
        parts += left_out("Without numbers", without)
        replace_file(page, "\n".join(parts))
        _draw(rows, picture)
        written += [page, table, picture]
    return written


def row_of(result: Result) -> dict:
    """A run's row: ``FIELDS``; what is not known is None."""
    images = (read_json(result.folder / "per_image.json") or {}).get("images", [])
    views = sorted((one["time"], one["scores"]["psnr"]) for one in images)
    numbers, scores = result.numbers, result.metrics["test"][result.ability]
    protocol = result.metrics["protocol"]
    return {
        "method": result.config["model"]["name"],
        "preset": result.config["preset"]["name"],
        "scene": result.scene,
        "minutes": result.minutes,
        "seed": result.seed,
        **{name: numbers.get(name) for name in ("psnr", "ssim", "steps", "memory", "parameters")},
        "lpips": next((scores[f"lpips_{net}"] for net in NETS if f"lpips_{net}" in scores), None),
        "ends": ends_below(views),
        "threads": protocol.get("threads"),
        "clock": protocol.get("clock", "wall"),
        "dataset": result.dataset,
        "device": protocol.get("device"),
        "views": " ".join(f"{time:.4f}:{psnr:.2f}" for time, psnr in views),
        "command": result.command,
    }


def ends_below(views: Sequence[tuple[float, float]]) -> float | None:
    """By how many dB the mean of the views (time, PSNR) at both ends is below the median of the others.

    >>> ends_below([(0.0, 30.0), (0.05, 31.0), (0.5, 34.0), (0.6, 33.0), (1.0, 32.0)])
    2.5
    """
    ends = [psnr for time, psnr in views if not _ENDS < time < 1 - _ENDS]
    others = [psnr for time, psnr in views if _ENDS < time < 1 - _ENDS]
    return statistics.median(others) - statistics.fmean(ends) if ends and others else None


def _machine(rows: list[dict]) -> str:
    return "; ".join(
        sorted(
            {
                f"{row['device']}, threads: {row['threads']:g}, minutes by the {row['clock']} clock"
                for row in rows
                if row["device"]
            }
        )
    )


def _merged(file: Path, rows: list[dict]) -> list[dict]:
    """Add rows to those of a table, as numbers; new ones replace old ones."""
    known = list(csv.DictReader(io.StringIO(read_text(file, _MOST)))) if file.is_file() else []
    found = {}
    for row in (*(_read(row) for row in known), *rows):
        found[tuple(row[name] for name in KEY)] = row
    return [found[key] for key in sorted(found, key=str)]


def _read(row: dict) -> dict:
    numbers = {name: float(row[name]) if row[name] else None for name in ("minutes", *NUMBERS)}
    return {"clock": "wall"} | row | numbers | {"seed": int(row["seed"])}


def _csv(rows: list[dict]) -> str:
    file = io.StringIO()
    writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if row[name] is None else row[name] for name in FIELDS} for row in rows)
    return file.getvalue()


def _estimate(rows: Sequence[dict], name: str) -> Estimate | None:
    return Estimate.of([row[name] for row in rows if row[name] is not None])


def _by_minutes(rows: list[dict]) -> Table:
    """PSNR by scene and minutes, and its mean over a dataset's scenes where all are there."""
    scenes, minutes = (sorted({row[name] for row in rows}) for name in ("scene", "minutes"))
    cells = {
        (scene, m): _estimate([r for r in rows if (r["scene"], r["minutes"]) == (scene, m)], "psnr")
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
        found = {name: _estimate(own, name) for name in names}
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
                times, values = zip(*(map(float, one.split(":")) for one in row["views"].split()))
                axis.plot(times, values, marker=".", label=f"{row['minutes']:g} min")
        axis.set(title=scene, xlabel="time", ylabel="PSNR (dB)")
        if axis.lines:
            axis.legend(fontsize="small")
    curve._save(figure, picture)
