"""Training views set aside: never trained on, so that they tell how a run does while it goes on."""

from __future__ import annotations

from dataclasses import replace

from forewarp.data.files import whole
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene


def hold_out(scene: Scene, count: int) -> Scene:
    """The scene with ``count`` of its training frames in ``held``, spread evenly over the sequence.

    Always the same ones. The first and the last time and the canonical one keep all their frames: beyond what
    was seen there is nothing to compare with, and a stage starts from the canonical time. Where there is only
    one time its frames are shared out.

    Args:
        scene: as read.
        count: frames; 0: none. At most half of those that may be set aside.

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
    """How many training frames a scene can spare."""
    return len(_spare(scene)) // 2


def _spare(scene: Scene) -> list[tuple[float, int]]:
    """Time and number of the training frames some of which may be set aside, in the order of time."""
    kept = {scene.times[0], scene.times[-1], scene.canonical_time} if len(scene.times) > 1 else set()
    return sorted((f.time, i) for i, f in enumerate(scene.train) if f.time not in kept)
