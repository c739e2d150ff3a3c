"""Put the numbers of several runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from forewarp.metrics.registry import METRICS, metric_of
from forewarp.report.results import KINDS, UNREADABLE, Row, read_run, unreadable
from forewarp.report.tables import Column, Difference, Table

COSTS = {"steps": ("steps", 0), "train": ("seconds of training", 0), "frame": ("seconds per image", 3)}
# Shown where the runs differ in them, as their numbers then tell little of the methods.
CONDITIONS = {"clock": "clock of the minutes", "threads": "threads", "device": "computed on"}
CONDITIONS |= {"pictures": "pictures", "measured": "test views", "held_out": "views held out"}


def compare(runs: dict[str, Row]) -> Table:
    """Make a table with a row for each measure that all runs have, and a column for each run.

    Metrics are those of the test views; for two runs a column with the difference is added, which is empty
    where they are of different views. Conditions in which the runs differ come last.

    Args:
        runs: as of ``read_compared``.
    """
    rows, lines, two = list(runs.values()), [], len(runs) == 2
    same_views = len({row["measured"] for row in rows}) == 1

    def add(name: str, values: list, digits: int, with_difference: bool = False) -> None:
        if None not in values:
            column = Column("", digits)
            difference = column.text(Difference(values[0] - values[-1])) if with_difference else None
            lines.append([name, *(column.text(float(value)) for value in values), *[difference] * two])

    added = (name for row in rows for scores in row["test"].values() for name in scores)
    for metric in map(metric_of, dict.fromkeys([*METRICS, *added])):
        for kind, words in KINDS.items() if metric.summary else ():
            name = words if metric.name == "psnr" else f"{metric.heading}, {words}"
            values = [row["test"].get(kind, {}).get(metric.name) for row in rows]
            add(name, values, metric.digits, same_views)
    shares = [None if row["motion_error"] is None else 100 * row["motion_error"] for row in rows]
    add("moving points' error, % of motion", shares, 0, True)
    for name, (words, digits) in COSTS.items():
        add(words, [row[name] or None for row in rows], digits)
    for name, words in CONDITIONS.items():
        values = ["none named" if row[name] is None else str(row[name]) for row in rows]
        lines += [[words, *values, *[None] * two]] if len(set(values)) > 1 else []
    return Table(["PSNR (dB) of test views", *runs, *["difference"] * two], lines)


def read_compared(folders: Sequence[str | Path]) -> dict[str, Row]:
    """Read runs, named by their methods if these differ, else by as much of their folders as needed.

    Raises:
        ValueError: if there is no folder, or one that holds no measured run.
    """
    if not folders:
        raise ValueError("runs: expected folders of runs, but got none; set runs=[FOLDER,FOLDER]")
    rows, paths = [], [Path(folder) for folder in folders]
    for path in paths:
        again = f"forewarp-evaluate run={path}"
        if not (path / "metrics.json").is_file():
            raise ValueError(
                f"{path / 'metrics.json'}: expected a run's numbers, but got none; make them with {again}"
            )
        try:
            rows.append(read_run(path))
        except UNREADABLE as error:
            raise ValueError(
                f"{path}: expected a measured run, but got {unreadable(error)}; measure it with {again}"
            ) from error
    choices = (
        [row["metrics"].get("protocol", {}).get("method", path.name) for row, path in zip(rows, paths)],
        [path.resolve().name for path in paths],
        [path.as_posix() for path in paths],
        [f"{number} {path.as_posix()}" for number, path in enumerate(paths, 1)],
    )
    return dict(zip(next(names for names in choices if len(set(names)) == len(names)), rows))
