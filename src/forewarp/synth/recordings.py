"""Films of two movers in a room, with their truth: by a rig of fixed cameras."""

from __future__ import annotations

import math
import wave
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from forewarp.data import posed_video
from forewarp.data.files import mismatch, remove, whole
from forewarp.data.multicam import write_poses
from forewarp.data.posed_video import PosedShot
from forewarp.drawing.images import write_video
from forewarp.files import write_json
from forewarp.ops.backend import cores
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.synth.movers import MOVERS, moving_faces, near_movers, placed_movers, specimen
from forewarp.synth.raycast import (
    LIGHT_RADIUS,
    SAMPLES_A_PROCESS,
    Posed,
    by_processes,
    camera_rays,
    shaded,
    surface_points,
)
from forewarp.synth.scenes import UP, check_numbers
from forewarp.synth.world import LIGHT_AT, ROOM_HIGH, ROOM_LOW, World, room

TRUTH = "truth"  # the folder, and the file's stem
HALL_LOW, HALL_HIGH = (-3.2, -3.7, ROOM_LOW[2]), (3.2, ROOM_HIGH[1], ROOM_HIGH[2])
FINENESS = 1.8  # tiles of the hall: 20 to 30 pixels wide, so that there are corners to match everywhere
# The rig's arc, degrees from x towards y, and metres.
MIDDLE, STEP, MOST_ARC = -90.0, 12.5, 165.0
DISTANCE, HEIGHTS, FOCUS, VIEW_ANGLE = 2.75, (1.0, 1.4), (0.0, 0.0, 0.5), 60.0
RATES = (29.97, 30.0)  # frames a second, in turns
LATEST, LATEST_SHARE = 0.5, 0.3  # the most by which a camera begins late: seconds, share of its recording
NEAR, FAR = 0.5, 8.0
SHADOW_RAYS = 2  # a sample; eight lights a pixel
POINTS = 4000  # drawn of what stands still
# Sound: of the clap a few damped tones, hertz and seconds; its and the noise's loudness.
HERTZ, TONES, FADE, LOUD, NOISE = 48000, (610.0, 1130.0, 1870.0, 2950.0, 4700.0), 0.012, 0.7, 0.01
_LENSES, _OFFSETS, _SOUNDS, _DRAWN = 20, 21, 22, 23  # streams of random numbers


@lru_cache(4)
def hall(seconds: float, has_movers: bool = True) -> World:
    """Make the room with or without its movers; times from 0 to 1 last ``seconds``."""
    subject = specimen(seconds, lambda: room(HALL_LOW, HALL_HIGH, FINENESS))
    return World(subject if has_movers else replace(subject, absent=lambda time: MOVERS))


