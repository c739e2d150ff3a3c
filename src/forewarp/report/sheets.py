"""Read the sheets truth | rendering | error in run folders, and draw several runs' beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from forewarp.files import read_json
from forewarp.report import curve

GAP = 4  # pixels between the parts of a sheet


def draw_beside(path: Path, runs: Mapping[str, Path], near: float, about: str) -> Path | None:
    """Draw one test view: the truth, each run's rendering, and below each its error.

    Args:
        path: file of the picture.
        runs: name -> folder of the run.
        near: of the views that all runs have a sheet of, the one nearest to this time is drawn.
        about: begins the title.

    Return None if the runs share no view with a sheet.
    """
    if (view := view_near(runs, near)) is None:
        return None
    parts = {name: thirds(read_picture(sheets_of(folder)[view])) for name, folder in runs.items()}
    truth = next(iter(parts.values()))[0]
    figure, axes = figure_of(2, 1 + len(parts), (3 * (1 + len(parts)), 6.6))
    show(axes[0], {"truth": truth} | {name: rendered for name, (_, rendered, _) in parts.items()})
    axes[1, 0].set_axis_off()
    show(axes[1, 1:], {f"error, {name}": error for name, (_, _, error) in parts.items()})
    figure.suptitle(f"{about}, {view}; errors up to 0.25 (white)")
    return curve._save(figure, path)


def view_near(runs: Mapping[str, Path], near: float) -> str | None:
    """Choose, of the views that all runs have a sheet of, the nearest to a time; None if there is none."""
    sheets = [set(sheets_of(folder)) for folder in runs.values()]
    shared = sorted(set.intersection(*sheets)) if sheets else []
    if not shared:
        return None
    times = {image["name"]: image["time"] for image in images_of(next(iter(runs.values())))}
    known = [name for name in shared if name in times]
    return min(known or shared, key=lambda name: abs(times.get(name, near) - near))


def sheets_of(folder: Path) -> dict[str, Path]:
    """Return the sheets of a run: name of the view -> file."""
    sheets = Path(folder) / "images" / "sheets"
    return {path.relative_to(sheets).with_suffix("").as_posix(): path for path in sheets.rglob("[!.]*.png")}


def thirds(sheet: np.ndarray) -> list[np.ndarray]:
    """Split a sheet (H, 3 W + 2 GAP, C) into its three pictures (H, W, C)."""
    width = (sheet.shape[1] - 2 * GAP) // 3
    return [sheet[:, i * (width + GAP) : i * (width + GAP) + width] for i in range(3)]


def read_picture(path: Path) -> np.ndarray:
    """Read a picture as matplotlib shows it.

    Raises:
        ImportError: if matplotlib is missing.
    """
    try:
        from matplotlib.image import imread
    except ImportError:
        raise ImportError(curve.NO_PLOTS) from None
    return imread(path)


def show(axes, pictures: Mapping[str, np.ndarray], size: str = "small") -> None:
    """Show pictures, one on each axis, with titles of a ``size``."""
    for axis, (title, picture) in zip(axes, pictures.items()):
        axis.imshow(picture)
        axis.set_title(title, fontsize=size)
        axis.set_axis_off()


def figure_of(rows: int, columns: int, size: tuple[float, float], heights: Sequence[float] | None = None):
    """Make a figure and its axes (rows, columns); ``size`` in inches, ``heights`` of rows in any unit.

    Raises:
        ImportError: if matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError(curve.NO_PLOTS) from None
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, height_ratios=heights)


def images_of(folder: Path) -> list[dict]:
    """Read what a run's ``per_image.json`` holds of each test view; nothing if there is none."""
    return (read_json(Path(folder) / "per_image.json") or {}).get("images", [])
