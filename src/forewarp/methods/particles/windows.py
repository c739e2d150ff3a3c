"""Where a window of a long film begins: what stands still in all of it, as another run has found, and points
on what moves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from forewarp.methods.method import Start
from forewarp.methods.particles.start import first_points, first_values, widths
from forewarp.ops.grid import dilate
from forewarp.scene.frame import Frame, Scene, instants_of, sightings, spread
from forewarp.scene.view import Rendering

_MOMENTS, _CAMERAS = 6, 12  # at which, and by how many cameras of each, it is looked at what moves
_WRONG = 0.05, 0.15  # error from which on a pixel is wrong: thrice its image's mean, but at least and at most
_GROWN = 0.01  # share of an image's width by which what is wrong is enlarged
# Share of a moment's views that show a place wrongly: it moves; a new point is on it.
_MOVES, _NEW = 0.5, 0.75
_POINTS = 4096  # tried on what moves
_FEW = 16  # particles that are too few to move


def check_still(is_still: bool) -> None:
    """Refuse a method that no window can begin from: times of a window are not those of another run.

    Args:
        is_still: whether it is of particles that do not change over time, or of a window itself.

    Raises:
        ValueError: if not.
    """
    if not is_still:
        made = "make it by the same command with windows=still, without data.window and start"
        raise ValueError(
            f"start: expected a run of model=particles that stand still, but got one of another kind; {made}"
        )


@torch.no_grad()
def begin_window(
    still: Mapping[str, Tensor],
    draw: Callable[[Frame], Rendering],
    start: Start,
    count_of: Callable[[float], int],
) -> tuple[dict[str, Tensor], float]:
    """Return the first values of a window's particles, and how many pixels of an image show what moves.

    First come those of ``still``, then new ones on what moves at the canonical time. ``shared`` (N,) int64
    holds the row in ``still`` of those that the window leaves as they are, else -1.

    Args:
        still: values by name, fitted to all of the film, at rest.
        draw: renders them as an image shows them, (H, W).
        start: of the window.
        count_of: returns for the number of moving pixels how many new particles there may be.

    Cost: some 70 images are rendered; and that of ``first_points``.
    """
    scene, means = start.scene, still["means"]
    own, pixels = torch.zeros(len(means), dtype=torch.bool), []
    for frames in moments_of(scene):
        masks = [wrong_pixels(draw, frame) for frame in frames]
        wrong, seen = sightings(means, [frame.camera for frame in frames], masks)
        own |= (seen > 0) & (wrong >= _MOVES * seen)
        pixels += [float(mask.sum()) for mask in masks]
    if int(own.sum()) < _FEW:
        own[:_FEW] = True
    moving_pixels = max(sum(pixels) / len(pixels), float(_FEW))
    # Times of its exposure are those of the whole film.
    values = {name: value for name, value in still.items() if name != "exposure"}
    fresh = _on_what_moves(draw, start, count_of(moving_pixels))
    if fresh:
        count = len(fresh["means"])
        fresh |= {n: v.new_zeros(count, *v.shape[1:]) for n, v in values.items() if n not in fresh}
        values = {name: torch.cat([value, fresh[name]]) for name, value in values.items()}
        own = torch.cat([own, torch.ones(count, dtype=torch.bool)])
    values["shared"] = torch.where(own, -1, torch.arange(len(own)))
    return values, moving_pixels


def _on_what_moves(draw: Callable[[Frame], Rendering], start: Start, count: int) -> dict[str, Tensor]:
    """Make at most ``count`` particles where what stands still is wrong in images of the canonical time."""
    scene = start.scene
    cloud = first_points(replace(start, handover=None), _POINTS)
    canonical = min(scene.instants, key=lambda time: abs(time - scene.canonical_time))
    now = _frames_at(scene, canonical)
    masks = [wrong_pixels(draw, frame) for frame in now]
    wrong, seen = sightings(cloud.points, [frame.camera for frame in now], masks)
    rows = ((seen > 0) & (wrong >= _NEW * seen)).nonzero()[:, 0]
    if not len(rows):
        return {}
    cloud = cloud[rows[spread(len(rows), max(count, 1))]]
    area = sum(float(mask.sum()) for mask in masks) / len(masks)
    return first_values(cloud, widths(scene, cloud.points, max(area, 1.0)))


def moments_of(scene: Scene) -> list[list[Frame]]:
    """Return training frames of some instants, evenly spread: those of some cameras of each."""
    instants = scene.instants
    return [_frames_at(scene, instants[i]) for i in spread(len(instants), _MOMENTS)]


def _frames_at(scene: Scene, instant: float) -> list[Frame]:
    """Return the training frames of one of ``scene.instants``, of some cameras where there are many."""
    frames = [frame for frame, time in zip(scene.train, instants_of(scene.train)) if time == instant]
    return [frames[i] for i in spread(len(frames), _CAMERAS)]


@torch.no_grad()
def wrong_pixels(draw: Callable[[Frame], Rendering], frame: Frame) -> Tensor:
    """Return which pixels (H, W) of an image what stands still does not show, and what is beside them.

    Args:
        draw: renders what stands still as an image shows it, (H, W).
        frame: the image.
    """
    rgba, width = frame.load().float() / 255, frame.camera.width
    error = (draw(frame).rgb - rgba[..., :3] * rgba[..., 3:]).abs().mean(-1)
    smooth = torch.nn.functional.avg_pool2d(error[None, None], 3, 1, 1, count_include_pad=False)[0, 0]
    wrong = smooth > (3 * error.mean()).clamp(*_WRONG)
    if frame.load_valid is not None:
        wrong &= frame.load_valid()
    return dilate(wrong, max(1, round(_GROWN * width)))
