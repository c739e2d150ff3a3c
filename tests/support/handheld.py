"""Films a textured scene of ``synth`` as a hand would: an arc with sway and tremor, and a lens."""

import math
from dataclasses import dataclass

import numpy as np
import torch

from forewarp.scene.camera import Camera, Lens, look_at
from forewarp.synth.raycast import render_all
from forewarp.synth.world import World


@dataclass(frozen=True)
class Walk:
    """An arc from azimuth to azimuth (degrees) at ``radius`` around ``focus``, ``angle`` degrees wide."""

    motion: str
    has_room: bool
    azimuth: tuple[float, float]
    radius: float
    height: float  # degrees above the ground
    focus: tuple[float, float, float]
    angle: float


WALKS = {
    "room": Walk("lift_tilt", True, (-125.0, -55.0), 3.0, 20.0, (0.0, 0.0, -0.08), 62.0),
    "corner": Walk("room", False, (22.0, 68.0), 3.6, 22.0, (-0.1, -0.1, -0.1), 56.0),
}
PHONE = Lens((0.05, -0.04, 0.0), (0.001, -0.0015))


def _sway(rng, times, seconds, rates, size):
    """Sums of sines (N, 3): slow sway and a small tremor, as of a hand."""
    total = np.zeros((len(times), 3))
    for rate, weight in rates:
        phase, jitter = rng.uniform(0, 2 * np.pi, 3), rng.uniform(0.8, 1.25, 3)
        total += weight * np.sin(2 * np.pi * rate * jitter * seconds * times[:, None] + phase)
    return size * total


def cameras_of(walk: Walk, times, seconds: float, size=(640, 480), seed: int = 0) -> list[Camera]:
    """One camera for each of ``times`` in [0, 1]; ``size`` is (width, height)."""
    rng, made = np.random.default_rng(seed), []
    times = np.asarray(times, dtype=np.float64)
    at = _sway(rng, times, seconds, ((0.35, 1.0), (1.1, 0.4), (7.0, 0.04)), 0.012 * walk.radius)
    aim = _sway(rng, times, seconds, ((0.4, 1.0), (1.3, 0.5), (8.0, 0.05)), 0.02 * walk.radius)
    roll = _sway(rng, times, seconds, ((0.5, 1.0), (6.0, 0.1)), 2.0)[:, 0]
    width, height = size
    fx = 0.5 * width / math.tan(0.5 * math.radians(walk.angle))
    for time, move, look, turn in zip(times, at, aim, roll):
        azimuth = math.radians(walk.azimuth[0] + (walk.azimuth[1] - walk.azimuth[0]) * time)
        rise = math.radians(walk.height + 4 * math.sin(2 * np.pi * time))
        level = math.cos(rise)
        way = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(rise)])
        center = np.array(walk.focus) + walk.radius * way + move
        up = torch.tensor(
            [
                math.sin(math.radians(turn)) * -math.sin(azimuth),
                math.sin(math.radians(turn)) * math.cos(azimuth),
                1.0,
            ]
        )
        pose = look_at(torch.from_numpy(center), torch.from_numpy(np.array(walk.focus) + look), up)
        made.append(Camera(width, height, fx, fx, width / 2, height / 2, pose, 0.1, 20.0, lens=PHONE))
    return made


def pictures_of(walk: Walk, times, cameras, *, samples: int = 2, workers=None, progress=None):
    """Yield uint8 pictures (H, W, 3), one for each camera; what is behind everything is white."""
    world = World(walk.motion, has_room=walk.has_room)
    views = [(world, float(time), camera) for time, camera in zip(times, cameras)]
    for rgba, _ in render_all(views, samples, workers, progress, shadow_rays=1):
        yield rgba[..., :3]


def smeared(picture: np.ndarray, length: int) -> np.ndarray:
    """The mean of ``length`` copies of (H, W, 3), each a pixel further right: a shaken frame."""
    moved = [
        np.roll(picture, shift, 1).astype(np.float32) for shift in range(-(length // 2), length - length // 2)
    ]
    return np.mean(moved, 0).round().astype(np.uint8)
