"""Read the sheets truth | rendering | error in run folders, and draw several runs' beside each other."""

from __future__ import annotations

from collections.abc import Mapping
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
    sheets = {name: sheets_of(folder) for name, folder in runs.items()}
    shared = set.intersection(*(set(found) for found in sheets.values())) if sheets else set()
    if not shared:
        return None
    times = {image["name"]: image["time"] for image in _images(next(iter(runs.values())))}
    known = [name for name in sorted(shared) if name in times]
    view = min(known or sorted(shared), key=lambda name: abs(times.get(name, near) - near))
    parts = {name: thirds(read_picture(found[view])) for name, found in sheets.items()}
    truth = next(iter(parts.values()))[0]
    figure, axes = figure_of(2, 1 + len(parts), (3 * (1 + len(parts)), 6.6))
    show(axes[0], {"truth": truth} | {name: rendered for name, (_, rendered, _) in parts.items()})
    axes[1, 0].set_axis_off()
    show(axes[1, 1:], {f"error, {name}": error for name, (_, _, error) in parts.items()})
    figure.suptitle(f"{about}, {view}; errors up to 0.25 (white)")
    return curve._save(figure, path)


def sheets_of(folder: Path) -> dict[str, Path]:
    """Return the sheets of a run: name of the view -> file."""
    sheets = Path(folder) / "images" / "sheets"
    return {path.relative_to(sheets).with_suffix("").as_posix(): path for path in sheets.rglob("[!.]*.png")}


def thirds(sheet: np.ndarray) -> list[np.ndarray]:
    """Split a sheet (H, 3 W + 2 GAP, C) into its three pictures (H, W, C)."""
    width = (sheet.shape[1] - 2 * GAP) // 3
    return [sheet[:, i * (width + GAP) : i * (width + GAP) + width] for i in range(3)]


def read_picture(path: Path) -> np.ndarray:
    """Read a picture as matplotlib shows it."""
    from matplotlib.image import imread

    return imread(path)


def show(axes, pictures: Mapping[str, np.ndarray]) -> None:
    """Show titled pictures, one on each axis."""
    for axis, (title, picture) in zip(axes, pictures.items()):
        axis.imshow(picture)
        axis.set_title(title, fontsize="small")
        axis.set_axis_off()


def figure_of(rows: int, columns: int, size: tuple[float, float]):
    """Make a figure and its axes (rows, columns); ``size`` in inches.

    Raises:
        ImportError: if matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("expected matplotlib for plots; install forewarp[plots]") from None
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _images(folder: Path) -> list[dict]:
    return (read_json(Path(folder) / "per_image.json") or {}).get("images", [])
