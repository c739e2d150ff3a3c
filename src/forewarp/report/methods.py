"""Write the page of all methods under one clock: what each reaches on each scene in so many minutes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from forewarp.files import read_text, replace_file
from forewarp.report.collect import left_out
from forewarp.report.methods_figures import draw_curves, draw_views
from forewarp.report.run_rows import (
    CLOCKS,
    CONDITIONS,
    NETS,
    apart,
    commands,
    estimate,
    key_of,
    made_on,
    merged,
    of_minutes,
    row_of,
    telling,
)
from forewarp.report.sheets import sheets_of
from forewarp.report.tables import Column, Table

OURS = "forward"  # the paper's own method
STEPS = "faithful-step.md"  # beside the page, by python -m tests.bench.faithful
INTRODUCTION = """# All methods under one clock

Written by `forewarp-report kind=methods` from runs of `sweeps=methods`: each method learns from the same
pictures in the same minutes, and is measured on the same test views. `{ours}` is the paper's method,
`backward` its ablation with a backward warp, `particles` our own; the others are the published systems of
the paper's tables ([what each is](../methods.md)). With `preset=fast` all are as small as minutes of a
processor ask for: this is what they reach in such minutes, and says nothing of what they reach in the hours
of a GPU that they were made for.

{clocks}

