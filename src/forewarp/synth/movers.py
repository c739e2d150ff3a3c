"""Two movers in a room, for films: a box slides and turns on a bench, a ball bounces. Metres and seconds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch

from forewarp.scene.camera import Camera
from forewarp.synth.shapes import Material, Part, box, sphere
from forewarp.synth.vehicle import rotation, shift
from forewarp.synth.world import INK, LACQUER, ROOM_LOW, STONES, TILES, Specimen, World

MOVERS = ("box", "ball")
RADIUS, BOUNCE, GRAVITY = 0.15, 0.36, 9.81  # of the ball, how high it bounces
_PAD = 4  # pixels around what moves


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

    def still(name: str, low, high, colors, scale: float) -> Part:
        return Part(name, "ground", *box(low, high), Material("mosaic", colors, scale))

    return [
        Part("box", "box", *box((-0.16, -0.12, 0.0), (0.16, 0.12, 0.27)), Material("mosaic", TILES, 0.06)),
        Part("ball", "ball", *sphere(RADIUS), Material("mosaic", LACQUER, 0.06), smooth=True),
        still("bench", (-0.85, 0.0, floor), (0.85, 0.5, 0.5), STONES, 0.09),
        still("crate", (-1.3, 0.7, floor), (-0.75, 1.2, 0.8), LACQUER, 0.11),
        still("shelf", (-0.5, 1.45, 1.25), (0.9, 1.75, 1.35), (*TILES[:4], INK), 0.07),
        still("pillar", (0.95, 0.9, floor), (1.2, 1.15, 2.0), (*STONES[:4], INK), 0.08),
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
            corners[name].append(camera.project(torch.from_numpy(placed))[0].numpy())
    width, height = cameras[0].width, cameras[0].height
    near = np.zeros((height, width), bool)
    for places in map(np.concatenate, corners.values()):
        (left, top), (right, bottom) = places.min(0) - _PAD, places.max(0) + _PAD
        columns, rows = (
            slice(*np.clip((a, b), 0, most).astype(int))
            for a, b, most in ((left, right, width), (top, bottom, height))
        )
        near[rows, columns] = True
    return near


def placed_movers(world: World, time: float) -> dict[str, np.ndarray]:
    """Return the vertices (V, 3) of each mover at a time, by name."""
    maps = world.subject.joints(time)
    return {
        part.name: part.vertices @ maps[part.joint][:3, :3].T + maps[part.joint][:3, 3]
        for part in world.parts
        if part.name in MOVERS
    }
