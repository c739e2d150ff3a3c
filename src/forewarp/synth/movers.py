"""Two movers in a room, for films: a box slides and turns on a bench, a ball bounces. Metres and seconds.

Cameras that stand still film cheaply: the room without movers is rendered once, then only what they and their
shadows touch.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from forewarp.scene.camera import Camera
from forewarp.synth.raycast import LIGHT_RADIUS, Posed, by_processes, camera_rays, shaded, surface_points
from forewarp.synth.shapes import Material, Part, sphere
from forewarp.synth.vehicle import rotation, shift
from forewarp.synth.world import (
    BACK,
    INK,
    LACQUER,
    LEFT,
    LIGHT_AT,
    ROOM_HIGH,
    ROOM_LOW,
    STONES,
    TILES,
    Specimen,
    World,
    room,
    tiled,
)

MOVERS = ("box", "ball")
RADIUS, BOUNCE, GRAVITY = 0.15, 0.36, 9.81  # of the ball, how high it bounces
HALL_LOW, HALL_HIGH = (-3.2, -3.7, ROOM_LOW[2]), (3.2, ROOM_HIGH[1], ROOM_HIGH[2])
FINENESS = 1.8  # of the hall's tiles, which are 20 to 30 pixels wide in the rig's images
# Pictures and mats, whose tiles are 7 to 10 pixels wide: without them the same features are found less
# accurately. A side, then metres: along it and up (a mat: x and y), width and height.
PICTURES = (
    *(("back", -2.6, 0.9, 0.6, 0.8), ("back", -1.7, 1.5, 0.7, 0.5), ("back", -0.5, 1.6, 0.5, 0.7)),
    *(("back", 0.3, 0.6, 0.5, 0.4), ("back", 1.4, 0.5, 0.6, 0.9), ("back", 2.2, 1.3, 0.7, 0.6)),
    *(("left", -2.4, 0.9, 0.7, 0.6), ("left", -1.2, 0.4, 0.6, 0.8), ("left", -0.1, 1.3, 0.7, 0.5)),
    *(("right", -2.4, 0.9, 0.7, 0.6), ("right", -1.2, 0.4, 0.6, 0.8), ("right", -0.1, 1.3, 0.7, 0.5)),
    *(("left", 0.8, 0.6, 0.6, 0.7), ("right", 0.8, 0.6, 0.6, 0.7), ("mat", -1.9, -1.0, 0.7, 0.5)),
    *(("mat", -0.9, -1.5, 0.6, 0.5), ("mat", 0.4, -1.3, 0.7, 0.5), ("mat", 1.3, -0.8, 0.6, 0.7)),
    *(("mat", 1.5, 0.4, 0.7, 0.6), ("mat", -2.4, 0.3, 0.6, 0.6)),
)
PALETTES, SMALL_TILE = (STONES, TILES, LACQUER, BACK, LEFT), 0.04
SHADOW_RAYS = 2  # a sample; eight lights a pixel
_PAD = 4  # pixels around what moves
_TOUCHED = 0.06  # of an image, about
_SAME = 2e-3  # metres by which a ray may miss a point that it shows


def specimen(seconds: float, extra=list) -> Specimen:
    """Make the movers and furniture, whose times from 0 to 1 last ``seconds``; ``extra`` makes more parts."""
    return Specimen(lambda time: _joints(seconds * time), _parts, extra)


def _joints(seconds: float) -> dict[str, np.ndarray]:
    """Place what moves at a time: the box slides to and fro at 0.15 to 1.05 Hz, the ball falls freely."""
    phase = 2 * np.pi * (0.6 * seconds - 0.45 * 5 / (2 * np.pi) * np.cos(2 * np.pi * seconds / 5))
    slid = shift((0.5 * np.sin(phase), 0.22, 0.5 + 0.001))
    turned = rotation(0.5 * seconds + 0.8 * np.sin(2 * np.pi * 0.23 * seconds), 0, 1)
    fall = 2 * np.sqrt(2 * BOUNCE / GRAVITY)
    share = seconds / fall % 1
    x, y = 0.4 * np.sin(2 * np.pi * 0.17 * seconds + 1), -0.42 + 0.08 * np.sin(2 * np.pi * 0.11 * seconds)
    thrown = shift((x, y, ROOM_LOW[2] + RADIUS + 4 * BOUNCE * share * (1 - share)))
    rolled = rotation(-x / RADIUS, 2, 0) @ rotation(0.9 * seconds, 1, 2)
    return {"ground": np.eye(4), "box": slid @ turned, "ball": thrown @ rolled}


def _parts() -> list[Part]:
    """Make what moves, and before the walls a bench, a crate, a shelf and a pillar."""
    floor = ROOM_LOW[2]
    return [
        tiled("box", "box", (-0.16, -0.12, 0.0), (0.16, 0.12, 0.27), TILES, 0.06),
        Part("ball", "ball", *sphere(RADIUS), Material("mosaic", LACQUER, 0.06), smooth=True),
        tiled("bench", "ground", (-0.85, 0.0, floor), (0.85, 0.5, 0.5), STONES, 0.09),
        tiled("crate", "ground", (-1.3, 0.7, floor), (-0.75, 1.2, 0.8), LACQUER, 0.11),
        tiled("shelf", "ground", (-0.5, 1.45, 1.25), (0.9, 1.75, 1.35), (*TILES[:4], INK), 0.07),
        tiled("pillar", "ground", (0.95, 0.9, floor), (1.2, 1.15, 2.0), STONES, 0.08),
    ]


def moving_faces(world: World) -> np.ndarray:
    """Tell which faces (F,) of a world are the movers'."""
    return np.array([part.name in MOVERS for part in world.parts])[world.part_of_face]


