"""A moment, a view (camera and pixels), and a rendering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from forewarp.scene.camera import Camera
from forewarp.scene.rays import Rays


@dataclass(frozen=True)
class Moment:
    """A ``time`` in [0, 1] and, if known, the index of the training ``frame`` and the id of the physical
    ``camera`` that took it.
    """

    time: float
    frame: int | None = None
    camera: int | None = None


@dataclass(frozen=True)
class View:
    """A camera and some of its pixels: flat row-major indices ``pixels`` (R,), or a ``crop`` (top, left,
    height, width), or, with neither, all of them.
    """

    camera: Camera
    pixels: Tensor | None = None
    crop: tuple[int, int, int, int] | None = None

    def __post_init__(self) -> None:
        if self.pixels is not None and self.crop is not None:
            raise ValueError("view: expected pixels or a crop, but got both")
        if self.crop is not None:
            top, left, height, width = self.crop
            inside = top + height <= self.camera.height and left + width <= self.camera.width
            if not (inside and min(top, left) >= 0 and min(height, width) >= 1):
                size = f"{self.camera.width} x {self.camera.height}"
                raise ValueError(f"view: expected a crop inside {size} pixels, but got {self.crop}")

    def __len__(self) -> int:
        if self.pixels is not None:
            return len(self.pixels)
        height, width = self.shape
        return height * width

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the picture: (R,) of single pixels, else (height, width)."""
        if self.pixels is not None:
            return (len(self.pixels),)
        return (self.camera.height, self.camera.width) if self.crop is None else self.crop[2:]

    @cached_property
    def indices(self) -> Tensor | None:
        """Flat indices (R,) of the pixels in the whole picture; None for all pixels."""
        if self.crop is None:
            return self.pixels
        top, left, height, width = self.crop
        rows = torch.arange(top, top + height)[:, None] * self.camera.width
        return (rows + torch.arange(left, left + width)).flatten()

    def rays(self) -> Rays:
        """Return the rays (R) through the pixels' centres, on the CPU; computed once."""
        return self._rays

    @cached_property
    def _rays(self) -> Rays:
        return self.camera.rays(self.indices)


@dataclass(frozen=True)
class Rendering:
    """A rendered view, one row per pixel: ``rgb`` (R, 3) over the background; ``depth`` (R,), the mean
    distance along the ray in world units, 0 if the ray hits nothing; ``opacity`` (R,) in [0, 1].
    """

    rgb: Tensor
    depth: Tensor
    opacity: Tensor

    @staticmethod
    def joined(parts: Sequence[Rendering]) -> Rendering:
        """Put what several groups of pixels show behind one another."""
        return Rendering(
            *(torch.cat([getattr(p, key) for p in parts]) for key in ("rgb", "depth", "opacity"))
        )
