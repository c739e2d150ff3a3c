"""Windows of a long film, each of moving Gaussians, that play one after another."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forewarp.fields.moving import GaussiansSnapshot, MovingGaussians
from forewarp.scene.brief import brief
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.view import Moment, Rendering, View

# What has a row for each Gaussian; the last two may be None.
ROWS = ("means", "log_scales", "quaternions", "opacity", "harmonics", "color_over_time", "opacity_over_time")
_NEXT = 1e-5  # of all time: numbers are rounded


@dataclass(frozen=True)
class Window:
    """What is shown from a time ``begin`` of the film until the next window begins. Its own times 0 and 1
    are those of the film in ``span``, which holds all times at which it is shown.
    """

    gaussians: MovingGaussians
    span: tuple[float, float]
    begin: float

    __repr__ = brief

    def time(self, film_time: float) -> float:
        """Return the window's own time at a time of the film, in [0, 1]."""
        first, last = self.span
        return min(max((film_time - first) / (last - first), 0.0), 1.0)


@dataclass(eq=False)
class Fading:
    """Two snapshots of one moment, of which the image of the second counts by a ``share`` in [0, 1]."""

    moment: Moment
    first: GaussiansSnapshot
    second: GaussiansSnapshot
    share: float

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """Mix what both show of a view; see ``GaussiansSnapshot.render``."""
        first, second = (part.render(view, background) for part in (self.first, self.second))
        rgb = torch.lerp(first.rgb.clamp(0, 1), second.rgb.clamp(0, 1), self.share)
        others = ((getattr(part, name) for part in (first, second)) for name in ("depth", "opacity"))
        return Rendering(rgb, *(torch.lerp(*pair, self.share) for pair in others))

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time."""
        return moment.time == self.moment.time


@dataclass(frozen=True)
class MovingWindows:
    """A film in ``windows``, the first of which begins at 0; asked as ``MovingGaussians`` are.

    From ``fade`` (of the film's time) before a window begins until as long after, its images and those of the
    window before are mixed: what both were trained on looks slightly different in each.
    """

    windows: tuple[Window, ...]
    fade: float = 0.0

    __repr__ = brief

    @property
    def device(self) -> torch.device:
        """Where they are."""
        return self.windows[0].gaussians.device

    @property
    def moves(self) -> bool:
        """Whether there is any motion."""
        return any(window.gaussians.moves for window in self.windows)

    def to(self, device: torch.device | str) -> MovingWindows:
        """Move all tensors to a device."""
        moved = (replace(window, gaussians=window.gaussians.to(device)) for window in self.windows)
        return replace(self, windows=tuple(moved))

    def number(self, time: float) -> int:
        """Return the number of the window that a time of the film is of."""
        return max(bisect_right([window.begin for window in self.windows], time) - 1, 0)

    def at(self, moment: Moment) -> GaussiansSnapshot | Fading:
        """Freeze what is shown at a moment of the film."""
        number, time = self.number(moment.time), moment.time
        begins = [window.begin for window in self.windows]
        if number and time - begins[number] < self.fade:
            number -= 1
        seam = begins[number + 1] if number + 1 < len(begins) else math.inf
        if time <= seam - self.fade:
            return self._of(number, moment)
        share = (time - seam + self.fade) / (2 * self.fade)
        return Fading(moment, self._of(number, moment), self._of(number + 1, moment), share)

    def _of(self, number: int, moment: Moment) -> GaussiansSnapshot:
        window = self.windows[number]
        snapshot = window.gaussians.at(replace(moment, time=window.time(moment.time)))
        return replace(snapshot, moment=moment)

    def ellipsoids(self, time: float) -> Ellipsoids:
        """Return the Gaussians of the window that a time of the film is of; of each window others."""
        window = self.windows[self.number(time)]
        return window.gaussians.ellipsoids(window.time(time))


def with_shared(own: MovingGaussians, still: MovingGaussians) -> MovingGaussians:
    """Return Gaussians, and after them others that stand ``still``, of as many coefficients."""
    names = [name for name in ROWS if getattr(own, name) is not None]
    parts = {name: torch.cat([getattr(own, name), getattr(still, name)]) for name in names}
    motion = own.motion
    if motion is not None:
        none = motion.weights.new_zeros(len(still.means), motion.weights.shape[1])
        links, weights = torch.cat([motion.links, none.to(motion.links)]), torch.cat([motion.weights, none])
        motion = replace(motion, links=links, weights=weights)
    return replace(own, **parts, motion=motion)


def taken(gaussians: MovingGaussians, rows: Tensor | slice) -> MovingGaussians:
    """Return some rows of Gaussians, which follow no nodes."""
    names = [name for name in ROWS if getattr(gaussians, name) is not None]
    return replace(gaussians, **{name: getattr(gaussians, name)[rows] for name in names}, motion=None)


def check_windows(begins: Sequence[float], spans: Sequence[Sequence[float]], fade: float) -> None:
    """Refuse windows that do not follow one another, or do not reach as far as they are shown.

    Raises:
        ValueError: saying what is expected.
    """
    ends = [*begins[1:], 1.0]
    rise = begins[0] == 0 and all(end - begin >= 2 * fade - _NEXT for begin, end in zip(begins, ends))
    rise = rise and all(begin < end for begin, end in zip(begins, ends))
    shown = [(max(begin - fade, 0.0), min(end + fade, 1.0)) for begin, end in zip(begins, ends)]
    within = all(a - _NEXT <= begin and end <= b + _NEXT for (a, b), (begin, end) in zip(spans, shown))
    if not rise or not within:
        wanted = "windows that begin at 0 and follow one another, each shown within its span"
        came = ", ".join(f"{begin:g} in [{a:g}, {b:g}]" for begin, (a, b) in zip(begins, spans))
        raise ValueError(f"windows: expected {wanted}, but got {came[:200]}")


def longest_fade(begins: Sequence[float], spans: Sequence[Sequence[float]]) -> float:
    """Return for how long before and after a seam both windows are known, at most half of a window.

    >>> longest_fade([0.0, 0.5], [(0.0, 0.6), (0.45, 1.0)])
    0.05
    """
    ends = [*begins[1:], 1.0]
    most = [0.5 * (end - begin) for begin, end in zip(begins, ends)]
    most += [begin - a for begin, (a, _) in zip(begins[1:], spans[1:])]
    most += [b - end for end, (_, b) in zip(ends[:-1], spans[:-1])]
    return max(round(min(most), 6), 0.0)