def synthesize_multicam(
    folder: str | Path,
    *,
    cameras: int = 12,
    frames: int = 100,
    size: int = 676,
    synchronised: bool = False,
    seed: int = 0,
    samples_per_pixel: int = 4,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write what a rig of fixed cameras films into ``folder``, with the truth, and return that folder.

    Cameras stand on an arc, at most 12.5 degrees apart. There is a film ``cam00.mp4`` of each, of ``frames``
    frames with a sound track: weak noise, and one clap that all hear at once. In turns their rates are 29.97
    and 30 frames a second; each begins at an offset of its own, up to half a second. The scene ``truth``,
    which ``posed_video.read_scene`` reads, has the frames as they were before compression, true times, poses
    and masks of what moves; ``truth.json`` has offsets, rates, the clap's time in seconds, and the cameras.

    Args:
        folder: folder of the films; an existing one is replaced.
        cameras: at least 2.
        size: pixels of the width, even; the height is three quarters of it, rounded down to an even
            number for the codec.
        synchronised: all begin at once, at 30 frames a second, and ``poses_bounds.npy`` is written: DyNeRF's
            layout, which ``multicam.read_scene`` reads.
        seed: draws lenses, offsets, places and noise.
        samples_per_pixel: rays averaged into a pixel.
        workers: processes; see ``raycast.render_all``.
        progress: called with (frames done, all frames) after each.

    Raises:
        SceneError: for a bad argument; ImportError: without ``forewarp[synth]``.

    **Cost** the still room once a camera; then of each frame only pixels that movers and their shadows touch,
    about a twentieth.
    """
    folder = Path(folder)
    check_numbers(samples_per_pixel, workers, cameras=(cameras, 2), frames=(frames, 2), seed=(seed, 0))
    whole(size, "size", 16, multiple=2)
    if not isinstance(synchronised, bool):
        raise mismatch("synchronised", "true or false", repr(synchronised), "set synchronised")
    views = rig(cameras, size, seed)
    clocks = _clocks(cameras, frames, synchronised, seed)
    seconds = max(clock.end for clock in clocks)
    clap = max(clock.offset for clock in clocks) / 2 + min(clock.end for clock in clocks) / 2
    remove(folder, f"{TRUTH}.json", "cam*.mp4", "poses_bounds.npy")

    def shots() -> Iterator[PosedShot]:
        images, done = _filmed(views, clocks, seconds, samples_per_pixel, workers), 0
        for k, (view, clock) in enumerate(zip(views, clocks)):
            name, film = f"cam{k:02d}", Film(next(images))
            for number, time in enumerate(clock.times):
                pixels, colors, is_mover = next(images)
                moving = np.zeros((view.height, view.width), bool)
                moving.flat[pixels[is_mover]] = True
                shot, image = f"{name}_{number:04d}.jpg", film.add(pixels, colors)
                yield PosedShot(shot, view, image, time / seconds, moving=moving, taken_by=name)
                done += 1
                if progress is not None:
                    progress(done, cameras * frames)
            sound = folder / f"{name}.wav"
            write_sound(sound, clock, clap, np.random.default_rng([seed, _SOUNDS, k]))
            frames_of_film = (torch.from_numpy(image).float() / 255 for image in film)
            write_video(folder / f"{name}.mp4", frames_of_film, fps=clock.rate, sound=sound)
            sound.unlink()

    world, box = hall(seconds), Box(HALL_LOW, HALL_HIGH)
    drawn = surface_points(
        world, POINTS, views, np.random.default_rng([seed, _DRAWN]), among=~moving_faces(world)
    )
    told = {"seconds": seconds, "moving_from": "the program that made the film"}
    limits = {"near": NEAR, "far": FAR, "aabb": box, "points": world.points(*drawn, 0.0)}
    posed_video.write_scene(folder / TRUTH, shots(), **limits, **told)
    if synchronised:
        write_poses(folder, views, near=NEAR, far=FAR)
    told_of = [
        {"name": f"cam{k:02d}", "offset": clock.offset, "fps": clock.rate, "frames": frames, **_told(view)}
        for k, (view, clock) in enumerate(zip(views, clocks))
    ]
    write_json(folder / f"{TRUTH}.json", {"clap": clap, "seconds": seconds, "cameras": told_of})
    return folder


def rig(count: int, size: int, seed: int) -> list[Camera]:
    """Place cameras on an arc, by turns low and high; focal lengths differ by up to 2 %."""
    rng, made = np.random.default_rng([seed, _LENSES]), []
    arc = min(MOST_ARC, STEP * (count - 1))
    width, height = size, size * 3 // 8 * 2
    for k in range(count):
        azimuth = math.radians(MIDDLE + arc * (k / (count - 1) - 0.5))
        distance, rise = DISTANCE + rng.uniform(-0.12, 0.12), HEIGHTS[k % 2] + rng.uniform(-0.1, 0.1)
        focal = rng.uniform(0.98, 1.02) * 0.5 * width / math.tan(0.5 * math.radians(VIEW_ANGLE))
        center = torch.tensor([distance * math.cos(azimuth), distance * math.sin(azimuth), rise])
        pose = look_at(center.double(), torch.tensor(FOCUS), UP)
        made.append(Camera(width, height, focal, focal, width / 2, height / 2, pose, NEAR, FAR))
    return made


@dataclass(frozen=True)
class Clock:
    """When a camera films: ``offset`` seconds after the first one begins, ``rate`` frames a second."""

    offset: float
    rate: float
    frames: int

    @property
    def times(self) -> list[float]:
        """Of the frames, seconds."""
        return [self.offset + number / self.rate for number in range(self.frames)]

    @property
    def end(self) -> float:
        """Of the last frame, seconds."""
        return self.times[-1]


def _clocks(count: int, frames: int, synchronised: bool, seed: int) -> list[Clock]:
    if synchronised:
        return [Clock(0.0, RATES[1], frames)] * count
    latest = min(LATEST, LATEST_SHARE * (frames - 1) / RATES[1])
    offsets = np.random.default_rng([seed, _OFFSETS]).uniform(0, latest, count)
    first = offsets.min()
    return [Clock(float(at - first), RATES[k % 2], frames) for k, at in enumerate(offsets)]


def _told(camera: Camera) -> dict:
    """Tell a pinhole camera: camera-to-world with OpenCV's axes, metres; the rest in pixels."""
    inner = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
    inner |= {"cx": camera.cx, "cy": camera.cy}
    return inner | {"camera_to_world": camera.camera_to_world.tolist()}


class Film:
    """Frames of a fixed camera, of which only what differs from the still image (H, W, 3) uint8 is kept."""

    def __init__(self, still: np.ndarray) -> None:
        self.still, self.changes = still, []

    def add(self, pixels: np.ndarray, colors: np.ndarray) -> np.ndarray:
        """Add a frame by its ``pixels`` (n,) that may have other ``colors`` (n, 3) uint8, and return it."""
        self.changes.append((pixels.astype(np.int32), colors))
        return self._changed(pixels, colors)

    def _changed(self, pixels: np.ndarray, colors: np.ndarray) -> np.ndarray:
        image = self.still.copy()
        image.reshape(-1, 3)[pixels] = colors
        return image

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self._changed(*change) for change in self.changes)


