"""``python -m forewarp.cli.compare RUN RUN ...``: the numbers of several runs side by side."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

_ABILITIES = {
    "space": "at training times",
    "time": "between them",
    "canonical": "canonical time",
    "all": "all",
}


def table_of(runs: dict[str, dict]) -> Table:
    """A row a measure, a column a run; with two runs, their difference.

    Args:
        runs: name -> what its ``metrics.json`` holds.
    """
    table = Table(box=box.SIMPLE)
    table.add_column("PSNR (dB) of held-out views")
    for name in [*runs, *(["difference"] if len(runs) == 2 else [])]:
        table.add_column(name, justify="right")
    for ability, words in _ABILITIES.items():
        values = [metrics["test"].get(ability, {}).get("psnr") for metrics in runs.values()]
        if None not in values:
            table.add_row(words, *(f"{v:.2f}" for v in values), *_difference(values, "+.2f"))
    shares = [_flow_share(metrics) for metrics in runs.values()]
    if None not in shares:
        table.add_row(
            "moving points' error, share of motion",
            *(f"{v:.0%}" for v in shares),
            *_difference(shares, "+.0%"),
        )
    table.add_row("seconds of training", *(f"{metrics['seconds']['train']:.0f}" for metrics in runs.values()))
    return table


def _difference(values: list[float], form: str) -> list[str]:
    return [format(values[0] - values[1], form)] if len(values) == 2 else []


def _flow_share(metrics: dict) -> float | None:
    flow = metrics.get("flow") or {}
    return flow["epe_moving"] / flow["motion_mean"] if flow.get("epe_moving") is not None else None


def main(folders: list[str]) -> None:
    """Print the table of run folders."""
    runs = {}
    for folder in folders:
        metrics = json.loads((Path(folder) / "metrics.json").read_text())
        runs[metrics["protocol"].get("method", Path(folder).name)] = metrics
    Console().print(table_of(runs))


if __name__ == "__main__":
    main(sys.argv[1:])
