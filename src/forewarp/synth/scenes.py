"""Scenes in the layout of every dataset: cameras on a sphere, two phones in a room, a studio's dome.

Lego Complete has three scenes of one vehicle with three kinds of test view each. The authors' files are not
available: numbers and kinds of views are as published, vehicle and motions ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from forewarp.data import dnerf, hypernerf, nhr
from forewarp.data.files import mismatch, whole
from forewarp.scene.camera import Camera, Lens, look_at
from forewarp.scene.frame import Truth
from forewarp.synth.raycast import Hits, Posed, camera_rays, light_points, render_all, surface_points
from forewarp.synth.vehicle import MOTIONS
from forewarp.synth.world import AROUND, ELEVATION, SUBJECTS, Range, World

UP = torch.tensor([0.0, 0.0, 1.0])
POINTS = 4000  # of the trajectories

# D-NeRF and Lego Complete: a sphere around the scene.
CAMERA_RADIUS, CAMERA_ANGLE_X = 4.0311, 0.6911112
POINT_VIEWS = 30
# Streams of random numbers: the cameras of each split, then the points.
_TRAIN, _VAL, _TEST, _POINT_VIEWS, _POINTS = 0, 1, 2, 9, 10
# Half of a single scene's samples: costs one grey level at this size and saves a quarter of the time.
_LEGO_SHADOW_RAYS = 3

# HyperNeRF: a rig of two phones on an arc, in the vehicle's units and degrees from x towards y.
RADIUS, ARC, FOCUS, BASELINE = 3.0, (-118.0, -62.0), (0.0, 0.0, -0.08), 0.26
VIEW_ANGLE = 52.0  # horizontal field of view, degrees
# Two phones of one make differ a little: pixel aspect, focal length, principal point and lens.
PHONES = (
    (1.013, 1.0, (0.012, -0.008), Lens((0.11, -0.08, 0.02), (0.004, -0.006))),
    (0.991, 1.02, (-0.009, 0.011), Lens((0.08, -0.05, 0.0), (-0.003, 0.004))),
)
# The capture's own world: neither centred nor of known scale, as a reconstruction leaves it.
WORLD_SCALE, WORLD_AT = 2.4, (3.1, -1.7, 0.9)
SCENE_CENTER, SCENE_SCALE = (2.9, -1.4, 1.1), 0.2
STILL_POINTS = 20000  # drawn; about a ninth of them is in both images
_RANGE_MARGIN = 0.08

# NHR: a dome of cameras.
CAMERAS, DOME_RADIUS, HEIGHTS = 20, 3.7, (0.55, 1.6)
TARGET = (0.0, 0.0, -0.05)
DOME_VIEW_ANGLE = 36.0  # vertical field of view, degrees: the whole scene fits, with a margin
STUDIO = (0.38, 0.50, 0.42)  # colour of the backdrop; a trace of it shows at the rim of cut-outs
_CLOUD_LIGHTS = 24
# Streams of random numbers of both: hand shake or lenses, points of the trajectories, other points.
_CAMERAS, _TRACKS, _CLOUDS = 0, 1, 2


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
    check_all(samples_per_pixel, workers, seed, size=(size, 8), frames=(frames, 2), val_views=(val_views, 0))
    check_motion(motion, SUBJECTS)
    check_views(test_views, "space, time, canonical")
    times = np.linspace(0, 1, 2 * frames - 1)
    train, between = times[::2], times[1::2]
    test = spread_over(train, test_views[0]), spread_over(between, test_views[1]), np.zeros(test_views[2])
    views = views_at(motion, (seed,), size, train, spread_over(train, val_views), test)
    worlds = {Path(folder): (World(motion), views, (seed,))}
    write_worlds(worlds, times, samples_per_pixel, workers, progress)
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
        raise mismatch("motions", f"a list of {', '.join(MOTIONS)}", repr(motions), "set motions")
    for motion in motions:
        check_motion(motion, name="motions")
    if len(set(motions)) < len(motions):
        raise mismatch("motions", "each once", list(motions), "set motions")
    check_views(test_views, "views a training time, steps between training times, canonical views")
    check_all(samples_per_pixel, workers, seed, size=(size, 8), frames=(frames, 2), val_views=(val_views, 0))
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
    write_worlds(worlds, times, samples_per_pixel, workers, progress, _LEGO_SHADOW_RAYS)
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

    kinds = [view for i, times in enumerate(test) for view in views(_TEST + i, times, dnerf.ABILITIES[i])]
    return {"train": views(_TRAIN, train), "val": views(_VAL, val), "test": kinds}


def spread_over(times: np.ndarray, count: int) -> np.ndarray:
    """Choose ``count`` evenly spaced times, including the first and the last if ``count`` is 2 or more."""
    return times[np.rint(np.linspace(0, len(times) - 1, count)).astype(np.int64)]


def write_worlds(
    worlds: Mapping[Path, tuple[World, Views, Sequence[int]]], times: np.ndarray, *rendering
) -> None:
    """Write views of worlds with trajectories at ``times``, the first of them canonical.

    Args:
        worlds: world, views and random stream of each scene's folder.
        times: (T,) in [0, 1].
        rendering: other arguments of ``raycast.render_all``.
    """
    splits = [(world, split) for world, views, _ in worlds.values() for split in views.values()]
    to_render = [(world, view.time, view.camera) for world, split in splits for view in split]
    with closing(render_all(to_render, *rendering)) as images:
        for folder, (world, views, stream) in worlds.items():
            seen_from = random_cameras(POINT_VIEWS, 8, np.random.default_rng([*stream, _POINT_VIEWS]))
            points = surface_points(world, POINTS, seen_from, np.random.default_rng([*stream, _POINTS]))
            # Taken from one stream of images, so in the order in which the splits are written.
            shots = {split: map(_shot, of_split, images) for split, of_split in views.items()}
            truth = world.trajectories(*points, times)
            dnerf.write_scene(folder, shots, camera_angle_x=CAMERA_ANGLE_X, trajectories=truth)


def _shot(view: ImageSpec, image: tuple[np.ndarray, np.ndarray]) -> dnerf.Shot:
    depth = None if view.ability == "all" else image[1]
    return dnerf.Shot(view.name, view.time, view.camera.camera_to_world, image[0], depth, view.ability)


def orbit_camera(azimuth: float, sine: float, size: int) -> Camera:
    """Place a square camera on D-NeRF's sphere around the scene, looking at the origin, z upwards.

    Args:
        azimuth: radians from x towards y.
        sine: sine of the elevation above the ground.
        size: width and height in pixels.
    """
    level = math.sqrt(1 - sine * sine)
    direction = np.array([level * math.cos(azimuth), level * math.sin(azimuth), sine])
    pose = look_at(CAMERA_RADIUS * direction, torch.zeros(3), UP)
    focal = 0.5 * size / math.tan(0.5 * CAMERA_ANGLE_X)
    return Camera(size, size, focal, focal, size / 2, size / 2, pose, 2.0, 6.0)


def random_cameras(
    count: int, size: int, rng: np.random.Generator, azimuth: Range = AROUND, rise: Range = ELEVATION
) -> list[Camera]:
    """Draw cameras uniformly by area on the upper half of the sphere, or a part of it.

    Args:
        azimuth: least and greatest azimuth, degrees.
        rise: least and greatest sine of the elevation.
    """
    angles, sines = rng.uniform(*np.radians(azimuth), count), rng.uniform(*rise, count)
    return [orbit_camera(float(angle), float(sine), size) for angle, sine in zip(angles, sines)]


def synthesize_hypernerf(
    folder: str | Path,
    *,
    size: int = 256,
    frames: int = 41,
    seed: int = 0,
    motion: str = "lift_tilt",
    samples_per_pixel: int = 4,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a capture by a validation rig into ``folder`` and return that folder.

    Both phones take an image at each of ``frames`` times, evenly spaced over [0, 1]; by turns one is for
    training and the other held out. Lenses distort, pixels are not square, the world is scaled and shifted.
    ``points.npy`` has points of the room and the slab; trajectories follow vehicle, ball and slab, the middle
    time first. Equal arguments give equal files, byte by byte; ``seed`` draws hand shake and points.

    Args:
        folder: folder of the capture; an existing one is replaced.
        size: width in pixels, a multiple of 8; the height is 3/4 of it. Half-size images are written too.
        frames: number of times, odd, so that one is the canonical time 1/2.
        motion: one of ``vehicle.MOTIONS``.
        samples_per_pixel: rays averaged into a pixel.
        workers, progress: see ``raycast.render_all``.

    Raises:
        SceneError: for a bad argument; ImportError: without ``forewarp[synth]``.
    """
    check_all(samples_per_pixel, workers, seed, size=(size, 16, 8), frames=(frames, 3))
    if frames % 2 == 0:
        raise mismatch("frames", "an odd number, one in the middle", frames, "set frames")
    check_motion(motion)
    world, times = World(motion, has_room=True), np.linspace(0, 1, frames)
    pairs = rig_cameras(size, times, seed)
    cameras = [camera for pair in pairs for camera in pair]
    near, far = (distance * WORLD_SCALE * SCENE_SCALE for distance in _seen_range(world, pairs))
    space = {"center": SCENE_CENTER, "scale": SCENE_SCALE, "near": near, "far": far}
    points = _still_points(world, pairs[frames // 2], np.random.default_rng([seed, _CLOUDS]))
    truth = _truth(world, times, cameras, np.random.default_rng([seed, _TRACKS]))
    views = [(world, float(times[i // 2]), camera) for i, camera in enumerate(cameras)]
    with closing(render_all(views, samples_per_pixel, workers, progress)) as images:
        shots = _rig_shots(images, cameras)
        hypernerf.write_scene(folder, shots, **space, points=points, trajectories=truth)
    return Path(folder)


def rig_cameras(size: int, times: np.ndarray, seed: int) -> list[tuple[Camera, Camera]]:
    """Place the left and right camera at each time, in the vehicle's units: along an arc, shaking slowly."""
    rng = np.random.default_rng([seed, _CAMERAS])
    phase, rate = rng.uniform(0, 2 * np.pi, 4), rng.uniform(1.0, 2.2, 4)
    pairs = []
    for time in times:
        shake = np.sin(2 * np.pi * rate * time + phase)
        azimuth = math.radians(ARC[0] + (ARC[1] - ARC[0]) * float(time) + 0.8 * shake[0])
        rise = math.radians(20.0 + 3.0 * shake[1])
        level = RADIUS * math.cos(rise)
        middle = np.array([level * math.cos(azimuth), level * math.sin(azimuth), RADIUS * math.sin(rise)])
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        target = np.array(FOCUS) + 0.03 * np.array([shake[2], 0, shake[3]])
        pairs.append(tuple(_phone(size, k, middle + (k - 0.5) * BASELINE * right, target) for k in (0, 1)))
    return pairs


def _phone(size: int, k: int, center: np.ndarray, target: np.ndarray) -> Camera:
    (aspect, focal, off, lens), width, height = PHONES[k], size, size * 3 // 4
    fx = focal * 0.5 * width / math.tan(0.5 * math.radians(VIEW_ANGLE))
    cx, cy = width * (0.5 + off[0]), height * (0.5 + off[1])
    return Camera(width, height, fx, fx * aspect, cx, cy, look_at(center, target, UP), 0.1, 10.0, lens=lens)


def _rig_shots(images: Iterator, cameras: list[Camera]) -> Iterator[hypernerf.RigShot]:
    for i, (camera, (rgba, _)) in enumerate(zip(cameras, images)):
        t, k = divmod(i, 2)
        pose = camera.camera_to_world.clone()
        pose[:3, 3] = torch.from_numpy(_in_capture(pose[:3, 3].numpy()))
        name, split = f"{('left', 'right')[k]}1_{t:06d}", "train" if k == t % 2 else "val"
        yield hypernerf.RigShot(name, t, k, split, replace(camera, camera_to_world=pose), rgba[..., :3])


def _in_capture(points: np.ndarray) -> np.ndarray:
    """Move points (..., 3) from the vehicle's units to the capture's world."""
    return WORLD_SCALE * points + np.array(WORLD_AT)


def _seen_range(world: World, pairs: list[tuple[Camera, Camera]]) -> tuple[float, float]:
    """Find the least and the greatest distance in any image, with a margin."""
    distances = []
    for i, pair in enumerate(pairs):
        posed = Posed(world, i / (len(pairs) - 1))
        distances += [posed.first_hits(*camera_rays(camera.resized(16, 12))).distance for camera in pair]
    distance = np.concatenate(distances)
    assert len(distance) == 2 * 16 * 12 * len(pairs), "a ray left the room"
    return float(distance.min()) * (1 - _RANGE_MARGIN), float(distance.max()) * (1 + _RANGE_MARGIN)


def _truth(world: World, times: np.ndarray, cameras: list[Camera], rng: np.random.Generator) -> Truth:
    """Follow points that are not on a wall, the middle time first."""
    middle = len(times) // 2
    order = [middle, *(i for i in range(len(times)) if i != middle)]
    points = surface_points(world, POINTS, cameras, rng, times[middle], world.casts)
    truth = world.trajectories(*points, times[order])
    return Truth(torch.from_numpy(_in_capture(truth.points.double().numpy())).float(), truth.times)


def _still_points(world: World, pair: tuple[Camera, Camera], rng: np.random.Generator) -> np.ndarray:
    """Draw points (N, 3) float32 of room and slab that both phones see, in the capture's world."""
    still = np.array([part.joint == "ground" for part in world.parts])[world.part_of_face]
    points = world.points(*surface_points(world, STILL_POINTS, list(pair), rng, 0.5, still), 0.5)
    for camera in pair:
        pixel, depth = (np.asarray(v) for v in camera.project(points))
        inside = (depth > 0) & (pixel > 0).all(-1) & (pixel < (camera.width, camera.height)).all(-1)
        points = points[inside]
    return _in_capture(points).astype(np.float32)


def synthesize_nhr(
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
    or 5/6 by 5/8. All take an image at each of ``frames`` times, evenly spaced over [0, 1]. Every frame has
    masks and a coloured cloud of visible points. Trajectories hold all times, 0 first. Equal
    arguments give equal files; ``seed`` draws lenses and points.

    Args:
        folder: folder of the recording; an existing one is replaced.
        size: pixels across of the larger images, a multiple of 24.
        motion: one of ``vehicle.MOTIONS``.
        points: number of points in the cloud of each frame.
        samples_per_pixel: rays averaged into a pixel.
        workers, progress: see ``raycast.render_all``.

    Raises:
        SceneError: for a bad argument; ImportError: without ``forewarp[synth]``.
    """
    check_all(samples_per_pixel, workers, seed, size=(size, 24, 24), frames=(frames, 2), points=(points, 1))
    check_motion(motion)
    world, times, cameras = World(motion), np.linspace(0, 1, frames), dome_cameras(size, seed)
    drawn = surface_points(world, POINTS, cameras, np.random.default_rng([seed, _TRACKS]))
    truth = world.trajectories(*drawn, times)

    views = [(world, float(time), camera) for time in times for camera in cameras]
    with closing(render_all(views, samples_per_pixel, workers, progress)) as images:

        def recorded() -> Iterator[nhr.DomeFrame]:
            for f, time in enumerate(times):
                cloud = lit_cloud(world, time, points, cameras, np.random.default_rng([seed, _CLOUDS, f]))
                rgba = [next(images)[0] for _ in cameras]
                yield nhr.DomeFrame([_in_studio(i) for i in rgba], [i[..., 3] for i in rgba], cloud)

        nhr.write_scene(folder, cameras, recorded(), trajectories=truth)
    return Path(folder)


def dome_cameras(size: int, seed: int) -> list[Camera]:
    """Make the cameras; their lenses differ slightly."""
    rng, cameras = np.random.default_rng([seed, _CAMERAS]), []
    for k in range(CAMERAS):
        azimuth, height = 2 * math.pi * k / CAMERAS, HEIGHTS[k % 2]
        center = torch.tensor([DOME_RADIUS * math.cos(azimuth), DOME_RADIUS * math.sin(azimuth), height])
        width, rows = (size, size * 5 // 6) if k % 8 < 4 else (size * 5 // 6, size * 5 // 8)
        focal = rng.uniform(0.98, 1.02, 2) * 0.5 * rows / math.tan(0.5 * math.radians(DOME_VIEW_ANGLE))
        cx, cy = (0.5 + rng.uniform(-0.01, 0.01, 2)) * (width, rows)
        pose = look_at(center, torch.tensor(TARGET), UP)
        near, far = DOME_RADIUS - 1.6, DOME_RADIUS + 2.2
        cameras.append(Camera(width, rows, *map(float, (*focal, cx, cy)), pose, near, far))
    return cameras


def lit_cloud(
    world: World, time: float, count: int, cameras: list[Camera], rng: np.random.Generator
) -> np.ndarray:
    """Draw points (N, 6) float32 that are visible at ``time``: x y z in world units, lit r g b, 0-255."""
    face, barycentric = surface_points(world, count, cameras, rng, time)
    hits = Hits(np.arange(len(face)), face, barycentric, np.zeros(len(face)))
    color = Posed(world, time).color(hits, light_points(_CLOUD_LIGHTS))
    return np.concatenate([world.points(face, barycentric, time), 255 * color], -1).astype(np.float32)


def _in_studio(rgba: np.ndarray) -> np.ndarray:
    """Composite an image uint8 (H, W, 4) over the backdrop: uint8 (H, W, 3)."""
    alpha = rgba[..., 3:] / 255
    return np.rint(alpha * rgba[..., :3] + (1 - alpha) * 255 * np.array(STUDIO)).astype(np.uint8)


def check_all(samples_per_pixel: int, workers: int | None, seed: int, **numbers: tuple[int, ...]) -> None:
    """Check what all scenes have, and whole numbers by name: value, least and, perhaps, a divisor."""
    always = {"samples_per_pixel": (samples_per_pixel, 1), "seed": (seed, 0)}
    always["workers"] = 1 if workers is None else workers, 1
    for name, (value, *bounds) in (always | numbers).items():
        whole(value, name, *bounds)


def check_motion(motion: str, among: Collection[str] = MOTIONS, name: str = "motion") -> None:
    """Check that a motion has one of the names ``among``; ``name`` is the key to set."""
    if not isinstance(motion, str) or motion not in among:
        raise mismatch(name, f"one of {', '.join(among)}", repr(motion), f"set {name}")


def check_views(counts: Sequence[int], meaning: str) -> None:
    """Check the three counts of ``test_views``, not all of them 0; ``meaning`` says what they count."""
    is_three = isinstance(counts, Sequence) and len(counts) == 3
    if not is_three or not any([whole(count, "test_views", 0) for count in counts]):
        raise mismatch("test_views", f"three numbers ({meaning}), not all 0", repr(counts), "set test_views")
