"""Write the page of accuracy against time: what each method reaches in so many seconds or minutes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

from forewarp.files import replace_file
from forewarp.metrics.gain import Estimate
from forewarp.report import curve
from forewarp.report.curve import Published, over_seconds
from forewarp.report.minutes_sections import Group, alike, is_plain
from forewarp.report.run_rows import (
    CLOCKS,
    CONDITIONS,
    another_length,
    commands,
    estimate,
    key_of,
    length,
    made_on,
    telling,
)
from forewarp.report.sheets import figure_of
from forewarp.report.tables import Column, Table

INTRODUCTION = f"""# Accuracy against time

Written by `forewarp-report kind=minutes` from runs of `sweeps=minutes` with several methods and lengths.
Each point is a run of its own, trained from the start for so long, since rates and curricula follow the time
that a run has; lines join the means of the seeds. PSNR (dB) is of test views. {CLOCKS}
"""
_LENGTHS = 3  # of training, at least: two points make no curve
PUBLISHED = (
    "Published by others for all of D-NeRF's scenes, by protocols of their own, for orientation (stars):\n"
)


def write_by_method(
    tables: Mapping[str, Sequence[dict]], out: Path, published: Sequence[Published]
) -> list[Path]:
    """Write ``accuracy-time.md`` and a picture for each scene that two methods or more have in three lengths.

    Args:
        tables: rows as of ``run_rows.row_of``, by method.
        out: folder to write to.
        published: results of others, drawn beside scenes of their dataset.

    Returns:
        the files written; none where no scene has that much.
    """
    plain = [row | {"label": row["scene"]} for rows in tables.values() for row in rows if is_plain(row)]
    colors = {method: f"C{number}" for number, method in enumerate(sorted(tables))}
    written, parts, used, shown = [], [], [], []
    for scene, groups in _compared(plain).items():
        rows = [row for found in groups.values() for group in found for row in group]
        beside = [other for other in published if other.dataset == rows[0]["dataset"]]
        picture = out / f"accuracy-time-{re.sub(r'[^a-zA-Z0-9]+', '-', scene).strip('-')}.png"
        _draw(groups, beside, scene, picture, colors)
        parts += [f"## {scene}\n", f"![PSNR of {scene} against seconds of training]({picture.name})\n"]
        parts += [_table(groups).markdown()]
        written.append(picture)
        used, shown = used + rows, [*shown, *(other for other in beside if other not in shown)]
    if not written:
        return []
    lines = [
        f"* {p.name}: {p.psnr:g} dB after {p.seconds:g} s of an {p.hardware} ({p.dataset}; {p.source})"
        for p in shown
    ]
    parts += ["## Others\n", PUBLISHED, "\n".join(lines) + "\n"] if lines else []
    page = out / "accuracy-time.md"
    about = [INTRODUCTION, f"Machine: {made_on(used)}.\n"]
    replace_file(page, "\n".join([*about, *parts, commands(used, "minutes")]))
    return [page, *written]


def _compared(rows: Sequence[dict]) -> dict[str, dict[str, list[Group]]]:
    """Groups of seeds, shortest first, by scene and method: of two methods or more that ran for several
    lengths under the same ``CONDITIONS``. A scene is named with these where its rows differ in them.
    """
    tasks: dict[tuple, list[dict]] = {}
    for row in rows:
        tasks.setdefault(key_of(row, ("scene", "preset", *CONDITIONS)), []).append(row)
    found = {}
    for own in tasks.values():
        lengths: dict[str, list[Group]] = {}
        for group in alike(own):
            lengths.setdefault(group[0]["method"], []).append(group)
        lengths = {method: groups for method, groups in lengths.items() if len(groups) >= _LENGTHS}
        if len(lengths) > 1:
            others = [row for row in rows if row["scene"] == own[0]["scene"]]
            name = ", ".join([own[0]["scene"], *telling(own[0], others, ("preset", *CONDITIONS))])
            found[name] = lengths
    return dict(sorted(found.items()))


def _table(groups: Mapping[str, Sequence[Group]]) -> Table:
    """PSNR by method and length; how long the best method takes to pass what each reaches in the end."""
    lengths = sorted({group[0]["minutes"] for found in groups.values() for group in found})
    best = max(groups, key=lambda method: max(estimate(group, "psnr").mean for group in groups[method]))
    lines = []
    for method, found in groups.items():
        cells = {group[0]["minutes"]: _cell(group) for group in found}
        most = max(estimate(group, "psnr").mean for group in found)
        passed = [g[0]["minutes"] for g in groups[best] if estimate(g, "psnr").mean > most]
        seeds = ", ".join(str(len(group)) for group in found)
        lines.append([f"`{method}`", *map(cells.get, lengths), seeds, length(passed[0]) if passed else None])
    columns = [Column("method"), *(Column(length(minutes)) for minutes in lengths)]
    return Table([*columns, Column("seeds"), Column(f"passed by `{best}` after")], lines)


def _cell(group: Group) -> Estimate | str:
    """A group's PSNR, with a word where its runs took other minutes than theirs."""
    found, words = estimate(group, "psnr"), another_length(group)
    return f"{Column('').text(found)}{words}" if words else found


def _seconds(rows: Group) -> float:
    """The mean seconds that runs took, by the clock that their minutes are of."""
    return fmean(row[row["clock"]] or 60 * row["minutes"] for row in rows)


def _draw(
    groups: Mapping[str, Sequence[Group]],
    beside: Sequence[Published],
    title: str,
    path: Path,
    colors: Mapping[str, str],
) -> None:
    """Draw a point a run and a line a method over seconds of training; a method keeps its color."""
    figure, ((axis,),) = figure_of(1, 1, (7, 4.5))
    seconds = [_seconds(group) for found in groups.values() for group in found]
    seconds += [other.seconds for other in beside]
    over_seconds(axis, "PSNR of test views (dB)", wide=max(seconds) > 1000 * min(seconds))
    for method, found in groups.items():
        means = [(_seconds(group), estimate(group, "psnr").mean) for group in found]
        axis.plot(*zip(*means), color=colors[method], linewidth=2, label=method)
        runs = [(_seconds([row]), row["psnr"]) for group in found for row in group]
        axis.plot(*zip(*runs), "o", color=colors[method], markersize=3.5)
    for number, other in enumerate(beside, len(colors)):
        label = f"{other.name} (published, {other.hardware})"
        axis.plot(other.seconds, other.psnr, "*", color=f"C{number % 10}", fillstyle="none", label=label)
    axis.legend(fontsize="x-small", loc="lower right")
    axis.set_title(title)
    curve._save(figure, path)
