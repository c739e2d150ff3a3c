"""A toy excavator of bricks, a ball and the slab under both: meshes and colours."""

from __future__ import annotations

import numpy as np

from forewarp.synth.motions import (
    BALL_RADIUS,
    BAND_ALONG_STICK,
    BAND_FROM,
    BAND_SIDE,
    BOOM,
    PIVOT,
    STICK,
    WHEEL_RADIUS,
    WHEELS,
)
from forewarp.synth.shapes import Mesh, Part, box, cylinder, joined, prism, rounded_slab, sphere, studs
from forewarp.synth.textures import Material

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
