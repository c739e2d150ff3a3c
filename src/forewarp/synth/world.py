"""A subject, perhaps in a room, as one moving mesh; and specimens that each call for a few known effects."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from forewarp.synth.shapes import Material, Part, box, joined, rounded_slab, sphere
from forewarp.synth.vehicle import GROUND, Controls, joints, placed, room, vehicle

INK, CHALK = (0.20, 0.21, 0.26), (0.93, 0.92, 0.88)
STONES = ((0.72, 0.52, 0.34), (0.26, 0.42, 0.62), (0.86, 0.70, 0.50), (0.46, 0.62, 0.42), INK)
TILES = ((0.62, 0.44, 0.60), (0.88, 0.78, 0.72), (0.42, 0.32, 0.50), (0.84, 0.80, 0.62), CHALK)
LACQUER = ((0.58, 0.16, 0.18), (0.20, 0.30, 0.52), (0.30, 0.46, 0.26), (0.62, 0.48, 0.14), INK)


# Least and greatest sine of the elevation: neither along the slab nor straight from above.
ELEVATION = (0.06, 0.96)


@dataclass(frozen=True)
class Specimen:
    """A subject.

    Args:
        joints: time in [0, 1] -> each joint's map (4, 4).
        parts: meshes; None: the vehicle's.
        extra: parts beside the vehicle's.
        light: time -> place of the light (3,); None: it stands still.
        absent: time -> names of the parts that are not there.
        azimuth, rise: range of camera positions; see ``random_cameras``.
    """

    joints: Callable[[float], dict[str, np.ndarray]]
    parts: Callable[[], list[Part]] | None = None
    extra: Callable[[], list[Part]] = list
    light: Callable[[float], np.ndarray] | None = None
    absent: Callable[[float], Collection[str]] = lambda time: ()
    azimuth: tuple[float, float] = (0.0, 360.0)
    rise: tuple[float, float] = ELEVATION


def _still(time: float) -> dict[str, np.ndarray]:
    return placed(Controls(), (-0.22, 0.08, 18.0))


def _rigid(time: float) -> dict[str, np.ndarray]:
    """Drive along an arc with the arm fixed."""
    go = 0.5 - 0.5 * np.cos(np.pi * time)
    return placed(Controls(travel=0.42 * go, turn=32 * go), (-0.32, -0.02, 4.0))


def _quick(time: float) -> dict[str, np.ndarray]:
    """Drive forth and back three times: more than a few cosines can represent."""
    return placed(Controls(travel=0.3 * (0.5 - 0.5 * np.cos(6 * np.pi * time))), (-0.32, -0.02, 4.0))


def _map(scale: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    place = np.diag([*scale, 1.0])
    place[:3, 3] = shift
    return place


def _band(time: float) -> dict[str, np.ndarray]:
    """Let a sheet on a pillar rest at first, then stretch it to five times its width."""
    wide = 1 + 4 * (0.5 - 0.5 * np.cos(np.pi * max(0.0, (time - 0.2) / 0.8)))
    return {"pillar": np.eye(4), "sheet": _map((wide, wide, 1), (0, 0, 0))}


def _sheet() -> list[Part]:
    pillar = Material("bricks", ((0.25, 0.26, 0.29), (0.62, 0.65, 0.70)), 0.08)
    rubber = Material("checker", ((0.86, 0.45, 0.20), (0.26, 0.42, 0.62), INK), 0.13)
    return [
        Part("pillar", "pillar", *box((-0.1, -0.1, -0.5), (0.1, 0.1, -0.04)), pillar),
        Part("sheet", "sheet", *box((-0.13, -0.12, -0.05), (0.13, 0.12, 0.05)), rubber),
    ]


def _globe() -> list[Part]:
    lacquer = replace(Material("mosaic", LACQUER, 0.16), gloss=0.75, shine=5.0)
    vertices, faces = sphere(0.52, rings=40, segments=64)
    plate = rounded_slab(0.7, 0.2, -0.07, 0.0)
    return [
        Part("globe", "globe", vertices, faces, lacquer, smooth=True),
        Part("plate", "ground", *plate, replace(lacquer, colors=TILES, gloss=0.6)),
    ]


def _globe_joints(time: float) -> dict[str, np.ndarray]:
    return {"ground": _map((1, 1, 1), (0, 0, GROUND)), "globe": _map((1, 1, 1), (0, 0, GROUND + 0.5))}


def _corner() -> list[Part]:
    """Make a floor and two walls behind the subject; they fill every picture."""
    low, high, thick = 1.1, 5.0, 0.1
    floor = GROUND - 0.0702
    walls = [
        ("floor", (-low - thick, -low - thick, floor - thick), (high, high, floor), STONES),
        ("wall_x", (-low - thick, -low - thick, floor), (-low, high, high), TILES),
        ("wall_y", (-low, -low - thick, floor), (high, -low, high), LACQUER),
    ]
    return [
        Part(name, "room", *box(start, end), Material("mosaic", colors, 0.22), casts=False)
        for name, start, end, colors in walls
    ]


def _in_room(time: float) -> dict[str, np.ndarray]:
    return _rigid(time) | {"room": np.eye(4)}


def _matte_globe() -> list[Part]:
    globe, plate = _globe()
    matte = Material("mosaic", STONES, 0.16)
    return [replace(globe, material=matte), replace(plate, material=replace(matte, colors=TILES))]


def _sun(time: float) -> np.ndarray:
    """Let the light go halfway round the scene, low above the ground in the middle of its way."""
    angle = np.radians(-140 + 180 * time)
    return 5.5 * np.array([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.6])


# From when to when a block is there.
_STAY = {"north": (0.0, 0.34), "west": (0.0, 0.62), "south": (0.42, 1.0), "east": (0.7, 1.0)}


def _blocks() -> list[Part]:
    """Put four blocks around a pillar on a plate, which each come or go."""
    plate, pillar = rounded_slab(0.7, 0.2, -0.07, 0.0), box((-0.14, -0.14, 0.0), (0.14, 0.14, 0.7))
    parts = [
        Part("plate", "ground", *plate, Material("mosaic", TILES, 0.2)),
        Part("pillar", "ground", *pillar, Material("mosaic", STONES, 0.14)),
    ]
    paint = {"north": LACQUER, "west": STONES, "south": TILES, "east": LACQUER}
    for name, (x, y) in {"north": (0, 1), "west": (-1, 0), "south": (0, -1), "east": (1, 0)}.items():
        middle = 0.35 * np.array([x, y, 0.0])
        solid = box(middle - (0.2, 0.2, 0.0), middle + (0.2, 0.2, 0.42))
        parts.append(Part(name, "ground", *solid, Material("mosaic", paint[name], 0.13)))
    return parts


def _spin(time: float) -> dict[str, np.ndarray]:
    """Turn three wings about the axis where they meet by a sixth of a turn."""
    angle = np.radians(60) * (0.5 - 0.5 * np.cos(np.pi * time))
    place = np.eye(4)
    place[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return {"wings": place}


def _wings() -> list[Part]:
    """Set up three wings, as of a revolving door."""
    parts = []
    for name, turn, colors in (("first", 0, LACQUER), ("second", 120, TILES), ("third", 240, STONES)):
        vertices, faces = box((0.02, -0.05, -0.45), (0.62, 0.05, 0.35))
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        vertices = vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        parts.append(Part(name, "wings", vertices, faces, Material("mosaic", colors, 0.13)))
    return parts


def _gone(time: float) -> list[str]:
    return [name for name, (come, go) in _STAY.items() if not come <= time <= go]


SPECIMENS = {
    "still": Specimen(_still),
    "rigid": Specimen(_rigid),
    "band": Specimen(_band, _sheet),
    "glossy": Specimen(_globe_joints, _globe),
    "room": Specimen(_in_room, extra=_corner, azimuth=(28.0, 62.0), rise=(0.28, 0.5)),
    "quick": Specimen(_quick),
    "spin": Specimen(_spin, _wings),
    "daylight": Specimen(_globe_joints, _matte_globe, light=_sun),
    "blocks": Specimen(_globe_joints, _blocks, absent=_gone),
}


class World:
    """Everything in the scene as one mesh of fixed topology that moves by ``motion``.

    ``faces`` (F, 3) index the vertices of ``place``; ``part_of_face`` (F,) indexes ``parts``; ``rest``
    (V, 3) are coordinates in each part's rest frame, from which colours are computed.

    Args:
        motion: a name in ``motions.MOTIONS`` (the vehicle) or in ``specimens.SPECIMENS``.
        has_room: put a static room around the subject.
    """

    def __init__(self, motion: str = "lift_tilt", has_room: bool = False):
        self.motion, self.has_room = motion, has_room
        self.specimen = specimen = SPECIMENS.get(motion)
        self.joints = partial(joints, motion) if specimen is None else specimen.joints
        self.parts = vehicle() if specimen is None or specimen.parts is None else specimen.parts()
        self.parts += [] if specimen is None else specimen.extra()
        self.parts += room() if has_room else []
        self.rest, self.faces = joined([(p.vertices, p.faces) for p in self.parts])
        self.part_of_face = np.repeat(np.arange(len(self.parts)), [len(p.faces) for p in self.parts])
        self.smooth = np.array([p.smooth for p in self.parts])[self.part_of_face]
        self.casts = np.array([p.casts for p in self.parts])[self.part_of_face]

    def place(self, time: float) -> np.ndarray:
        """Place every vertex at any ``time`` in [0, 1]: world positions (V, 3) float64."""
        at = self.joints(time)
        return np.concatenate([p.vertices @ at[p.joint][:3, :3].T + at[p.joint][:3, 3] for p in self.parts])

    def light(self, time: float) -> np.ndarray | None:
        """Return where the light is (3,); None where it stands still."""
        return None if self.specimen is None or self.specimen.light is None else self.specimen.light(time)

    def there(self, time: float) -> np.ndarray:
        """Tell which faces (F,) are there at ``time``."""
        absent = () if self.specimen is None else self.specimen.absent(time)
        return np.array([part.name not in absent for part in self.parts])[self.part_of_face]

    def points(self, faces: np.ndarray, barycentric: np.ndarray, time: float) -> np.ndarray:
        """Place surface points, given as faces (N,) and barycentric (N, 3), at ``time``: (N, 3)."""
        corners = self.place(time)[self.faces[faces]]  # (N, 3, 3)
        return np.einsum("nc,ncd->nd", barycentric, corners)
