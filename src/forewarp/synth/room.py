"""A room around the vehicle: floor, four walls and ceiling, strongly textured and still."""

from __future__ import annotations

from forewarp.synth.shapes import Part, box
from forewarp.synth.textures import Material

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
