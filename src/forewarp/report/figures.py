"""Draw runs with matplotlib: curves over seconds of training, and test views side by side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image

from forewarp.files import written_whole
from forewarp.media import read_rgb
from forewarp.report.results import Point, Row, Runs, in_words, pairs, read_points
from forewarp.report.settings import CONDITIONS, SAME

NO_PLOTS = "expected matplotlib for plots; install forewarp[plots]"
GAP = 4  # pixels between the parts of a sheet
COLORS = ("#1b6ca8", "#d1495b", "#2e8b57", "#d98200", "#6a4c93", "#333333")
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1)))
LEADER = {"arrowstyle": "-", "linewidth": 0.6, "alpha": 0.6, "relpos": (0, 0.5), "shrinkA": 2, "shrinkB": 1}
DOTS, TITLE, WIDEST, MARGIN = 120, 26, 1500, 24  # pixels: an inch, a title, the picture, around the subject
ACROSS = 7  # most test views beside each other
DETAIL = 0.3  # of a picture's shorter side: the width of what is enlarged
STEPS = {
    "batch_norm": "norm",
    "conv3d": "convolution",
    "linear": "convolution",
    "relu": "ReLU",
    "cat": "concatenation",
}
STEPS |= {"max_pool3d": "max pooling", "interpolate": "interpolation"}  # of networks, in words


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


def sheets_of(folder: Path, kind: str = "sheets") -> dict[str, Path]:
    """Return the sheets truth | rendering | error of a run, or its ``depth``: name of the view -> file."""
    sheets = Path(folder) / "images" / kind
    return {path.relative_to(sheets).with_suffix("").as_posix(): path for path in sheets.rglob("[!.]*.png")}


def thirds(sheet):
    """Split a sheet (H, 3 W + 2 GAP, C) into its three pictures (H, W, C)."""
    width = (sheet.shape[1] - 2 * GAP) // 3
    return [sheet[:, i * (width + GAP) : i * (width + GAP) + width] for i in range(3)]


def _parts(row: Row, view: str, kind: str = "sheets") -> list[np.ndarray]:
    """Read truth, rendering and error of a view of a run, or of its ``depth``."""
    return thirds(read_rgb(sheets_of(row["folder"], kind)[view]) / 255)


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


def draw_details(
    path: Path, runs: Mapping[str, Row], near: float = 0.5, *, depth: bool = False
) -> Path | None:
    """Draw a test view by all runs, cut to the subject, and enlarged below it what is in its box,
    chosen by ``telling``; at last the view's PSNR.

    Args:
        path: file of the picture.
        runs: label -> row of the run; runs without sheets are left out.
        near: time near which the view is chosen, as by ``view_near``.
        depth: show the depth, too, where all runs have it.

    Return None if the runs share no view with a sheet.
    """
    runs = {name: row for name, row in runs.items() if sheets_of(row["folder"])}
    if (view := view_near(runs, near)) is None:
        return None
    parts = {name: _parts(row, view) for name, row in runs.items()}
    depth = depth and all(view in sheets_of(row["folder"], "depth") for row in runs.values())
    depths = {name: _parts(row, view, "depth") for name, row in runs.items()} if depth else {}
    first, (truth, *_) = next(iter(parts.items()))
    cut = subject(truth)
    shown = {"truth": truth, **{name: drawn for name, (_, drawn, _) in parts.items()}}
    shown = {name: picture[cut] for name, picture in shown.items()}
    by_depth = {"truth": depths[first][0]} | {n: of[1] for n, of in depths.items()} if depth else {}
    height, width = shown["truth"].shape[:2]
    size = max(2, round(DETAIL * 0.7 * min(height, width))), max(2, round(DETAIL * min(height, width)))
    errors = [abs(picture - shown["truth"]).mean(-1) for name, picture in shown.items() if name != "truth"]
    window = telling(np.stack(errors), size)
    boxed = framed(shown["truth"], window)
    tiles = {}
    for name, picture in shown.items():
        tile = [boxed if name == "truth" else picture, enlarged(picture[window], width)]
        tile += [by_depth[name][cut]] if depth else []
        white = np.ones((GAP, width, 3))
        tiles[name] = np.concatenate([row for part in tile for row in (white, part)][1:])
    times = {image["name"]: image["time"] for image in runs[first]["images"]}
    below = {"truth": view + (f"\ntime {times[view]:.2f}" if view in times else "")}
    for name, row in runs.items():
        psnr = [image["scores"]["psnr"] for image in row["images"] if image["name"] == view]
        below[name] = f"{psnr[0]:.2f} dB" if psnr else ""
    across = min(len(tiles), ACROSS)
    down, wide = -(-len(tiles) // across), WIDEST / across / DOTS
    high = wide * next(iter(tiles.values())).shape[0] / width + 3 * TITLE / DOTS
    figure, axes = figure_of(down, across, (across * wide, down * high))
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0, hspace=0)
    for axis in axes.flat[len(tiles) :]:
        axis.set_axis_off()
    for axis, (name, tile) in zip(axes.flat, tiles.items()):
        axis.imshow(tile, interpolation="antialiased")
        axis.set_title(name, fontsize="medium")
        axis.set_xlabel(below[name], fontsize="medium", labelpad=3)
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    return save(figure, path, colors=256)


def telling(errors: np.ndarray, size: tuple[int, int]) -> tuple[slice, slice]:
    """Choose the window where runs differ most: whose sum of the standard deviation, over the runs, of their
    errors is largest; of one run, or equal ones, where the error is.

    Args:
        errors: (runs, H, W).
        size: rows and columns of the window.

    Returns:
        its rows and its columns.
    """
    spread = errors.std(0)
    spread = spread if spread.max() > 1e-6 else errors.mean(0)
    rows, columns = (min(side, most) for side, most in zip(size, spread.shape))
    sums = np.pad(spread, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    of_window = (
        sums[rows:, columns:] - sums[:-rows, columns:] - sums[rows:, :-columns] + sums[:-rows, :-columns]
    )
    row, column = np.unravel_index(of_window.argmax(), of_window.shape)
    return slice(int(row), int(row) + rows), slice(int(column), int(column) + columns)


def framed(picture: np.ndarray, window: tuple[slice, slice], wide: int = 2) -> np.ndarray:
    """Draw a red line ``wide`` pixels wide along the inside of a window of a picture (H, W, 3)."""
    boxed, inner = picture.copy(), tuple(slice(side.start + wide, side.stop - wide) for side in window)
    boxed[window] = (0.82, 0.1, 0.15)
    boxed[inner] = picture[inner]
    return boxed


def enlarged(picture: np.ndarray, width: int) -> np.ndarray:
    """Repeat the pixels of a picture (H, W, 3) so that it becomes ``width`` wide."""
    old_height, old_width = picture.shape[:2]
    height = round(old_height * width / old_width)
    return picture[np.arange(height) * old_height // height][:, np.arange(width) * old_width // width]


def draw_network(path: Path, steps: Sequence[Mapping]) -> Path:
    """Draw a network from the list of its steps that a run's ``networks.json`` has (see ``fields.outline``).

    A box is a volume, the lower the smaller, and as wide as it has channels (the number above). An arrow is
    one or several steps, a dashed one a skip connection. N voxels along a side are given.

    Args:
        path: file of the picture.
        steps: in their order.
    """
    from matplotlib.patches import Rectangle

    groups = grouped_steps(steps)
    volumes = [steps[group[-1]]["shape"] for group in groups]
    levels = [round(np.log2(volumes[0][1] / side)) for _, side, *_ in volumes]
    deep, top, most = max(levels), min(levels), max(channels for channels, *_ in volumes)
    of_step = {number: place for place, group in enumerate(groups) for number in group}
    names = [arrow_name(steps, group) for group in groups]
    styles = dict(zip(dict.fromkeys(names[1:]), COLORS * len(names)))
    lefts, rights = [], []
    for place, (channels, *_) in enumerate(volumes):
        changed = place and levels[place] != levels[place - 1]
        lefts.append(rights[-1] + (0.55 if changed else 0.75) if place else 0.0)
        rights.append(lefts[-1] + 0.1 + 0.5 * channels / most)
    figure, ((axis,),) = figure_of(1, 1, (12.5, 1.1 + deep - top + 1))
    for place, (channels, *_) in enumerate(volumes):
        left, right, middle = lefts[place], rights[place], -levels[place]
        about = {"facecolor": "#dbe7f1", "edgecolor": COLORS[0], "linewidth": 1}
        axis.add_patch(Rectangle((left, middle - 0.3), right - left, 0.6, **about))
        axis.text((left + right) / 2, middle + 0.34, channels, ha="center", va="bottom", fontsize=8)
        for source in (of_step[number] for number in steps[groups[place][0]]["from"]):
            color, shift, line = styles[names[place]], 0.0, {"linewidth": 1.4}
            if source < place - 1:
                color, shift, line = "0.55", 0.2, {"linewidth": 1, "linestyle": "--"}
            elif levels[place] != levels[source]:
                shift = 0.15 if levels[place] > levels[source] else -0.15
            down = shift if source == place - 1 else -shift  # a skip stays at its height
            begin, end = (rights[source], -levels[source] - down), (left, middle + shift)
            about = {"arrowstyle": "-|>", "color": color, "shrinkA": 0}
            axis.annotate("", end, begin, arrowprops=about | line)
    for level in range(top, deep + 1):
        axis.text(-0.35, -level, _sides(level), ha="right", va="center", fontsize=9)
    for name, color in styles.items():
        axis.plot([], [], color=color, linewidth=2, label=name)
    if any(len(step["from"]) > 1 for step in steps):
        axis.plot([], [], color="0.55", linestyle="--", label="skip connection")
    axis.set(xlim=(-1.1, rights[-1] + 0.4), ylim=(-deep - 0.4, -top + 0.6))
    axis.set_axis_off()
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return save(figure, path, colors=64)


def _sides(level: int) -> str:
    return "N³" if level == 0 else f"(N/{2**level})³" if level > 0 else f"({2**-level}N)³"


def grouped_steps(steps: Sequence[Mapping]) -> list[list[int]]:
    """Gather steps that one arrow stands for: a norm, the layer behind it and its activation.

    >>> of = "input batch_norm conv3d relu interpolate".split()
    >>> grouped_steps([{"does": does, "from": [i - 1]} for i, does in enumerate(of)])
    [[0], [1, 2, 3], [4]]
    """
    groups: list[list[int]] = []
    for number, step in enumerate(steps):
        before = groups[-1] if groups and step["from"] == [number - 1] else None
        last = steps[number - 1]["does"] if number else ""
        if before is not None and (last == "batch_norm" or step["does"] == "relu"):
            before.append(number)
        else:
            groups.append([number])
    return groups


def arrow_name(steps: Sequence[Mapping], group: Sequence[int]) -> str:
    """Name the steps of an arrow.

    >>> arrow_name([{"does": "batch_norm"}, {"does": "conv3d", "kernel": [3, 3, 3]}], [0, 1])
    'norm, convolution 3×3×3'
    """
    words = []
    for number in group:
        step = steps[number]
        kernel = "×".join(map(str, step.get("kernel", ())))
        words.append(f"{STEPS.get(step['does'], step['does'])} {kernel}".strip())
    return ", ".join(words)


BUDGETS = {"minutes": "min", "iterations": "steps"}


def by_side(rows: Iterable[Row]) -> dict[str, dict[int, Runs]]:
    """Gather runs of ``sweeps=resolution``: scene, method and budget -> voxels along a side -> runs, where
    there are two sizes.
    """
    runs, lines = Runs(), {}
    for row in (row for row in rows if row["psnr"] is not None):
        voxels = row["config"]["stage"]["fine"]["num_voxels"][-1][1]
        other = " ".join(word for key, word in row["words"].items() if not key.endswith("num_voxels"))
        runs.append(row | {"side": round(voxels ** (1 / 3)), "setting": other})
    shared = [name for name in (*SAME, "setting") if name != "ablation"]  # which may name the size
    groups = [group for group in runs.by(*shared).values() if len(group.by("side")) > 1]
    for group in groups:
        row, others = group[0], [other[0] for other in groups]
        alike = [other for other in others if all(other[n] == row[n] for n in ("scene", "method", "preset"))]
        about = [row[name] for name in ("scene", "method", "preset", "setting") if row[name]]
        about += [f"{row[name]:g} {unit}" for name, unit in BUDGETS.items() if row[name]]
        about += in_words(row, alike, ["dataset", *(n for n in CONDITIONS if n != "iterations")])
        lines[", ".join(about)] = group.by("side")
    return lines


def draw_resolution(path: Path, lines: Mapping[str, Mapping[int, Runs]]) -> Path | None:
    """Draw PSNR against voxels along a side, a line for each label of ``by_side``; None if there is none."""
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