def _filmed(views, clocks, seconds: float, samples: int, workers: int | None) -> Iterator:
    """Yield of each camera the still image, then its frames; see ``_shade``."""

    def jobs():
        for view, clock in zip(views, clocks):
            touched = Touched(view, seconds)
            yield seconds, None, view, samples, None
            for time in clock.times:
                yield seconds, time / seconds, view, samples, touched(time / seconds)

    rays = samples * sum(view.width * view.height * (1 + 0.06 * c.frames) for view, c in zip(views, clocks))
    workers = workers or max(1, min(cores(), int(rays / SAMPLES_A_PROCESS)))
    return by_processes(_shade, jobs(), workers)


def _shade(seconds: float, time: float | None, view: Camera, samples: int, pixels: np.ndarray | None):
    """Shade the still image (H, W, 3) where time is None; else pixels, colours, and which are movers'."""
    world = hall(seconds, has_movers=time is not None)
    posed = Posed(world, time or 0.0)
    rgb = np.rint(255 * shaded(posed, view, samples, SHADOW_RAYS, pixels)[0]).astype(np.uint8)
    if time is None:
        return rgb.reshape(view.height, view.width, 3)
    hits, moving = posed.first_hits(*camera_rays(view, pixels=pixels)), np.zeros(len(pixels), bool)
    moving[hits.ray] = moving_faces(world)[hits.face]
    return pixels, rgb, moving


class Touched:
    """Find the pixels of a fixed camera that movers or their shadows can touch: a few more than do."""

    def __init__(self, camera: Camera, seconds: float) -> None:
        self.camera, self.world = camera, hall(seconds)
        origins, directions = camera_rays(camera)
        hits = Posed(hall(seconds, has_movers=False), 0.0).first_hits(origins, directions)
        points = np.full(origins.shape, np.inf, np.float32)
        points[hits.ray] = origins[hits.ray] + hits.distance[:, None] * directions[hits.ray]
        self.points, self.to_light = points, LIGHT_AT.astype(np.float32) - points
        self.length = np.linalg.norm(self.to_light, axis=-1)

    def __call__(self, time: float) -> np.ndarray:
        """Return the numbers (n,) of the pixels at a time."""
        touched = near_movers(self.world, [time], [self.camera]).ravel()
        for vertices in placed_movers(self.world, time).values():
            center = 0.5 * (vertices.min(0) + vertices.max(0))
            radius = np.linalg.norm(vertices - center, axis=-1).max() + 0.02
            # A cone from a point to the light's disc meets the sphere around the mover.
            away = center.astype(np.float32) - self.points
            along = np.einsum("nd,nd->n", away, self.to_light) / self.length
            aside = np.sqrt(np.maximum(np.einsum("nd,nd->n", away, away) - along**2, 0))
            share = along / self.length
            touched |= (along > -radius) & (aside < radius + LIGHT_RADIUS * share.clip(0, 1))
        return np.flatnonzero(touched)


def write_sound(path: Path, clock: Clock, clap: float, rng: np.random.Generator) -> None:
    """Write what a camera hears as WAV: noise of its own, and the clap at ``clap`` seconds for all."""
    since = clock.offset + np.arange(round(clock.frames / clock.rate * HERTZ)) / HERTZ - clap
    tones = sum(np.sin(2 * np.pi * tone * since) for tone in TONES) / len(TONES)
    heard = LOUD * np.where(since > 0, np.exp(-since.clip(0) / FADE) * tones, 0)
    samples = heard + NOISE * rng.normal(size=len(since))
    path.parent.mkdir(parents=True, exist_ok=True)
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(HERTZ)
        file.writeframes((32767 * samples.clip(-1, 1)).astype("<i2").tobytes())
