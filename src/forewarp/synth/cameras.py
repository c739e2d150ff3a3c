"""Cameras on a sphere around the scene, as in D-NeRF, and streams of random numbers."""

from __future__ import annotations

import math

import numpy as np
import torch

from forewarp.scene.camera import Camera, look_at

CAMERA_RADIUS, CAMERA_ANGLE_X = 4.0311, 0.6911112
# Least and greatest sine of the elevation: neither along the slab nor straight from above.
ELEVATION = (0.06, 0.96)


def orbit_camera(azimuth: float, sine: float, size: int) -> Camera:
    """Place a square camera on the sphere, looking at the origin, z upwards.

    Args:
        azimuth: radians from x towards y.
        sine: sine of the elevation above the ground.
        size: width and height in pixels.
    """
    level = math.sqrt(1 - sine * sine)
    center = CAMERA_RADIUS * torch.tensor(
        [level * math.cos(azimuth), level * math.sin(azimuth), sine], dtype=torch.float64
    )
    pose = look_at(center, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    focal = 0.5 * size / math.tan(0.5 * CAMERA_ANGLE_X)
    return Camera(size, size, focal, focal, size / 2, size / 2, pose, 2.0, 6.0)


def random_cameras(
    count: int,
    size: int,
    rng: np.random.Generator,
    azimuth: tuple[float, float] = (0.0, 360.0),
    rise: tuple[float, float] = ELEVATION,
) -> list[Camera]:
    """Draw cameras uniformly by area on the upper half of the sphere, or a part of it.

    Args:
        azimuth: least and greatest azimuth, degrees.
        rise: least and greatest sine of the elevation.
    """
    azimuth = rng.uniform(*np.radians(azimuth), count)
    sine = rng.uniform(*rise, count)
    return [orbit_camera(float(a), float(s), size) for a, s in zip(azimuth, sine)]


def centers_of(cameras: list[Camera]) -> np.ndarray:
    """Stack the cameras' centres (C, 3) float64, world units."""
    return np.stack([np.asarray(camera.center) for camera in cameras])


def stream(seed: int, *number: int) -> np.random.Generator:
    """Start a random stream for one purpose; drawing from one stream leaves the others unchanged."""
    return np.random.default_rng([seed, *number])
