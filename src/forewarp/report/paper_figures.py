"""Draw the paper's figures from the pictures and numbers in run folders."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from forewarp.metrics.gain import Estimate
from forewarp.report import curve
from forewarp.report.collect import Result
from forewarp.report.paper_tables import row_of
from forewarp.report.sheets import draw_beside, figure_of, read_picture, sheets_of, show, thirds

RESOLUTION = re.compile(r"resolution |voxels_\d")  # variants of sweeps=resolution, now and before 0.3


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


def draw_canonical(path: Path, rivals: Mapping[str, Result]) -> Path | None:
    """Draw the view nearest to the canonical time: truth, then each method's rendering and error.

    Return None if the runs, by their methods, share no view with a sheet.
    """
    first = next(iter(rivals.values()))
    at = first.metrics["protocol"].get("canonical_time", 0.5 if first.dataset == "hypernerf" else 0.0)
    folders = {name: run.folder for name, run in rivals.items()}
    return draw_beside(path, folders, at, f"{first.scene}, near the canonical time")


def draw_sheet(path: Path, results: Sequence[Result], columns: int = 3) -> Path | None:
    """Draw a row for each scene: truth, result and error of a view; None if no run has a sheet."""
    found = {run.scene: sheets_of(run.folder) for run in sorted(results, key=lambda run: run.scene)}
    found = {scene: sheets for scene, sheets in found.items() if sheets}
    if not found:
        return None
    figure, axes = figure_of(len(found), columns, (3 * columns, 3.2 * len(found)))
    for row, (scene, sheets) in zip(axes, found.items()):
        name = sorted(sheets)[len(sheets) // 2]
        parts = thirds(read_picture(sheets[name]))
        show(row, dict(zip((f"{scene}, {name}", "rendered", "error"), parts)))
    return curve._save(figure, path)
