"""Draw methods against each other: PSNR over seconds of training, and views side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from forewarp.report import curve
from forewarp.report.run_rows import pairs
from forewarp.report.sheets import figure_of, images_of, read_picture, sheets_of, show, thirds, view_near

COLORS = ("#1b6ca8", "#d1495b", "#2e8b57", "#d98200", "#6a4c93", "#333333")
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1)))
TIMES = (0.25, 0.75)  # near which a view is shown
LEADER = {"arrowstyle": "-", "linewidth": 0.6, "alpha": 0.6, "relpos": (0, 0.5), "shrinkA": 2, "shrinkB": 1}
DOTS = 120  # an inch
TITLE = 26  # pixels
WIDEST = 1500  # pixels of the picture of views
MARGIN = 24  # pixels around the subject


def draw_curves(path: Path, rows: Mapping[str, dict], title: str) -> Path | None:
    """Draw a line for each method, with its name and last PSNR (dB) at its end, the best on top.

    Args:
        path: file of the picture.
        rows: name -> row of a run (see ``run_rows.row_of``).
        title: above the picture.

    Return None if no run has a curve.
    """
    curves = {name: pairs(rows[name]["curve"]) for name in sorted(rows)}
    styles = dict(zip(curves, [(color, dash) for dash, color in product(DASHES, COLORS)] * len(curves)))
    curves = {name: points for name, points in curves.items() if points}
    if not curves:
        return None
    figure, axes = figure_of(1, 1, (8.5, 5.5))
    axis = axes[0, 0]
    for name, points in curves.items():
        color, dash = styles[name]
        axis.plot(*zip(*points), color=color, linestyle=dash, linewidth=1.8)
    curve.over_seconds(axis, "PSNR of validation views (dB)")
    ends = {name: points[-1] for name, points in curves.items()}
    low, high = axis.get_ylim()
    places = spread_out([psnr for _, psnr in ends.values()], 0.042 * (high - low))
    for (name, end), place in zip(ends.items(), places):
        axis.annotate(
            f"{end[1]:.1f}  {name}",
            end,
            (1.03, place),
            textcoords=axis.get_yaxis_transform(),
            color=styles[name][0],
            verticalalignment="center",
            annotation_clip=False,
            arrowprops={"color": styles[name][0]} | LEADER,
        )
    axis.set_title(title)
    return curve._save(figure, path)


def spread_out(places: Sequence[float], gap: float) -> list[float]:
    """Move places apart until neighbours are ``gap`` apart, as little as possible.

    >>> spread_out([1.0, 5.0, 1.0], 1.0)
    [0.5, 5.0, 1.5]
    """
    clusters: list[list[int]] = []  # indices, by place
    for index in sorted(range(len(places)), key=lambda i: places[i]):
        cluster = [index]
        while clusters and _span(clusters[-1], places, gap)[1] + gap > _span(cluster, places, gap)[0]:
            cluster = clusters.pop() + cluster
        clusters.append(cluster)
    found = list(places)
    for cluster in clusters:
        low, _ = _span(cluster, places, gap)
        for number, index in enumerate(cluster):
            found[index] = low + number * gap
    return found


def _span(cluster: Sequence[int], places: Sequence[float], gap: float) -> tuple[float, float]:
    """The first and the last place of names that stand ``gap`` apart around their mean."""
    middle, half = sum(places[i] for i in cluster) / len(cluster), gap * (len(cluster) - 1) / 2
    return middle - half, middle + half


def draw_views(path: Path, runs: Mapping[str, Path], times: Sequence[float] = TIMES) -> Path | None:
    """Draw the test views nearest to some times, cut to the subject: the truth, then each run in order.

    Args:
        path: file of the picture.
        runs: name -> folder of the run; runs without sheets are left out.
        times: of the views; a view that is nearest to several is shown once.

    Return None if the runs share no view with a sheet.
    """
    runs = {name: folder for name, folder in runs.items() if sheets_of(folder)}
    views = list(dict.fromkeys(filter(None, (view_near(runs, time) for time in times))))
    if not views:
        return None
    blocks = [_tiles(view, runs) for view in views]
    cuts = [subject(next(iter(block.values()))) for block in blocks]
    wide = max(columns.stop - columns.start for _, columns in cuts)
    across = min(len(blocks[0]), max(1, WIDEST // wide))
    down = -(-len(blocks[0]) // across)
    heights = [rows.stop - rows.start + TITLE for rows, _ in cuts for _ in range(down)]
    size = across * wide / DOTS, sum(heights) / DOTS
    figure, axes = figure_of(len(heights), across, size, heights)
    figure.get_layout_engine().set(w_pad=0.01, h_pad=0.01, wspace=0, hspace=0)
    for axis in axes.flat:
        axis.set_axis_off()
    for number, (block, cut) in enumerate(zip(blocks, cuts)):
        own = axes[number * down : (number + 1) * down].flat
        show(own, {title: picture[cut] for title, picture in block.items()}, size="medium")
    return curve._save(figure, path, colors=256)


def _tiles(view: str, runs: Mapping[str, Path]) -> dict[str, np.ndarray]:
    """The pictures of a view by their titles, the truth first."""
    tiles = {}
    for name, folder in runs.items():
        truth, drawn, _ = thirds(read_picture(sheets_of(folder)[view]))
        psnr = [one["scores"]["psnr"] for one in images_of(folder) if one["name"] == view]
        tiles = tiles or {f"truth, {view.rpartition('/')[2]}": truth}
        tiles[f"{name}, {psnr[0]:.1f}" if psnr else name] = drawn
    return tiles


def subject(picture: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of what is not of the colour of the first pixel of a picture (H, W, C); else all."""
    shown = np.abs(picture - picture[:1, :1]).max(-1) > 0.1
    if not shown.any():
        return slice(0, shown.shape[0]), slice(0, shown.shape[1])
    rows, columns = (np.flatnonzero(shown.any(axis)) for axis in (1, 0))
    cut = [slice(max(0, int(at[0]) - MARGIN), int(at[-1]) + 1 + MARGIN) for at in (rows, columns)]
    return tuple(slice(part.start, min(part.stop, side)) for part, side in zip(cut, shown.shape))
