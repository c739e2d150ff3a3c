"""Make closed triangle meshes: vertices (V, 3) float64 and faces (F, 3) int64, turned outwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forewarp.synth.textures import Material

Mesh = tuple[np.ndarray, np.ndarray]


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


def prism(outline, low: float, high: float, axis: int = 2) -> Mesh:
    """Sweep a convex ``outline`` (P, 2), counter-clockwise, along ``axis`` from ``low`` to ``high``.

    The outline's two coordinates are the remaining axes in cyclic order: axis 2 takes (x, y), axis 0
    takes (y, z), axis 1 takes (z, x).
    """
    outline = np.asarray(outline, dtype=np.float64)
    count = len(outline)
    vertices = np.empty((2 * count + 2, 3))
    flat = [(axis + 1) % 3, (axis + 2) % 3]
    center = outline.mean(0)
    for start, level in ((0, low), (count + 1, high)):
        vertices[start : start + count, flat] = outline
        vertices[start + count, flat] = center
        vertices[start : start + count + 1, axis] = level
    i = np.arange(count)
    j = (i + 1) % count
    top = count + 1
    middle = np.full(count, count)
    faces = np.concatenate(
        [
            np.stack([i, j, j + top], -1),
            np.stack([i, j + top, i + top], -1),
            np.stack([j, i, middle], -1),
            np.stack([i + top, j + top, middle + top], -1),
        ]
    )
    return vertices, faces


def box(low, high) -> Mesh:
    """Make an axis-aligned box between two corners (3,)."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return prism([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], z0, z1)


def cylinder(center, radius: float, length: float, axis: int = 2, segments: int = 24) -> Mesh:
    """Make a cylinder about ``center`` (3,) along ``axis``."""
    angle = 2 * np.pi * np.arange(segments) / segments
    vertices, faces = prism(
        radius * np.stack([np.cos(angle), np.sin(angle)], -1), -length / 2, length / 2, axis
    )
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
    grid = np.stack(
        np.broadcast_arrays(
            np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
        ),
        -1,
    )
    vertices = np.concatenate([grid.reshape(-1, 3), [[0, 0, -1.0], [0, 0, 1.0]]])
    i = np.arange(segments)
    j = (i + 1) % segments
    south, north = np.full(segments, len(vertices) - 2), np.full(segments, len(vertices) - 1)
    faces = [np.stack([j, i, south], -1)]
    for row in range(rings - 2):
        a, b = row * segments, (row + 1) * segments
        faces += [np.stack([a + i, a + j, b + j], -1), np.stack([a + i, b + j, b + i], -1)]
    last = (rings - 2) * segments
    faces.append(np.stack([last + i, last + j, north], -1))
    return radius * vertices, np.concatenate(faces)


def joined(meshes: list[Mesh]) -> Mesh:
    """Join several meshes into one."""
    offsets = np.cumsum([0] + [len(v) for v, _ in meshes])
    return (
        np.concatenate([v for v, _ in meshes]),
        np.concatenate([f + offset for (_, f), offset in zip(meshes, offsets)]),
    )


def studs(xs, ys, z: float, radius: float = 0.032, height: float = 0.026) -> Mesh:
    """Put brick studs at every (x, y) of two lists, at height ``z``."""
    # Sunk a little, so that the foot does not lie in the plane below.
    return joined(
        [
            cylinder((x, y, z + height / 2 - 0.002), radius, height + 0.004, segments=16)
            for x in xs
            for y in ys
        ]
    )
