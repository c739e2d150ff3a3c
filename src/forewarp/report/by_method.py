"""Write the page of accuracy against time: what each method reaches in so many seconds or minutes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from forewarp.files import replace_file
from forewarp.report import curve
from forewarp.report.curve import Published, over_seconds
from forewarp.report.minutes_sections import Group, alike, is_plain, labelled
from forewarp.report.run_rows import CLOCKS, commands, estimate, length, made_on
from forewarp.report.sheets import figure_of
from forewarp.report.tables import Column, Table

INTRODUCTION = f"""# Accuracy against time

Written by `forewarp-report kind=minutes` from runs of `sweeps=minutes` with several methods and lengths.
Each point is a run of its own, trained from the start for so long, since rates and curricula follow the time
that a run has; lines join the means of the seeds. PSNR (dB) is of test views. {CLOCKS}
"""
PUBLISHED = (
    "Published by others for all of D-NeRF's scenes, by protocols of their own, for orientation (stars):\n"
)


def write_by_method(
    tables: Mapping[str, Sequence[dict]], out: Path, published: Sequence[Published]
) -> list[Path]:
    """Write ``accuracy-time.md`` and a picture for each scene that two methods or more have in two lengths.

    Args:
        tables: rows as of ``run_rows.row_of``, by method.
        out: folder to write to.
        published: results of others, drawn beside scenes of their dataset.

    Returns:
        the files written; none where no scene has that much.
    """
    plain = [row for rows in tables.values() for row in labelled(rows) if is_plain(row)]
    written, parts, used = [], [], []
    for scene in sorted({row["label"] for row in plain}):
        groups = _comparable([row for row in plain if row["label"] == scene])
        if not groups:
            continue
        used += [row for found in groups.values() for group in found for row in group]
        beside = [other for other in published if other.dataset == used[-1]["dataset"]]
        picture = out / f"accuracy-time-{scene}.png"
        _draw(groups, beside, scene, picture)
        parts += [f"## {scene}\n", f"![PSNR of {scene} against seconds of training]({picture.name})\n"]
        parts += [_table(groups).markdown()]
        written.append(picture)
    if not written:
        return []
    lines = [
        f"* {p.name}: {p.psnr:g} dB after {p.seconds:g} s of an {p.hardware} ({p.source})" for p in published
    ]
    parts += ["## Others\n", PUBLISHED, "\n".join(lines) + "\n"] if lines else []
    page = out / "accuracy-time.md"
    about = [INTRODUCTION, f"Machine: {made_on(used)}.\n"]
    replace_file(page, "\n".join([*about, *parts, commands(used, "minutes")]))
    return [page, *written]


def _comparable(rows: Sequence[dict]) -> dict[str, list[Group]]:
    """Groups of seeds, shortest first, of the methods that ran for several lengths; none if only one did."""
    found: dict[str, list[Group]] = {}
    for group in alike(rows):
        found.setdefault(group[0]["method"], []).append(group)
    found = {method: groups for method, groups in found.items() if len(groups) > 1}
    return found if len(found) > 1 else {}


def _table(groups: Mapping[str, Sequence[Group]]) -> Table:
    """PSNR by method and length; how long the best method takes to pass what each reaches in the end."""
    lengths = sorted({group[0]["minutes"] for found in groups.values() for group in found})
    best = max(groups, key=lambda method: max(estimate(group, "psnr").mean for group in groups[method]))
    lines = []
    for method, found in groups.items():
        cells = {group[0]["minutes"]: estimate(group, "psnr") for group in found}
        most = max(cell.mean for cell in cells.values())
        passed = [g[0]["minutes"] for g in groups[best] if estimate(g, "psnr").mean > most]
        seeds = ", ".join(str(len(group)) for group in found)
        lines.append([f"`{method}`", *map(cells.get, lengths), seeds, length(passed[0]) if passed else None])
    columns = [Column("method"), *(Column(length(minutes)) for minutes in lengths)]
    return Table([*columns, Column("seeds"), Column(f"passed by `{best}` after")], lines)


def _draw(groups: Mapping[str, Sequence[Group]], beside: Sequence[Published], title: str, path: Path) -> None:
    """Draw a point a run and a line a method over seconds of training."""
    figure, ((axis,),) = figure_of(1, 1, (7, 4.5))
    seconds = [60 * group[0]["minutes"] for found in groups.values() for group in found]
    seconds += [other.seconds for other in beside]
    over_seconds(axis, "PSNR of test views (dB)", wide=max(seconds) > 1000 * min(seconds))
    for number, (method, found) in enumerate(groups.items()):
        means = [(60 * group[0]["minutes"], estimate(group, "psnr").mean) for group in found]
        axis.plot(*zip(*means), color=f"C{number}", linewidth=2, label=method)
        runs = [(60 * row["minutes"], row["psnr"]) for group in found for row in group]
        axis.plot(*zip(*runs), "o", color=f"C{number}", markersize=3.5)
    for number, other in enumerate(beside, len(groups)):
        label = f"{other.name} (published, {other.hardware})"
        axis.plot(other.seconds, other.psnr, "*", color=f"C{number % 10}", fillstyle="none", label=label)
    axis.legend(fontsize="x-small", loc="lower right")
    axis.set_title(title)
    curve._save(figure, path)
