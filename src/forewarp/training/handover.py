"""The handover: what a stage leaves to the next, as files in its folder."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from forewarp.files import read_json, write_json
from forewarp.methods.method import HasBounds, HasMatter, HasTrajectories, Method
from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud, Handover
from forewarp.scene.frame import Scene, spread
from forewarp.training.checkpoints import read_archive, write_archive

NUMBERS, POINTS = "handover.json", "handover.pt"
_POINTS, _TIMES = 10_000, 16  # at most this many points of the cloud, and times of their paths


@torch.no_grad()
def make_handover(method: Method, scene: Scene, before: Handover | None, frames_in_play: int) -> Handover:
    """Gather what a fitted stage leaves: its box, and points with colours and paths if the method has them.

    Args:
        method: fitted.
        scene: the scene that the method was fitted to.
        before: the handover that the stage began with; None for the first stage.
        frames_in_play: at the stage's end.
    """
    times = list(scene.times)
    box = method.bounds(times) if isinstance(method, HasBounds) else None
    room = scene.box.scaled(1.05)
    if tight := box is not None and box.meets(room):  # what drew nothing may have strayed from it
        box = box.intersection(room)
    else:
        box = scene.box if before is None else before.box
    some = paths = cloud = None
    if isinstance(method, HasMatter):
        cloud = method.matter()
        rows = torch.tensor(spread(len(cloud), _POINTS), dtype=torch.long, device=cloud.points.device)
        cloud = cloud[rows]
        if isinstance(method, HasTrajectories):
            some = torch.tensor([times[i] for i in spread(len(times), _TIMES)])
            paths = method.trajectories(cloud.points, some.to(cloud.points)).cpu()
        cloud = Cloud(cloud.points.cpu(), cloud.colors.cpu(), cloud.opacity.cpu(), cloud.size)
    return Handover(box, tight, frames_in_play, cloud, some, paths, method.notes())


def save_handover(handover: Handover, folder: Path) -> None:
    """Write ``handover.pt`` (points, if there are any), then ``handover.json`` (numbers)."""
    cloud = handover.cloud
    if cloud is not None:
        tensors = {"points": cloud.points, "colors": cloud.colors, "opacity": cloud.opacity}
        if handover.paths is not None:
            tensors |= {"times": handover.times, "paths": handover.paths}
        write_archive(folder / POINTS, {name: t.contiguous() for name, t in tensors.items()})
    numbers = {
        "low": handover.box.low,
        "high": handover.box.high,
        "tight": handover.tight,
        "frames_in_play": handover.frames_in_play,
        "size": None if cloud is None else cloud.size,
        "notes": dict(handover.notes),
    }
    write_json(folder / NUMBERS, numbers)


def load_handover(folder: Path) -> Handover:
    """Read what ``save_handover`` wrote.

    Raises:
        ValueError: naming the file that is missing, damaged, or something else.
    """
    path = folder / NUMBERS
    try:
        content = read_json(path) or {}
        box, notes = Box(tuple(content["low"]), tuple(content["high"])), content["notes"]
        if not all(math.isfinite(value) for value in notes.values()):
            raise ValueError
        cloud, times, paths = None, None, None
        if content["size"] is not None:
            path = folder / POINTS
            cloud, times, paths = _points(read_archive(path), float(content["size"]))
        return Handover(box, content["tight"], content["frames_in_play"], cloud, times, paths, notes)
    except (KeyError, TypeError, ValueError, AttributeError, OSError):
        pass
    raise ValueError(f"{path}: expected what a stage leaves to the next, but got something else; delete it")


def _points(content: dict, size: float) -> tuple:
    points, colors, opacity = (content[name] for name in ("points", "colors", "opacity"))
    times, paths = content.get("times"), content.get("paths")
    count = len(points)
    good = points.shape == colors.shape == (count, 3) and opacity.shape == (count,)
    good = good and (paths is None or paths.shape == (count, len(times), 3))
    if not good or not 0 < size < math.inf:
        raise ValueError
    return Cloud(points, colors, opacity, size), times, paths
