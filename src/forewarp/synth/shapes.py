"""Make closed, coloured triangle meshes: vertices (V, 3) float64 and faces (F, 3) int64, turned outwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]  # vertices and faces


@dataclass(frozen=True)
class Material:
    """A ``pattern`` of PATTERNS, its ``colors`` (RGB in [0, 1]) and its ``scale`` in world units.

    ``gloss`` is the strength of the highlight (0: matte), ``shine`` its narrowness.
    """

    pattern: str
    colors: tuple[tuple[float, float, float], ...]
    scale: float = 0.1
    gloss: float = 0.0
    shine: float = 10.0


@dataclass(frozen=True)
class Surface:
    """n surface points at rest: ``position`` (n, 3), ``relative`` (n, 3) the position in the part's
    bounding box as [0, 1], ``normal`` (n, 3).
    """

    position: np.ndarray
    relative: np.ndarray
    normal: np.ndarray

    def flat(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take the two coordinates of ``values`` (n, 3) across the normal's main axis; on upright faces the
        second one is the height.
        """
        main = np.abs(self.normal).argmax(-1)
        first = np.where(main == 0, values[:, 1], values[:, 0])
        return first, np.where(main == 2, values[:, 1], values[:, 2])


def checker(at: Surface, scale: float) -> np.ndarray:
    """Two-coloured squares, with thin joints as a third colour."""
    u, v = (c / scale for c in at.flat(at.position))
    joint = np.minimum(np.abs(u - np.rint(u)), np.abs(v - np.rint(v))) < 0.03
    return np.where(joint, 2, (np.floor(u) + np.floor(v)).astype(np.int64) % 2)


def bricks(at: Surface, scale: float) -> np.ndarray:
    """Running bond of bricks twice as long as high on upright faces, plates on level ones."""
    u, v = at.flat(at.position)
    row = np.floor(v / scale)
    along = u / (2 * scale) + 0.5 * (row % 2)
    joint = (np.abs(v / scale - np.rint(v / scale)) < 0.06) | (np.abs(along - np.rint(along)) < 0.03)
    return joint.astype(np.int64)


def cabin(at: Surface, scale: float) -> np.ndarray:
    """Bricks with a framed pane of glass and a streak of light on every upright face."""
    h, v = at.flat(at.relative)
    upright = np.abs(at.normal[:, 2]) < 0.5
    frame = upright & (np.abs(h - 0.5) < 0.42) & (v > 0.32) & (v < 0.96)
    glass = upright & (np.abs(h - 0.5) < 0.35) & (v > 0.38) & (v < 0.90)
    streak = glass & (np.abs(h - 0.6 * v - 0.12) < 0.07)
    index = np.where(frame, 2, bricks(at, scale))
    return np.where(streak, 4, np.where(glass, 3, index))


def slanted(at: Surface, scale: float) -> np.ndarray:
    """Diagonal warning stripes."""
    u, v = at.flat(at.position)
    return np.floor((u + v) / scale).astype(np.int64) % 2


def rings(at: Surface, scale: float) -> np.ndarray:
    """Bands along x, which widen as the part stretches."""
    return np.floor(at.position[:, 0] / scale).astype(np.int64) % 2


def wheel(at: Surface, scale: float) -> np.ndarray:
    """A treaded tyre about the y axis with a hub of six spokes; ``scale`` is the hub's radius."""
    radius = np.hypot(at.position[:, 0], at.position[:, 2])
    angle = np.arctan2(at.position[:, 2], at.position[:, 0]) / (2 * np.pi)
    between = np.floor(angle * 12).astype(np.int64) % 2 == 0
    spoke = between | (radius < 0.4 * scale) | (radius > 0.85 * scale)
    side = np.where(radius < scale, np.where(spoke, 2, 3), 0)
    tread = np.floor(angle * 24).astype(np.int64) % 2
    return np.where(np.abs(at.normal[:, 1]) > 0.5, side, tread)


def beach(at: Surface, scale: float) -> np.ndarray:
    """Six gores, two of each colour, about an axis leaning towards x, with a cap at either pole."""
    x, y, z = (at.position / scale).T
    pole, across = 0.8 * z + 0.6 * x, 0.8 * x - 0.6 * z
    gore = np.floor(np.arctan2(y, across) / (2 * np.pi) * 6).astype(np.int64) % 3
    return np.where(np.abs(pole) > 0.92, 3, gore)


def mosaic(at: Surface, scale: float) -> np.ndarray:
    """Squares of four colours in an order that never repeats, with joints as a fifth colour."""
    u, v = (c / scale for c in at.flat(at.position))
    joint = np.minimum(np.abs(u - np.rint(u)), np.abs(v - np.rint(v))) < 0.04
    # Large odd factors scatter neighbours, but the low bits of a product least: fold the high ones in.
    mixed = (np.floor(u).astype(np.int64) * 374761393 + np.floor(v).astype(np.int64) * 668265263) & 0xFFFFFFFF
    mixed = ((mixed ^ (mixed >> 13)) * 1274126177) & 0xFFFFFFFF
    return np.where(joint, 4, (mixed ^ (mixed >> 16)) % 4)


