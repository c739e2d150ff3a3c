"""Windows of a long film: a part of a scene's time, with its own time from 0 to 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from forewarp.data.files import mismatch
from forewarp.scene.frame import Frame, Scene, middle_of

OVERLAP = 3  # instants before and after a window that it is trained on, too: its neighbours meet it there
_FEWEST = 4  # instants that a window must have of its own


def cut(scene: Scene, window: Sequence[float] | None) -> Scene:
    """Keep a window of a scene; None: all of it.

    Training frames are those of the window and of ``OVERLAP`` instants before and after it. Test, validation
    and held-out frames are those of the window alone, so that each of them belongs to one of the windows that
    share a film. Times are those of the window: 0 and 1 are the ends of what it is trained on, the
    ``span`` of the protocol, in the film's time. Known trajectories are dropped.

    Args:
        scene: as read.
        window: from and to, in [0, 1]; a frame at ``to`` is of the next window, unless that is 1.

    Raises:
        SceneError: for another window, or one with too few instants.
    """
    if window is None:
        return scene
    begin, end = limits_of(window)
    times = scene.instants

    def holds(time: float) -> bool:
        return begin <= time < end or (time == 1 and end == 1)

    inside = [i for i, time in enumerate(times) if holds(time)]
    if len(inside) < _FEWEST:
        expected = f"a window with at least {_FEWEST} of the film's {len(times)} instants"
        raise mismatch("data.window", expected, f"{len(inside)} in [{begin:g}, {end:g}]", "use fewer windows")
    first = times[max(inside[0] - OVERLAP, 0)]
    last = times[min(inside[-1] + OVERLAP, len(times) - 1)]
    first, last = min(first, begin), max(last, end)  # test frames may lie before and after all others

    def moved(frames: Sequence[Frame]) -> tuple[Frame, ...]:
        return tuple(replace(frame, time=(frame.time - first) / (last - first)) for frame in frames)

    train = tuple(frame for frame in moved(scene.train) if 0 <= frame.time <= 1)
    others = {name: getattr(scene, name) for name in ("val", "test", "held")}
    others = {name: moved(f for f in frames if holds(f.time)) for name, frames in others.items()}
    protocol = scene.protocol | {"window": [begin, end], "span": [first, last]}
    if "test_frames" in protocol:
        protocol["test_frames"] = len(others["test"])
    if "seconds" in protocol:
        protocol["seconds"] *= last - first
    canonical = middle_of(frame.time for frame in train)
    return replace(scene, train=train, **others, canonical_time=canonical, truth=None, protocol=protocol)


def limits_of(window: Sequence[float]) -> tuple[float, float]:
    """Return where a window begins and ends.

    Raises:
        SceneError: for anything but two rising numbers in [0, 1].
    """
    is_pair = isinstance(window, Sequence) and not isinstance(window, str) and len(window) == 2
    if not is_pair or not all(type(x) in (int, float) for x in window) or not 0 <= window[0] < window[1] <= 1:
        raise mismatch("data.window", "from and to in [0, 1], as [0.25, 0.5]", repr(window))
    return float(window[0]), float(window[1])
