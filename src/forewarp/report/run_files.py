"""Read all that one run's folder tells, for the page of a run."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from forewarp.files import read_json, read_rows
from forewarp.report.collect import UNREADABLE, Result, read_run, unreadable
from forewarp.report.effects import plan_of

_POINTS = 150  # of a stage's loss that are kept
WHYS = "best", "median", "worst", "earliest", "latest"  # views to look at, as they are shown
_KINDS = ("particles", "voxels")  # that a scene may consist of


@dataclass(frozen=True)
class View:
    """A measured test view; ``time`` in [0, 1], ``psnr`` in dB, ``scores`` all of its numbers."""

    name: str
    time: float
    ability: str
    psnr: float
    scores: dict[str, float]


@dataclass(frozen=True)
class Curves:
    """``loss`` by stage: (seconds of training over all stages, mean loss). ``size``: what the method consists
    of and how many of it there were at the end, such as ("particles", 2874); None if it is not known.
    """

    loss: dict[str, list[tuple[float, float]]]
    size: tuple[str, int] | None


@dataclass(frozen=True)
class Story:
    """A run as its folder tells it.

    Attributes:
        result: config, numbers and curve.
        views: the measured test views, by name.
        curves: of the losses.
        plan: content of ``plan.yaml``; empty if the run follows none.
        unfinished: the stages that are not finished.
    """

    result: Result
    views: tuple[View, ...]
    curves: Curves
    plan: dict
    unfinished: tuple[str, ...]


def read_story(folder: Path) -> Story:
    """Read a run's folder; parts whose files are missing are empty.

    Raises:
        ValueError: in one line, if the folder holds no run, several runs, or one that cannot be read.
    """
    refuse_other(folder)
    try:
        result = read_run(folder)
        planned = result.config.get("stage") or result.stages
        stages = [name for name, stage in planned.items() if stage is not None]
        rows = (read_json(folder / "per_image.json") or {}).get("images", [])
        views = tuple(sorted(_views(rows), key=lambda view: view.name))
        plan = plan_of(result)
        _ = [(d["choice"], d["on"], d["because"]) for d in (plan.get("effects") or {}).values()]
        curves = read_curves(result, stages)
    except UNREADABLE as error:
        raise ValueError(
            f"run: expected a run whose files can be read, but got {folder} ({unreadable(error)})"
        ) from error
    unfinished = tuple(name for name in stages if name not in result.stages)
    return Story(result, views, curves, plan, unfinished)


def refuse_other(folder: Path) -> None:
    """Refuse a folder that is not one run's.

    Raises:
        ValueError: in one line; names the runs below it, if there are some.
    """
    if (folder / "config.yaml").is_file():
        return
    runs = sorted(path.parent for depth in ("*", "*/*") for path in folder.glob(f"{depth}/config.yaml"))
    if runs:
        some = ", ".join(str(run) for run in runs[:3]) + (", ..." if len(runs) > 3 else "")
        raise ValueError(
            f"run: expected the folder of one run, but got {folder}, which holds {len(runs)}; choose one: "
            f"{some}"
        )
    raise ValueError(
        f"{folder / 'config.yaml'}: expected the configuration of a run, but got none; "
        "set run=<a run's folder>"
    )


def _views(rows: Sequence[dict]) -> Iterator[View]:
    """Give the views that have a PSNR; scores that are no finite number are left out."""
    for row in rows:
        known = {name: float(value) for name, value in row["scores"].items() if value is not None}
        scores = {name: value for name, value in known.items() if math.isfinite(value)}
        if "psnr" in scores and math.isfinite(time := float(row["time"])):
            yield View(str(row["name"]), time, str(row["ability"]), scores["psnr"], scores)


def read_curves(result: Result, stages: Sequence[str]) -> Curves:
    """Read each stage's loss from TensorBoard's events, against seconds of training."""
    losses, noted, before, rows = {}, {}, 0.0, read_rows(result.folder / "accuracy_time.csv")
    for stage in stages:
        scalars = _scalars(result.folder / stage / "tensorboard")
        known = _clock(result, stage, before, rows)
        if (loss := scalars.get("train/loss")) and len(known) > 1:
            losses[stage] = thinned([(_between(known, step), value) for step, value in loss], _POINTS)
        noted |= {tag.split("/")[1]: values[-1][1] for tag, values in scalars.items() if values}
        before += float(result.stages.get(stage, {}).get("seconds", 0))
    return Curves(losses, _size(noted, rows))


def _size(noted: Mapping[str, float], rows: Sequence[Mapping[str, str]]) -> tuple[str, int] | None:
    """Say how many particles or voxels there were: the last ``size`` of the curve, without one as noted.

    The noted number tells what was counted: it is a mean over the last steps, so about as large.

    >>> _size({"samples": 801.0, "occupied_voxels": 812.5}, [{"size": "700"}, {"size": "800"}])
    ('voxels', 800)
    >>> _size({"samples": 801.0, "particles": 812.0}, [])
    ('particles', 812)
    """
    for name, value in noted.items():
        kind, count = name.split("_")[-1], round(value)
        if rows:
            count = int(rows[-1].get("size") or 0)
        if kind in _KINDS and abs(value - count) < 0.1 * count:
            return kind, count
    return None


def _scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return the scalars in TensorBoard's events, (step, value) by tag; later events replace earlier ones."""
    if not folder.is_dir():
        return {}
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    kept = {"scalars": 0, "images": 1, "tensors": 1, "histograms": 1, "audio": 1, "compressedHistograms": 1}
    events = EventAccumulator(str(folder), size_guidance=kept).Reload()
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith("train/")]
    found = {tag: {event.step: event.value for event in events.Scalars(tag)} for tag in tags}
    return {
        tag: [(step, value) for step, value in sorted(values.items()) if math.isfinite(value)]
        for tag, values in found.items()
    }