def plain(at: Surface, scale: float) -> np.ndarray:
    """One colour."""
    return np.zeros(len(at.position), dtype=np.int64)


_ALL = (plain, checker, bricks, cabin, slanted, rings, wheel, beach, mosaic)
PATTERNS = {pattern.__name__: pattern for pattern in _ALL}


def color_of(material: Material, at: Surface) -> np.ndarray:
    """RGB (n, 3) in [0, 1] of surface points."""
    return np.asarray(material.colors, dtype=np.float64)[PATTERNS[material.pattern](at, material.scale)]


@dataclass(frozen=True)
class Part:
    """A coloured piece that follows one joint.

    ``vertices`` (V, 3) float64 are in the joint's rest frame, ``faces`` (F, 3) index them; a ``smooth``
    part is shaded with interpolated normals; a part without ``casts`` throws no shadow.
    """

    name: str
    joint: str
    vertices: np.ndarray
    faces: np.ndarray
    material: Material
    smooth: bool = False
    casts: bool = True

    def placed(self, maps: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return where the vertices are (V, 3) by the map (4, 4) of each joint."""
        place = maps[self.joint]
        return self.vertices @ place[:3, :3].T + place[:3, 3]


def prism(outline, low: float, high: float, axis: int = 2) -> Mesh:
    """Sweep a convex ``outline`` (P, 2), counter-clockwise, along ``axis`` from ``low`` to ``high``.

    The outline's two coordinates are the remaining axes in cyclic order: axis 2 takes (x, y), axis 0
    takes (y, z), axis 1 takes (z, x).
    """
    outline = np.asarray(outline, dtype=np.float64)
    flat, count = [(axis + 1) % 3, (axis + 2) % 3], len(outline)
    top, i, middle = count + 1, np.arange(count), np.full(count, count)
    vertices, j = np.empty((2, top, 3)), (i + 1) % count
    vertices[:, :, flat] = np.concatenate([outline, [outline.mean(0)]])
    vertices[:, :, axis] = [[low], [high]]
    faces = [(i, j, j + top), (i, j + top, i + top), (j, i, middle), (i + top, j + top, middle + top)]
    return vertices.reshape(-1, 3), np.concatenate([np.stack(corners, -1) for corners in faces])


def box(low, high) -> Mesh:
    """Make an axis-aligned box between two corners (3,)."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return prism([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], z0, z1)


def cylinder(center, radius: float, length: float, axis: int = 2, segments: int = 24) -> Mesh:
    """Make a cylinder about ``center`` (3,) along ``axis``."""
    angle = 2 * np.pi * np.arange(segments) / segments
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    vertices, faces = prism(circle, -length / 2, length / 2, axis)
    return vertices + np.asarray(center, dtype=np.float64), faces


def rounded_slab(half: float, corner: float, low: float, high: float, steps: int = 8) -> Mesh:
    """Make a square plate of half width ``half`` whose corners have radius ``corner``."""
    turn = np.linspace(0, np.pi / 2, steps + 1)
    outline = [
        (half - corner) * np.array(sign) + corner * np.array([np.cos(a), np.sin(a)])
        for quarter, sign in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)])
        for a in turn + quarter * np.pi / 2
    ]
    return prism(outline, low, high)


def sphere(radius: float, rings: int = 24, segments: int = 40) -> Mesh:
    """Make a sphere about the origin with ``rings`` of latitude."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)[1:-1, None]
    longitude = (2 * np.pi * np.arange(segments) / segments)[None]
    level = np.cos(latitude)
    axes = np.broadcast_arrays(level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude))
    grid = np.stack(axes, -1)
    vertices = np.concatenate([grid.reshape(-1, 3), [[0, 0, -1.0], [0, 0, 1.0]]])
    i = np.arange(segments)
    j, last = (i + 1) % segments, (rings - 2) * segments
    south, north = np.full(segments, len(vertices) - 2), np.full(segments, len(vertices) - 1)
    faces = [(j, i, south)]
    for a in range(0, last, segments):
        b = a + segments
        faces += [(a + i, a + j, b + j), (a + i, b + j, b + i)]
    faces.append((last + i, last + j, north))
    return radius * vertices, np.concatenate([np.stack(corners, -1) for corners in faces])


def joined(meshes: list[Mesh]) -> Mesh:
    """Join several meshes into one."""
    vertices, faces = zip(*meshes)
    offsets = np.cumsum([0, *map(len, vertices)])
    return np.concatenate(vertices), np.concatenate([own + offset for own, offset in zip(faces, offsets)])