PSNR (dB), SSIM and LPIPS are means over the test views, and over the seeds: ± is the standard deviation
where there are several. *s a step* is all seconds of training divided by the steps. *s a frame* is for the
first picture of a time (later ones of that time may be faster), mean over the test views, by the wall
clock: other work on the machine makes it longer. *GiB* is the most memory of the process. LPIPS is by the
first of {nets} whose weights were found; a run's `metrics.json` says which.
"""
CURVES = """PSNR of a few pixels of validation views while each method learns; the number at a line's end
differs from the table, which is of whole test views. Schedules follow the share of the minutes that is
spent: the point at one minute is not what a run of one minute reaches.
"""
CURVES_OF = "PSNR against seconds of training"  # and then the methods
VIEWS_OF = "Test views, the truth first,"  # likewise
KNOWN = re.compile(r"[^\[\]]* after (?P<minutes>\S+) minutes: (?P<methods>[^\[\]]*)$")  # words of a picture
VIEWS = "Test views and their PSNR (dB), cut to the subject: what a method draws elsewhere is not seen.\n"
NUMBERS = ("psnr", "ssim", "lpips", "steps", "step", "frame", "parameters", "memory")
COLUMNS = (
    *(Column("method"), Column("seeds", 0), Column("PSNR"), Column("SSIM", 4), Column("LPIPS", 4)),
    *(
        Column("steps", 0),
        Column("s a step", 3),
        Column("s a frame", 2),
        Column("parameters (M)", 2),
        Column("GiB", 2),
    ),
)


def write_methods(runs: Path, out: Path) -> list[Path]:
    """Write ``methods.md``, ``methods.csv`` (a row a run), and two pictures of each scene.

    Rows of a table that is there already stay, as in ``write_minutes``. Views are drawn of the given runs
    alone; a picture that an earlier page shows stays if it has more methods, and the page says which of
    them have other rows by now. Ablations are left out.

    Args:
        runs: folder to search for measured runs.
        out: folder to write to.

    Returns:
        the files written.

    Raises:
        ValueError: if there is no run of a method, and no table with such runs.
    """
    results, without = of_minutes(runs)
    plain = [run for run in results if (run.config.get("variant") or {}).get("name") in (None, "base")]
    without += [f"{run.folder.relative_to(runs)}: an ablation" for run in results if run not in plain]
    page, table = out / "methods.md", out / "methods.csv"
    rows, written = merged(table, plain), [page, table]
    about = INTRODUCTION.format(ours=OURS, clocks=CLOCKS, nets=", ".join(NETS))
    parts = [about, f"Machine: {made_on(rows)}.\n"]
    earlier = read_text(page) if page.is_file() else ""
    folders = {key_of(row_of(run)): run.folder for run in sorted(plain, key=lambda run: run.measured_at)}
    for scene in sorted({row["scene"] for row in rows}):
        own = [row for row in rows if row["scene"] == scene]
        text, pictures = _pictures(scene, own, folders, out, earlier)
        parts += [f"## {scene}\n", *text, *(_reached(group, own).markdown() for group in apart(own))]
        written += pictures
    if (departures := _departures(rows)).rows:
        parts += [departures.markdown()]
    if (out / STEPS).is_file():
        parts += [f"What a step costs with the published numbers: [a step of `faithful`]({STEPS}).\n"]
    parts += [commands(rows, "methods"), *left_out("Without numbers", without)]
    replace_file(page, "\n".join(parts))
    return written


def names_of(rows: Sequence[dict]) -> dict[int, str]:
    """Name the method of each row, by ``id``; with the preset where not all rows have the same."""
    several = len({row["preset"] for row in rows}) > 1
    return {id(row): row["method"] + (f" ({row['preset']})" if several else "") for row in rows}


def _pictures(
    scene: str, rows: list[dict], folders: Mapping[tuple, Path], out: Path, earlier: str
) -> tuple[list[str], list[Path]]:
    """The part of the page with a scene's pictures, and those drawn; of one group of ``apart``.

    That is the group with the most methods and, of equal ones, the most minutes; of a method its first seed.
    """
    names, parts, drawn = names_of(rows), [], []
    chosen = max(apart(rows), key=lambda group: (len({names[id(row)] for row in group}), group[0]["minutes"]))
    first = {names[id(row)]: row for row in sorted(chosen, key=lambda row: -row["seed"])}
    about = f"{chosen[0]['minutes']:g} minutes"
    seen = {name: folders[key_of(row)] for name, row in first.items() if key_of(row) in folders}
    seen = {name: folder for name, folder in seen.items() if sheets_of(folder)}
    seen = dict(sorted(seen.items(), key=lambda one: -(first[one[0]]["psnr"] or 0.0)))
    curves, views = out / f"methods-{scene}.png", out / f"methods-{scene}-views.png"
    for path, heading, text, shown, draw in (
        (curves, CURVES_OF, CURVES, first, partial(draw_curves, rows=first, title=f"{scene}, {about}")),
        (views, VIEWS_OF, VIEWS, seen, partial(draw_views, runs=seen)),
    ):
        known = KNOWN.search(earlier.partition(f"]({path.name})")[0]) if path.is_file() else None
        listed = _listed(known["methods"]) if known else {}
        kept = (
            [f"![{known[0]}]({path.name})\n", text, *_older(listed, known["minutes"], rows)] if known else []
        )
        if len(listed) > len(shown):
            parts += kept
            continue
        try:
            done = draw(path)
        except ImportError as error:
            parts += kept or [f"Without a picture: {error}.\n"]
            continue
        if done:
            told = ", ".join(f"{name} {first[name]['psnr'] or 0.0:.2f}" for name in shown)
            parts += [f"![{heading} after {about}: {told}]({path.name})\n", text]
            drawn.append(path)
    return parts, drawn


def _listed(methods: str) -> dict[str, str]:
    """Read the methods and their PSNR (dB) that the words of a picture list."""
    return {name: psnr for name, _, psnr in (one.rpartition(" ") for one in methods.split(", "))}


def _older(listed: Mapping[str, str], minutes: str, rows: list[dict]) -> list[str]:
    """Say which methods of a picture have no row any more with the PSNR that the picture has."""
    names = names_of(rows)
    now = {(names[id(row)], f"{row['psnr'] or 0.0:.2f}") for row in rows if f"{row['minutes']:g}" == minutes}
    changed = [f"`{name}`" for name, psnr in listed.items() if (name, psnr) not in now]
    return [f"The picture is of runs before the table's of {', '.join(changed)}.\n"] if changed else []


def _reached(rows: list[dict], others: list[dict]) -> Table:
    """All numbers of the runs of a scene that may be compared, the best PSNR first."""
    names, groups = names_of(others), {}
    for row in rows:
        groups.setdefault(names[id(row)], []).append(row)
    lines = []
    for name, group in groups.items():
        found = {number: estimate(group, number) for number in NUMBERS}
        plain = {n: found[n] and found[n].mean for n in NUMBERS[3:]}
        paper = " (the paper's)" if group[0]["method"] == OURS else ""
        lines.append([f"`{name}`{paper}", len(group), *(found | plain).values()])
    lines.sort(key=lambda line: -line[2].mean if line[2] else 0.0)
    measured = sorted({row["measured"] for row in rows if row["measured"]})
    words = telling(rows[0], others, [name for name in CONDITIONS if name != "measured"])
    about = [rows[0]["scene"], f"{rows[0]['minutes']:g} minutes", *words, *measured]
    return Table(COLUMNS, lines, caption=f"**{', '.join(about)}**")


def _departures(rows: list[dict]) -> Table:
    """What differs from the publications, and the faults kept from released code, each with its methods."""
    found: dict[str, dict[str, None]] = {}
    for field, mark in (("departures", ""), ("faults", "kept fault: ")):
        for row in rows:
            for one in filter(None, (row[field] or "").split("; ")):
                found.setdefault(mark + one, {})[f"`{row['method']}`"] = None
    lines = [[about, ", ".join(sorted(methods))] for about, methods in found.items()]
    lines.sort(key=lambda line: (line[0].startswith("kept"), -line[1].count(","), line[0]))
    columns = [Column("departure"), Column("methods")]
    presets = ", ".join(f"`preset={name}`" for name in sorted({row["preset"] for row in rows}))
    return Table(columns, lines, caption=f"## What differs from the publications with {presets}")
