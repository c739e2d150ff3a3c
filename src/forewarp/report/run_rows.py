"""A row a run, in a CSV table that later runs add to: the pages of minutes and of methods are made of it."""

from __future__ import annotations

import csv
import io
import re
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path

from forewarp.files import read_json, read_text, replace_file
from forewarp.metrics.gain import Estimate
from forewarp.report.collect import Result, collect

KEY = ("method", "preset", "scene", "minutes", "seed")  # what tells rows apart
NUMBERS = ("psnr", "ssim", "lpips", "steps", "step", "frame", "parameters", "memory", "ends", "threads")
TEXTS = ("clock", "dataset", "device", "day", "measured", "departures", "faults", "views", "curve", "command")
NETS = ("vgg", "alex", "squeeze")  # LPIPS is of the first whose weights were there
CLOCKS = """Minutes are of training, by the
platform's clock: it counts all that a method does to begin with (a visual hull, a plane sweep), and leaves
out reading pictures and compiling. The processor clock counts processor time of the process, which is the
same beside other work on the machine and, with one thread, equals the wall clock on an idle one."""
_ENDS = 0.1  # share of the time that counts as its first and last part
_MOST = 1 << 24  # bytes of a table that is read back


def of_minutes(runs: Path) -> tuple[list[Result], list[str]]:
    """Read the measured runs below a folder that ended after minutes, and a line for each other run.

    Raises:
        ValueError: if there is no run at all.
    """
    results, without = collect(runs, ["metrics.json"])
    endless = [result for result in results if result.minutes is None]
    without += [f"{result.folder.relative_to(runs)}: no budget.minutes" for result in endless]
    return [result for result in results if result.minutes is not None], without


def key_of(result: Result) -> tuple[str, str, str, float, int]:
    """What tells a run's row from others: ``KEY``."""
    config = result.config
    return config["model"]["name"], config["preset"]["name"], result.scene, result.minutes, result.seed


def row_of(result: Result) -> dict:
    """A run's row: ``KEY``, ``NUMBERS`` and ``TEXTS``; what is not known is None.

    ``step`` and ``frame`` are seconds, ``views`` is time:PSNR of each test view, ``curve`` is seconds:PSNR.
    """
    images = (read_json(result.folder / "per_image.json") or {}).get("images", [])
    views = sorted((one["time"], one["scores"]["psnr"]) for one in images)
    numbers, scores = result.numbers, result.metrics["test"][result.ability]
    protocol = result.metrics["protocol"]
    frames = protocol.get("test_frames")
    return {
        **dict(zip(KEY, key_of(result))),
        **{name: numbers.get(name) for name in NUMBERS},
        "lpips": next((scores[f"lpips_{net}"] for net in NETS if f"lpips_{net}" in scores), None),
        "ends": ends_below(views),
        "threads": protocol.get("threads"),
        "clock": protocol.get("clock", "wall"),
        "dataset": result.dataset,
        "device": protocol.get("device"),
        "day": result.day,
        "measured": protocol.get("measured", frames and f"all {frames} test views"),
        "departures": protocol.get("departures"),
        "faults": protocol.get("faults"),
        "views": " ".join(f"{time:.4f}:{psnr:.2f}" for time, psnr in views),
        "curve": " ".join(f"{point.seconds:.1f}:{point.psnr:.2f}" for point in result.curve),
        "command": result.command,
    }


def pairs(text: str | None) -> list[tuple[float, float]]:
    """Read what a row has in ``views`` and ``curve``.

    >>> pairs("0.5:30.25 1:31")
    [(0.5, 30.25), (1.0, 31.0)]
    """
    return [tuple(map(float, one.split(":"))) for one in (text or "").split()]


def ends_below(views: Sequence[tuple[float, float]]) -> float | None:
    """By how many dB the mean of the views (time, PSNR) at both ends is below the median of the others.

    >>> ends_below([(0.0, 30.0), (0.05, 31.0), (0.5, 34.0), (0.6, 33.0), (1.0, 32.0)])
    2.5
    """
    ends = [psnr for time, psnr in views if not _ENDS < time < 1 - _ENDS]
    others = [psnr for time, psnr in views if _ENDS < time < 1 - _ENDS]
    return statistics.median(others) - statistics.fmean(ends) if ends and others else None


def merged(file: Path, results: Iterable[Result]) -> list[dict]:
    """Add the rows of runs to those of a table, which is written; return all.

    A run takes the place of a row of the same method, preset, scene, minutes and seed.
    """
    known = list(csv.DictReader(io.StringIO(read_text(file, _MOST)))) if file.is_file() else []
    found = {}
    for row in (*(_read(row) for row in known), *(row_of(result) for result in results)):
        found[tuple(row[name] for name in KEY)] = row
    rows = [found[key] for key in sorted(found, key=str)]
    replace_file(file, _csv(rows))
    return rows


def _read(row: dict) -> dict:
    """A row as ``row_of`` makes it; of an older table some fields are unknown."""
    numbers = {name: float(row[name]) if row.get(name) else None for name in ("minutes", *NUMBERS)}
    texts = {name: row.get(name) or None for name in TEXTS}
    return row | numbers | texts | {"seed": int(row["seed"]), "clock": texts["clock"] or "wall"}


def _csv(rows: list[dict]) -> str:
    file, fields = io.StringIO(), (*KEY, *NUMBERS, *TEXTS)
    writer = csv.DictWriter(file, fields, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if row[name] is None else row[name] for name in fields} for row in rows)
    return file.getvalue()


def estimate(rows: Sequence[dict], name: str) -> Estimate | None:
    """Estimate a number over the rows that have it; None if none has."""
    return Estimate.of([row[name] for row in rows if row[name] is not None])


def machine(rows: Sequence[dict]) -> str:
    """Say in a line on what the runs were computed, and when."""
    about = {
        f"{row['device']}, threads: {row['threads']:g}, minutes by the {row['clock']} clock"
        for row in rows
        if row["device"]
    }
    days = sorted({row["day"] for row in rows if row["day"]})
    return "; ".join(sorted(about)) + (f"; {' to '.join(dict.fromkeys((days[0], days[-1])))}" if days else "")


def commands(rows: Sequence[dict]) -> str:
    """The section with the commands that made the rows: those that differ only in ``model=`` as one.

    A job of a sweep does not name what the sweep sets, so the clock and the threads are added.
    """
    models: dict[str, list[str]] = {}
    for row in rows:
        command = re.sub(r"\bseed=\d+ | run=\S+$", "", row["command"])
        if row["clock"] != "wall" and "budget.clock=" not in command and "#" not in command:
            command += f" budget.clock={row['clock']} threads={row['threads']:g}"
        model = re.search(r" model=(\S+)", command)
        command = command.replace(model[0], " model={}", 1) if model else command
        known = models.setdefault(command, [])
        known += [model[1]] if model and model[1] not in known else []
    lines = []
    for command, names in models.items():
        several = command.replace("forewarp-train", "forewarp-train --multirun", 1)
        lines.append((several if len(names) > 1 else command).replace("model={}", f"model={','.join(names)}"))
    return "\n".join(["## Commands\n", "Each with its `seed=`.\n", "```bash", *sorted(lines), "```\n"])
