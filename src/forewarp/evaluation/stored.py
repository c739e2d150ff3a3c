"""Look again at test views that a run has rendered: their errors, and how far training views are."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from forewarp.drawing.images import read_image
from forewarp.metrics.errors import split_errors
from forewarp.metrics.geometry import MOVING_FRACTION
from forewarp.metrics.image import psnr
from forewarp.scene.camera import Camera, focus_point
from forewarp.scene.frame import Scene
from forewarp.scene.view import Target

_SLACK = 0.02  # dB by which a stored image may miss its stored score
_BEHIND = 1.02  # times the depth of the surface, beyond which a point is hidden
_CHUNK = 4096  # pixels that are compared with all points at once


def stored_views(
    targets: Sequence[Target], folder: Path, scores: Mapping[str, float], most: int
) -> Iterator[tuple[Target, Tensor]]:
    """Give target and stored rendering (H, W, 3) of measured views, at most so many, evenly spread.

    Args:
        targets: the test views, as they were scored.
        folder: of the run.
        scores: PSNR (dB) by the name of each measured view. One whose image does not give it is left out: the
            data or the background changed, or the rendering did.
        most: views.
    """
    numbers = [i for i, frame in enumerate(targets.frames) if frame.name in scores]
    for number in numbers[:: -(-len(numbers) // most) or 1]:
        name = targets.frames[number].name
        if not (file := folder / "images" / f"{name}.png").is_file():
            continue
        target, prediction = targets[number], read_image(file)
        if prediction.shape != target.rgb.shape:
            continue
        valid = ... if target.valid is None else target.valid
        colors = prediction[valid].reshape(1, -1, 3), target.rgb[valid].reshape(1, -1, 3)
        if abs(psnr(*colors) - scores[name]) < _SLACK:
            yield target, prediction


def view_errors(target: Target, prediction: Tensor, scene: Scene) -> dict:
    """Split the error of a view: ``sums`` by group, and how much brighter the truth is, ``ratio``."""
    moving = target.moving if target.moving is not None else _moving(target, scene)
    foreground = target.foreground if scene.has_alpha else None
    sums, ratio = split_errors(
        prediction, target.rgb, foreground=foreground, moving=moving, valid=target.valid
    )
    return {"sums": sums, "ratio": ratio}


def _moving(target: Target, scene: Scene) -> Tensor | None:
    """Tell which pixels (H, W) show what moves, by the nearest visible point of the true trajectories; None
    without these or without depth.
    """
    if scene.truth is None or target.depth is None or target.depth.shape != target.view.shape:
        return None
    points, times = scene.truth.points, scene.truth.times
    canonical = points[:, 0]
    least = MOVING_FRACTION * float((canonical.amax(0) - canonical.amin(0)).norm())
    moves = (points - canonical[:, None]).norm(dim=-1).amax(1) > least
    now = points[:, int((times - target.frame.time).abs().argmin())]
    camera, (height, width) = target.frame.camera, target.depth.shape
    pixel, ahead = camera.project(now)
    column, row = pixel.floor().long().unbind(-1)
    seen = (ahead > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    surface = target.depth[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    seen &= (now - camera.center.to(now)).norm(dim=-1) < _BEHIND * surface
    solid = (target.depth > 0).nonzero()
    moving = torch.zeros(height, width, dtype=torch.bool)
    if bool(seen.any()):
        at, moves = pixel[seen].float(), moves[seen]
        for part in solid.split(_CHUNK):
            nearest = torch.cdist(part.flip(-1) + 0.5, at).argmin(1)
            moving[part[:, 0], part[:, 1]] = moves[nearest]
    return moving


def placed(scene: Scene) -> tuple[dict[str, dict], dict]:
    """Say where test views are against the training views.

    Returns:
        by name of each test view ``degrees`` to the nearest training camera, seen from the point that these
        look at, and ``gap``, steps to the nearest training time, as far as they are known; of the training
        views their number ``images`` and the ``spacing`` of their cameras, degrees, None of a single one.
    """
    cameras = [frame.camera for frame in scene.train]
    focus = focus_point(cameras).double() if len(cameras) > 1 else None
    views = {frame.name: {} for frame in scene.test}
    training = {"images": len(scene.train), "spacing": None}
    times = scene.times
    if len(times) > 1:
        step = median(b - a for a, b in zip(times, times[1:]))
        for frame in scene.test:
            views[frame.name]["gap"] = min(abs(frame.time - time) for time in times) / step
    if focus is not None:
        trained = _directions(cameras, focus)
        near = _degrees(trained, trained)
        near[near < 1e-3] = math.inf  # itself, and those at the same place
        spacing = near.amin(1)
        if bool(spacing.isfinite().all()):
            training["spacing"] = float(spacing.median())
        if scene.test:
            least = _degrees(_directions([frame.camera for frame in scene.test], focus), trained).amin(1)
            for frame, degrees in zip(scene.test, least.tolist()):
                views[frame.name]["degrees"] = degrees
    return views, training


def _directions(cameras: Sequence[Camera], focus: Tensor) -> Tensor:
    towards = torch.stack([camera.center.double() for camera in cameras]) - focus
    return torch.nn.functional.normalize(towards, dim=-1)


def _degrees(first: Tensor, second: Tensor) -> Tensor:
    """Return the angles (M, N) between directions (M, 3) and (N, 3)."""
    return torch.rad2deg(2 * torch.asin((torch.cdist(first, second) / 2).clamp(max=1)))