def near_movers(world: World, times: Iterable[float], cameras: Sequence[Camera]) -> np.ndarray:
    """Mark the pixels (H, W) bool in a rectangle around each mover, which holds it at all ``times``.

    Args:
        cameras: one for each time.
    """
    corners: dict[str, list] = {name: [] for name in MOVERS}
    for time, camera in zip(times, cameras):
        for name, placed in placed_movers(world, time).items():
            corners[name].append(camera.project(placed)[0].numpy())
    size = cameras[0].width, cameras[0].height
    near = np.zeros(size[::-1], bool)
    for places in map(np.concatenate, corners.values()):
        ends = np.stack([places.min(0) - _PAD, places.max(0) + _PAD])
        (left, top), (right, bottom) = ends.clip(0, size).astype(int)
        near[top:bottom, left:right] = True
    return near


def placed_movers(world: World, time: float) -> dict[str, np.ndarray]:
    """Return the vertices (V, 3) of each mover at a time, by name."""
    maps = world.subject.joints(time)
    return {part.name: part.placed(maps) for part in world.parts if part.name in MOVERS}


@lru_cache(4)
def hall(seconds: float, has_movers: bool = True) -> World:
    """Make the room with or without its movers; times from 0 to 1 last ``seconds``."""
    subject = specimen(seconds, lambda: room(HALL_LOW, HALL_HIGH, FINENESS) + _pictures())
    return World(subject if has_movers else replace(subject, absent=lambda time: MOVERS))


def _pictures() -> list[Part]:
    """Hang pictures on three walls and lay mats on the floor, in small tiles."""
    ways = {  # a place along and up the wall, or on the floor, to the corners (3,) of a thin box
        "back": lambda x, z, w, h: ((x, HALL_HIGH[1] - 0.01, z), (x + w, HALL_HIGH[1], z + h)),
        "left": lambda y, z, w, h: ((HALL_LOW[0], y, z), (HALL_LOW[0] + 0.01, y + w, z + h)),
        "right": lambda y, z, w, h: ((HALL_HIGH[0] - 0.01, y, z), (HALL_HIGH[0], y + w, z + h)),
        "mat": lambda x, y, w, h: ((x, y, HALL_LOW[2]), (x + w, y + h, HALL_LOW[2] + 0.006)),
    }
    made = []
    for number, (side, *place) in enumerate(PICTURES):
        colors, scale = PALETTES[number % len(PALETTES)], SMALL_TILE + 0.003 * (number % 7)
        made.append(tiled(f"{side}{number}", "ground", *ways[side](*place), colors, scale))
    return made


