"""Hand-held cameras that are carried along an arc."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from forewarp.scene.camera import Camera, Lens, look_at

NEAR, FAR = 0.1, 20.0


@dataclass(frozen=True)
class Walk:
    """An arc from azimuth to azimuth (degrees) at ``radius`` around ``focus``, by a camera ``angle`` degrees
    wide; ``height`` is degrees above the ground.
    """

    azimuth: tuple[float, float]
    radius: float
    height: float
    focus: tuple[float, float, float]
    angle: float
    lens: Lens | None = None


def cameras_of(
    walk: Walk, times: Sequence[float], seconds: float, size: tuple[int, int] = (640, 480), seed: int = 0
) -> list[Camera]:
    """Return the camera of a walk at ``times`` in [0, 1], which sways slowly and trembles a little.

    Args:
        seconds: between the times 0 and 1.
        size: (width, height).
        seed: draws the sway; equal seeds sway alike, whatever the times.
    """
    rng, made = np.random.default_rng(seed), []
    times = np.asarray(times, dtype=np.float64)
    at = _sway(rng, times, seconds, ((0.35, 1.0), (1.1, 0.4), (7.0, 0.04)), 0.012 * walk.radius)
    aim = _sway(rng, times, seconds, ((0.4, 1.0), (1.3, 0.5), (8.0, 0.05)), 0.02 * walk.radius)
    roll = _sway(rng, times, seconds, ((0.5, 1.0), (6.0, 0.1)), 2.0)[:, 0]
    for time, move, look, turn in zip(times, at, aim, roll):
        azimuth = math.radians(walk.azimuth[0] + (walk.azimuth[1] - walk.azimuth[0]) * time)
        rise = math.radians(walk.height + 4 * math.sin(2 * np.pi * time))
        center = np.array(walk.focus) + walk.radius * direction(azimuth, rise) + move
        aslant = math.sin(math.radians(turn))
        up = torch.tensor([aslant * -math.sin(azimuth), aslant * math.cos(azimuth), 1.0])
        pose = look_at(center, np.array(walk.focus) + look, up)
        made.append(pinhole(pose, size, walk.angle, NEAR, FAR, lens=walk.lens))
    return made


def pinhole(
    pose: Tensor, size: Sequence[int], angle: float, near: float, far: float, *, zoom: float = 1.0, lens=None
) -> Camera:
    """Make a camera of ``size`` (width, height), ``angle`` degrees wide; a ``zoom`` above 1 sees less."""
    width, height = size
    focal = zoom * 0.5 * width / math.tan(0.5 * math.radians(angle))
    return Camera(width, height, focal, focal, width / 2, height / 2, pose, near, far, lens=lens)


def direction(azimuth: float, rise: float) -> np.ndarray:
    """Return the unit vector (3,) of an azimuth from x towards y and a rise above the ground, radians."""
    level = math.cos(rise)
    return np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(rise)])


def _sway(rng: np.random.Generator, times: np.ndarray, seconds: float, rates, size: float) -> np.ndarray:
    """Sum sines (N, 3), each of a rate in hertz and a weight."""
    total = np.zeros((len(times), 3))
    for rate, weight in rates:
        phase, jitter = rng.uniform(0, 2 * np.pi, 3), rng.uniform(0.8, 1.25, 3)
        total += weight * np.sin(2 * np.pi * rate * jitter * seconds * times[:, None] + phase)
    return size * total
