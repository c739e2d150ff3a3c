"""Draw the paper's figures of motion and canonical shape from the ``motion.npz`` of run folders."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from forewarp.files import MOST_ARRAYS, read_bytes, replace_file, unpack_arrays
from forewarp.metrics.variation import variation
from forewarp.report.figures import COLORS, figure_of, save
from forewarp.report.results import Row, Runs, in_words
from forewarp.report.settings import CONDITIONS, SAME
from forewarp.report.statistics import Estimate
from forewarp.report.tables import Column, Section, Table

FILE = "motion.npz"
TRUTH = "true motion"
WARPS = ("forward", "backward")  # whose flow the first figure draws
SHAPES = ("forward", "dnerf", "ndvg", "tineuvox_s", "tineuvox_b", "backward", "particles")
FOLLOWING = ("forward", "particles", "backward")
ROW = (*SAME, "setting")  # what the runs of a row have in common
DIRECTIONS = {"backward": "backward flow at the place", "forward": "forward flow of the point"}
STYLES = {TRUTH: ("black", "-", "o"), "forward": (COLORS[0], "--", "s"), "backward": (COLORS[3], ":", "^")}
MARKS = ("place", "o", 11, "#d01c8b"), ("point", "D", 8, "#0b5394")  # name, marker, size, colour
_COVERED = 0.8  # of the times of the truth, that a curve needs to be compared
_PALE = np.array([0.86, 0.93, 1.0])  # what a canonical picture fades to, behind trajectories
_FADED = 0.4


def arrays_of(row: Row) -> dict[str, np.ndarray]:
    """Read the arrays that evaluation stored in a run's folder; of an earlier version there are none.

    Raises:
        ValueError: naming the file, where it is no archive of arrays.
    """
    path = Path(row["folder"]) / FILE
    if not path.is_file():
        return {}
    try:
        return unpack_arrays(read_bytes(path, MOST_ARRAYS))
    except Exception as error:  # ValueError, BadZipFile, zlib.error and more
        words = shlex.quote(f"run={row['folder']}")
        again = f"write it anew with forewarp-evaluate {words}"
        raise ValueError(f"{path}: expected NumPy's arrays, but got {error}; {again}") from error


def common_times(truth: np.ndarray, curves: Iterable[np.ndarray]) -> np.ndarray:
    """Return at which times (T,) bool the truth and all curves (T,) are known.

    A curve that is known at less than 80 % of the truth's times is not waited for.
    """
    known = np.isfinite(truth)
    for curve in curves:
        both = np.isfinite(truth) & np.isfinite(curve)
        if both.sum() >= _COVERED * np.isfinite(truth).sum():
            known = known & both
    return known


def variation_at(curve: np.ndarray | None, known: np.ndarray) -> float | None:
    """Return the variation of a curve (T,) at the ``known`` times; None if it lacks some of them."""
    if curve is None or not np.isfinite(curve[known]).all():
        return None
    return variation(curve[known])


class Flows:
    """The flows of a scene's runs, all at the same place and times.

    Args:
        runs: of one scene; those without flow, or at another place than the first, are left out.
    """

    def __init__(self, runs: Iterable[Row]) -> None:
        stored = [(row, arrays) for row in runs if "true_backward" in (arrays := arrays_of(row))]
        first = stored[0][1] if stored else {}
        same = [(r, a) for r, a in stored if all(np.array_equal(a[n], first[n]) for n in ("times", "place"))]
        self.runs = same
        self.truth = {name: first[f"true_{name}"] for name in DIRECTIONS} if stored else {}
        curves = [arrays["backward"] for _, arrays in same if "backward" in arrays]
        self.known = common_times(self.truth["backward"], curves) if stored else np.zeros(0, bool)

    def true_variation(self) -> float:
        """Return the variation of the true backward flow at the common times; 0 without one."""
        return variation_at(self.truth["backward"], self.known) or 0.0 if self.runs else 0.0

    def lines(self, scene: str) -> list[list]:
        """Return the rows of the table: the truth, then each method over its runs."""
        if not self.runs:
            return []
        stored = [row["metrics"].get("flow_variation") for row, _ in self.runs]
        medians = [next(filter(None, stored), {}).get(f"true_{name}") for name in DIRECTIONS]
        at = [variation_at(self.truth[name], self.known) for name in DIRECTIONS]
        lines = [[scene, TRUTH, *at, *medians, int(self.known.sum()), None, None]]
        arrays = {id(row): of for row, of in self.runs}
        runs = Runs(row for row, _ in self.runs)
        for group in sorted(runs.by(*ROW).values(), key=_place):
            of_group = [[variation_at(arrays[id(r)].get(n), self.known) for r in group] for n in DIRECTIONS]
            stored = [row["metrics"].get("flow_variation", {}) for row in group]
            of_group += [[of.get(name) for of in stored] for name in DIRECTIONS]
            if all(value is None for values in of_group for value in values):
                continue
            seeds = len({row["seed"] for row in group})
            about = [scene, _name(group, runs)]
            lines.append([*about, *map(Estimate.of, of_group), int(self.known.sum()), seeds])
            lines[-1].append(group.estimate("train"))
        return lines


def _name(group: Runs, runs: Runs) -> str:
    """Name the method of runs, and what tells them apart from the others of it among all."""
    others = runs.where(method=group[0]["method"])
    words = in_words(group[0], others, ("preset", "minutes", *CONDITIONS))
    return ", ".join(filter(None, (group[0]["method"], group[0]["setting"], *words)))


def _place(runs: Runs) -> int:
    """Order rows as the figures do, other methods last."""
    return SHAPES.index(runs[0]["method"]) if runs[0]["method"] in SHAPES else len(SHAPES)


COLUMNS = ("scene", "curves of", *(f"{words}: variation" for words in DIRECTIONS.values()))
COLUMNS += ("median of all places", "median of all points")
COLUMNS += (Column("common times", 0), Column("seeds", 0), Column("training, s a run", 0))


def sections_of(runs: Runs, out: Path) -> tuple[list[Section], list[Path]]:
    """Draw flow, trajectories and canonical shapes of plain runs, as far as their folders hold them.

    Args:
        runs: of any scenes and methods.
        out: folder of the pictures and of ``paper-flow.csv``.

    Returns:
        sections of a page, and the files written.

    Raises:
        ImportError: without matplotlib.
        ValueError: for a ``motion.npz`` that cannot be read.
    """
    by_scene = runs.where(ablation=None).by("scene")
    sections, files = [], []
    flows = {scene: Flows(of_scene) for scene, of_scene in by_scene.items()}
    if lines := [line for scene, of_scene in flows.items() for line in of_scene.lines(scene)]:
        scene = max(flows, key=lambda name: (_has(flows[name], WARPS), flows[name].true_variation()))
        picture = draw_flow(out / f"paper-flow-{scene}.png", flows[scene], scene)
        table = Table(
            COLUMNS,
            lines,
            caption="Total variation over the common times, divided by the range: 1 is monotone.",
        )
        replace_file(out / "paper-flow.csv", table.csv())
        sections.append(
            Section("Forward and backward flow", [table], FACTS, pictures=[picture], caption=OF_FLOW)
        )
        files += [picture, out / "paper-flow.csv"]
    for scene, of_scene in by_scene.items():
        picture = out / f"paper-trajectories-{scene}.png"
        if draw_trajectories(picture, best_compared(of_scene), scene) is not None:
            sections.append(Section(f"Trajectories: {scene}", pictures=[picture], caption=OF_PATHS))
            files.append(picture)
    pictures = [out / f"paper-canonical-{scene}.png" for scene in by_scene]
    drawn = [draw_canonical(p, best_compared(runs), s) for p, (s, runs) in zip(pictures, by_scene.items())]
    shapes = shape_table(by_scene)
    if shapes.rows:
        replace_file(out / "paper-canonical.csv", shapes.csv())
        files.append(out / "paper-canonical.csv")
    if pictures := [path for path in drawn if path is not None]:
        tables = [shapes] if shapes.rows else []
        sections.append(Section("Canonical shape", tables, pictures=pictures, caption=OF_SHAPE))
        files += pictures
    return sections, files


def shape_table(by_scene: Mapping[str, Runs]) -> Table:
    """List how far the canonical shape of each method is from the true one, where that is known."""
    lines, names = [], ("chamfer", "accuracy", "completeness")
    for scene, runs in by_scene.items():
        known = Runs(row for row in runs if "canonical_shape" in row["metrics"])
        for group in sorted(known.by(*ROW).values(), key=_place):
            errors = [[row["metrics"]["canonical_shape"][name] for row in group] for name in names]
            seeds = len({row["seed"] for row in group})
            lines.append(
                [scene, _name(group, known), *map(Estimate.of, errors), seeds, group.estimate("train")]
            )
    columns = ["scene", "method", *(Column(name, 4) for name in names)]
    caption = (
        "Chamfer distance to the true shape at the canonical time, in world units: the mean of both ways."
    )
    return Table([*columns, Column("seeds", 0), Column("training, s a run", 0)], lines, caption)


OF_FLOW = "Backward flow at a place and forward flow of a point: lengths, and total variation over range."
OF_PATHS = "Points of the moving surface over the canonical image; dots mark the canonical time."
OF_SHAPE = "The canonical time from the same cameras, in colour and depth."
FACTS = (
    "The backward flow at a place leads from it to where what covers it was at the canonical time; the "
    "forward flow of a point leads from its canonical place to where it is. Drawn are their lengths.",
    "The place is one of a lattice around what moves. Followed points of the true surfaces cover it at 80 % "
    "of the times or more, and of such places the true backward flow jumps most there. The point covers it "
    "at some time. The medians are of all such places, and of points that move.",
    "The backward flow of backward, dnerf and ndvg is what their network says; that of the others is the way "
    "back of the matter that they carry to the place. All curves are compared at the same times.",
)


def _has(flows: Flows, methods: Sequence[str]) -> bool:
    return set(methods) <= {row["method"] for row, _ in flows.runs}


def best_compared(runs: Runs) -> dict[str, Row]:
    """Choose one run of each method, all of one seed and budget: where most methods have a run."""
    groups = runs.by("seed", *(name for name in ROW if name != "method")).values()
    methods = [{row["method"]: row for row in reversed(group)} for group in groups]  # the first run stays
    return max(methods, key=len, default={})


def draw_flow(path: Path, flows: Flows, scene: str) -> Path:
    """Draw a scene at a few times, and below it the lengths of backward and forward flow over time.

    Args:
        path: file of the picture.
        flows: of the scene's runs; one of each of ``WARPS`` is drawn.
        scene: for the title.
    """
    shown = best_compared(Runs(row for row, _ in flows.runs if row["method"] in WARPS))
    stored = {id(row): of for row, of in flows.runs}
    arrays = {name: stored[id(shown[name])] for name in WARPS if name in shown}
    pictured = next((arrays[name] for name in WARPS if "shots" in arrays.get(name, {})), None)
    some = pictured or flows.runs[0][1]
    count = len(some["shots"])
    figure, axes = figure_of(2, 1, (8.4, 6.4), [1.05, 1])
    for axis in axes.flat:
        axis.set_axis_off()
    spec = axes[0, 0].get_subplotspec(), axes[1, 0].get_subplotspec()
    top, bottom = (one.subgridspec(1, n) for one, n in zip(spec, (count, 2)))
    of = next((name for name in WARPS if arrays.get(name) is pictured), flows.runs[0][0]["method"])
    cut = _around(some["marks"].reshape(-1, 2), some["shots"].shape[1:3])
    for i, (shot, time, marks) in enumerate(zip(some["shots"], some["shot_times"], some["marks"])):
        axis = figure.add_subplot(top[0, i])
        axis.imshow(shot, interpolation="bicubic", extent=(0, shot.shape[1], shot.shape[0], 0))
        axis.set(xlim=cut[0], ylim=cut[1])
        for (x, y), (label, marker, size, color) in zip(marks, MARKS):
            look = {"markersize": size, "markeredgecolor": color, "markeredgewidth": 2.2}
            axis.plot(x, y, marker, label=label, markerfacecolor="none", **look)
        axis.set_title(f"t = {time:.2f}" + (", canonical" if i == 0 else ""), fontsize="medium")
        axis.set_axis_off()
        if i == 0:
            axis.legend(fontsize="small", loc="lower left", framealpha=0.9)
    for i, (name, words) in enumerate(DIRECTIONS.items()):
        axis = figure.add_subplot(bottom[0, i])
        curves = {TRUTH: flows.truth[name], **{method: of.get(name) for method, of in arrays.items()}}
        for label, curve in curves.items():
            if curve is None:
                continue
            known, number = np.isfinite(curve), variation_at(curve, flows.known)
            look = dict(zip(("color", "linestyle", "marker"), STYLES[label])) | {
                "markersize": 3,
                "linewidth": 1.4,
            }
            look["label"] = label if number is None else f"{label}, {number:.2f}"
            axis.plot(some["times"][known], curve[known], **look)
        axis.set(xlabel="time", ylabel="length (world units)", title=words, xlim=(-0.02, 1.02))
        axis.set_ylim(bottom=0, top=1.32 * axis.get_ylim()[1])
        axis.grid(alpha=0.3)
        axis.legend(
            fontsize="small", title="total variation / range", title_fontsize="small", loc="upper left"
        )
    figure.suptitle(f"{scene}: pictures rendered by {of}")
    return save(figure, path)


def _around(pixels: np.ndarray, shape: Sequence[int], margin: float = 0.25) -> tuple[tuple, tuple]:
    """Return the limits of x and of y (downwards) of the square part of a picture around pixels (N, 2).

    Args:
        pixels: x and y.
        shape: height and width of the picture.
        margin: least distance of pixels from an edge, as a share of the picture's shorter side.
    """
    low, high = pixels.min(0), pixels.max(0)
    side = min(min(shape), float((high - low).max()) + 2 * margin * min(shape))
    begin = np.clip((low + high - side) / 2, 0, np.maximum(0, np.array(shape[::-1]) - side))
    return (begin[0], begin[0] + side), (begin[1] + side, begin[1])


def draw_trajectories(path: Path, runs: Mapping[str, Row], scene: str) -> Path | None:
    """Draw trajectories over the canonical picture: the true ones, and those of each method that has some.

    Return None if no method has.
    """
    from matplotlib.collections import LineCollection

    found = {name: arrays_of(runs[name]) for name in FOLLOWING if name in runs}
    found = {name: arrays for name, arrays in found.items() if "paths" in arrays}
    if not found:
        return None
    first = next(iter(found.values()))
    tiles = {}
    if "true_paths" in first:
        tiles["truth"] = first.get("true_rgb", first["canonical_rgb"])[0], first["true_paths"]
    tiles |= {name: (arrays["canonical_rgb"][0], arrays["paths"]) for name, arrays in found.items()}
    figure, axes = figure_of(1, len(tiles), (2.9 * len(tiles) + 0.8, 3.3))
    shape = first["canonical_rgb"].shape[1:3]
    limits = _around(np.concatenate([paths.reshape(-1, 2) for _, paths in tiles.values()]), shape, 0.04)
    for axis, (name, (picture, paths)) in zip(axes[0], tiles.items()):
        pale = _FADED * _PALE + (1 - _FADED) * picture / 255
        axis.imshow(pale, interpolation="bicubic", extent=(0, shape[1], shape[0], 0))
        for line in paths:
            pieces = np.stack([line[:-1], line[1:]], 1)
            lines = LineCollection(pieces, cmap="plasma", linewidths=1.4, capstyle="round")
            lines.set_array(np.linspace(0, 1, len(pieces)))
            axis.add_collection(lines)
        axis.plot(*paths[:, 0].T, "o", color="black", markersize=1.6)
        axis.set(xlim=limits[0], ylim=limits[1], title=name)
        axis.set_axis_off()
    figure.colorbar(lines, ax=axes[0, -1], label="time", shrink=0.85)
    figure.suptitle(f"{scene}: trajectories over the canonical picture")
    return save(figure, path)


def _solid(depths: Sequence[np.ndarray]) -> tuple[slice, slice]:
    """Return rows and columns of what is solid in any of some depths (H, W), 0 where clear; else all."""
    solid = np.max(depths, 0) > 0
    cut = []
    for axis, side in zip((1, 0), solid.shape):
        at = np.flatnonzero(solid.any(axis)) if solid.any() else [0, side]
        cut.append(slice(max(0, int(at[0]) - 2), min(int(at[-1]) + 3, side)))
    return tuple(cut)


def draw_canonical(path: Path, runs: Mapping[str, Row], scene: str) -> Path | None:
    """Draw the canonical time by each method, colours and depth, beside the truth if known.

    Return None if fewer than two methods have such pictures, or sizes differ.
    """
    found = {name: arrays_of(runs[name]) for name in SHAPES if name in runs}
    found = {name: arrays for name, arrays in found.items() if "canonical_rgb" in arrays}
    if len(found) < 2 or len({arrays["canonical_rgb"].shape for arrays in found.values()}) > 1:
        return None
    first = next(iter(found.values()))
    tiles = {}
    if "true_rgb" in first:
        tiles["truth"] = first["true_rgb"], first.get("true_depth")
    for name, arrays in found.items():
        error = runs[name]["metrics"].get("canonical_shape", {}).get("chamfer")
        title = name if error is None else f"{name}\nchamfer {error:.4f}"
        tiles[title] = arrays["canonical_rgb"], arrays["canonical_depth"]
    views = range(len(first["canonical_rgb"]))
    cuts = [_solid([arrays["canonical_depth"][view] for arrays in found.values()]) for view in views]
    heights = [cut[0].stop - cut[0].start for cut in cuts for _ in range(2)]
    width = max(cut[1].stop - cut[1].start for cut in cuts)
    size = (1.7 * len(tiles) + 0.9, 1.7 / width * sum(heights) + 0.9)
    figure, axes = figure_of(len(heights), len(tiles), size, heights)
    for view in views:
        depths = [depth[view][cuts[view]] for _, depth in tiles.values() if depth is not None]
        solid = np.concatenate([depth[depth > 0] for depth in depths[:1]])
        solid = solid if len(solid) else np.concatenate([[0.0, 1.0], *(d[d > 0] for d in depths)])
        near, far = np.quantile(solid, [0.01, 0.99])
        shown = {"cmap": "viridis_r", "vmin": near, "vmax": far, "interpolation": "nearest"}
        for column, (title, (rgb, depth)) in enumerate(tiles.items()):
            upper, lower = axes[2 * view, column], axes[2 * view + 1, column]
            upper.imshow(rgb[view][cuts[view]], interpolation="nearest")
            upper.set_title(title if view == 0 else "", fontsize="small")
            for axis in (upper, lower):
                axis.set_axis_off()
            if depth is not None:
                cut = depth[view][cuts[view]]
                picture = lower.imshow(np.where(cut > 0, cut, np.nan), **shown)
        figure.colorbar(picture, ax=axes[2 * view + 1, -1], label="depth", shrink=0.9)
    chamfers = "; chamfer distance in world units" if any("chamfer" in title for title in tiles) else ""
    figure.suptitle(f"{scene}: the canonical time{chamfers}", fontsize="medium")
    return save(figure, path)
