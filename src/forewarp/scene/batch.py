"""What a training step sees, and what an evaluation compares with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forewarp.scene.frame import Frame
from forewarp.scene.rays import Rays, joined
from forewarp.scene.view import Moment, View


@dataclass(frozen=True)
class Asks:
    """What a method wants of the sampler: single ``pixels``, square ``crops`` of ``side`` pixels, or whole
    ``pictures``; further observations of ``neighbours`` training times next to the picked one; and up to
    ``instant`` whole training pictures of the picked time beside them. ``straight``: pixels as they are
    stored, not yet over a background.
    """

    kind: str = "pixels"
    side: int = 64
    neighbours: int = 0
    instant: int = 0
    straight: bool = False

    def __post_init__(self) -> None:
        kinds = ("pixels", "crops", "pictures")
        if self.kind not in kinds or min(self.side - 1, self.neighbours, self.instant) < 0:
            raise ValueError(
                f"asks: expected a kind of {', '.join(kinds)}, side >= 1, neighbours >= 0 and instant >= 0, "
                f"but got {self}"
            )


@dataclass(frozen=True)
class Observation:
    """Pixels of one picture: ``rgb`` (R, 3) in [0, 1], the truth over ``background`` (3,) or (R, 3), which is
    what a pixel shows where nothing is met. Where the method asks for it ``straight``, ``rgb`` is (R, 4)
    uint8: colour and alpha as they are stored.
    """

    moment: Moment
    view: View
    rgb: Tensor
    background: Tensor

    def to(self, device) -> Observation:
        """Move the truth to another device; the view stays where cameras are."""
        return replace(self, rgb=self.rgb.to(device), background=self.background.to(device))


@dataclass(frozen=True)
class Batch:
    """What one step is trained on, as the method asked for it.

    ``observations``: those of the picked frame's time first, of neighbouring times after them. ``frame``: the
    index of the training frame that was picked. ``instant``: whole training pictures of that frame's time
    over white, for methods that look at them to know the scene; empty where none were asked for.
    """

    observations: tuple[Observation, ...]
    frame: int
    instant: tuple[Observation, ...] = ()

    @property
    def time(self) -> float:
        """That of the picked frame."""
        return self.observations[0].moment.time

    def joined(self) -> tuple[Rays, Tensor, Tensor]:
        """Put the rays of all observations after one another, on the CPU, with their true colours (R, 3) and
        backgrounds: (R, 3), or (3,) of a single one. For methods that ask for one time.
        """
        rays = joined([one.view.rays() for one in self.observations])
        rgb = [one.rgb for one in self.observations]
        behind = [one.background for one in self.observations]
        if len(rgb) == 1:
            return rays, rgb[0], behind[0]
        each = [b.expand(len(one.view), 3) for b, one in zip(behind, self.observations)]
        return rays, torch.cat(rgb), torch.cat(each)

    def __len__(self) -> int:
        return sum(len(one.view) for one in self.observations)

    def to(self, device) -> Batch:
        """Move all truth to another device."""
        moved = (tuple(one.to(device) for one in part) for part in (self.observations, self.instant))
        observations, instant = moved
        return Batch(observations, self.frame, instant)


@dataclass(frozen=True)
class Target:
    """A whole image to compare with: ``rgb`` (H, W, 3) in [0, 1] over ``background`` (3,);
    ``foreground`` (H, W) bool where the image tells it, ``depth`` (H, W) exact ray depth in world units
    (0 on the background) where it is known, ``index`` that of a training frame.
    """

    frame: Frame
    rgb: Tensor
    background: Tensor
    foreground: Tensor | None = None
    depth: Tensor | None = None
    index: int | None = None

    @property
    def moment(self) -> Moment:
        """When it was taken, and by which camera."""
        return Moment(self.frame.time, self.index, self.frame.camera_id)

    @property
    def view(self) -> View:
        """All of its pixels."""
        return View(self.frame.camera)

    def to(self, device) -> Target:
        """The same target with its tensors on another device."""
        foreground, depth = (None if t is None else t.to(device) for t in (self.foreground, self.depth))
        moved = self.rgb.to(device), self.background.to(device)
        return Target(self.frame, *moved, foreground, depth, self.index)
