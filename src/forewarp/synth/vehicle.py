"""A toy excavator of bricks, a ball and the slab under both, and how they move.

Every joint is an affine map (4, 4) at every time in [0, 1], so every point of a part has an exact position.
The controls are sums of cosines of at most three half periods, which a few low DCT frequencies span.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from forewarp.synth.shapes import Material, Mesh, Part, box, cylinder, joined, prism, rounded_slab, sphere

GROUND = -0.5
WHEELS = {f"wheel{i}": (x, side, 0.162) for i, (x, side) in enumerate(product((-0.36, 0.2), (1, -1)))}
WHEEL_RADIUS, WHEEL_SIDE = 0.16, 0.285
PIVOT, BOOM, STICK = (0.10, 0.0, 0.44), 0.62, 0.46
BALL_RADIUS, BALL_AT = 0.17, (0.34, -0.48)
BAND_FROM, BAND_ALONG_STICK, BAND_SIDE, BAND_RADIUS = (-0.05, 0.52), 0.36, 0.125, 0.022
START, DRIVE_START = (-0.22, 0.08, 18.0), (-0.32, -0.02, 4.0)  # x, y and heading in degrees

YELLOW, AMBER, CHARCOAL = (0.96, 0.76, 0.20), (0.80, 0.58, 0.12), (0.25, 0.26, 0.29)
STEEL, GLASS, GLINT = (0.62, 0.65, 0.70), (0.36, 0.60, 0.80), (0.62, 0.80, 0.92)
CREAM, TEAL, SLATE = (0.88, 0.84, 0.74), (0.43, 0.66, 0.63), (0.34, 0.42, 0.45)
RED, BLUE, GREEN, ORANGE = (0.86, 0.25, 0.22), (0.22, 0.42, 0.78), (0.30, 0.72, 0.38), (0.93, 0.49, 0.16)

BODY = Material("bricks", (YELLOW, AMBER), 0.09)
DARK = Material("bricks", (CHARCOAL, (0.17, 0.18, 0.20)), 0.09)
PIN = Material("plain", (CHARCOAL,))
METAL = Material("bricks", (STEEL, (0.48, 0.51, 0.56)), 0.06)
WARNING = Material("slanted", (YELLOW, CHARCOAL), 0.10)
CABIN = Material("cabin", (YELLOW, AMBER, CHARCOAL, GLASS, GLINT), 0.09)
TYRE = Material("wheel", (CHARCOAL, (0.36, 0.37, 0.40), YELLOW, AMBER), 0.095)
BEACH = Material("beach", (RED, CREAM, BLUE, YELLOW), BALL_RADIUS)


def ease(time: float) -> float:
    """Go from 0 to 1 along half a period of a cosine."""
    return 0.5 - 0.5 * np.cos(np.pi * time)


def lift(time: float) -> dict[str, np.ndarray]:
    """Lift the boom; return each joint's map."""
    return placed(START, boom=39 + 42 * ease(time), stick=-112)


def lift_tilt(time: float) -> dict[str, np.ndarray]:
    """Lift and tilt the whole arm while the ball bounces and drifts; return each joint's map."""
    up, contact = ease(time), 0.5 - 0.5 * np.cos(2 * np.pi * time)
    arm = {"boom": 46 + 14 * up, "stick": -116 + 26 * up}
    arm["bucket"] = 10 + 16 * up + 8 * np.sin(np.pi * time) ** 2
    return placed(START, **arm, height=0.3 * (1 - contact), drift=0.12 * up, squash=1.06 - 0.3 * contact)


def drive(time: float) -> dict[str, np.ndarray]:
    """Drive along an arc while the arm moves; return each joint's map."""
    go = ease(time)
    arm = {"boom": 40 + 14 * go, "stick": -132 + 30 * go, "bucket": 14 + 20 * go}
    return placed(DRIVE_START, **arm, travel=0.42 * go, turn=32 * go)


def still(time: float) -> dict[str, np.ndarray]:
    """Stand still; return each joint's map."""
    return placed(START)


def rigid(time: float) -> dict[str, np.ndarray]:
    """Drive along an arc with the arm fixed; return each joint's map."""
    return placed(DRIVE_START, travel=0.42 * ease(time), turn=32 * ease(time))


def quick(time: float) -> dict[str, np.ndarray]:
    """Drive forth and back three times, more than a few cosines can represent; return each joint's map."""
    return placed(DRIVE_START, travel=0.3 * (0.5 - 0.5 * np.cos(6 * np.pi * time)))


MOTIONS = {"lift": lift, "lift_tilt": lift_tilt, "drive": drive}


