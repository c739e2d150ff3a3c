"""The vehicle filmed by two phones in a room (HyperNeRF layout) or by a studio's dome (NHR layout)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from forewarp.data import hypernerf, nhr
from forewarp.data.files import SceneError, whole
from forewarp.data.hypernerf import RigShot
from forewarp.data.nhr import DomeFrame
from forewarp.scene.camera import Camera, Lens, look_at
from forewarp.scene.frame import Truth
from forewarp.synth.film import Exposure, Film, ImageSpec
from forewarp.synth.raycast import Hits, Posed, camera_rays, light_points, surface_points, trajectories
from forewarp.synth.scenes import centers_of, check_motion, check_numbers, check_workers, stream, writing_to
from forewarp.synth.world import World

# About a ninth of the drawn static points is in both pictures.
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
_SHAKE, _POINTS, _STILL = 0, 1, 2
_RANGE_MARGIN = 0.08


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

    Both phones take a picture at each of ``frames`` times, evenly spaced over [0, 1]; by turns one is for
    training and the other held out. Lenses distort, pixels are not square, the world is scaled and shifted.
    ``points.npy`` has points of the room and the slab; trajectories follow vehicle, ball and slab, the middle
    time first. Equal arguments give equal files, byte by byte; ``seed`` draws hand shake and points.

    Args:
        folder: folder of the capture; an existing one is replaced.
        size: width in pixels, a multiple of 8; the height is 3/4 of it. Half-size images are written too.
        frames: number of times, odd, so that one is the canonical time 1/2.
        motion: one of ``motions.MOTIONS``.
        samples_per_pixel: rays averaged into a pixel.
        workers, progress: see ``film.Film``.

    Raises:
        SceneError: for a bad argument or folder; ImportError: without ``forewarp[synth]``.
    """
    whole(size, "size", 16, multiple=8)
    check_numbers(frames=(frames, 3), seed=(seed, 0), samples_per_pixel=(samples_per_pixel, 1))
    if frames % 2 == 0:
        raise SceneError(f"frames: expected an odd number, one in the middle, but got {frames}; set frames")
    check_motion(motion)
    check_workers(workers)
    world, times = World(motion, has_room=True), np.linspace(0, 1, frames)
    pairs = rig_cameras(size, times, seed)
    near, far = _seen_range(world, pairs)
    views = [
        ImageSpec(_name(t, k), float(times[t]), camera)
        for t, pair in enumerate(pairs)
        for k, camera in enumerate(pair)
    ]
    with (
        Film(Exposure(samples_per_pixel), [v.camera for v in views], workers, progress) as film,
        writing_to(folder) as place,
    ):
        hypernerf.write_scene(
            place,
            _shots(film, world, views),
            center=SCENE_CENTER,
            scale=SCENE_SCALE,
            near=near * WORLD_SCALE * SCENE_SCALE,
            far=far * WORLD_SCALE * SCENE_SCALE,
            points=_still_points(world, pairs, stream(seed, _STILL)),
            trajectories=_truth(world, times, pairs, stream(seed, _POINTS)),
        )
    return Path(folder)


def rig_cameras(size: int, times: np.ndarray, seed: int) -> list[tuple[Camera, Camera]]:
    """Place the left and right camera at each time, in the vehicle's units: along an arc, shaking slowly."""
    rng = stream(seed, _SHAKE)
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


def _name(t: int, k: int) -> str:
    return f"{('left', 'right')[k]}1_{t:06d}"


def _shots(film: Film, world: World, views: list[ImageSpec]) -> Iterator[RigShot]:
    for i, (view, (rgba, _)) in enumerate(zip(views, film.pictures(world, views))):
        t, k = divmod(i, 2)
        camera = replace(view.camera, camera_to_world=_pose_in_capture(view.camera))
        yield RigShot(view.name, t, k, "train" if k == t % 2 else "val", camera, rgba[..., :3])


def _pose_in_capture(camera: Camera) -> torch.Tensor:
    pose = camera.camera_to_world.clone()
    pose[:3, 3] = torch.from_numpy(_in_capture(pose[:3, 3].numpy()))
    return pose


