"""Draw runs with matplotlib: curves over seconds of training, and test views side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image

from forewarp.files import written_whole
from forewarp.report.results import Point, Row, Runs, pairs, read_points

NO_PLOTS = "expected matplotlib for plots; install forewarp[plots]"
GAP = 4  # pixels between the parts of a sheet
COLORS = ("#1b6ca8", "#d1495b", "#2e8b57", "#d98200", "#6a4c93", "#333333")
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1)))
LEADER = {"arrowstyle": "-", "linewidth": 0.6, "alpha": 0.6, "relpos": (0, 0.5), "shrinkA": 2, "shrinkB": 1}
DOTS, TITLE, WIDEST, MARGIN = 120, 26, 1500, 24  # pixels: an inch, a title, the picture, around the subject


def figure_of(rows: int, columns: int, size: tuple[float, float], heights: Sequence[float] | None = None):
    """Make a figure and its axes (rows, columns); ``size`` in inches, ``heights`` of rows in any unit.

    Raises:
        ImportError: if matplotlib is missing.
    """
    try:
        # Without pyplot, which keeps global state and looks for a display.
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError(NO_PLOTS) from None
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, height_ratios=heights)


def save(figure, path: Path, colors: int | None = None) -> Path:
    """Save a figure as PNG; with ``colors`` of so few colours, which takes a third of the bytes."""
    with written_whole(path) as beside:
        figure.savefig(beside, format="png", dpi=DOTS)
        if colors is not None:
            with Image.open(beside) as drawn:
                fewer = drawn.convert("RGB").quantize(colors)
            fewer.save(beside, format="png", optimize=True)
    return path


def over_seconds(axis, label: str, seconds: Sequence[float] = ()) -> None:
    """Let an axis show ``label`` over seconds of training; ``seconds``: all that will be drawn."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set(xscale="log", xlabel="seconds of training", ylabel=label)
    wide = max(seconds, default=1) > 1000 * min(seconds, default=1)  # has room for one tick per decade
    axis.xaxis.set_major_locator(LogLocator(subs=(1,) if wide else (1, 2, 5)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3)


def draw_own(folder: Path) -> None:
    """Draw a run's PSNR, and below it the flow error if known, against seconds into ``accuracy_time.png``, if
    there is a curve and matplotlib is installed.
    """
    if points := read_points(folder):
        try:
            figure, _ = _curves([(points, {"color": "C0", "linewidth": 2})], folder.name)
            print(f"curve    {save(figure, folder / 'accuracy_time.png')}")
        except ImportError as error:
            print(f"without accuracy_time.png: {error}")


def draw_scene(path: Path, groups: Mapping[tuple, Sequence[Row]], title: str, published: Sequence) -> Path:
    """Draw all runs of a scene; color and name the groups on the Pareto front, and mark the front.

    Args:
        path: file of the picture.
        groups: runs by variant and minutes; a line for each run, a color for each group.
        title: title above the picture.
        published: results of others, drawn as stars with their hardware; they may be of other scenes.
    """
    every = [(key, point) for key, group in groups.items() for row in group for point in row["points"]]
    front = [every[i] for i in pareto_front([(point.seconds, point.psnr) for _, point in every])]
    keys = list(dict.fromkeys(key for key, _ in front))
    dashes = "-", "--"
    styles = {key: {"color": f"C{i % 10}", "linestyle": dashes[i >= 10]} for i, key in enumerate(keys)}
    grey = {"color": "0.8", "zorder": 1}
    lines = [(row["points"], styles.get(key, grey)) for key, group in groups.items() for row in group]
    figure, axis = _curves(lines, title, [other.seconds for other in published])
    for (variant, minutes), style in styles.items():
        axis.plot([], [], label=f"{variant}, {minutes:g} min" if minutes else variant, **style)
    marks = [point.seconds for _, point in front], [point.psnr for _, point in front]
    axis.plot(*marks, "ko", markersize=4, label="Pareto front")
    _stars(axis, published, 0)
    return save(figure, path)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices, by time, of the (seconds, psnr) points that no other point beats in both.

    >>> pareto_front([(2, 20), (1, 21), (4, 25), (3, 25)])
    [1, 3]
    """
    front: list[int] = []
    for i in sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1])):
        if not front or points[i][1] > points[front[-1]][1]:
            front.append(i)
    return front


def _curves(lines: Sequence[tuple[Sequence[Point], dict]], title: str, seconds: Sequence[float] = ()):
    """Draw curves, each with its style: PSNR, and below it the flow error if it is known; return the figure
    and the axis of PSNR.
    """
    seconds = [*seconds, *(point.seconds for points, _ in lines for point in points)]
    with_flow = any(point.epe is not None for points, _ in lines for point in points)
    figure, axes = figure_of(1 + with_flow, 1, (7, 7.5 if with_flow else 4.5))
    labels = ("PSNR of views not trained on (dB)", "error of moving points (world units)")
    for axis, label in zip(axes[:, 0], labels):
        over_seconds(axis, label, seconds)
    for points, style in lines:
        axes[0, 0].plot([p.seconds for p in points], [p.psnr for p in points], **style)
        if with_flow and (known := [p for p in points if p.epe is not None]):
            axes[1, 0].plot([p.seconds for p in known], [p.epe for p in known], **style)
    axes[0, 0].set_title(title)
    return figure, axes[0, 0]


def _stars(axis, published: Sequence, first: int) -> None:
    """Draw results of others as stars, and the legend."""
    for i, other in enumerate(published, first):
        label = f"{other.name} (published, {other.hardware})"
        axis.plot(other.seconds, other.psnr, "*", color=f"C{i % 10}", fillstyle="none", label=label)
    axis.legend(fontsize="x-small", loc="lower right")


def draw_lengths(path: Path, points: Mapping, title: str, published: Sequence, colors: Mapping) -> Path:
    """Draw a point a run and a line a method over seconds of training; a method keeps its color.

    Args:
        path: file of the picture.
        points: method -> for each length of training (seconds, PSNR) of the runs.
        title: title above the picture.
        published: results of others, drawn as stars.
        colors: method -> color.
    """
    figure, ((axis,),) = figure_of(1, 1, (7, 4.5))
    seconds = [point[0] for groups in points.values() for group in groups for point in group]
    over_seconds(axis, "PSNR of test views (dB)", [*seconds, *(other.seconds for other in published)])
    for method, groups in points.items():
        means = [np.mean(group, 0) for group in groups]
        axis.plot(*zip(*means), color=colors[method], linewidth=2, label=method)
        runs = [point for group in groups for point in group]
        axis.plot(*zip(*runs), "o", color=colors[method], markersize=3.5)
    _stars(axis, published, len(colors))
    axis.set_title(title)
    return save(figure, path)


def draw_by_time(path: Path, scenes: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]]) -> Path:
    """Draw PSNR over the scene's time: scene -> label of a line -> (time, PSNR) of its views."""
    height = max(1, -(-len(scenes) // 3))
    figure, axes = figure_of(height, max(1, min(3, len(scenes))), (12, 3 * height))
    for axis in axes.flat[len(scenes) :]:
        axis.set_axis_off()
    for axis, (scene, lines) in zip(axes.flat, scenes.items()):
        for label, points in lines.items():
            axis.plot(*zip(*points), marker=".", label=label)
        axis.set(title=scene, xlabel="time", ylabel="PSNR (dB)")
        if lines:
            axis.legend(fontsize="small")
    return save(figure, path)


def draw_curves(path: Path, rows: Mapping[str, Row], title: str) -> Path | None:
    """Draw a line for each method, with its name and last PSNR (dB) at its end, the best on top.

    Args:
        path: file of the picture.
        rows: name -> row of a run.
        title: above the picture.

    Return None if no run has a curve.
    """
    names = sorted(rows)
    styles = dict(zip(names, [(color, dash) for dash, color in product(DASHES, COLORS)] * len(names)))
    curves = {name: pairs(rows[name]["curve"]) for name in names if rows[name]["curve"]}
    if not curves:
        return None
    figure, ((axis,),) = figure_of(1, 1, (8.5, 5.5))
    for name, points in curves.items():
        axis.plot(*zip(*points), color=styles[name][0], linestyle=styles[name][1], linewidth=1.8)
    over_seconds(axis, "PSNR of validation views (dB)")
    low, high = axis.get_ylim()
    places = spread_out([points[-1][1] for points in curves.values()], 0.042 * (high - low))
    for (name, points), place in zip(curves.items(), places):
        last, color = points[-1], styles[name][0]
        about = {"color": color, "verticalalignment": "center", "annotation_clip": False}
        about |= {"textcoords": axis.get_yaxis_transform(), "arrowprops": {"color": color} | LEADER}
        axis.annotate(f"{last[1]:.1f}  {name}", last, (1.03, place), **about)
    axis.set_title(title)
    return save(figure, path)


def spread_out(places: Sequence[float], gap: float) -> list[float]:
    """Move places apart until neighbours are about ``gap`` apart.

    >>> spread_out([1.0, 5.0, 1.0], 1.0)
    [0.5, 5.0, 1.5]
    """
    found, order = list(places), sorted(range(len(places)), key=lambda i: places[i])
    for _ in range(100 * len(places)):  # neighbours push each other away until none is too close
        for low, high in zip(order, order[1:]):
            push = max(0.0, gap - (found[high] - found[low])) / 2
            found[low], found[high] = found[low] - push, found[high] + push
    return found


def sheets_of(folder: Path) -> dict[str, Path]:
    """Return the sheets truth | rendering | error of a run: name of the view -> file."""
    sheets = Path(folder) / "images" / "sheets"
    return {path.relative_to(sheets).with_suffix("").as_posix(): path for path in sheets.rglob("[!.]*.png")}


def thirds(sheet):
    """Split a sheet (H, 3 W + 2 GAP, C) into its three pictures (H, W, C)."""
    width = (sheet.shape[1] - 2 * GAP) // 3
    return [sheet[:, i * (width + GAP) : i * (width + GAP) + width] for i in range(3)]


def _parts(row: Row, view: str) -> list[np.ndarray]:
    """Read truth, rendering and error of a view of a run."""
    with Image.open(sheets_of(row["folder"])[view]) as sheet:
        return thirds(np.asarray(sheet) / 255)


def _show(axes, pictures: Mapping[str, np.ndarray], size: str = "small") -> None:
    """Show pictures, one on each axis, with titles of a ``size``."""
    for axis, (title, picture) in zip(axes, pictures.items()):
        axis.imshow(picture)
        axis.set_title(title, fontsize=size)
        axis.set_axis_off()


def view_near(runs: Mapping[str, Row], near: float) -> str | None:
    """Choose, of the views that all runs have a sheet of, the nearest to a time; None if there is none."""
    sheets = [set(sheets_of(row["folder"])) for row in runs.values()]
    shared = sorted(set.intersection(*sheets)) if sheets else []
    times = {image["name"]: image["time"] for row in [*runs.values()][:1] for image in row["images"]}
    known = [name for name in shared if name in times] or shared
    return min(known, key=lambda name: abs(times.get(name, near) - near), default=None)


def draw_beside(path: Path, runs: Mapping[str, Row], near: float, about: str) -> Path | None:
    """Draw one test view: the truth, each run's rendering, and below each its error.

    Args:
        path: file of the picture.
        runs: name -> row of the run.
        near: of the views that all runs have a sheet of, the one nearest to this time is drawn.
        about: begins the title.

    Return None if the runs share no view with a sheet.
    """
    if (view := view_near(runs, near)) is None:
        return None
    parts = {name: _parts(row, view) for name, row in runs.items()}
    figure, axes = figure_of(2, 1 + len(parts), (3 * (1 + len(parts)), 6.6))
    truth = next(iter(parts.values()))[0]
    _show(axes[0], {"truth": truth} | {name: drawn for name, (_, drawn, _) in parts.items()})
    axes[1, 0].set_axis_off()
    _show(axes[1, 1:], {f"error, {name}": error for name, (_, _, error) in parts.items()})
    figure.suptitle(f"{about}, {view}; errors up to 0.25 (white)")
    return save(figure, path)


def draw_sheet(path: Path, runs: Mapping[str, Row]) -> Path | None:
    """Draw a row for each scene: truth, result and error of a view; None if no run has a sheet."""
    found = {scene: sheets for scene in sorted(runs) if (sheets := sheets_of(runs[scene]["folder"]))}
    if not found:
        return None
    figure, axes = figure_of(len(found), 3, (9, 3.2 * len(found)))
    for row, (scene, sheets) in zip(axes, found.items()):
        name = sorted(sheets)[len(sheets) // 2]
        _show(row, dict(zip((f"{scene}, {name}", "rendered", "error"), _parts(runs[scene], name))))
    return save(figure, path)


def draw_resolution(path: Path, rows: Sequence[Row]) -> Path | None:
    """Draw PSNR against voxels along a side for runs of ``sweeps=resolution``, one line per scene.

    Return None if no scene has two sizes.
    """
    runs, lines = Runs(), {}
    for row in (row for row in rows if row["psnr"] is not None):
        voxels = row["config"]["stage"]["fine"]["num_voxels"][-1][1]
        runs.append(row | {"side": round(voxels ** (1 / 3))})
    for key, group in runs.by("scene", "method", "preset", "setting", "minutes", "iterations").items():
        *names, minutes, iterations = filter(lambda part: part != "", key)
        label = ", ".join([*names, f"{minutes or iterations:g}"])
        lines |= {label: group.by("side")} if len(group.by("side")) > 1 else {}
    if not lines:
        return None
    figure, ((axis,),) = figure_of(1, 1, (7, 4.5))
    for label, sides in lines.items():
        found = [of_side.estimate("psnr") for of_side in sides.values()]
        bars = [e.error_bar for e in found]
        axis.errorbar([*sides], [e.mean for e in found], bars, marker="o", label=label)
    title = "Performance with different resolutions"
    axis.set(xlabel="voxels along a side", ylabel="PSNR (dB)", title=title)
    axis.grid(alpha=0.3)
    axis.legend()
    return save(figure, path)


def draw_views(path: Path, runs: Mapping[str, Row], times: Sequence[float] = (0.25, 0.75)) -> Path | None:
    """Draw the test views nearest to some times, cut to the subject: the truth, then each run in order.

    Args:
        path: file of the picture.
        runs: name -> row of the run; runs without sheets are left out.
        times: of the views; a view that is nearest to several is shown once.

    Return None if the runs share no view with a sheet.
    """
    runs = {name: row for name, row in runs.items() if sheets_of(row["folder"])}
    blocks = []
    for view in dict.fromkeys(filter(None, (view_near(runs, time) for time in times))):
        tiles = {}
        for name, row in runs.items():
            truth, drawn, _ = _parts(row, view)
            psnr = [image["scores"]["psnr"] for image in row["images"] if image["name"] == view]
            tiles = tiles or {f"truth, {view.rpartition('/')[2]}": truth}
            tiles[f"{name}, {psnr[0]:.1f}" if psnr else name] = drawn
        cut = subject(next(iter(tiles.values())))
        blocks.append({title: tile[cut] for title, tile in tiles.items()})
    if not blocks:
        return None
    shapes = [next(iter(block.values())).shape for block in blocks]
    wide = max(shape[1] for shape in shapes)
    across = min(1 + len(runs), max(1, WIDEST // wide))
    down = -(-(1 + len(runs)) // across)
    heights = [shape[0] + TITLE for shape in shapes for _ in range(down)]
    figure, axes = figure_of(len(heights), across, (across * wide / DOTS, sum(heights) / DOTS), heights)
    figure.get_layout_engine().set(w_pad=0.01, h_pad=0.01, wspace=0, hspace=0)
    for axis in axes.flat:
        axis.set_axis_off()
    for number, block in enumerate(blocks):
        _show(axes[number * down : (number + 1) * down].flat, block, size="medium")
    return save(figure, path, colors=256)


def subject(picture: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of what is not of the colour of the first pixel of a picture (H, W, C); else all."""
    shown = np.abs(picture - picture[:1, :1]).max(-1) > 0.1
    found = []
    for axis, side in zip((1, 0), shown.shape):
        at = np.flatnonzero(shown.any(axis)) if shown.any() else [0, side]
        found.append(slice(max(0, int(at[0]) - MARGIN), min(int(at[-1]) + 1 + MARGIN, side)))
    return tuple(found)