class Film:
    """Frames of a fixed camera, of which only what differs from the still image (H, W, 3) uint8 is kept."""

    def __init__(self, still: np.ndarray) -> None:
        self.still, self.changes = still, []

    def add(self, pixels: np.ndarray, colors: np.ndarray, is_mover: np.ndarray) -> tuple:
        """Add a frame; return it, and bool (H, W), what moves.

        Args:
            pixels: (n,) numbers of those that may differ.
            colors: (n, 3) uint8.
            is_mover: (n,) bool.
        """
        self.changes.append((pixels.astype(np.int32), colors))
        moving = np.zeros(self.still.shape[:2], bool)
        moving.flat[pixels[is_mover]] = True
        return self._changed(pixels, colors), moving

    def _changed(self, pixels: np.ndarray, colors: np.ndarray) -> np.ndarray:
        image = self.still.copy()
        image.reshape(-1, 3)[pixels] = colors
        return image

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self._changed(*change) for change in self.changes)


def filmed(
    views: Sequence[Camera], times: Sequence[list[float]], seconds: float, samples: int, workers: int | None
) -> Iterator:
    """Yield of each fixed camera what ``Film`` takes, then of each of its frames what ``Film.add`` takes.

    Args:
        times: of each camera, in [0, 1].
        seconds: of the ``hall``.
        samples, workers: see ``raycast.render_all``.
    """

    def jobs():
        for view, of_view in zip(views, times):
            yield seconds, None, view, samples, None
            for time, pixels in zip(of_view, touched(view, of_view, seconds)):
                yield seconds, time, view, samples, pixels

    pixels = sum(v.width * v.height * (1 + _TOUCHED * len(of_view)) for v, of_view in zip(views, times))
    return by_processes(_shade, jobs(), pixels * samples, workers)


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


def touched(camera: Camera, times: Iterable[float], seconds: float) -> Iterator[np.ndarray]:
    """Yield of each time the numbers (n,) of the pixels of a fixed camera that movers or their shadows can
    touch: a few more than do.
    """
    world, (origins, directions) = hall(seconds), camera_rays(camera)
    hits = Posed(hall(seconds, has_movers=False), 0.0).first_hits(origins, directions)
    points = np.full(origins.shape, np.inf, np.float32)
    points[hits.ray] = origins[hits.ray] + hits.distance[:, None] * directions[hits.ray]
    to_light = LIGHT_AT.astype(np.float32) - points
    length = np.linalg.norm(to_light, axis=-1)
    for time in times:
        is_touched = near_movers(world, [time], [camera]).ravel()
        for vertices in placed_movers(world, time).values():
            center = 0.5 * (vertices.min(0) + vertices.max(0))
            radius = np.linalg.norm(vertices - center, axis=-1).max() + 0.02
            # A cone from a point to the light's disc meets the sphere around the mover.
            away = center.astype(np.float32) - points
            along = np.einsum("nd,nd->n", away, to_light) / length
            aside = np.sqrt(np.maximum(np.einsum("nd,nd->n", away, away) - along**2, 0))
            is_touched |= (along > -radius) & (aside < radius + LIGHT_RADIUS * (along / length).clip(0, 1))
        yield np.flatnonzero(is_touched)


def still_points(world: World, cameras: Sequence[Camera], rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw ``count`` points of what stands still, less those (N, 3) that no camera sees at time 0."""
    drawn = surface_points(world, count, list(cameras), rng, among=~moving_faces(world))
    return world.points(*drawn, 0.0)[views_of(world, [0.0] * len(cameras), cameras, *drawn) > 0]


def views_of(
    world: World, times: Sequence[float], cameras: Sequence[Camera], face: np.ndarray, barycentric: np.ndarray
) -> np.ndarray:
    """Count the images (N,) that show surface points, which move with what they lie on.

    Args:
        times, cameras: of the images.
        face, barycentric: (N,) and (N, 3), the points; see ``World.points``.

    **Cost** a ray for each point and each image within whose rectangle it falls.
    """
    counts = np.zeros(len(face), np.int64)
    for time, camera in zip(times, cameras):
        points, center = world.points(face, barycentric, time), camera.center.double().numpy()
        pixel, depth = (values.numpy() for values in camera.project(points))
        inside = ((pixel >= 0) & (pixel < (camera.width, camera.height))).all(-1)
        rows = np.flatnonzero((depth > 0) & inside)
        away = points[rows] - center
        distance = np.linalg.norm(away, axis=-1)
        hits = Posed(world, time).first_hits(np.broadcast_to(center, away.shape), away / distance[:, None])
        counts[rows[hits.ray]] += np.abs(hits.distance - distance[hits.ray]) < _SAME
    return counts
