"""What a training step sees."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from forewarp.scene.frame import Frame
from forewarp.scene.rays import Rays


@dataclass(frozen=True)
class Batch:
    """Rays of ONE time with their true colours.

    ``rgb`` (R, 3) in [0, 1], already over ``background``; ``background`` (3,) or (R, 3) is what a ray
    that meets nothing shows; ``time`` in [0, 1]; ``frame`` is the index of the training frame
    that was picked, whose time others may share that gave rays too.
    """

    rays: Rays
    rgb: Tensor
    background: Tensor
    time: float
    frame: int

    def to(self, device) -> Batch:
        """The same batch on another device."""
        return Batch(
            self.rays.to(device), self.rgb.to(device), self.background.to(device), self.time, self.frame
        )


@dataclass(frozen=True)
class Target:
    """A whole image to compare with: ``rgb`` (H, W, 3) in [0, 1] over ``background`` (3,);
    ``foreground`` (H, W) bool where the image tells it, ``depth`` (H, W) exact ray depth in world units
    (0 on the background) where it is known.
    """

    frame: Frame
    rgb: Tensor
    background: Tensor
    foreground: Tensor | None = None
    depth: Tensor | None = None

    def to(self, device) -> Target:
        """The same target with its tensors on another device."""
        foreground, depth = (None if t is None else t.to(device) for t in (self.foreground, self.depth))
        return Target(self.frame, self.rgb.to(device), self.background.to(device), foreground, depth)
