"""Scenes in D-NeRF's layout: one of cameras on a sphere, and a counterpart of the Lego Complete data.

Lego Complete has three scenes of one vehicle with three kinds of test view each. The authors' files are not
available: numbers and kinds of views are as published, vehicle and motions ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from forewarp.data.dnerf import ABILITIES, Shot, write_scene
from forewarp.data.files import SceneError, whole
from forewarp.scene.camera import Camera, look_at
from forewarp.synth.film import Exposure, Film, ImageSpec
from forewarp.synth.raycast import surface_points, trajectories
from forewarp.synth.vehicle import MOTIONS
from forewarp.synth.world import ELEVATION, SPECIMENS, Specimen, World


def check_numbers(**numbers: tuple[int, int]) -> None:
    """Check whole numbers against their least value; ``numbers`` are (value, least) by name."""
    for name, (value, least) in numbers.items():
        whole(value, name, least)


def check_workers(workers: int | None) -> None:
    """Check a number of processes: None or at least 1."""
    if workers is not None:
        whole(workers, "workers", 1)


def check_motion(motion: str, name: str = "motion", *, specimens: bool = False) -> None:
    """Check that a motion is one of ``motions.MOTIONS`` or, if allowed, of ``SPECIMENS``."""
    known = [*MOTIONS, *(SPECIMENS if specimens else ())]
    if not isinstance(motion, str) or motion not in known:
        raise SceneError(f"{name}: expected one of {', '.join(known)}, but got {motion!r}; set {name}")


def check_counts(name: str, counts: Sequence[int], meaning: str) -> None:
    """Check three counts, not all of them 0; ``meaning`` says what they count."""
    try:
        good = [whole(n, name, 0) for n in counts]
    except TypeError:
        good = []
    if len(good) != 3 or not any(good):
        raise SceneError(
            f"{name}: expected three numbers ({meaning}), not all 0, but got {counts!r}; set {name}"
        )


CAMERA_RADIUS, CAMERA_ANGLE_X = 4.0311, 0.6911112


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


POINTS, POINT_VIEWS = 4000, 30
# Seeds of the random streams: the cameras of each split, then the points.
_TRAIN, _VAL, _TEST, _POINT_VIEWS, _POINTS = 0, 1, 2, 9, 10

Views = dict[str, list[ImageSpec]]  # by split


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
        motion: one of ``motions.MOTIONS``, or of ``specimens.SPECIMENS``, which replaces the vehicle.
        samples_per_pixel: rays averaged into a pixel.
        workers, progress: see ``film.Film``.

    Raises:
        SceneError: for a bad argument or folder; ImportError: without ``forewarp[synth]``.

    **Cost** about size^2 * samples_per_pixel * 7 rays an image, at one to two million a second on one core.
    """
    check_numbers(size=(size, 8), frames=(frames, 2), seed=(seed, 0), val_views=(val_views, 0))
    check_motion(motion, specimens=True)
    check_counts("test_views", test_views, "space, time, canonical")
    check_numbers(samples_per_pixel=(samples_per_pixel, 1))
    check_workers(workers)
    times = np.linspace(0, 1, 2 * frames - 1)
    train, between = times[::2], times[1::2]
    test = chosen(train, test_views[0]), chosen(between, test_views[1]), np.zeros(test_views[2])
    views = views_at((seed,), size, train, chosen(train, val_views), test, SPECIMENS.get(motion))
    cameras = [view.camera for split in views.values() for view in split]
    with Film(Exposure(samples_per_pixel), cameras, workers, progress) as film:
        write_world(folder, World(motion), views, times, film, (seed,))
    return Path(folder)


def views_at(
    seed: tuple[int, ...],
    size: int,
    train: np.ndarray,
    val: np.ndarray,
    test: Sequence[np.ndarray],
    specimen: Specimen | None = None,
) -> Views:
    """Draw a random view at each of these times, from the part of the sphere that a ``specimen`` allows;
    ``test`` has the times of (space, time, canonical).
    """
    where = {} if specimen is None else {"azimuth": specimen.azimuth, "rise": specimen.rise}

    def views(number: int, times: np.ndarray, ability: str = "all") -> list[ImageSpec]:
        cameras = random_cameras(len(times), size, stream(*seed, number), **where)
        return [ImageSpec(f"r_{i:03d}", float(t), c, ability) for i, (t, c) in enumerate(zip(times, cameras))]

    kinds = [view for i, times in enumerate(test) for view in views(_TEST + i, times, ABILITIES[i])]
    return {"train": views(_TRAIN, train), "val": views(_VAL, val), "test": kinds}


