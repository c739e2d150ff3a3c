"""Another canonical time than the format's own."""

from __future__ import annotations

from dataclasses import replace

from forewarp.data.views import middle_of
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene, Truth


def with_canonical(scene: Scene, canonical: str | None) -> Scene:
    """The scene, canonical at its middle training time.

    Known trajectories are kept where they hold that time, which then stands first; else they are dropped.
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
    return replace(scene, canonical_time=time, truth=_from(scene.truth, time), protocol=protocol)


def _from(truth: Truth | None, time: float) -> Truth | None:
    if truth is None:
        return None
    at = [i for i, other in enumerate(truth.times.tolist()) if abs(other - time) < 1e-6]
    if not at:
        return None
    order = [at[0], *(i for i in range(len(truth.times)) if i != at[0])]
    return Truth(truth.points[:, order], truth.times[order])