def placed(
    start: tuple[float, float, float],
    *,
    boom: float = 40.0,
    stick: float = -132.0,
    bucket: float = 14.0,
    travel: float = 0.0,
    turn: float = 0.0,
    height: float = 0.0,
    drift: float = 0.0,
    squash: float = 1.0,
) -> dict[str, np.ndarray]:
    """Compute each joint's affine map (4, 4) from its rest frame to the world.

    Args:
        start: the chassis's x, y and heading in degrees.
        boom, stick, bucket: degrees, each relative to the link before it.
        travel, turn: of the chassis, world units and degrees.
        height, drift: of the ball, world units.
        squash: the ball's height over its diameter.
    """
    chassis = link = _along_arc(start, travel, turn)
    maps = {"ground": shift((0, 0, GROUND)), "chassis": chassis, "band": chassis @ _band(boom, boom + stick)}
    joints = (("boom", PIVOT, boom), ("stick", (BOOM, 0, 0), stick), ("bucket", (STICK, 0, 0), bucket))
    for name, pin, angle in joints:
        link = maps[name] = link @ shift(pin) @ rotation(np.radians(angle), 0, 2)
    roll = -np.degrees(travel / WHEEL_RADIUS)
    for name, (x, side, z) in WHEELS.items():
        maps[name] = chassis @ shift((x, side * WHEEL_SIDE, z)) @ rotation(np.radians(roll), 0, 2)
    # The ball is squashed along z and widens across, keeping its volume.
    wide, (x, y) = squash**-0.5, BALL_AT
    z = GROUND + 0.002 + BALL_RADIUS * squash + height
    maps["ball"] = shift((x - drift, y, z)) @ np.diag([wide, wide, squash, 1.0])
    return maps


def shift(by) -> np.ndarray:
    """Make the map (4, 4) that moves points by (3,)."""
    place = np.eye(4)
    place[:3, 3] = by
    return place


def _band(boom: float, stick: float) -> np.ndarray:
    """Map a cylinder of length and radius 1 along x to the span between two pins, in the chassis frame;
    it gets thinner as it stretches, keeping its volume. Angles of boom and stick are degrees above level.
    """
    boom, stick = np.radians([boom, stick])
    pin = np.array([PIVOT[0], PIVOT[2]]) + BOOM * _direction(boom) + BAND_ALONG_STICK * _direction(stick)
    span = pin - np.array(BAND_FROM)
    length = np.hypot(*span)
    forward = np.array([span[0], 0, span[1]]) / length
    radius = BAND_RADIUS * (0.6 / length) ** 0.5
    place = shift((BAND_FROM[0], BAND_SIDE, BAND_FROM[1]))
    place[:3, 0] = length * forward
    place[:3, 1] = (0, radius, 0)
    place[:3, 2] = radius * np.cross(forward, (0, 1.0, 0))
    return place


def _along_arc(start: tuple[float, float, float], travel: float, turn: float) -> np.ndarray:
    """Move the chassis by ``travel`` along a circular arc that turns it by ``turn`` degrees."""
    x, y, heading = start
    half = np.radians(turn / 2)
    chord = travel * np.sinc(half / np.pi)
    course = np.radians(heading) + half
    place = shift((x + chord * np.cos(course), y + chord * np.sin(course), GROUND))
    return place @ rotation(np.radians(heading + turn), 0, 1)


