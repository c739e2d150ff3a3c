"""``python -m forewarp.cli.compare RUN RUN ...``: the numbers of several runs side by side."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from forewarp.cli.entry import MISTAKE

_ABILITIES = {
    "space": "at training times",
    "time": "between them",
    "canonical": "canonical time",
    "all": "all",
}

_KEYS = ("protocol", "seconds", "test")


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
    steps = [metrics.get("steps") for metrics in runs.values()]
    if all(steps):  # runs measured before they were noted have none
        table.add_row("steps", *(f"{sum(of_stages.values()):,}" for of_stages in steps))
    table.add_row("seconds of training", *(f"{metrics['seconds']['train']:.0f}" for metrics in runs.values()))
    return table


def _difference(values: list[float], form: str) -> list[str]:
    return [format(values[0] - values[1], form)] if len(values) == 2 else []


def _flow_share(metrics: dict) -> float | None:
    flow = metrics.get("flow") or {}
    return flow["epe_moving"] / flow["motion_mean"] if flow.get("epe_moving") is not None else None


def read_metrics(folder: str) -> dict:
    """What a run's ``metrics.json`` holds.

    Raises:
        ValueError: where there is none, or not what ``forewarp-evaluate`` writes.
    """
    path = Path(folder) / "metrics.json"
    try:
        metrics = json.loads(path.read_text())
    except OSError as error:
        raise ValueError(
            f"{path}: expected the numbers of a run, but got {error.strerror}; "
            f"make them with forewarp-evaluate run={folder}"
        ) from None
    except ValueError:
        metrics = None
    missing = [k for k in _KEYS if not isinstance(metrics, dict) or not isinstance(metrics.get(k), dict)]
    if missing:
        raise ValueError(
            f"{path}: expected the key {missing[0]}, but got none; make it anew with forewarp-evaluate "
            f"run={folder}"
        )
    return metrics


def named(folders: list[str], metrics: list[dict]) -> dict[str, dict]:
    """The runs under their methods' names where those differ, else under their folders', as far as needed.

    >>> list(named(["a/x", "b/x"], [{"protocol": {"method": "forward"}}] * 2))
    ['a/x', 'b/x']
    """
    paths = [Path(folder) for folder in folders]
    choices = (
        [content["protocol"].get("method", path.name) for path, content in zip(paths, metrics)],
        [path.resolve().name for path in paths],
        [path.as_posix() for path in paths],
        [f"{number} {path.as_posix()}" for number, path in enumerate(paths, 1)],
    )
    return dict(zip(next(names for names in choices if len(set(names)) == len(names)), metrics))


def main(folders: list[str]) -> None:
    """Print the table of run folders; a mistake ends in one line and status 2."""
    try:
        if not folders:
            raise ValueError("expected folders of runs, but got none; name two")
        runs = named(folders, [read_metrics(folder) for folder in folders])
    except ValueError as error:
        print(f"forewarp.cli.compare: error: {error}", file=sys.stderr)
        sys.exit(MISTAKE)
    Console().print(table_of(runs))


if __name__ == "__main__":
    main(sys.argv[1:])
