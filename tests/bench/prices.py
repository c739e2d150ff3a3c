"""``python -m tests.bench.prices``: write the price list that is packaged, from the tables in docs/results.

A row is the median of the runs of a model and preset. ``jobs.csv`` beside these tables holds whole jobs, as
``FOREWARP_TIMES=docs/results/jobs.csv forewarp-train ...`` adds them; they alone know how long scoring a view
and all else of a job takes, and the size of its folder.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

from forewarp.files import read_rows
from forewarp.runs.config_files import project_root
from forewarp.runs.cost import PRICES, Row, read_costs, write_costs

TABLES = ("methods", "particles", "forward", "backward")
FAITHFUL = {"faithful-step": "AMD EPYC", "faithful-step-gpu": "NVIDIA H200"}
KEPT = 3 * 4 * 2  # bytes of a parameter: weights and two moments of 4 bytes each, in two stages


def prices_of(tables: Sequence[Sequence[Mapping[str, str]]]) -> list[Row]:
    """Return a row for each model, preset and device of tables of runs."""
    groups = defaultdict(list)
    for row in (row for table in tables for row in table if row["step"]):
        groups[row["method"], row["preset"], row["device"]].append(row)
    return [_price(*key, rows) for key, rows in sorted(groups.items())]


def _price(model: str, preset: str, device: str, rows: Sequence[Mapping[str, str]]) -> Row:
    def middle(name: str) -> float | None:
        known = [float(row[name]) for row in rows if row[name]]
        return median(known) if known else None

    sides = (re.match(r"(\d+)x(\d+)", row["pictures"] or "") for row in rows)
    pixels = [float(found[1]) * float(found[2]) for found in sides if found]
    steps, step, parameters = middle("steps"), middle("step"), middle("parameters")
    return Row(
        model=model,
        preset=preset,
        device=device,
        threads=middle("threads"),
        day=max(row["day"] for row in rows),
        steps=steps,
        seconds=steps * step,
        processor=steps * step,
        pixels=median(pixels) if pixels else None,
        frame=middle("frame"),
        memory=middle("memory"),
        disk=KEPT * 1e6 * parameters,
    )


def faithful_prices(table: Sequence[Mapping[str, str]], device: str) -> list[Row]:
    """Return a row for each method with its published numbers, of which only a step was measured."""
    return [
        Row(
            model=row["method"],
            preset="faithful",
            scene=row["scene"],
            device=device,
            threads=1.0,
            day=row["day"],
            steps=float(row["steps"]),
            seconds=float(row["steps"]) * float(row["seconds"]),
            memory=float(row["bytes"]) / 2**30,
            disk=KEPT * float(row["parameters"]),
        )
        for row in table
        if not row["failed"]
    ]


def main(results: Path, out: Path = PRICES) -> None:
    """Write the price list."""
    rows = prices_of([read_rows(results / f"{name}.csv") for name in TABLES])
    for name, device in FAITHFUL.items():
        rows += faithful_prices(read_rows(results / f"{name}.csv"), device)
    write_costs(out, [*rows, *read_costs(results / "jobs.csv")])
    print(f"written: {out}")


if __name__ == "__main__":
    main(project_root() / "docs" / "results")
