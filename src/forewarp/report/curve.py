"""Draw accuracy against training time; find when a PSNR is reached, and the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from forewarp.files import MOST_CONFIG, read_text, written_whole
from forewarp.report.collect import Point, Result, read_curve

OTHERS = Path(__file__).with_name("published.yaml")  # results of others
NO_PLOTS = "expected matplotlib for plots; install forewarp[plots]"
_KEYS = ("name", "seconds", "psnr", "hardware", "source", "dataset")


def seconds_to(curve: Sequence[Point], psnr: float) -> float | None:
    """Return the seconds until two evaluations in a row first reach a PSNR (dB); None if none do.

    >>> curve = [Point(s, p, 0) for s, p in [(1, 20), (2, 25), (4, 24), (8, 26), (16, 27)]]
    >>> seconds_to(curve, 25), seconds_to(curve, 27)
    (8, None)
    """
    for point, following in zip(curve, curve[1:]):
        if point.psnr >= psnr and following.psnr >= psnr:
            return point.seconds
    return None


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


@dataclass(frozen=True)
class Published:
    """A result of others: PSNR (dB) on a dataset after ``seconds`` on some hardware."""

    name: str
    seconds: float
    psnr: float
    hardware: str
    source: str
    dataset: str


def read_published(path: Path) -> list[Published]:
    """Read a YAML list of entries with the keys name, seconds, psnr, hardware, source, dataset.

    Raises:
        ValueError: if the file is no YAML, or an entry has other keys.
    """
    try:
        entries = yaml.safe_load(read_text(Path(path), MOST_CONFIG))
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: expected YAML, but got {str(error).splitlines()[0]}") from None
    for number, entry in enumerate(entries if isinstance(entries, list) else [None]):
        if not isinstance(entry, dict) or set(entry) != set(_KEYS):
            got = sorted(entry) if isinstance(entry, dict) else type(entry).__name__
            raise ValueError(f"{path}: [{number}]: expected the keys {', '.join(_KEYS)}, but got {got}")
    return [Published(**entry) for entry in entries]


def draw_own(folder: Path) -> None:
    """Draw a run's curve into ``accuracy_time.png``, if there is a curve and matplotlib is installed."""
    if points := read_curve(folder):
        try:
            print(f"curve    {draw_run(folder / 'accuracy_time.png', points, folder.name)}")
        except ImportError as error:
            print(f"without accuracy_time.png: {error}")


def draw_run(path: Path, curve: Sequence[Point], title: str) -> Path:
    """Draw a run's PSNR, and the flow error if known, against seconds."""
    figure, axes = _axes(any(point.epe is not None for point in curve))
    _line(axes, curve, color="C0", linewidth=2)
    axes[0].set_title(title)
    return _save(figure, path)


def draw_scene(
    path: Path,
    groups: Mapping[tuple[str, float | None], Sequence[Result]],
    title: str,
    published: Sequence[Published] = (),
) -> Path:
    """Draw all runs of a scene; color and name the groups on the Pareto front, and mark the front.

    Args:
        path: file of the picture.
        groups: runs as grouped by ``collect.grouped``; a line for each run, a color for each group.
        title: title above the picture.
        published: results of others, drawn as stars with their hardware; they may be of other scenes.
    """
    runs = [(key, run) for key, group in groups.items() for run in group]
    every = [(key, point) for key, run in runs for point in run.curve]
    front = [every[i] for i in pareto_front([(point.seconds, point.psnr) for _, point in every])]
    known = enumerate(dict.fromkeys(key for key, _ in front))
    styles = {key: {"color": f"C{i % 10}", "linestyle": "--" if i >= 10 else "-"} for i, key in known}
    seconds = [point.seconds for _, point in every] + [other.seconds for other in published]
    wide = max(seconds) > 1000 * min(seconds)
    figure, axes = _axes(any(point.epe is not None for _, point in every), wide)
    for key, run in runs:
        _line(axes, run.curve, **styles.get(key, {"color": "0.8", "zorder": 1}))
    for key, style in styles.items():
        axes[0].plot([], [], label=f"{key[0]}, {key[1]:g} min" if key[1] else key[0], **style)
    marks = [point.seconds for _, point in front], [point.psnr for _, point in front]
    axes[0].plot(*marks, "ko", markersize=4, label="Pareto front")
    for number, other in enumerate(published):
        label = f"{other.name} (published, {other.hardware})"
        axes[0].plot(other.seconds, other.psnr, "*", color=f"C{number % 10}", fillstyle="none", label=label)
    axes[0].legend(fontsize="x-small", loc="lower right")
    axes[0].set_title(title)
    return _save(figure, path)


def _axes(with_flow: bool, wide: bool = False):
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError(NO_PLOTS) from None
    # Without pyplot, which keeps global state and looks for a display.
    figure = Figure(figsize=(7, 7.5 if with_flow else 4.5), layout="constrained")
    axes = figure.subplots(2 if with_flow else 1, 1, squeeze=False)[:, 0]
    labels = ("PSNR of views not trained on (dB)", "error of moving points (world units)")
    for axis, label in zip(axes, labels):
        over_seconds(axis, label, wide)
    return figure, axes


def over_seconds(axis, label: str, wide: bool = False) -> None:
    """Let an axis show ``label`` over seconds of training; ``wide``: over many decades."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set(xscale="log", xlabel="seconds of training", ylabel=label)
    # An axis of many decades has room for one tick per decade.
    axis.xaxis.set_major_locator(LogLocator(subs=(1,) if wide else (1, 2, 5)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3)


def _line(axes, curve: Sequence[Point], **style) -> None:
    axes[0].plot([p.seconds for p in curve], [p.psnr for p in curve], **style)
    known = [p for p in curve if p.epe is not None]
    if known and len(axes) > 1:
        axes[1].plot([p.seconds for p in known], [p.epe for p in known], **style)


def _save(figure, path: Path, colors: int | None = None) -> Path:
    """Save a figure as PNG; with ``colors`` of so few colours, which takes a third of the bytes."""
    with written_whole(path) as beside:
        figure.savefig(beside, format="png", dpi=120)
        if colors is not None:
            from PIL import Image

            with Image.open(beside) as drawn:
                fewer = drawn.convert("RGB").quantize(colors)
            fewer.save(beside, format="png", optimize=True)
    return path
