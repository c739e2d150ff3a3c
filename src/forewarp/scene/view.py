"""Moments, views (camera and pixels), renderings, batches to train on and targets to compare with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from forewarp.scene.brief import brief
from forewarp.scene.camera import Camera, Rays, joined
from forewarp.scene.frame import Frame

_WHOLLY = 0.999  # share of a pixel from which on all of it is valid


@dataclass(frozen=True)
class Moment:
    """A ``time`` in [0, 1] and, if known, the index of the training ``frame`` and the id of the physical
    ``camera`` that took it. ``filmed``: an image is meant that was taken then, with its exposure; else
    the scene alone. ``lit``: another time, at which that camera had the exposure that is meant.
    """

    time: float
    frame: int | None = None
    camera: int | None = None
    filmed: bool = False
    lit: float | None = None

    __repr__ = brief


@dataclass(frozen=True)
class View:
    """A camera and some of its pixels: flat row-major indices ``pixels`` (R,), or a ``crop`` (top, left,
    height, width), or, with neither, all of them.
    """

    camera: Camera
    pixels: Tensor | None = None
    crop: tuple[int, int, int, int] | None = None

    __repr__ = brief

    def __len__(self) -> int:
        return math.prod(self.shape)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the image: (R,) of single pixels, else (height, width)."""
        if self.pixels is not None:
            return (len(self.pixels),)
        return (self.camera.height, self.camera.width) if self.crop is None else self.crop[2:]

    @cached_property
    def indices(self) -> Tensor | None:
        """Flat indices (R,) of the pixels in the whole image; None for all pixels."""
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
    distance along the ray in world units, 0 if the ray hits nothing; ``opacity`` (R,) in [0, 1]. As images
    (``shaped``) R is H, W.
    """

    rgb: Tensor
    depth: Tensor
    opacity: Tensor

    __repr__ = brief

    def shaped(self, height: int, width: int) -> Rendering:
        """Make images of all pixels, on the CPU: ``rgb`` (H, W, 3), clipped to [0, 1], ``depth`` and
        ``opacity`` (H, W).
        """
        rgb, *others = self.rgb.clamp(0, 1), self.depth, self.opacity
        return Rendering(*(part.reshape(height, width, *part.shape[1:]).cpu() for part in (rgb, *others)))

    @staticmethod
    def joined(parts: Sequence[Rendering]) -> Rendering:
        """Put what several groups of pixels show behind one another."""
        columns = zip(*((part.rgb, part.depth, part.opacity) for part in parts))
        return Rendering(*map(torch.cat, columns))


KINDS = ("pixels", "crops", "pictures")


@dataclass(frozen=True)
class Asks:
    """What a method asks for in a batch.

    ``kind``: single ``pixels``, square ``crops`` of ``side`` pixels, or ``pictures``, whole images.
    ``neighbours``: how many of the nearest other training times to observe too. ``instant``: up to how many
    whole training images of the picked time to add. ``straight``: give pixels as stored, not composited.
    ``sensed``: give the depth of pixels where a sensor measured it. ``near``: share of single pixels,
    below 1, that is drawn on and beside what an image with alpha shows; ``Observation.shares`` make up for
    it.
    """

    kind: str = "pixels"
    side: int = 64
    neighbours: int = 0
    instant: int = 0
    straight: bool = False
    sensed: bool = False
    near: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS or min(self.side - 1, self.neighbours, self.instant) < 0:
            expected = f"a kind of {', '.join(KINDS)}, side >= 1, neighbours >= 0 and instant >= 0"
            raise ValueError(f"asks: expected {expected}, but got {self}")


def _moved(record, device):
    """Move the tensors of a record to another device."""
    tensors = {name: value for name, value in vars(record).items() if isinstance(value, Tensor)}
    return replace(record, **{name: tensor.to(device) for name, tensor in tensors.items()})


@dataclass(frozen=True)
class Observation:
    """Pixels of one image: the true ``rgb`` (R, 3) in [0, 1] over ``background`` (3,) or (R, 3), the colour
    of rays that hit nothing. If the method asks for ``straight`` pixels, ``rgb`` is (R, 4) uint8: colour
    and alpha as stored. ``valid`` (R,) bool: those to learn from; None: all, as always of single pixels.
    ``sensed`` (2, R), if asked for and known: the depth of their rays, 0 where there is none, and its
    confidence. ``shares`` (R,): how often each single pixel counts, once on average; None: once.
    """

    moment: Moment
    view: View
    rgb: Tensor
    background: Tensor
    valid: Tensor | None = None
    sensed: Tensor | None = None
    shares: Tensor | None = None

    __repr__ = brief

    def to(self, device) -> Observation:
        """Move what is known of the pixels to another device; the view stays on the CPU."""
        return _moved(self, device)

    def smaller(self, times: float) -> Observation:
        """Average a whole image of ``straight`` pixels to one about so many times smaller: colours by their
        alpha; a pixel is valid if all of it is; its depth is that of its middle. Where no pixel would be
        valid, the image stays as it is.
        """
        camera = self.view.camera
        small = camera.resized(*(max(1, round(side / times)) for side in (camera.width, camera.height)))
        whole, size = (camera.height, camera.width), (small.height, small.width)

        def averaged(planes: Tensor) -> Tensor:
            mean = torch.nn.functional.interpolate(planes.reshape(1, -1, *whole), size, mode="area")
            return mean.reshape(len(planes), -1)

        rgba = self.rgb.T.float()
        color, alpha = averaged(rgba[:3] * rgba[3:]), averaged(rgba[3:])
        rgba = torch.cat([color / alpha.clamp(min=1e-6), alpha]).round().to(torch.uint8).T.contiguous()
        valid, sensed = self.valid, self.sensed
        if valid is not None:
            valid = averaged(valid[None].float())[0] > _WHOLLY
            if not bool(valid.any()):
                return self
        if sensed is not None:
            planes = sensed.reshape(1, -1, *whole)
            sensed = torch.nn.functional.interpolate(planes, size, mode="nearest-exact").reshape(2, -1)
        return replace(self, view=View(small), rgb=rgba, valid=valid, sensed=sensed)


@dataclass(frozen=True)
class Batch:
    """What one training step uses, as the method asked for it.

    ``observations``: first of the picked frame's time, then of neighbouring times. ``frame``: the index of
    the picked training frame. ``instant``: whole training images of that time over white, for methods
    that encode them; empty unless asked for.
    """

    observations: tuple[Observation, ...]
    frame: int
    instant: tuple[Observation, ...] = ()

    __repr__ = brief

    @property
    def time(self) -> float:
        """The time of the picked frame."""
        return self.observations[0].moment.time

    def joined(self) -> tuple[Rays, Tensor, Tensor]:
        """Concatenate the rays of all observations, on the CPU, with their true colours (R, 3) and
        backgrounds (R, 3), or (3,) of a single observation. For methods that ask for one time.
        """
        first, *others = self.observations
        if not others:
            return first.view.rays(), first.rgb, first.background
        rays = joined([o.view.rays() for o in self.observations])
        backgrounds = [o.background.expand(len(o.view), 3) for o in self.observations]
        return rays, torch.cat([o.rgb for o in self.observations]), torch.cat(backgrounds)

    def shares(self) -> Tensor | None:
        """Return how often each ray (R,) of ``joined`` counts; None: each once."""
        shares = [observation.shares for observation in self.observations]
        return None if shares[0] is None else torch.cat(shares)

    def split(self) -> list[Batch]:
        """Return a batch of each observation."""
        return [replace(self, observations=(observation,)) for observation in self.observations]

    def __len__(self) -> int:
        return sum(len(observation.view) for observation in self.observations)

    def to(self, device) -> Batch:
        """Move all colours to another device."""
        observations, instant = (tuple(o.to(device) for o in p) for p in (self.observations, self.instant))
        return Batch(observations, self.frame, instant)


@dataclass(frozen=True)
class Target:
    """A whole image to compare with: ``rgb`` (H, W, 3) in [0, 1] over ``background`` (3,), of the size of the
    frame's camera or, where it was reduced, smaller.

    If known: ``foreground`` (H, W) bool, ``depth`` (H, W) exact ray depth in world units (0 on the
    background), ``index`` among the training frames, ``valid`` (H, W) bool, the pixels that count,
    ``moving`` (H, W) bool, those of what moves, ``covisible`` (H, W) bool, those of what training images show
    too.
    """

    frame: Frame
    rgb: Tensor
    background: Tensor
    foreground: Tensor | None = None
    depth: Tensor | None = None
    index: int | None = None
    valid: Tensor | None = None
    moving: Tensor | None = None
    covisible: Tensor | None = None

    __repr__ = brief

    @property
    def moment(self) -> Moment:
        """The time and the camera of the image."""
        return Moment(self.frame.time, self.index, self.frame.camera_id, filmed=True)

    @property
    def view(self) -> View:
        """The view of all the image's pixels."""
        return View(self.frame.camera)

    def to(self, device) -> Target:
        """Move the tensors to another device."""
        return _moved(self, device)
