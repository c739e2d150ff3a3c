"""Scenes in D-NeRF's layout: one of cameras on a sphere, and a counterpart of the Lego Complete data.

Lego Complete has three scenes of one vehicle with three kinds of test view each. The authors' files are not
available: numbers and kinds of views are as published, vehicle and motions ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from forewarp.data.dnerf import ABILITIES, Shot, write_scene
from forewarp.data.files import SceneError, whole
from forewarp.scene.camera import Camera, look_at
from forewarp.synth.raycast import render_all, surface_points
from forewarp.synth.vehicle import MOTIONS
from forewarp.synth.world import ELEVATION, SUBJECTS, World

CAMERA_RADIUS, CAMERA_ANGLE_X = 4.0311, 0.6911112
POINTS, POINT_VIEWS = 4000, 30
# Streams of random numbers: the cameras of each split, then the points.
_TRAIN, _VAL, _TEST, _POINT_VIEWS, _POINTS = 0, 1, 2, 9, 10
# Half of a single scene's samples: costs one grey level at this size and saves a quarter of the time.
_LEGO_SHADOW_RAYS = 3


class ImageSpec(NamedTuple):
    """An image to render: at ``time`` in [0, 1] by ``camera``; ``ability`` as in ``scene.Frame``."""

    name: str
    time: float
    camera: Camera
    ability: str


Views = dict[str, list[ImageSpec]]  # by split
Times = np.ndarray  # (T,) in [0, 1]


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
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a moving scene with its exact truth into ``folder`` and return that folder.

    The vehicle is always the same; ``seed`` draws the cameras and the trajectories' points. Equal arguments
    give equal files, byte by byte. ``frames`` training images are evenly spaced over the times [0, 1], one
    camera each. Test images, with depth, are new views at training times, at times midway, and at the
    canonical time 0: ``test_views`` counts (space, time, canonical). Trajectories hold all those times.

    Args:
        folder: folder of the scene; an existing one is replaced.
        size: width and height in pixels, at least 8.
        motion: one of ``vehicle.MOTIONS``, or of ``world.SPECIMENS``, which replaces the vehicle.
        samples_per_pixel: rays averaged into a pixel.
        workers, progress: see ``raycast.render_all``.

    Raises:
        SceneError: for a bad argument; ImportError: without ``forewarp[synth]``.

    **Cost** about size^2 * samples_per_pixel * 7 rays an image, at one to two million a second on one core.
    """
    check_numbers(samples_per_pixel, workers, size=(size, 8), frames=(frames, 2), seed=(seed, 0))
    whole(val_views, "val_views", 0)
    check_motion(motion, SUBJECTS)
    check_views(test_views, "space, time, canonical")
    times = np.linspace(0, 1, 2 * frames - 1)
    train, between = times[::2], times[1::2]
    test = spread_over(train, test_views[0]), spread_over(between, test_views[1]), np.zeros(test_views[2])
    views = views_at(motion, (seed,), size, train, spread_over(train, val_views), test)
    rendering = {"samples": samples_per_pixel, "workers": workers, "progress": progress}
    write_worlds({Path(folder): (World(motion), views, (seed,))}, times, **rendering)
    return Path(folder)


