"""Draw the paper's figures from the pictures and numbers in run folders."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from forewarp.files import read_json
from forewarp.metrics.gain import Estimate
from forewarp.report import curve
from forewarp.report.collect import Result
from forewarp.report.paper_tables import row_of

RESOLUTION = re.compile(r"resolution |voxels_\d")  # variants of sweeps=resolution, now and before 0.3
GAP = 4  # pixels between the parts of a sheet


def draw_resolution(path: Path, results: Sequence[Result]) -> Path | None:
    """Draw PSNR against voxels along a side for runs of ``sweeps=resolution``, one line per scene.

    Return None if no scene has two sizes.
    """
    scenes: dict[str, dict[int, list[float]]] = {}
    for run in results:
        fine = run.config["stage"]["fine"]
        side = round(fine.get("num_voxels", fine.get("voxels"))[-1][1] ** (1 / 3))
        if "psnr" in run.numbers:
            row = row_of(run)
            line = f"{run.scene}, {row.model}, {row.preset}, {row.minutes or row.iterations:g}"
            scenes.setdefault(line, {}).setdefault(side, []).append(run.numbers["psnr"])
    scenes = {scene: sides for scene, sides in scenes.items() if len(sides) > 1}
    if not scenes:
        return None
    figure, axes = figure_of(1, 1, (7, 4.5))
    for scene, sides in sorted(scenes.items()):
        estimates = [Estimate.of(sides[side]) for side in sorted(sides)]
        spread = [estimate.deviation or 0 for estimate in estimates]
        axes[0, 0].errorbar(sorted(sides), [e.mean for e in estimates], spread, marker="o", label=scene)
    axes[0, 0].set(
        xlabel="voxels along a side", ylabel="PSNR (dB)", title="Performance with different resolutions"
    )
    axes[0, 0].grid(alpha=0.3)
    axes[0, 0].legend()
    return curve._save(figure, path)


def draw_canonical(path: Path, forward: Result, backward: Result) -> Path | None:
    """Draw the view nearest to the canonical time: truth, forward, backward, and both errors.

    Return None if the two runs share no view with a sheet.
    """
    both = sorted(set(_sheets(forward)) & set(_sheets(backward)))
    if not both:
        return None
    about = {image["name"]: image for image in _images(forward)}
    at = forward.metrics["protocol"].get("canonical_time", 0.5 if forward.dataset == "hypernerf" else 0.0)
    known = [name for name in both if name in about]
    name = min(known or both, key=lambda name: abs(about.get(name, {"time": at})["time"] - at))
    truth, ours, error = thirds(_read(_sheets(forward)[name]))
    _, theirs, their_error = thirds(_read(_sheets(backward)[name]))
    pictures = {"truth": truth, "forward": ours, "backward": theirs}
    pictures |= {"error, forward": error, "error, backward": their_error}
    figure, axes = figure_of(1, len(pictures), (3 * len(pictures), 3.4))
    _show(axes[0], pictures)
    figure.suptitle(f"{forward.scene}, {name}: near the canonical time; errors up to 0.25 (white)")
    return curve._save(figure, path)


def draw_sheet(path: Path, results: Sequence[Result], columns: int = 3) -> Path | None:
    """Draw a row for each scene: truth, result and error of a view; None if no run has a sheet."""
    found = {run.scene: _sheets(run) for run in sorted(results, key=lambda run: run.scene)}
    found = {scene: sheets for scene, sheets in found.items() if sheets}
    if not found:
        return None
    figure, axes = figure_of(len(found), columns, (3 * columns, 3.2 * len(found)))
    for row, (scene, sheets) in zip(axes, found.items()):
        name = sorted(sheets)[len(sheets) // 2]
        parts = thirds(_read(sheets[name]))
        _show(row, dict(zip((f"{scene}, {name}", "rendered", "error"), parts)))
    return curve._save(figure, path)


def thirds(sheet: np.ndarray) -> list[np.ndarray]:
    """Split a sheet (H, 3 W + 2 GAP, C) into its three pictures (H, W, C)."""
    width = (sheet.shape[1] - 2 * GAP) // 3
    return [sheet[:, i * (width + GAP) : i * (width + GAP) + width] for i in range(3)]


def _sheets(run: Result) -> dict[str, Path]:
    folder = run.folder / "images" / "sheets"
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in folder.rglob("[!.]*.png")}


def _images(run: Result) -> list[dict]:
    return (read_json(run.folder / "per_image.json") or {}).get("images", [])


def _read(path: Path) -> np.ndarray:
    from matplotlib.image import imread

    return imread(path)


def _show(axes, pictures: Mapping[str, np.ndarray]) -> None:
    for axis, (title, picture) in zip(axes, pictures.items()):
        axis.imshow(picture)
        axis.set_title(title, fontsize="small")
        axis.set_axis_off()


def figure_of(rows: int, columns: int, size: tuple[float, float]):
    """Make a figure and its axes (rows, columns); ``size`` in inches."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("expected matplotlib for plots; install forewarp[plots]") from None
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)