def _in_capture(points: np.ndarray) -> np.ndarray:
    """Move points (..., 3) from the vehicle's units to the capture's world."""
    return WORLD_SCALE * points + np.array(WORLD_AT)


def _seen_range(world: World, pairs: list[tuple[Camera, Camera]]) -> tuple[float, float]:
    """Find the least and the greatest distance in any picture, with a margin."""
    seen = []
    for i, pair in enumerate(pairs):
        posed = Posed(world, i / (len(pairs) - 1))
        seen += [posed.first_hits(*camera_rays(camera.resized(16, 12))).distance for camera in pair]
    distance = np.concatenate(seen)
    if len(distance) < 2 * 16 * 12 * len(pairs):
        raise AssertionError("a ray left the room")
    return float(distance.min()) * (1 - _RANGE_MARGIN), float(distance.max()) * (1 + _RANGE_MARGIN)


def _truth(world: World, times: np.ndarray, pairs, rng: np.random.Generator) -> Truth:
    """Follow points that are not on a wall, the middle time first."""
    middle = len(times) // 2
    order = [middle, *(i for i in range(len(times)) if i != middle)]
    centers = centers_of([camera for pair in pairs for camera in pair])
    chosen = surface_points(world, POINTS, centers, rng, times[middle], world.casts)
    found = trajectories(world, *chosen, times[order])
    return Truth(torch.from_numpy(_in_capture(found.points.double().numpy())).float(), found.times)


def _still_points(world: World, pairs, rng: np.random.Generator) -> np.ndarray:
    """Draw points (N, 3) float32 of room and slab that both phones see, in the capture's world."""
    still = np.array([part.joint == "ground" for part in world.parts])[world.part_of_face]
    pair = pairs[len(pairs) // 2]
    faces, barycentric = surface_points(world, STILL_POINTS, centers_of(list(pair)), rng, 0.5, still)
    points = world.points(faces, barycentric, 0.5)
    for camera in pair:
        pixel, depth = (np.asarray(v) for v in camera.project(torch.from_numpy(points)))
        inside = (depth > 0) & (pixel > 0).all(-1) & (pixel < (camera.width, camera.height)).all(-1)
        points = points[inside]
    return _in_capture(points).astype(np.float32)


CAMERAS, DOME_RADIUS, HEIGHTS = 20, 3.7, (0.55, 1.6)
TARGET = (0.0, 0.0, -0.05)
DOME_VIEW_ANGLE = 36.0  # vertical field of view, degrees: the whole scene fits, with a margin
STUDIO = (0.38, 0.50, 0.42)  # colour of the backdrop; a trace of it shows at the rim of cut-outs
_LENSES, _CLOUDS = 0, 2
_CLOUD_LIGHTS = 24


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
        nhr.write_scene(place, cameras, _frames(film, world, times, cameras, clouds), trajectories=truth)
    return Path(folder)


def dome_cameras(size: int, seed: int) -> list[Camera]:
    """Make the cameras; their lenses differ slightly."""
    rng, cameras = stream(seed, _LENSES), []
    for k in range(CAMERAS):
        azimuth, height = 2 * math.pi * k / CAMERAS, HEIGHTS[k % 2]
        center = torch.tensor([DOME_RADIUS * math.cos(azimuth), DOME_RADIUS * math.sin(azimuth), height])
        large = k % 8 < 4
        width, rows = (size, size * 5 // 6) if large else (size * 5 // 6, size * 5 // 8)
        focal = rng.uniform(0.98, 1.02, 2) * 0.5 * rows / math.tan(0.5 * math.radians(DOME_VIEW_ANGLE))
        cx, cy = (0.5 + rng.uniform(-0.01, 0.01, 2)) * (width, rows)
        pose = look_at(center, torch.tensor(TARGET), torch.tensor([0.0, 0.0, 1.0]))
        near, far = DOME_RADIUS - 1.6, DOME_RADIUS + 2.2
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
