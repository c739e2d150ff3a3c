"""Write the page of all methods under one clock: what each reaches on each scene in so many minutes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from forewarp.files import replace_file
from forewarp.report.collect import Result, left_out
from forewarp.report.methods_figures import draw_curves, draw_views
from forewarp.report.run_rows import (
    CLOCKS,
    KEY,
    NETS,
    commands,
    estimate,
    key_of,
    machine,
    merged,
    of_minutes,
)
from forewarp.report.tables import Column, Table

OURS = "forward"  # the paper's own method
STEPS = "faithful-step.md"  # beside the page, by python -m tests.bench.faithful
INTRODUCTION = """# All methods under one clock

Written by `forewarp-report kind=methods` from runs of `sweeps=methods`: each method learns from the same
pictures in the same minutes, and is measured on the same test views. `{ours}` is the paper's method,
`backward` its opponent like for like, `particles` our own; the others are the published systems of the
paper's tables. With `preset=fast` all are as small as minutes of a processor ask for: this is what they
reach in such minutes, and says nothing of what they reach in the hours of a GPU that they were made for.

{clocks}

PSNR (dB), SSIM and LPIPS are means over the test views; ± is the standard deviation over seeds. *s a
step* are all seconds of training by the number of steps, *s a frame* those of the first picture of a
time, *GiB* the most memory of the process. LPIPS is of the first of {nets} whose weights were there.
"""
CURVES = """PSNR of some pixels of validation views while each method learns; the number at a line's end is
the last of these, and not the table's, which is of whole test views. Schedules follow the share of the
minutes that is spent, so no method is at its best before the end.
"""
VIEWS = "Test views and their PSNR (dB), cut to the subject: what a method draws elsewhere is not seen.\n"
NUMBERS = ("psnr", "ssim", "lpips", "steps", "step", "frame", "parameters", "memory")
COLUMNS = (
    *(Column("method"), Column("PSNR"), Column("SSIM", 4), Column("LPIPS", 4), Column("steps", 0)),
    *(Column("s a step", 3), Column("s a frame", 2), Column("parameters (M)", 2), Column("GiB", 2)),
)


def write_methods(runs: Path, out: Path) -> list[Path]:
    """Write ``methods.md``, ``methods.csv`` (a row a run), and two pictures of each scene.

    Rows of a table that is there already stay, as in ``write_minutes``; views are drawn of the given runs
    alone. Ablations among the runs are left out.

    Args:
        runs: folder to search for measured runs.
        out: folder to write to.

    Returns:
        the files written.
    """
    results, without = of_minutes(runs)
    plain = [run for run in results if (run.config.get("variant") or {}).get("name") in (None, "base")]
    without += [f"{run.folder.relative_to(runs)}: an ablation" for run in results if run not in plain]
    page, table = out / "methods.md", out / "methods.csv"
    rows, written = merged(table, plain), [page, table]
    about = INTRODUCTION.format(ours=OURS, clocks=CLOCKS, nets=", ".join(NETS))
    parts = [about, f"Machine: {machine(rows)}.\n"]
    for scene in sorted({row["scene"] for row in rows}):
        text, pictures = _scene(scene, rows, plain, out)
        parts += text
        written += pictures
    parts += [_departures(rows).markdown()]
    if (out / STEPS).is_file():
        parts += [f"What a step costs with the published numbers: [a step of `faithful`]({STEPS}).\n"]
    parts += [commands(rows), *left_out("Without numbers", without)]
    replace_file(page, "\n".join(parts))
    return written


def names_of(rows: Sequence[dict]) -> dict[int, str]:
    """Name the method of each row, by ``id``; with the preset where not all rows have the same."""
    several = len({row["preset"] for row in rows}) > 1
    return {id(row): row["method"] + (f" ({row['preset']})" if several else "") for row in rows}


def _scene(scene: str, rows: list[dict], results: list[Result], out: Path) -> tuple[list[str], list[Path]]:
    """The part of the page about a scene, and its pictures, which are of each method's longest runs."""
    own = [row for row in rows if row["scene"] == scene]
    names, parts, pictures = names_of(own), [f"## {scene}\n"], []
    longest: dict[str, dict] = {}
    for row in sorted(own, key=lambda row: (row["minutes"], -row["seed"])):
        longest[names[id(row)]] = row
    if drawn := draw_curves(out / f"methods-{scene}.png", longest, scene):
        parts += [f"![PSNR against seconds of training, a line a method]({drawn.name})\n", CURVES]
        pictures.append(drawn)
    at = {tuple(row[key] for key in KEY): name for name, row in longest.items()}
    folders = {at[key_of(run)]: run.folder for run in results if key_of(run) in at}
    ranked = sorted(folders, key=lambda name: -(longest[name]["psnr"] or 0.0))
    path = out / f"methods-{scene}-views.png"
    if drawn := draw_views(path, {name: folders[name] for name in ranked}):
        parts += [f"![Test views, the truth and each method]({drawn.name})\n", VIEWS]
        pictures.append(drawn)
    for minutes in sorted({row["minutes"] for row in own}):
        parts.append(_reached([row for row in own if row["minutes"] == minutes], names).markdown())
    return parts, pictures


def _reached(rows: list[dict], names: dict[int, str]) -> Table:
    """All numbers of the runs of a scene and some minutes, the best PSNR first."""
    groups: dict[str, list[dict]] = {}
    for row in rows:
        groups.setdefault(names[id(row)], []).append(row)
    lines = []
    for name, group in groups.items():
        found = {number: estimate(group, number) for number in NUMBERS}
        plain = {n: found[n] and found[n].mean for n in NUMBERS[3:]}
        paper = " (the paper's)" if group[0]["method"] == OURS else ""
        lines.append([f"`{name}`{paper}", *(found | plain).values()])
    lines.sort(key=lambda line: -line[1].mean if line[1] else 0.0)
    measured = "; ".join(sorted({row["measured"] for row in rows if row["measured"]}))
    about = f"{rows[0]['scene']}, {rows[0]['minutes']:g} minutes" + (f", {measured}" if measured else "")
    return Table(COLUMNS, lines, caption=f"**{about}**")


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
    return Table(columns, lines, caption="## What differs from the publications")