def chosen(times: np.ndarray, count: int) -> np.ndarray:
    """Choose ``count`` evenly spaced times, including the first and the last if ``count`` is 2 or more."""
    return times[np.rint(np.linspace(0, len(times) - 1, count)).astype(np.int64)]


def write_world(
    folder: str | Path, world: World, views: Views, times: np.ndarray, film: Film, seed: tuple[int, ...]
) -> None:
    """Write views of a world with its trajectories at ``times``, the first of them canonical."""
    centers = centers_of(random_cameras(POINT_VIEWS, 8, stream(*seed, _POINT_VIEWS)))
    truth = trajectories(world, *surface_points(world, POINTS, centers, stream(*seed, _POINTS)), times)
    shots = {split: _shots(film, world, of_split) for split, of_split in views.items()}
    with writing_to(folder) as place:
        write_scene(place, shots, camera_angle_x=CAMERA_ANGLE_X, trajectories=truth)


def _shots(film: Film, world: World, views: list[ImageSpec]) -> Iterator[Shot]:
    for view, (rgba, depth) in zip(views, film.pictures(world, views)):
        known = None if view.ability == "all" else depth
        yield Shot(view.name, view.time, view.camera.camera_to_world, rgba, known, view.ability)


@contextmanager
def writing_to(folder: str | Path) -> Iterator[Path]:
    """Make a folder to write to; turn errors of the file system into SceneErrors."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except OSError as error:
        reason = error.strerror or error
        raise SceneError(f"{folder}: expected a folder to write to, but got {reason}; set folder") from error


# Half of a single scene's samples: costs one grey level at this size and saves a quarter of the time.
_SHADOW_RAYS = 3


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
        motions: names in ``motions.MOTIONS``: lift; lift_tilt, where band and ball move too;
            drive, driving and turning while the arm moves.
        test_views: views at each training time; steps from one training time to the next; canonical views.
        val_views: validation views, at training times.
        samples_per_pixel: rays averaged into a pixel.
        workers, progress: see ``film.Film``.

    Raises:
        SceneError: for a bad argument or folder; ImportError: without ``forewarp[synth]``.

    **Cost** a quarter of a second an image of 400 x 400 on one core: at the defaults 1521 of them and 0.9 GB.
    """
    _check(motions, test_views)
    check_numbers(size=(size, 8), frames=(frames, 2), seed=(seed, 0), val_views=(val_views, 0))
    check_numbers(samples_per_pixel=(samples_per_pixel, 1))
    check_workers(workers)
    steps = max(test_views[1], 1)
    times = np.linspace(0, 1, steps * (frames - 1) + 1)
    # A motion's own stream, so that the scenes are seen from different places.
    streams = {motion: (seed, 100 + list(MOTIONS).index(motion)) for motion in motions}
    views = {motion: _views(streams[motion], size, times, steps, test_views, val_views) for motion in motions}
    cameras = [v.camera for splits in views.values() for split in splits.values() for v in split]
    with Film(Exposure(samples_per_pixel, _SHADOW_RAYS), cameras, workers, progress) as film:
        for motion in motions:
            write_world(Path(folder) / motion, World(motion), views[motion], times, film, streams[motion])
    return Path(folder)


def _views(seed: tuple[int, ...], size: int, times: np.ndarray, steps: int, test_views, val_views) -> Views:
    train = times[::steps]
    test = np.repeat(train, test_views[0]), times[: len(times) * (test_views[1] > 0)], np.zeros(test_views[2])
    return views_at(seed, size, train, chosen(train, val_views), test)


def _check(motions: Sequence[str], test_views: Sequence[int]) -> None:
    if isinstance(motions, str) or not isinstance(motions, Sequence) or not motions:
        raise SceneError(
            f"motions: expected a list of {', '.join(MOTIONS)}, but got {motions!r}; set motions"
        )
    for motion in motions:
        check_motion(motion, "motions")
    if len(set(motions)) < len(motions):
        raise SceneError(f"motions: expected each once, but got {list(motions)}; set motions")
    meaning = "views a training time, steps between training times, canonical views"
    check_counts("test_views", test_views, meaning)
