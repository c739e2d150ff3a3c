"""A subject, perhaps in a room, as one moving mesh; and specimens that each call for a few known effects.

A plan made from a specimen's images should switch on only the effects that
``scene=specimen_<name>`` lists in ``conf/options.yaml`` or, for a method with a list of its own,
below ``scenes`` in ``conf/numbers/<method>.yaml``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch

from forewarp.scene.frame import Truth
from forewarp.synth.shapes import Material, Part, box, joined, rounded_slab, sphere
from forewarp.synth.vehicle import GROUND, MOTIONS, ease, quick, rigid, rotation, shift, still, vehicle

INK, CHALK = (0.20, 0.21, 0.26), (0.93, 0.92, 0.88)
STONES = ((0.72, 0.52, 0.34), (0.26, 0.42, 0.62), (0.86, 0.70, 0.50), (0.46, 0.62, 0.42), INK)
TILES = ((0.62, 0.44, 0.60), (0.88, 0.78, 0.72), (0.42, 0.32, 0.50), (0.84, 0.80, 0.62), CHALK)
LACQUER = ((0.58, 0.16, 0.18), (0.20, 0.30, 0.52), (0.30, 0.46, 0.26), (0.62, 0.48, 0.14), INK)
GLOSSY, MATTE = Material("mosaic", LACQUER, 0.16, gloss=0.75, shine=5.0), Material("mosaic", STONES, 0.16)
LIGHT_AT = np.array([2.2, -2.6, 4.6])
Range = tuple[float, float]
# Least and greatest azimuth of a camera, in degrees, and sine of its elevation: neither along the slab nor
# straight from above.
AROUND, ELEVATION = (0.0, 360.0), (0.06, 0.96)

# World units about the ground joint, whose z = 0 is the top of the slab; the slab stands on the floor.
ROOM_LOW, ROOM_HIGH = (-2.3, -3.7, -0.0702), (2.3, 1.75, 2.7)
FLOOR = (0.72, 0.52, 0.34), (0.52, 0.34, 0.21), (0.86, 0.70, 0.50), (0.38, 0.25, 0.17), INK
BACK = (0.26, 0.42, 0.62), (0.80, 0.72, 0.52), (0.55, 0.70, 0.80), (0.68, 0.36, 0.34), CHALK
LEFT = (0.46, 0.62, 0.42), (0.84, 0.80, 0.62), (0.28, 0.44, 0.34), (0.70, 0.56, 0.36), CHALK
RIGHT = (0.62, 0.44, 0.60), (0.88, 0.78, 0.72), (0.42, 0.32, 0.50), (0.78, 0.58, 0.52), CHALK
CEILING = CHALK, (0.80, 0.82, 0.84), (0.86, 0.84, 0.78), (0.74, 0.78, 0.82), INK


@dataclass(frozen=True)
class Specimen:
    """A subject.

    Args:
        joints: time in [0, 1] -> each joint's map (4, 4).
        parts: meshes.
        extra: parts beside them.
        light: time -> place of the light (3,).
        absent: time -> names of the parts that are not there.
        azimuth, rise: range of camera positions; see ``random_cameras``.
    """

    joints: Callable[[float], dict[str, np.ndarray]]
    parts: Callable[[], list[Part]] = vehicle
    extra: Callable[[], list[Part]] = list
    light: Callable[[float], np.ndarray] = lambda time: LIGHT_AT
    absent: Callable[[float], Collection[str]] = lambda time: ()
    azimuth: Range = AROUND
    rise: Range = ELEVATION


def _band(time: float) -> dict[str, np.ndarray]:
    """Let a sheet on a pillar rest at first, then stretch it to five times its width."""
    wide = 1 + 4 * ease(max(0.0, (time - 0.2) / 0.8))
    return {"pillar": np.eye(4), "sheet": np.diag([wide, wide, 1, 1.0])}


def _sheet() -> list[Part]:
    pillar = Material("bricks", ((0.25, 0.26, 0.29), (0.62, 0.65, 0.70)), 0.08)
    rubber = Material("checker", ((0.86, 0.45, 0.20), (0.26, 0.42, 0.62), INK), 0.13)
    return [
        Part("pillar", "pillar", *box((-0.1, -0.1, -0.5), (0.1, 0.1, -0.04)), pillar),
        Part("sheet", "sheet", *box((-0.13, -0.12, -0.05), (0.13, 0.12, 0.05)), rubber),
    ]


def tiled(name: str, joint: str, low, high, colors, scale: float, casts: bool = True) -> Part:
    """Make a box between two corners (3,), in a mosaic of tiles."""
    return Part(name, joint, *box(low, high), Material("mosaic", colors, scale), casts=casts)


def _plate(material: Material) -> Part:
    return Part("plate", "ground", *rounded_slab(0.7, 0.2, -0.07, 0.0), material)


def _globe(globe: Material, plate: Material) -> list[Part]:
    return [Part("globe", "globe", *sphere(0.52, rings=40, segments=64), globe, smooth=True), _plate(plate)]


def _globe_joints(time: float) -> dict[str, np.ndarray]:
    return {"ground": shift((0, 0, GROUND)), "globe": shift((0, 0, GROUND + 0.5))}


def _corner() -> list[Part]:
    """Make a floor and two walls behind the subject; they fill every image."""
    near, far, outside, floor = -1.1, 5.0, -1.1 - 0.1, GROUND - 0.0702
    return [
        tiled("floor", "room", (outside, outside, floor - 0.1), (far, far, floor), STONES, 0.22, False),
        tiled("wall_x", "room", (outside, outside, floor), (near, far, far), TILES, 0.22, False),
        tiled("wall_y", "room", (near, outside, floor), (far, near, far), LACQUER, 0.22, False),
    ]


def _in_room(time: float) -> dict[str, np.ndarray]:
    return rigid(time) | {"room": np.eye(4)}


def _sun(time: float) -> np.ndarray:
    """Let the light go halfway round the scene, low above the ground in the middle of its way."""
    angle = np.radians(-140 + 180 * time)
    return 5.5 * np.array([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.6])


# From when to when a block is there, where it stands on the plate, and its colours.
BLOCKS = {
    "north": ((0.0, 0.34), (0, 1), LACQUER),
    "west": ((0.0, 0.62), (-1, 0), STONES),
    "south": ((0.42, 1.0), (0, -1), TILES),
    "east": ((0.7, 1.0), (1, 0), LACQUER),
}


def _blocks() -> list[Part]:
    """Put four blocks around a pillar on a plate, which each come or go."""
    pillar = tiled("pillar", "ground", (-0.14, -0.14, 0.0), (0.14, 0.14, 0.7), STONES, 0.14)
    parts = [_plate(Material("mosaic", TILES, 0.2)), pillar]
    for name, (_, (x, y), colors) in BLOCKS.items():
        middle = 0.35 * np.array([x, y, 0.0])
        low, high = middle - (0.2, 0.2, 0.0), middle + (0.2, 0.2, 0.42)
        parts.append(tiled(name, "ground", low, high, colors, 0.13))
    return parts


def _absent_blocks(time: float) -> list[str]:
    return [name for name, ((begin, end), *_) in BLOCKS.items() if not begin <= time <= end]


def _spin(time: float) -> dict[str, np.ndarray]:
    """Turn three wings about the axis where they meet by a sixth of a turn."""
    return {"wings": rotation(np.radians(60) * ease(time), 0, 1)}


def _wings() -> list[Part]:
    """Set up three wings, as of a revolving door."""
    parts, (vertices, faces) = [], box((0.02, -0.05, -0.45), (0.62, 0.05, 0.35))
    for name, turn, colors in (("first", 0, LACQUER), ("second", 120, TILES), ("third", 240, STONES)):
        turned = vertices @ rotation(np.radians(turn), 0, 1)[:3, :3].T
        parts.append(Part(name, "wings", turned, faces, Material("mosaic", colors, 0.13)))
    return parts


def room(low=ROOM_LOW, high=ROOM_HIGH, fineness: float = 1.0) -> list[Part]:
    """Make six thin closed boxes, which cast no shadow, as the light is outside.

    Args:
        low, high: corners (3,) of the space within.
        fineness: how many times smaller the tiles are.
    """
    (x0, y0, z0), (x1, y1, z1), t = low, high, 0.1
    sides = (
        ("floor", (x0 - t, y0 - t, z0 - t), (x1 + t, y1 + t, z0), FLOOR, 0.30),
        ("ceiling", (x0 - t, y0 - t, z1), (x1 + t, y1 + t, z1 + t), CEILING, 0.50),
        ("left", (x0 - t, y0, z0), (x0, y1, z1), LEFT, 0.38),
        ("right", (x1, y0, z0), (x1 + t, y1, z1), RIGHT, 0.38),
        ("front", (x0 - t, y0 - t, z0), (x1 + t, y0, z1), BACK, 0.34),
        ("back", (x0 - t, y1, z0), (x1 + t, y1 + t, z1), BACK, 0.34),
    )
    return [tiled(name, "ground", *box, scale / fineness, casts=False) for name, *box, scale in sides]


SPECIMENS = {
    "still": Specimen(still),
    "rigid": Specimen(rigid),
    "band": Specimen(_band, _sheet),
    "glossy": Specimen(_globe_joints, lambda: _globe(GLOSSY, replace(GLOSSY, colors=TILES, gloss=0.6))),
    "room": Specimen(_in_room, extra=_corner, azimuth=(28.0, 62.0), rise=(0.28, 0.5)),
    "quick": Specimen(quick),
    "spin": Specimen(_spin, _wings),
    "daylight": Specimen(_globe_joints, lambda: _globe(MATTE, replace(MATTE, colors=TILES)), light=_sun),
    "blocks": Specimen(_globe_joints, _blocks, absent=_absent_blocks),
}
SUBJECTS = {name: Specimen(joints) for name, joints in MOTIONS.items()} | SPECIMENS


class World:
    """Everything in the scene as one mesh of fixed topology that moves by ``motion``.

    ``faces`` (F, 3) index the vertices of ``place``; ``part_of_face`` (F,) indexes ``parts``; ``rest``
    (V, 3) are coordinates in each part's rest frame, from which colours are computed.

    Args:
        motion: a name in ``SUBJECTS``, or a subject, which ``render_all`` renders in this process only.
        has_room: put a static room around the subject.
    """

    def __init__(self, motion: str | Specimen = "lift_tilt", has_room: bool = False):
        self.motion, self.has_room = motion, has_room
        self.subject = motion if isinstance(motion, Specimen) else SUBJECTS[motion]
        self.parts = self.subject.parts() + self.subject.extra() + (room() if has_room else [])
        self.rest, self.faces = joined([(p.vertices, p.faces) for p in self.parts])
        self.part_of_face = np.repeat(np.arange(len(self.parts)), [len(p.faces) for p in self.parts])
        self.smooth = np.array([p.smooth for p in self.parts])[self.part_of_face]
        self.casts = np.array([p.casts for p in self.parts])[self.part_of_face]

    def __reduce__(self) -> tuple:
        """Let other processes make it anew, once."""
        return _world, (self.motion, self.has_room)

    def place(self, time: float) -> np.ndarray:
        """Place every vertex at any ``time`` in [0, 1]: world positions (V, 3) float64."""
        maps = self.subject.joints(time)
        return np.concatenate([part.placed(maps) for part in self.parts])

    def is_there(self, time: float) -> np.ndarray:
        """Tell which faces (F,) are there at ``time``."""
        absent = self.subject.absent(time)
        return np.array([part.name not in absent for part in self.parts])[self.part_of_face]

    def points(self, faces: np.ndarray, barycentric: np.ndarray, time: float) -> np.ndarray:
        """Place surface points, given as faces (N,) and barycentric (N, 3), at ``time``: (N, 3)."""
        corners = self.place(time)[self.faces[faces]]  # (N, 3, 3)
        return np.einsum("nc,ncd->nd", barycentric, corners)

    def trajectories(self, faces: np.ndarray, barycentric: np.ndarray, times: np.ndarray) -> Truth:
        """Follow surface points (N) over ``times`` (T,), the canonical time first; float32 world units."""
        points = np.stack([self.points(faces, barycentric, time) for time in times], 1).astype(np.float32)
        return Truth(torch.from_numpy(points), torch.from_numpy(np.asarray(times, np.float64)))


@lru_cache(4)
def _world(motion: str, has_room: bool) -> World:
    return World(motion, has_room)
