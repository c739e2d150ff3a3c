"""Whole scenes: cameras on a sphere, pictures, depth and trajectories, written in D-NeRF's layout."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from forewarp.data.dnerf import ABILITIES, Shot, write_scene
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Truth
from forewarp.synth.motions import MOTIONS
from forewarp.synth.points import surface_points, trajectories
from forewarp.synth.raycast import render
from forewarp.synth.vehicle import World

CAMERA_RADIUS, CAMERA_ANGLE_X = 4.0311, 0.6911112
POINTS, POINT_VIEWS = 4000, 30
# Sine of the elevation: neither along the slab nor straight from above.
_ELEVATION = (0.06, 0.96)

View = tuple[str, float, Camera, str]  # name, time, camera, ability


def synthesize(
    folder: str | Path,
    *,
    size: int = 100,
    frames: int = 50,
    seed: int = 0,
    motion: str = "lift_tilt",
    test_views: tuple[int, int, int] = (10, 10, 10),
    val_views: int = 10,
    samples_per_pixel: int = 4,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a moving scene with its exact truth into ``folder`` and return that folder.

    The vehicle is always the same; ``seed`` draws the cameras and the trajectories' points. Equal arguments
    give equal files, byte by byte. ``frames`` training images stand at times spread evenly over [0, 1], one
    camera each. Test images, with depth, are new views at training times, at times midway, and at the
    canonical time 0: ``test_views`` counts (space, time, canonical). Trajectories hold all those times.

    Args:
        folder: the scene's own; a scene already there is replaced.
        size: width and height in pixels, at least 8.
        motion: one of ``motions.MOTIONS``.
        samples_per_pixel: rays averaged into a pixel.
        progress: called with (images done, all images) after each image.

    Raises:
        SceneError: for a bad argument or folder; ImportError: without ``forewarp[synth]``.

    **Cost** about size^2 * samples_per_pixel * 7 rays an image, a million or two a second on one core.
    """
    _check(motion, test_views, size=(size, 8), frames=(frames, 2), seed=(seed, 0), val_views=(val_views, 0))
    _check_whole("samples_per_pixel", samples_per_pixel, 1)
    world, times = World(motion), np.linspace(0, 1, 2 * frames - 1)
    centers = np.stack([np.asarray(c.center) for c in random_cameras(POINT_VIEWS, 8, _rng(seed, 9))])
    truth = trajectories(world, *surface_points(world, POINTS, centers, _rng(seed, 10)), times)
    splits = _views(size, times, seed, test_views, val_views)
    count = _Counter(progress, sum(len(views) for views in splits.values()))
    shots = {split: _shots(world, views, samples_per_pixel, count) for split, views in splits.items()}
    return _write(Path(folder), shots, truth)


def orbit_camera(azimuth: float, sine: float, size: int) -> Camera:
    """A square camera on the sphere that looks at the origin, z upwards.

    Args:
        azimuth: radians from x towards y.
        sine: of the elevation above the ground.
        size: pixels.
    """
    level = math.sqrt(1 - sine * sine)
    center = CAMERA_RADIUS * torch.tensor(
        [level * math.cos(azimuth), level * math.sin(azimuth), sine], dtype=torch.float64
    )
    pose = look_at(center, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    focal = 0.5 * size / math.tan(0.5 * CAMERA_ANGLE_X)
    return Camera(size, size, focal, focal, size / 2, size / 2, pose, 2.0, 6.0)


def random_cameras(count: int, size: int, rng: np.random.Generator) -> list[Camera]:
    """Cameras spread evenly by area over the upper half of the sphere."""
    azimuth = rng.uniform(0, 2 * np.pi, count)
    sine = rng.uniform(*_ELEVATION, count)
    return [orbit_camera(float(a), float(s), size) for a, s in zip(azimuth, sine)]


def _views(size: int, times: np.ndarray, seed: int, test_views, val_views: int) -> dict[str, list[View]]:
    """Every view to render by split; ``times`` are training and between times in turn."""
    train, between = times[::2], times[1::2]

    def views(stream: int, chosen: np.ndarray, ability: str = "all") -> list[View]:
        cameras = random_cameras(len(chosen), size, _rng(seed, stream))
        return [(f"r_{i:03d}", float(t), c, ability) for i, (t, c) in enumerate(zip(chosen, cameras))]

    chosen = (_spread(train, test_views[0]), _spread(between, test_views[1]), np.zeros(test_views[2]))
    test = [view for i in range(3) for view in views(2 + i, chosen[i], ABILITIES[i])]
    return {"train": views(0, train), "val": views(1, _spread(train, val_views)), "test": test}


def _spread(times: np.ndarray, count: int) -> np.ndarray:
    """``count`` of the times, the first and the last among them where there are two or more."""
    return times[np.rint(np.linspace(0, len(times) - 1, count)).astype(np.int64)]


def _shots(world: World, views: list[View], samples_per_pixel: int, count: _Counter) -> Iterator[Shot]:
    for name, time, camera, ability in views:
        rgba, depth = render(world, time, camera, samples_per_pixel)
        yield Shot(name, time, camera.camera_to_world, rgba, None if ability == "all" else depth, ability)
        count()


class _Counter:
    """Tells ``progress`` after each image."""

    def __init__(self, progress: Callable[[int, int], None] | None, total: int):
        self.progress, self.done, self.total = progress, 0, total

    def __call__(self) -> None:
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.total)


def _rng(seed: int, stream: int) -> np.random.Generator:
    """One stream of random numbers for each purpose, so that a count changed in one moves no other."""
    return np.random.default_rng([seed, stream])


def _write(folder: Path, shots: dict[str, Iterator[Shot]], truth: Truth) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_scene(folder, shots, camera_angle_x=CAMERA_ANGLE_X, trajectories=truth)
    except OSError as error:
        reason = error.strerror or error
        raise SceneError(f"{folder}: expected a folder to write to, but got {reason}; set folder") from error
    return folder


def _check(motion: str, test_views, **numbers: tuple[int, int]) -> None:
    """Refuse bad arguments; ``numbers`` are (value, least) by name."""
    for name, (value, least) in numbers.items():
        _check_whole(name, value, least)
    if motion not in MOTIONS:
        raise SceneError(f"motion: expected one of {', '.join(MOTIONS)}, but got {motion!r}; set motion")
    expected = "test_views: expected three numbers (space, time, canonical), not all 0"
    try:
        counts = [_check_whole("test_views", n, 0) for n in test_views]
    except TypeError:
        counts = []
    if len(counts) != 3 or not any(counts):
        raise SceneError(f"{expected}, but got {test_views!r}; set test_views")


def _check_whole(name: str, value, least: int) -> int:
    try:
        good = operator.index(value) >= least and not isinstance(value, bool)
    except TypeError:
        good = False
    if not good:
        raise SceneError(
            f"{name}: expected a whole number of at least {least}, but got {value!r}; set {name}"
        )
    return value
