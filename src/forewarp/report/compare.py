"""Put the numbers of several runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from forewarp.files import read_json
from forewarp.metrics.registry import METRICS, metric_of
from forewarp.report.figures import draw_beside
from forewarp.report.tables import Column, Difference, Table, columns_of

ABILITIES = {
    "space": "at training times",
    "time": "between them",
    "canonical": "canonical time",
    "all": "all",
}
# Shown where the runs differ in them, as their numbers then tell little of the methods.
CONDITIONS = {"clock": "clock of the minutes", "threads": "threads", "device": "computed on"}
CONDITIONS |= {"resolution": "size of pictures", "measured": "test views", "held_out": "views held out"}


def compare(folders: Sequence[str | Path]) -> Table:
    """Make a table with a row for each measure and a column for each run.

    PSNR is that of the test views, in dB; for two runs a column with the difference is added, which is empty
    where they are of different views. Conditions in which the runs differ come last.

    Args:
        folders: folders of measured runs.

    Raises:
        ValueError: if ``folders`` is empty, or a ``metrics.json`` is missing or incomplete.
    """
    runs = read_metrics(folders)
    views = {_condition(metrics, "measured") for metrics in runs.values()}
    lines, two = [], len(runs) == 2

    def add(name: str, values: list, digits: int, with_difference: bool = False) -> None:
        if None not in values:  # a measure that a run lacks has no row
            column = Column("", digits)
            difference = column.text(Difference(values[0] - values[-1])) if with_difference else None
            lines.append([name, *(column.text(float(value)) for value in values), *[difference] * two])

    tests = [metrics["test"] for metrics in runs.values()]
    for ability, words in ABILITIES.items():
        add(words, [test.get(ability, {}).get("psnr") for test in tests], 2, len(views) == 1)
    for name in dict.fromkeys(
        [*METRICS, *(name for test in tests for scores in test.values() for name in scores)]
    ):
        for ability, words in ABILITIES.items():
            values = [test.get(ability, {}).get(name) for test in tests]
            if name != "psnr" and metric_of(name).summary:
                add(f"{metric_of(name).heading}, {words}", values, metric_of(name).digits, len(views) == 1)
    flows = [metrics.get("flow") or {} for metrics in runs.values()]
    known = all(flow.get("epe_moving") is not None for flow in flows)
    shares = [100 * flow["epe_moving"] / flow["motion_mean"] for flow in flows] if known else [None]
    add("moving points' error, % of motion", shares, 0, True)
    add("steps", [sum((m.get("steps") or {}).values()) or None for m in runs.values()], 0)
    add("seconds of training", [metrics["seconds"].get("train") for metrics in runs.values()], 0)
    add("seconds a picture", [metrics["seconds"].get("render_per_frame") for metrics in runs.values()], 3)
    for key, words in CONDITIONS.items():
        values = [_condition(metrics, key) for metrics in runs.values()]
        lines += [[words, *values, *[None] * two]] if len(set(values)) > 1 else []
    return Table(columns_of(["PSNR (dB) of test views", *runs, *["difference"] * two]), lines)


def draw_compared(folders: Sequence[str | Path], out: Path) -> Path | None:
    """Draw a test view in the middle of the time by every run into ``compare.png``.

    Return None if the runs share no test view with a picture.
    """
    rows = {}
    for name, folder in zip(read_metrics(folders), folders):
        images = (read_json(Path(folder) / "per_image.json") or {}).get("images", [])
        rows[name] = {"folder": Path(folder), "images": images}
    return draw_beside(out / "compare.png", rows, 0.5, "test view")


def read_metrics(folders: Sequence[str | Path]) -> dict[str, dict]:
    """Read ``metrics.json`` of runs, named by their methods if these differ, else by as much of their folders
    as needed.

    Raises:
        ValueError: if there is no folder, a file is missing, or lacks keys that ``forewarp-evaluate`` writes.
    """
    if not folders:
        raise ValueError("runs: expected folders of runs, but got none; set runs=[FOLDER,FOLDER]")
    runs = []
    for folder in folders:
        path = Path(folder) / "metrics.json"
        if not path.is_file():
            raise ValueError(
                f"{path}: expected a run's numbers, but got none; make them with forewarp-evaluate "
                f"run={folder}"
            )
        runs.append(read_json(path) or {})
        for key in ("protocol", "seconds", "test"):
            if not isinstance(runs[-1].get(key), dict):
                raise ValueError(
                    f"{path}: expected the key {key}, but got none; make it anew with forewarp-evaluate "
                    f"run={folder}"
                )
    paths = [Path(folder) for folder in folders]
    choices = (
        [metrics["protocol"].get("method", path.name) for metrics, path in zip(runs, paths)],
        [path.resolve().name for path in paths],
        [path.as_posix() for path in paths],
        [f"{number} {path.as_posix()}" for number, path in enumerate(paths, 1)],
    )
    names = next(names for names in choices if len(set(names)) == len(names))
    return dict(zip(names, runs))


def _condition(metrics: Mapping, key: str) -> str:
    """A condition of a run, in words; runs that name no test views were measured on all."""
    words = str(metrics["protocol"].get(key) or ("all" if key == "measured" else "none named"))
    return "all" if key == "measured" and words.startswith("all ") else words
