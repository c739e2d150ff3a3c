"""Frames, and the scene they belong to."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from torch import Tensor

from forewarp.scene.box import Box
from forewarp.scene.camera import Camera


@dataclass(frozen=True)
class Frame:
    """One image with its camera and time.

    ``load()`` gives the image as a uint8 tensor (H, W, 4), straight (not premultiplied) alpha, at the
    camera's size; without an alpha channel on disk alpha is 255. ``load_depth()``, if not None,
    gives exact ray depth (H, W) float32 in world units, 0 on the background. ``ability`` is what a test
    frame measures: ``space``, ``time``, ``canonical``, or ``all`` if the dataset does not say.
    ``camera_id`` numbers the physical cameras from 0, if the dataset tells them apart.
    """

    name: str
    time: float
    camera: Camera
    load: Callable[[], Tensor]
    load_depth: Callable[[], Tensor] | None = None
    ability: str = "all"
    camera_id: int | None = None


@dataclass(frozen=True)
class Truth:
    """Exact trajectories of surface points: ``points`` (N, T, 3) float32 at ``times`` (T,), world units.

    The first column is the canonical time.
    """

    points: Tensor
    times: Tensor


@dataclass(frozen=True)
class Scene:
    """All frames of one subject, read once.

    ``box`` bounds everything visible; ``canonical_time`` in [0, 1]; ``has_alpha``: the images separate
    foreground from background; ``protocol`` says how numbers are measured; ``still`` (N, 3) float32: points
    that never move, world units, if known; ``held``: held-out frames, never trained on.
    """

    name: str
    train: tuple[Frame, ...]
    val: tuple[Frame, ...]
    test: tuple[Frame, ...]
    box: Box
    canonical_time: float
    has_alpha: bool
    truth: Truth | None = None
    protocol: dict = field(default_factory=dict)
    still: Tensor | None = None
    held: tuple[Frame, ...] = ()

    @property
    def times(self) -> tuple[float, ...]:
        """The distinct training times, ascending."""
        return tuple(sorted({f.time for f in self.train}))


def spread(count: int, wanted: int) -> list[int]:
    """Choose ``wanted`` evenly spaced indices below ``count``, first and last included; all if too few.

    >>> spread(10, 4), spread(2, 4)
    ([0, 3, 6, 9], [0, 1])
    """
    wanted = min(count, wanted)
    return [round(i * (count - 1) / max(wanted - 1, 1)) for i in range(wanted)]


def middle_of(times: Iterable[float]) -> float:
    """Choose the time nearest to the middle between first and last, the earlier of two as near.

    >>> middle_of([0.0, 0.1, 0.2, 0.8, 1.0])
    0.2
    >>> middle_of([0.0, 0.25, 0.75, 1.0])
    0.25
    """
    times = sorted(set(times))
    return min(times, key=lambda time: round(abs(time - 0.5 * (times[0] + times[-1])), 9))