def _direction(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def rotation(angle: float, first: int, second: int) -> np.ndarray:
    """Rotate (4, 4) by ``angle``, in radians, from the first of two axes towards the second."""
    cosine, sine = _direction(angle)
    place = np.eye(4)
    place[first, [first, second]] = cosine, -sine
    place[second, [first, second]] = sine, cosine
    return place


def vehicle() -> list[Part]:
    """Make all parts, the slab below and the ball beside."""
    slab = rounded_slab(0.78, 0.30, -0.07, 0.0)
    ground = Part("ground", "ground", *slab, Material("checker", (CREAM, TEAL, SLATE), 0.245))
    ball = Part("ball", "ball", *sphere(BALL_RADIUS), BEACH, smooth=True)
    return [ground, *_chassis(), *_arm(), ball]


def _chassis() -> list[Part]:
    across, along = [-0.15, -0.05, 0.05, 0.15], [0.03, 0.13, 0.23, 0.31]
    hull_studs = [_studs(along, [-0.2], 0.34), _studs(along, [0.2], 0.34)]
    hull_studs.append(_studs([0.25, 0.33], [-0.08, 0.02, 0.1], 0.34))
    bracket = [box((PIVOT[0] - 0.08, y, 0.33), (PIVOT[0] + 0.08, y + 0.03, 0.51)) for y in (-0.09, 0.06)]
    axles = [cylinder((x, 0, 0.162), 0.05, 0.5, axis=1) for x in (-0.36, 0.2)]
    lamps = [cylinder((0.385, y, 0.27), 0.035, 0.03, axis=0) for y in (-0.17, 0.17)]
    holder = cylinder((BAND_FROM[0] + 0.01, BAND_SIDE, BAND_FROM[1]), 0.036, 0.09, axis=0)
    red = Material("plain", (RED,))
    parts: list[tuple[str, Mesh, Material]] = [
        ("hull", box((-0.56, -0.25, 0.17), (0.38, 0.25, 0.34)), BODY),
        ("belly", joined([box((-0.5, -0.16, 0.09), (0.33, 0.16, 0.18)), *axles]), DARK),
        ("engine", box((-0.55, -0.21, 0.335), (-0.36, 0.21, 0.54)), DARK),
        ("cabin", box((-0.37, -0.19, 0.335), (-0.03, 0.19, 0.79)), CABIN),
        ("roof", box((-0.41, -0.22, 0.785), (0.0, 0.22, 0.83)), red),
        ("roof_studs", _studs([-0.34, -0.24, -0.14, -0.06], across, 0.83), red),
        ("studs", joined(hull_studs), Material("plain", (YELLOW,))),
        ("engine_studs", _studs([-0.49, -0.41], across, 0.54), PIN),
        ("exhaust", cylinder((-0.46, 0.245, 0.56), 0.032, 0.44), Material("plain", (STEEL,))),
        ("bracket", joined(bracket), METAL),
        ("lamps", joined(lamps), Material("plain", (CREAM,))),
        ("holder", holder, PIN),
    ]
    tyre = cylinder((0, 0, 0), WHEEL_RADIUS, 0.12, axis=1, segments=40)
    wheels = [Part(name, name, *tyre, TYRE) for name in WHEELS]
    return [Part(name, "chassis", *mesh, material) for name, mesh, material in parts] + wheels


def _arm() -> list[Part]:
    boom = [(-0.05, -0.04), (0.28, -0.05), (BOOM + 0.04, -0.04)]
    boom += [(BOOM + 0.04, 0.04), (0.3, 0.1), (-0.05, 0.05)]
    stick = [(-0.09, -0.03), (0.06, -0.055), (STICK + 0.03, -0.03)]
    stick += [(STICK + 0.03, 0.03), (0.06, 0.05), (-0.09, 0.045)]
    pins = [cylinder((x, 0, 0), 0.045, width, axis=1) for x, width in ((0, 0.21), (BOOM, 0.15))]
    hook = cylinder((BAND_ALONG_STICK, (BAND_SIDE - 0.02) / 2, 0), 0.028, BAND_SIDE + 0.06, axis=1)
    hooks = [cylinder((STICK, 0, 0), 0.034, 0.13, axis=1), hook]
    band = cylinder((0.5, 0, 0), 1.0, 1.0, axis=0, segments=20)
    return [
        Part("boom", "boom", *_upright(boom, 0.052), WARNING),
        Part("boom_pins", "boom", *joined(pins), PIN),
        Part("stick", "stick", *_upright(stick, 0.04), BODY),
        Part("stick_pins", "stick", *joined(hooks), PIN),
        Part("bucket", "bucket", *_bucket(), Material("bricks", (ORANGE, (0.62, 0.26, 0.10)), 0.12)),
        Part("band", "band", *band, Material("rings", (GREEN, (0.85, 0.95, 0.75)), 0.1)),
    ]


def _studs(xs, ys, z: float, radius: float = 0.032, height: float = 0.026) -> Mesh:
    """Put brick studs at every (x, y) of two lists, at height ``z``."""
    # Sunk a little, so that the foot does not lie in the plane below.
    centers = [(x, y, z + height / 2 - 0.002) for x in xs for y in ys]
    return joined([cylinder(center, radius, height + 0.004, segments=16) for center in centers])


def _upright(outline, half: float, at: float = 0.0) -> Mesh:
    """Thicken a counter-clockwise outline in (x, z) to ``half`` on either side of y = ``at``."""
    # A prism along y reads its outline as (z, x), which mirrors it, so the order is reversed too.
    return prism([(z, x) for x, z in reversed(outline)], at - half, at + half, axis=1)


def _bucket() -> Mesh:
    """Make an open scoop that hangs by its back at the origin: a bent shell, two cheeks, teeth on its lip."""
    angle = np.radians(np.linspace(95, 300, 13))
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    rim = np.stack([0.105 + 0.15 * np.cos(angle), -0.10 + 0.15 * np.sin(angle)], -1)
    rim = np.concatenate([rim, rim[-1:] + 0.13 * along])
    inward = np.concatenate([-circle, [[-along[1], along[0]]]])
    inner = rim + 0.06 * inward
    shell = [_upright([rim[i], rim[i + 1], inner[i + 1], inner[i]], 0.175) for i in range(len(rim) - 1)]
    cheeks = [_upright(rim, 0.025, at=y) for y in (-0.155, 0.155)]
    lip, thick = rim[-1], 0.018 * inward[-1]
    tooth = [lip - 0.02 * along, lip + 0.07 * along, lip - 0.02 * along + 1.6 * thick]
    return joined(shell + cheeks + [_upright(tooth, 0.022, at=y) for y in (-0.14, -0.047, 0.047, 0.14)])
