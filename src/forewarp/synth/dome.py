"""The vehicle in a studio, filmed by a cylinder of 20 cameras of two image sizes, in the NHR layout."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from forewarp.data.files import whole
from forewarp.data.nhr import DomeFrame, write_scene
from forewarp.scene.camera import Camera, look_at
from forewarp.synth.arguments import check_motion, check_numbers, check_workers
from forewarp.synth.cameras import centers_of, stream
from forewarp.synth.film import Exposure, Film, ImageSpec
from forewarp.synth.points import surface_points, trajectories
from forewarp.synth.raycast import Hits, Posed, light_points
from forewarp.synth.scenes import writing_to
from forewarp.synth.world import World

POINTS = 4000
CAMERAS, RADIUS, HEIGHTS = 20, 3.7, (0.55, 1.6)
TARGET = (0.0, 0.0, -0.05)
VIEW_ANGLE = 36.0  # vertical field of view, degrees: the whole scene fits, with a margin
STUDIO = (0.38, 0.50, 0.42)  # colour of the backdrop; a trace of it shows at the rim of cut-outs
_LENSES, _POINTS, _CLOUDS = 0, 1, 2
_CLOUD_LIGHTS = 24


def synthesize(
    folder: str | Path,
    *,
    size: int = 240,
    frames: int = 20,
    seed: int = 0,
    motion: str = "lift_tilt",
    points: int = 2000,
    samples_per_pixel: int = 4,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a dome's recording into ``folder`` and return that folder.

    20 cameras stand on a cylinder, alternately low and high; by fours their images are ``size`` by 5/6 of it,
    or 5/6 by 5/8. All take a picture at each of ``frames`` times, evenly spaced over [0, 1]. Every frame has
    masks and a coloured cloud of visible points. Trajectories hold all times, 0 first. Equal
    arguments give equal files; ``seed`` draws lenses and points.

    Args:
        folder: folder of the recording; an existing one is replaced.
        size: pixels across of the larger images, a multiple of 24.
        motion: one of ``motions.MOTIONS``.
        points: number of points in the cloud of each frame.
        samples_per_pixel: rays averaged into a pixel.
        workers, progress: see ``film.Film``.

    Raises:
        SceneError: for a bad argument or folder; ImportError: without ``forewarp[synth]``.
    """
    whole(size, "size", 24, multiple=24)
    check_numbers(frames=(frames, 2), seed=(seed, 0), points=(points, 1))
    check_numbers(samples_per_pixel=(samples_per_pixel, 1))
    check_motion(motion)
    check_workers(workers)
    world, times, cameras = World(motion), np.linspace(0, 1, frames), dome_cameras(size, seed)
    centers = centers_of(cameras)
    truth = trajectories(world, *surface_points(world, POINTS, centers, stream(seed, _POINTS)), times)
    with (
        Film(Exposure(samples_per_pixel), cameras * frames, workers, progress) as film,
        writing_to(folder) as place,
    ):
        clouds = (cloud(world, t, points, centers, stream(seed, _CLOUDS, f)) for f, t in enumerate(times))
        write_scene(place, cameras, _frames(film, world, times, cameras, clouds), trajectories=truth)
    return Path(folder)


def dome_cameras(size: int, seed: int) -> list[Camera]:
    """Make the cameras; their lenses differ slightly."""
    rng, cameras = stream(seed, _LENSES), []
    for k in range(CAMERAS):
        azimuth, height = 2 * math.pi * k / CAMERAS, HEIGHTS[k % 2]
        center = torch.tensor([RADIUS * math.cos(azimuth), RADIUS * math.sin(azimuth), height])
        large = k % 8 < 4
        width, rows = (size, size * 5 // 6) if large else (size * 5 // 6, size * 5 // 8)
        focal = rng.uniform(0.98, 1.02, 2) * 0.5 * rows / math.tan(0.5 * math.radians(VIEW_ANGLE))
        cx, cy = (0.5 + rng.uniform(-0.01, 0.01, 2)) * (width, rows)
        pose = look_at(center, torch.tensor(TARGET), torch.tensor([0.0, 0.0, 1.0]))
        near, far = RADIUS - 1.6, RADIUS + 2.2
        cameras.append(Camera(width, rows, *map(float, (*focal, cx, cy)), pose, near, far))
    return cameras


def cloud(world: World, time: float, count: int, centers: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw points (N, 6) float32 that are visible at ``time``: x y z in world units, lit r g b, 0-255."""
    face, barycentric = surface_points(world, count, centers, rng, time)
    hits = Hits(np.arange(len(face)), face, barycentric, np.zeros(len(face)))
    color = Posed(world, time).color(hits, light_points(_CLOUD_LIGHTS))
    return np.concatenate([world.points(face, barycentric, time), 255 * color], -1).astype(np.float32)


def _frames(film: Film, world: World, times, cameras: list[Camera], clouds) -> Iterator[DomeFrame]:
    views = [ImageSpec("", float(time), camera) for time in times for camera in cameras]
    pictures = film.pictures(world, views)
    for points in clouds:
        rgba = [next(pictures)[0] for _ in cameras]
        yield DomeFrame([_in_studio(one) for one in rgba], [one[..., 3] for one in rgba], points)


def _in_studio(rgba: np.ndarray) -> np.ndarray:
    """Composite a picture uint8 (H, W, 4) over the backdrop: uint8 (H, W, 3)."""
    alpha = rgba[..., 3:] / 255
    return np.rint(alpha * rgba[..., :3] + (1 - alpha) * 255 * np.array(STUDIO)).astype(np.uint8)
