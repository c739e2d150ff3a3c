"""A toy excavator of bricks, a ball and the slab under both, a room around them, and how they move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forewarp.synth.shapes import (
    Material,
    Mesh,
    Part,
    box,
    cylinder,
    joined,
    prism,
    rounded_slab,
    sphere,
    studs,
)

GROUND = -0.5
WHEELS = {
    f"wheel{i}": (x, y, 0.162) for i, (x, y) in enumerate([(-0.36, 1), (-0.36, -1), (0.2, 1), (0.2, -1)])
}
WHEEL_RADIUS, WHEEL_SIDE = 0.16, 0.285
PIVOT, BOOM, STICK = (0.10, 0.0, 0.44), 0.62, 0.46
BALL_RADIUS, BALL_AT = 0.17, (0.34, -0.48)
BAND_FROM, BAND_ALONG_STICK, BAND_SIDE, BAND_RADIUS = (-0.05, 0.52), 0.36, 0.125, 0.022


@dataclass(frozen=True)
class Controls:
    """Angles in degrees, each relative to the link before it; ``travel`` and ``height`` in world units;
    ``turn`` in degrees; ``squash`` the ball's height over its diameter.
    """

    boom: float = 40.0
    stick: float = -132.0
    bucket: float = 14.0
    travel: float = 0.0
    turn: float = 0.0
    height: float = 0.0
    drift: float = 0.0
    squash: float = 1.0


def _ease(time: float) -> float:
    return 0.5 - 0.5 * np.cos(np.pi * time)


def _lift(time: float) -> Controls:
    return Controls(boom=39 + 42 * _ease(time), stick=-112)


def _lift_tilt(time: float) -> Controls:
    up = _ease(time)
    contact = 0.5 - 0.5 * np.cos(2 * np.pi * time)
    return Controls(
        boom=46 + 14 * up,
        stick=-116 + 26 * up,
        bucket=10 + 16 * up + 8 * np.sin(np.pi * time) ** 2,
        height=0.3 * (1 - contact),
        drift=0.12 * up,
        squash=1.06 - 0.3 * contact,
    )


def _drive(time: float) -> Controls:
    go = _ease(time)
    return Controls(
        boom=40 + 14 * go, stick=-132 + 30 * go, bucket=14 + 20 * go, travel=0.42 * go, turn=32 * go
    )


MOTIONS = {"lift": _lift, "lift_tilt": _lift_tilt, "drive": _drive}
START = {"lift": (-0.22, 0.08, 18.0), "lift_tilt": (-0.22, 0.08, 18.0), "drive": (-0.32, -0.02, 4.0)}


def joints(motion: str, time: float) -> dict[str, np.ndarray]:
    """Compute each joint's affine map (4, 4) from its rest frame to the world at ``time``.

    Args:
        motion: a name in MOTIONS.
        time: in [0, 1].
    """
    return placed(MOTIONS[motion](time), START[motion])


def placed(now: Controls, start: tuple[float, float, float]) -> dict[str, np.ndarray]:
    """Compute each joint's affine map (4, 4) from its rest frame to the world.

    Args:
        now: angles and lengths.
        start: the chassis's x, y and heading in degrees.
    """
    chassis = _along_arc(start, now.travel, now.turn)
    boom = chassis @ _shift(PIVOT) @ _raise(now.boom)
    stick = boom @ _shift((BOOM, 0, 0)) @ _raise(now.stick)
    bucket = stick @ _shift((STICK, 0, 0)) @ _raise(now.bucket)
    roll = -np.degrees(now.travel / WHEEL_RADIUS)
    maps = {
        "ground": _shift((0, 0, GROUND)),
        "chassis": chassis,
        "boom": boom,
        "stick": stick,
        "bucket": bucket,
    }
    for name, (x, side, z) in WHEELS.items():
        maps[name] = chassis @ _shift((x, side * WHEEL_SIDE, z)) @ _raise(roll)
    maps["ball"] = _ball_map(now)
    maps["band"] = chassis @ _band_map(now)
    return maps


def _ball_map(now: Controls) -> np.ndarray:
    """Squash the ball along z and widen it across, keeping its volume."""
    wide = now.squash**-0.5
    x, y = BALL_AT
    return _shift((x - now.drift, y, GROUND + 0.002 + BALL_RADIUS * now.squash + now.height)) @ np.diag(
        [wide, wide, now.squash, 1.0]
    )


def _band_map(now: Controls) -> np.ndarray:
    """Map a cylinder of length and radius 1 along x to the span between two pins, in the chassis frame;
    it gets thinner as it stretches, keeping its volume.
    """
    angle = np.radians([now.boom, now.boom + now.stick])
    pin = np.array([PIVOT[0], PIVOT[2]]) + BOOM * _point(angle[0]) + BAND_ALONG_STICK * _point(angle[1])
    span = pin - np.array(BAND_FROM)
    length = np.hypot(*span)
    forward = np.array([span[0], 0, span[1]]) / length
    radius = BAND_RADIUS * (0.6 / length) ** 0.5
    place = np.eye(4)
    place[:3, 0] = length * forward
    place[:3, 1] = (0, radius, 0)
    place[:3, 2] = radius * np.cross(forward, (0, 1.0, 0))
    place[:3, 3] = (BAND_FROM[0], BAND_SIDE, BAND_FROM[1])
    return place


def _along_arc(start: tuple[float, float, float], travel: float, turn: float) -> np.ndarray:
    """Move the chassis by ``travel`` along a circular arc that turns it by ``turn`` degrees."""
    x, y, heading = start
    half = np.radians(turn / 2)
    chord = travel * np.sinc(half / np.pi)
    course = np.radians(heading) + half
    place = _shift((x + chord * np.cos(course), y + chord * np.sin(course), GROUND))
    c, s = _point(np.radians(heading + turn))
    place[:2, :2] = [[c, -s], [s, c]]
    return place


def _point(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def _shift(by) -> np.ndarray:
    place = np.eye(4)
    place[:3, 3] = by
    return place


def _raise(degrees: float) -> np.ndarray:
    """Rotate about y, lifting the x axis towards z."""
    c, s = _point(np.radians(degrees))
    place = np.eye(4)
    place[0, [0, 2]] = c, -s
    place[2, [0, 2]] = s, c
    return place


YELLOW, AMBER, CHARCOAL, STEEL = (
    (0.96, 0.76, 0.20),
    (0.80, 0.58, 0.12),
    (0.25, 0.26, 0.29),
    (0.62, 0.65, 0.70),
)
CREAM, TEAL, SLATE = (0.88, 0.84, 0.74), (0.43, 0.66, 0.63), (0.34, 0.42, 0.45)
GLASS, GLINT, RED, BLUE, GREEN = (
    (0.36, 0.60, 0.80),
    (0.62, 0.80, 0.92),
    (0.86, 0.25, 0.22),
    (0.22, 0.42, 0.78),
    (0.30, 0.72, 0.38),
)

ORANGE = (0.93, 0.49, 0.16)

BODY = Material("bricks", (YELLOW, AMBER), 0.09)
DARK = Material("bricks", (CHARCOAL, (0.17, 0.18, 0.20)), 0.09)
PIN = Material("plain", (CHARCOAL,))
METAL = Material("bricks", (STEEL, (0.48, 0.51, 0.56)), 0.06)
WARNING = Material("slanted", (YELLOW, CHARCOAL), 0.10)


def vehicle() -> list[Part]:
    """Make all parts, the slab below and the ball beside."""
    return _ground() + _chassis() + _arm() + _ball()


def _ground() -> list[Part]:
    slab = rounded_slab(0.78, 0.30, -0.07, 0.0)
    return [Part("ground", "ground", *slab, Material("checker", (CREAM, TEAL, SLATE), 0.245))]


def _chassis() -> list[Part]:
    def part(name: str, mesh: Mesh, material: Material) -> Part:
        return Part(name, "chassis", *mesh, material)

    nubs = [
        studs([-0.49, -0.41], [-0.15, -0.05, 0.05, 0.15], 0.54),
        studs([0.03, 0.13, 0.23, 0.31], [-0.2], 0.34),
        studs([0.03, 0.13, 0.23, 0.31], [0.2], 0.34),
        studs([0.25, 0.33], [-0.08, 0.02, 0.1], 0.34),
    ]
    bracket = [box((PIVOT[0] - 0.08, y, 0.33), (PIVOT[0] + 0.08, y + 0.03, 0.51)) for y in (-0.09, 0.06)]
    axles = [cylinder((x, 0, 0.162), 0.05, 0.5, axis=1) for x in (-0.36, 0.2)]
    lamps = [cylinder((0.385, y, 0.27), 0.035, 0.03, axis=0) for y in (-0.17, 0.17)]
    holder = cylinder((BAND_FROM[0] + 0.01, BAND_SIDE, BAND_FROM[1]), 0.036, 0.09, axis=0)
    parts = [
        part("hull", box((-0.56, -0.25, 0.17), (0.38, 0.25, 0.34)), BODY),
        part("belly", joined([box((-0.5, -0.16, 0.09), (0.33, 0.16, 0.18)), *axles]), DARK),
        part("engine", box((-0.55, -0.21, 0.335), (-0.36, 0.21, 0.54)), DARK),
        part("cabin", box((-0.37, -0.19, 0.335), (-0.03, 0.19, 0.79)), _cabin_material()),
        part("roof", box((-0.41, -0.22, 0.785), (0.0, 0.22, 0.83)), Material("plain", (RED,))),
        part(
            "roof_studs",
            studs([-0.34, -0.24, -0.14, -0.06], [-0.15, -0.05, 0.05, 0.15], 0.83),
            Material("plain", (RED,)),
        ),
        part("studs", joined(nubs[1:]), Material("plain", (YELLOW,))),
        part("engine_studs", nubs[0], PIN),
        part("exhaust", cylinder((-0.46, 0.245, 0.56), 0.032, 0.44), Material("plain", (STEEL,))),
        part("bracket", joined(bracket), METAL),
        part("lamps", joined(lamps), Material("plain", (CREAM,))),
        part("holder", holder, PIN),
    ]
    tyre = Material("wheel", (CHARCOAL, (0.36, 0.37, 0.40), YELLOW, AMBER), 0.095)
    for name in WHEELS:
        parts.append(Part(name, name, *cylinder((0, 0, 0), WHEEL_RADIUS, 0.12, axis=1, segments=40), tyre))
    return parts


def _cabin_material() -> Material:
    return Material("cabin", (YELLOW, AMBER, CHARCOAL, GLASS, GLINT), 0.09)


def _arm() -> list[Part]:
    boom = [
        (-0.05, -0.04),
        (0.28, -0.05),
        (BOOM + 0.04, -0.04),
        (BOOM + 0.04, 0.04),
        (0.3, 0.1),
        (-0.05, 0.05),
    ]
    stick = [
        (-0.09, -0.03),
        (0.06, -0.055),
        (STICK + 0.03, -0.03),
        (STICK + 0.03, 0.03),
        (0.06, 0.05),
        (-0.09, 0.045),
    ]
    pins = [cylinder((x, 0, 0), 0.045, w, axis=1) for x, w in ((0, 0.21), (BOOM, 0.15))]
    hooks = [
        cylinder((STICK, 0, 0), 0.034, 0.13, axis=1),
        cylinder((BAND_ALONG_STICK, (BAND_SIDE - 0.02) / 2, 0), 0.028, BAND_SIDE + 0.06, axis=1),
    ]
    band = cylinder((0.5, 0, 0), 1.0, 1.0, axis=0, segments=20)
    return [
        Part("boom", "boom", *_upright(boom, 0.052), WARNING),
        Part("boom_pins", "boom", *joined(pins), PIN),
        Part("stick", "stick", *_upright(stick, 0.04), BODY),
        Part("stick_pins", "stick", *joined(hooks), PIN),
        Part("bucket", "bucket", *_bucket(), Material("bricks", (ORANGE, (0.62, 0.26, 0.10)), 0.12)),
        Part("band", "band", *band, Material("rings", (GREEN, (0.85, 0.95, 0.75)), 0.1)),
    ]


def _upright(outline, half: float, at: float = 0.0) -> Mesh:
    """Thicken a counter-clockwise outline in (x, z) to ``half`` on either side of y = ``at``."""
    # A prism along y reads its outline as (z, x), which mirrors it, so the order is reversed too.
    return prism([(z, x) for x, z in reversed(outline)], at - half, at + half, axis=1)


def _bucket() -> Mesh:
    """Make an open scoop that hangs by its back at the origin: a bent shell, two cheeks, teeth on its lip."""
    angle = np.radians(np.linspace(95, 300, 13))
    rim = np.stack([0.105 + 0.15 * np.cos(angle), -0.10 + 0.15 * np.sin(angle)], -1)
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    rim = np.concatenate([rim, rim[-1:] + 0.13 * along])
    inward = np.concatenate([-np.stack([np.cos(angle), np.sin(angle)], -1), [[-along[1], along[0]]]])
    inner = rim + 0.06 * inward
    shell = [
        _upright([tuple(rim[i]), tuple(rim[i + 1]), tuple(inner[i + 1]), tuple(inner[i])], 0.175)
        for i in range(len(rim) - 1)
    ]
    cheeks = [_upright([tuple(p) for p in rim], 0.025, at=y) for y in (-0.155, 0.155)]
    lip, thick = rim[-1], 0.018 * inward[-1]
    tooth = [tuple(lip - 0.02 * along), tuple(lip + 0.07 * along), tuple(lip - 0.02 * along + 1.6 * thick)]
    return joined(shell + cheeks + [_upright(tooth, 0.022, at=y) for y in (-0.14, -0.047, 0.047, 0.14)])


def _ball() -> list[Part]:
    gores = Material("beach", (RED, CREAM, BLUE, YELLOW), BALL_RADIUS)
    return [Part("ball", "ball", *sphere(BALL_RADIUS), gores, smooth=True)]


# World units about the ground joint, whose z = 0 is the top of the slab; the slab stands on the floor.
LOW, HIGH = (-2.3, -3.7, -0.0702), (2.3, 1.75, 2.7)
_THICK = 0.1

INK, CHALK = (0.20, 0.21, 0.26), (0.93, 0.92, 0.88)
FLOOR = Material(
    "mosaic", ((0.72, 0.52, 0.34), (0.52, 0.34, 0.21), (0.86, 0.70, 0.50), (0.38, 0.25, 0.17), INK), 0.30
)
BACK = Material(
    "mosaic", ((0.26, 0.42, 0.62), (0.80, 0.72, 0.52), (0.55, 0.70, 0.80), (0.68, 0.36, 0.34), CHALK), 0.34
)
LEFT = Material(
    "mosaic", ((0.46, 0.62, 0.42), (0.84, 0.80, 0.62), (0.28, 0.44, 0.34), (0.70, 0.56, 0.36), CHALK), 0.38
)
RIGHT = Material(
    "mosaic", ((0.62, 0.44, 0.60), (0.88, 0.78, 0.72), (0.42, 0.32, 0.50), (0.78, 0.58, 0.52), CHALK), 0.38
)
CEILING = Material("mosaic", (CHALK, (0.80, 0.82, 0.84), (0.86, 0.84, 0.78), (0.74, 0.78, 0.82), INK), 0.50)


def room() -> list[Part]:
    """Make six thin closed boxes, which cast no shadow, as the light is outside."""
    (x0, y0, z0), (x1, y1, z1), t = LOW, HIGH, _THICK
    walls = [
        ("floor", (x0 - t, y0 - t, z0 - t), (x1 + t, y1 + t, z0), FLOOR),
        ("ceiling", (x0 - t, y0 - t, z1), (x1 + t, y1 + t, z1 + t), CEILING),
        ("left", (x0 - t, y0, z0), (x0, y1, z1), LEFT),
        ("right", (x1, y0, z0), (x1 + t, y1, z1), RIGHT),
        ("front", (x0 - t, y0 - t, z0), (x1 + t, y0, z1), BACK),
        ("back", (x0 - t, y1, z0), (x1 + t, y1 + t, z1), BACK),
    ]
    return [
        Part(name, "ground", *box(low, high), material, casts=False) for name, low, high, material in walls
    ]
