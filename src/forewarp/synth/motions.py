"""Move the vehicle's joints: smooth functions of a continuous time in [0, 1].

Every joint is an affine map, so every point of a part has an exact position at every time. The controls are
sums of cosines of at most three half periods, which a few low DCT frequencies span.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
    maps["ball"] = _ball(now)
    maps["band"] = chassis @ _band(now)
    return maps


def _ball(now: Controls) -> np.ndarray:
    """Squash the ball along z and widen it across, keeping its volume."""
    wide = now.squash**-0.5
    x, y = BALL_AT
    return _shift((x - now.drift, y, GROUND + 0.002 + BALL_RADIUS * now.squash + now.height)) @ np.diag(
        [wide, wide, now.squash, 1.0]
    )


def _band(now: Controls) -> np.ndarray:
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
