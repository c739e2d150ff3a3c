"""Apply the options that every format shares: training views held out, another canonical time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from forewarp.data.files import whole
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene, Truth

_SAME_TIME = 1e-6
_WINDOW = 0.08  # share of the sequence on either side of a time whose silhouettes are looked at
_SIDE = 100  # pixels of a picture's shorter side that are enough to tell how spread out it is
_FAR = 0.2  # share by which an end of the sequence counts less than its middle


def hold_out(scene: Scene, count: int) -> Scene:
    """Move ``count`` training frames, evenly spaced over the sequence, to ``held``; always the same ones.

    The first and the last time and the canonical one keep all their frames: nothing lies beyond what was seen
    to compare with, and a stage starts from the canonical time. Where there is only one time, any of its
    frames may be held out.

    Args:
        scene: as read.
        count: frames; 0: none. At most half of those that may be held out.

    Raises:
        SceneError: where that is more than the scene can spare.
    """
    if whole(count, "data.held_out", 0) == 0:
        return scene
    frames = _spare(scene)
    if count > len(frames) // 2:
        raise SceneError(
            f"data.held_out: expected at most {len(frames) // 2} of the {len(scene.train)} training frames "
            f"of {scene.name}, but got {count}; set data.held_out={len(frames) // 2}"
        )
    chosen = {frames[(2 * i + 1) * len(frames) // (2 * count)][1] for i in range(count)}
    return replace(
        scene,
        train=tuple(f for i, f in enumerate(scene.train) if i not in chosen),
        held=tuple(scene.train[i] for i in sorted(chosen)),
        protocol={**scene.protocol, "held_out": count},
    )


def most_held_out(scene: Scene) -> int:
    """Count the training frames that a scene can spare."""
    return len(_spare(scene)) // 2


def with_canonical(scene: Scene, canonical: str | float | None) -> Scene:
    """Make another training time canonical.

    Known trajectories are kept where they hold that time, which then comes first; else they are dropped.
    Kinds of test views keep their names: ``canonical`` is still the format's own time.

    Args:
        scene: as read.
        canonical: ``middle``, the time nearest to the middle; ``spread``, the one whose silhouettes are most
            spread out (``spread_time``; ``middle`` where pictures have no alpha); a time in [0, 1]: the
            training time nearest to it; None changes nothing.

    Raises:
        SceneError: for anything else.
    """
    if canonical is None:
        return scene
    number = isinstance(canonical, int | float) and not isinstance(canonical, bool) and 0 <= canonical <= 1
    if canonical not in ("middle", "spread") and not number:
        raise SceneError(
            f"data.canonical: expected middle, spread, a time in [0, 1] or null, but got {canonical!r}"
        )
    if number:
        time = min(scene.times, key=lambda t: abs(t - canonical))
    elif canonical == "spread" and scene.has_alpha:
        time = spread_time(scene)
    else:
        time = middle_of(scene.times)
    protocol = {**scene.protocol, "canonical_time": time}
    return replace(scene, canonical_time=time, truth=_beginning_at(scene.truth, time), protocol=protocol)


def spread_time(scene: Scene) -> float:
    """Choose the time whose silhouettes are most spread out; of much the same, the one nearest to the middle.

    Parts that touch or hide each other in the canonical shape cannot be told apart later. Spread is the
    length of a silhouette's outline over the square root of its area, the mean over the frames within
    ``_WINDOW`` of the time; the first and the last time count ``_FAR`` less than the middle one, as motion
    is learned outwards.

    Cost: every training picture is decoded, as training does anyway, and a third of a millisecond each.
    """
    spreads = sorted((frame.time, outline(_small(frame.load()[..., 3] > 127))) for frame in scene.train)
    first, length = spreads[0][0], max(spreads[-1][0] - spreads[0][0], _SAME_TIME)

    def score(time: float) -> float:
        near = [value for t, value in spreads if abs(t - time) <= _WINDOW * length]
        return sum(near) / len(near) * (1 - _FAR * abs(2 * (time - first) / length - 1))

    return max(scene.times, key=lambda time: round(score(time), 9))


def outline(mask: Tensor) -> float:
    """Length of a silhouette's outline (H, W) over the square root of its area; 0 for an empty one.

    >>> import torch
    >>> square = torch.zeros(6, 6, dtype=torch.bool)
    >>> square[1:5, 1:5] = True
    >>> outline(square)  # 12 of its 16 pixels
    3.0
    """
    inside = torch.nn.functional.max_pool2d((~mask)[None].float(), 3, 1, 1)[0] == 0
    area = int(mask.sum())
    return float((mask & ~inside).sum()) / area**0.5 if area else 0.0


def middle_of(times: Iterable[float]) -> float:
    """Choose the time nearest to the middle between first and last, the earlier of two as near.

    >>> middle_of([0.0, 0.1, 0.2, 0.8, 1.0])
    0.2
    >>> middle_of([0.0, 0.25, 0.75, 1.0])
    0.25
    """
    times = sorted(set(times))
    return min(times, key=lambda time: round(abs(time - 0.5 * (times[0] + times[-1])), 9))


def _small(mask: Tensor) -> Tensor:
    """Leave out rows and columns of a mask (H, W) that is far larger than ``_SIDE`` pixels."""
    step = max(1, min(mask.shape) // _SIDE)
    return mask[::step, ::step]


def _spare(scene: Scene) -> list[tuple[float, int]]:
    """List (time, index) of the frames that may be held out: not those at first, last and canonical time."""
    kept = {scene.times[0], scene.times[-1], scene.canonical_time} if len(scene.times) > 1 else set()
    return sorted((f.time, i) for i, f in enumerate(scene.train) if f.time not in kept)


def _beginning_at(truth: Truth | None, time: float) -> Truth | None:
    """Put ``time`` first; return None if the trajectories lack it."""
    at = (
        [] if truth is None else [i for i, t in enumerate(truth.times.tolist()) if abs(t - time) < _SAME_TIME]
    )
    if not at:
        return None
    order = [at[0], *(i for i in range(len(truth.times)) if i != at[0])]
    return Truth(truth.points[:, order], truth.times[order])
