"""Batches to train on and targets to compare with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forewarp.scene.frame import Frame
from forewarp.scene.rays import Rays, joined
from forewarp.scene.view import Moment, View


@dataclass(frozen=True)
class Asks:
    """What a method asks for in a batch.

    ``kind``: single ``pixels``, square ``crops`` of ``side`` pixels, or whole ``pictures``. ``neighbours``:
    how many of the nearest other training times to observe too. ``instant``: up to how many whole training
    pictures of the picked time to add. ``straight``: give pixels as stored, not composited.
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
    """Pixels of one picture: the true ``rgb`` (R, 3) in [0, 1] over ``background`` (3,) or (R, 3), the colour
    of rays that hit nothing. If the method asks for ``straight`` pixels, ``rgb`` is (R, 4) uint8: colour
    and alpha as stored.
    """

    moment: Moment
    view: View
    rgb: Tensor
    background: Tensor

    def to(self, device) -> Observation:
        """Move the colours to another device; the view stays on the CPU."""
        return replace(self, rgb=self.rgb.to(device), background=self.background.to(device))


@dataclass(frozen=True)
class Batch:
    """What one training step uses, as the method asked for it.

    ``observations``: first of the picked frame's time, then of neighbouring times. ``frame``: the index of
    the picked training frame. ``instant``: whole training pictures of that time over white, for methods
    that encode them; empty unless asked for.
    """

    observations: tuple[Observation, ...]
    frame: int
    instant: tuple[Observation, ...] = ()

    @property
    def time(self) -> float:
        """The time of the picked frame."""
        return self.observations[0].moment.time

    def joined(self) -> tuple[Rays, Tensor, Tensor]:
        """Concatenate the rays of all observations, on the CPU, with their true colours (R, 3) and
        backgrounds (R, 3), or (3,) of a single observation. For methods that ask for one time.
        """
        rays = joined([one.view.rays() for one in self.observations])
        rgb = [one.rgb for one in self.observations]
        behind = [one.background for one in self.observations]
        if len(rgb) == 1:
            return rays, rgb[0], behind[0]
        each = [b.expand(len(one.view), 3) for b, one in zip(behind, self.observations)]
        return rays, torch.cat(rgb), torch.cat(each)

    def split(self) -> list[Batch]:
        """Return a batch of each observation."""
        return [replace(self, observations=(one,)) for one in self.observations]

    def __len__(self) -> int:
        return sum(len(one.view) for one in self.observations)

    def to(self, device) -> Batch:
        """Move all colours to another device."""
        moved = (tuple(one.to(device) for one in part) for part in (self.observations, self.instant))
        observations, instant = moved
        return Batch(observations, self.frame, instant)


@dataclass(frozen=True)
class Target:
    """A whole image to compare with: ``rgb`` (H, W, 3) in [0, 1] over ``background`` (3,), of the size of the
    frame's camera or, where it was reduced, smaller.

    If known: ``foreground`` (H, W) bool, ``depth`` (H, W) exact ray depth in world units (0 on the
    background), ``index`` among the training frames.
    """

    frame: Frame
    rgb: Tensor
    background: Tensor
    foreground: Tensor | None = None
    depth: Tensor | None = None
    index: int | None = None

    @property
    def moment(self) -> Moment:
        """The time and the camera of the image."""
        return Moment(self.frame.time, self.index, self.frame.camera_id)

    @property
    def view(self) -> View:
        """The view of all the image's pixels."""
        return View(self.frame.camera)

    def to(self, device) -> Target:
        """Move the tensors to another device."""
        foreground, depth = (None if t is None else t.to(device) for t in (self.foreground, self.depth))
        moved = self.rgb.to(device), self.background.to(device)
        return Target(self.frame, *moved, foreground, depth, self.index)
