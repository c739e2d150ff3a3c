"""Apply the options that every format shares: training views held out, another canonical time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from forewarp.data.files import whole
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene, Truth

_SAME_TIME = 1e-6


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


def with_canonical(scene: Scene, canonical: str | None) -> Scene:
    """Make the middle training time canonical.

    Known trajectories are kept where they hold that time, which then comes first; else they are dropped.
    Kinds of test views keep their names: ``canonical`` is still the format's own time.

    Args:
        scene: as read.
        canonical: ``middle``; None changes nothing.

    Raises:
        SceneError: for another word.
    """
    if canonical is None:
        return scene
    if canonical != "middle":
        raise SceneError(f"data.canonical: expected middle or null, but got {canonical}")
    time = middle_of(frame.time for frame in scene.train)
    protocol = {**scene.protocol, "canonical_time": time}
    return replace(scene, canonical_time=time, truth=_beginning_at(scene.truth, time), protocol=protocol)


def middle_of(times: Iterable[float]) -> float:
    """Choose the time nearest to the middle between first and last, the earlier of two as near.

    >>> middle_of([0.0, 0.1, 0.2, 0.8, 1.0])
    0.2
    >>> middle_of([0.0, 0.25, 0.75, 1.0])
    0.25
    """
    times = sorted(set(times))
    return min(times, key=lambda time: round(abs(time - 0.5 * (times[0] + times[-1])), 9))


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
