"""The vehicle filmed by two phones in a room (HyperNeRF layout) or by a studio's dome (NHR layout)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from forewarp.data import hypernerf, nhr
from forewarp.data.files import SceneError, whole
from forewarp.scene.camera import Camera, Lens, look_at
from forewarp.scene.frame import Truth
from forewarp.synth.raycast import Hits, Posed, camera_rays, light_points, render_all, surface_points
from forewarp.synth.scenes import check_motion, check_numbers
from forewarp.synth.world import World

# About a ninth of the drawn static points is in both images.
POINTS, STILL_POINTS = 4000, 20000
# The arc, in the vehicle's units and degrees from x towards y.
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
_RANGE_MARGIN = 0.08

CAMERAS, DOME_RADIUS, HEIGHTS = 20, 3.7, (0.55, 1.6)
TARGET = (0.0, 0.0, -0.05)
DOME_VIEW_ANGLE = 36.0  # vertical field of view, degrees: the whole scene fits, with a margin
STUDIO = (0.38, 0.50, 0.42)  # colour of the backdrop; a trace of it shows at the rim of cut-outs
_CLOUD_LIGHTS = 24
# Streams of random numbers: hand shake or lenses, points of the trajectories, static points or clouds.
_CAMERAS, _POINTS, _CLOUDS = 0, 1, 2


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
    whole(size, "size", 16, multiple=8)
    check_numbers(samples_per_pixel, workers, frames=(frames, 3), seed=(seed, 0))
    if frames % 2 == 0:
        raise SceneError(f"frames: expected an odd number, one in the middle, but got {frames}; set frames")
    check_motion(motion)
    world, times = World(motion, has_room=True), np.linspace(0, 1, frames)
    pairs = rig_cameras(size, times, seed)
    cameras = [camera for pair in pairs for camera in pair]
    near, far = _seen_range(world, pairs)
    views = [(world, float(times[i // 2]), camera) for i, camera in enumerate(cameras)]
    with closing(render_all(views, samples_per_pixel, workers, progress)) as images:
        hypernerf.write_scene(
            folder,
            _shots(images, cameras),
            center=SCENE_CENTER,
            scale=SCENE_SCALE,
            near=near * WORLD_SCALE * SCENE_SCALE,
            far=far * WORLD_SCALE * SCENE_SCALE,
            points=_still_points(world, pairs[frames // 2], np.random.default_rng([seed, _CLOUDS])),
            trajectories=_truth(world, times, cameras, np.random.default_rng([seed, _POINTS])),
        )
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
    pose = look_at(torch.from_numpy(center), torch.from_numpy(target), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(width, height, fx, fx * aspect, cx, cy, pose, 0.1, 10.0, lens=lens)


def _shots(images: Iterator, cameras: list[Camera]) -> Iterator[hypernerf.RigShot]:
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
        pixel, depth = (np.asarray(v) for v in camera.project(torch.from_numpy(points)))
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
    whole(size, "size", 24, multiple=24)
    check_numbers(samples_per_pixel, workers, frames=(frames, 2), seed=(seed, 0), points=(points, 1))
    check_motion(motion)
    world, times, cameras = World(motion), np.linspace(0, 1, frames), dome_cameras(size, seed)
    drawn = surface_points(world, POINTS, cameras, np.random.default_rng([seed, _POINTS]))
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
        pose = look_at(center, torch.tensor(TARGET), torch.tensor([0.0, 0.0, 1.0]))
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
