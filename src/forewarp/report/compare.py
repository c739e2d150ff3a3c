"""Put the numbers of several runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from forewarp.files import read_json
from forewarp.report.sheets import draw_beside
from forewarp.report.tables import Column, Difference, Table

_ABILITIES = {
    "space": "at training times",
    "time": "between them",
    "canonical": "canonical time",
    "all": "all",
}
# Shown where the runs differ in them, as their numbers then tell little of the methods.
_CONDITIONS = {"clock": "clock of the minutes", "threads": "threads", "device": "computed on"}
_CONDITIONS |= {"resolution": "size of pictures", "measured": "test views", "held_out": "views held out"}
_KEYS = ("protocol", "seconds", "test")


def compare(folders: Sequence[Path]) -> Table:
    """Make a table with a row for each measure and a column for each run.

    PSNR is that of the test views, in dB; for two runs a column with the difference is added, which is empty
    where they are of different views. Conditions in which the runs differ come last.

    Args:
        folders: folders of measured runs.

    Raises:
        ValueError: if ``folders`` is empty, or a ``metrics.json`` is missing or incomplete.
    """
    if not folders:
        raise ValueError("runs: expected folders of runs, but got none; set runs=[FOLDER,FOLDER]")
    metrics = [read_metrics(Path(folder)) for folder in folders]
    rows = []
    for ability, name in _ABILITIES.items():
        values = [found["test"].get(ability, {}).get("psnr") for found in metrics]
        _add(rows, name, values, 2, with_difference=len(set(_told(metrics, "measured"))) == 1)
    shares = [_flow_share(found) for found in metrics]
    _add(rows, "moving points' error, % of motion", [share and 100 * share for share in shares], 0)
    steps = [sum((found.get("steps") or {}).values()) or None for found in metrics]
    _add(rows, "steps", steps, 0, with_difference=False)
    for about, key, digits in (
        ("seconds of training", "train", 0),
        ("seconds a picture", "render_per_frame", 3),
    ):
        _add(rows, about, [found["seconds"].get(key) for found in metrics], digits, with_difference=False)
    for key, about in _CONDITIONS.items():
        told = _told(metrics, key)
        if len(set(told)) > 1:
            rows.append([about, *told, *[None] * (len(folders) == 2)])
    columns = ["PSNR (dB) of test views", *names_of(folders, metrics)]
    columns += ["difference"] if len(folders) == 2 else []
    return Table([Column(name) for name in columns], rows)


def draw_compared(folders: Sequence[Path], out: Path) -> Path | None:
    """Draw a test view in the middle of the time by every run into ``compare.png``.

    Return None if the runs share no test view with a picture.
    """
    names = names_of(folders, [read_metrics(Path(folder)) for folder in folders])
    runs = {name: Path(folder) for name, folder in zip(names, folders)}
    return draw_beside(out / "compare.png", runs, 0.5, "test view")


def _told(metrics: Sequence[dict], key: str) -> list[str]:
    """A condition of each run, in words; runs that name no test views were measured on all."""
    unnamed = "all" if key == "measured" else "none named"
    told = [str(found["protocol"].get(key) or unnamed) for found in metrics]
    return ["all" if key == "measured" and one.startswith("all ") else one for one in told]


def _add(rows: list, name: str, values: list, digits: int, *, with_difference: bool = True) -> None:
    """Add a row, unless a run lacks the measure."""
    if None in values:
        return
    written = Column("", digits)
    cells = [written.text(float(value)) for value in values]
    if len(values) == 2:
        cells.append(written.text(Difference(values[0] - values[1])) if with_difference else None)
    rows.append([name, *cells])


def _flow_share(metrics: dict) -> float | None:
    flow = metrics.get("flow") or {}
    return flow["epe_moving"] / flow["motion_mean"] if flow.get("epe_moving") is not None else None


def read_metrics(folder: Path) -> dict:
    """Read a run's ``metrics.json``.

    Raises:
        ValueError: if the file is missing, or lacks keys that ``forewarp-evaluate`` writes.
    """
    path = folder / "metrics.json"
    if not path.is_file():
        raise ValueError(
            f"{path}: expected a run's numbers, but got none; make them with forewarp-evaluate run={folder}"
        )
    metrics = read_json(path) or {}
    for key in _KEYS:
        if not isinstance(metrics.get(key), dict):
            raise ValueError(
                f"{path}: expected the key {key}, but got none; make it anew with forewarp-evaluate "
                f"run={folder}"
            )
    return metrics


def names_of(folders: Sequence[Path], metrics: Sequence[dict]) -> list[str]:
    """Name runs by their methods if these differ, else by as much of their folders as needed.

    >>> names_of(["a/x", "b/x"], [{"protocol": {"method": "forward"}}] * 2)
    ['a/x', 'b/x']
    """
    paths = [Path(folder) for folder in folders]
    choices = (
        [content["protocol"].get("method", path.name) for path, content in zip(paths, metrics)],
        [path.resolve().name for path in paths],
        [path.as_posix() for path in paths],
        [f"{number} {path.as_posix()}" for number, path in enumerate(paths, 1)],
    )
    return next(names for names in choices if len(set(names)) == len(names))