def synthesize_lego_complete(
    folder: str | Path,
    *,
    size: int = 400,
    frames: int = 50,
    seed: int = 0,
    motions: Sequence[str] = ("lift", "lift_tilt", "drive"),
    test_views: tuple[int, int, int] = (4, 4, 50),
    val_views: int = 10,
    samples_per_pixel: int = 4,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write one scene per motion into ``folder/<motion>``; return ``folder``.

    ``frames`` training images, each from a random camera, are evenly spaced over the times [0, 1]. Test
    images have exact ray depth. The default counts are the published ones: 4 * 50 views at training times,
    one at each of 4 * 49 + 1 equally spaced times, 50 at the canonical time 0. Trajectories hold all times.

    Args:
        folder: parent folder of the scenes; existing ones are replaced.
        size: width and height in pixels, at least 8.
        motions: names in ``vehicle.MOTIONS``: lift; lift_tilt, where band and ball move too;
            drive, driving and turning while the arm moves.
        test_views: views at each training time; steps from one training time to the next; canonical views.
        val_views: validation views, at training times.
        samples_per_pixel: rays averaged into a pixel.
        workers, progress: see ``raycast.render_all``.

    Raises:
        SceneError: for a bad argument; ImportError: without ``forewarp[synth]``.

    **Cost** a quarter of a second an image of 400 x 400 on one core: at the defaults 1521 of them and 0.9 GB.
    """
    if isinstance(motions, str) or not isinstance(motions, Sequence) or not motions:
        expected = f"a list of {', '.join(MOTIONS)}"
        raise SceneError(f"motions: expected {expected}, but got {motions!r}; set motions")
    for motion in motions:
        check_motion(motion, name="motions")
    if len(set(motions)) < len(motions):
        raise SceneError(f"motions: expected each once, but got {list(motions)}; set motions")
    check_views(test_views, "views a training time, steps between training times, canonical views")
    check_numbers(samples_per_pixel, workers, size=(size, 8), frames=(frames, 2), seed=(seed, 0))
    whole(val_views, "val_views", 0)
    steps = max(test_views[1], 1)
    times = np.linspace(0, 1, steps * (frames - 1) + 1)
    train, between = times[::steps], times if test_views[1] else times[:0]
    test, val = [np.repeat(train, test_views[0]), between], spread_over(train, val_views)
    test.append(np.zeros(test_views[2]))
    worlds = {}
    for motion in motions:
        # A motion's own streams, so that the scenes are seen from different places.
        stream = (seed, 100 + list(MOTIONS).index(motion))
        views = views_at(motion, stream, size, train, val, test)
        worlds[Path(folder) / motion] = World(motion), views, stream
    rendering = {"samples": samples_per_pixel, "workers": workers, "progress": progress}
    write_worlds(worlds, times, **rendering, shadow_rays=_LEGO_SHADOW_RAYS)
    return Path(folder)


def views_at(
    motion: str, stream: Sequence[int], size: int, train: Times, val: Times, test: Sequence[Times]
) -> Views:
    """Draw a random view at each of these times, from the part of the sphere that the subject allows;
    ``test`` has the times of (space, time, canonical).
    """
    subject = SUBJECTS[motion]

    def views(number: int, times: np.ndarray, ability: str = "all") -> list[ImageSpec]:
        rng = np.random.default_rng([*stream, number])
        cameras = random_cameras(len(times), size, rng, subject.azimuth, subject.rise)
        return [ImageSpec(f"r_{i:03d}", float(t), c, ability) for i, (t, c) in enumerate(zip(times, cameras))]

    kinds = [view for i, times in enumerate(test) for view in views(_TEST + i, times, ABILITIES[i])]
    return {"train": views(_TRAIN, train), "val": views(_VAL, val), "test": kinds}


def spread_over(times: np.ndarray, count: int) -> np.ndarray:
    """Choose ``count`` evenly spaced times, including the first and the last if ``count`` is 2 or more."""
    return times[np.rint(np.linspace(0, len(times) - 1, count)).astype(np.int64)]


def write_worlds(
    worlds: Mapping[Path, tuple[World, Views, Sequence[int]]], times: np.ndarray, **rendering
) -> None:
    """Write views of worlds with trajectories at ``times``, the first of them canonical.

    Args:
        worlds: world, views and random stream of each scene's folder.
        times: (T,) in [0, 1].
        rendering: arguments of ``raycast.render_all``.
    """
    splits = [(world, split) for world, views, _ in worlds.values() for split in views.values()]
    to_render = [(world, view.time, view.camera) for world, split in splits for view in split]
    with closing(render_all(to_render, **rendering)) as images:
        for folder, (world, views, stream) in worlds.items():
            seen_from = random_cameras(POINT_VIEWS, 8, np.random.default_rng([*stream, _POINT_VIEWS]))
            points = surface_points(world, POINTS, seen_from, np.random.default_rng([*stream, _POINTS]))
            shots = {split: _shots(images, of_split) for split, of_split in views.items()}
            truth = world.trajectories(*points, times)
            write_scene(folder, shots, camera_angle_x=CAMERA_ANGLE_X, trajectories=truth)


def _shots(images: Iterator[tuple[np.ndarray, np.ndarray]], views: list[ImageSpec]) -> Iterator[Shot]:
    for view, (rgba, depth) in zip(views, images):
        known = None if view.ability == "all" else depth
        yield Shot(view.name, view.time, view.camera.camera_to_world, rgba, known, view.ability)


def orbit_camera(azimuth: float, sine: float, size: int) -> Camera:
    """Place a square camera on D-NeRF's sphere around the scene, looking at the origin, z upwards.

    Args:
        azimuth: radians from x towards y.
        sine: sine of the elevation above the ground.
        size: width and height in pixels.
    """
    level = math.sqrt(1 - sine * sine)
    direction = np.array([level * math.cos(azimuth), level * math.sin(azimuth), sine])
    pose = look_at(torch.from_numpy(CAMERA_RADIUS * direction), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
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
    angles, sines = rng.uniform(*np.radians(azimuth), count), rng.uniform(*rise, count)
    return [orbit_camera(float(angle), float(sine), size) for angle, sine in zip(angles, sines)]


def check_numbers(samples_per_pixel: int, workers: int | None, **numbers: tuple[int, int]) -> None:
    """Check what all scenes have, and whole numbers given as (value, least) by name."""
    whole(samples_per_pixel, "samples_per_pixel", 1)
    whole(1 if workers is None else workers, "workers", 1)
    for name, (value, least) in numbers.items():
        whole(value, name, least)


def check_motion(motion: str, among: Collection[str] = MOTIONS, name: str = "motion") -> None:
    """Check that a motion has one of the names ``among``; ``name`` is the key to set."""
    if not isinstance(motion, str) or motion not in among:
        raise SceneError(f"{name}: expected one of {', '.join(among)}, but got {motion!r}; set {name}")


def check_views(counts: Sequence[int], meaning: str) -> None:
    """Check the three counts of ``test_views``, not all of them 0; ``meaning`` says what they count."""
    is_three = isinstance(counts, Sequence) and len(counts) == 3
    if not is_three or not any([whole(count, "test_views", 0) for count in counts]):
        expected = f"three numbers ({meaning}), not all 0"
        raise SceneError(f"test_views: expected {expected}, but got {counts!r}; set test_views")