def _clock(
    result: Result, stage: str, before: float, rows: Sequence[Mapping[str, str]]
) -> list[tuple[int, float]]:
    """Return the known moments of a stage: (step of the stage, seconds of training over all stages)."""
    known = {0: before}
    known |= {int(row["step"]): float(row["seconds"]) for row in rows if row.get("stage") == stage}
    if (done := result.stages.get(stage)) is not None:
        known[int(done["steps"])] = before + float(done["seconds"])
    return sorted(known.items())


def _between(known: Sequence[tuple[int, float]], step: int) -> float:
    """Return the seconds at a step, on straight lines between the known moments and beyond the last."""
    at = min(max(bisect_left(known, (step, -math.inf)), 1), len(known) - 1)
    (low, begin), (high, end) = known[at - 1], known[at]
    return begin + (end - begin) * (step - low) / (high - low)


def thinned(points: Sequence[tuple[float, float]], most: int) -> list[tuple[float, float]]:
    """Average neighbouring points so that at most ``most`` remain.

    >>> thinned([(0, 1), (1, 3), (2, 5), (3, 7)], 2)
    [(0.5, 2.0), (2.5, 6.0)]
    """
    many = -(-len(points) // most)
    parts = [points[i : i + many] for i in range(0, len(points), many)]
    return [(fmean(a for a, _ in part), fmean(b for _, b in part)) for part in parts]


def telling(views: Sequence[View]) -> dict[str, str]:
    """Choose the views to look at: the best, the middle one and the worst by PSNR, then the ends of the time.

    >>> seen = ("a", 0.0, 30.0), ("b", 0.5, 20.0), ("c", 1.0, 40.0)
    >>> telling([View(name, time, "all", psnr, {}) for name, time, psnr in seen])
    {'c': 'best', 'a': 'median', 'b': 'worst'}
    >>> telling([View(name, time, "all", psnr, {}) for name, time, psnr in seen[:2]])
    {'a': 'best', 'b': 'worst'}
    """
    if not views:
        return {}
    ranked = sorted(views, key=lambda view: (-view.psnr, view.name))
    by_time = sorted(views, key=lambda view: (view.time, view.name))
    telling = ranked[0], ranked[-1], ranked[len(ranked) // 2], by_time[0], by_time[-1]
    chosen = {}
    for view, why in zip(telling, ("best", "worst", "median", "earliest", "latest")):
        chosen.setdefault(view.name, why)
    return dict(sorted(chosen.items(), key=lambda one: WHYS.index(one[1])))
