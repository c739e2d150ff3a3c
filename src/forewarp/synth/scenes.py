"""One moving scene in D-NeRF's layout: cameras on a sphere, pictures, depth and trajectories."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from forewarp.data.dnerf import ABILITIES, Shot, write_scene
from forewarp.scene.errors import SceneError
from forewarp.synth.arguments import check_counts, check_motion, check_numbers, check_workers
from forewarp.synth.cameras import CAMERA_ANGLE_X, centers_of, random_cameras, stream
from forewarp.synth.film import Exposure, Film, ImageSpec
from forewarp.synth.points import surface_points, trajectories
from forewarp.synth.specimens import SPECIMENS, Specimen
from forewarp.synth.world import World

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
