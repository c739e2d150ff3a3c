"""Procedural colour by coordinates of the rest pose, so that it moves with the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
    side = np.abs(at.normal[:, 1]) > 0.5
    spoke = (
        (np.floor(angle * 12).astype(np.int64) % 2 == 0) | (radius < 0.4 * scale) | (radius > 0.85 * scale)
    )
    tread = np.floor(angle * 24).astype(np.int64) % 2
    return np.where(side, np.where(radius < scale, np.where(spoke, 2, 3), 0), tread)


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


PATTERNS = {
    "plain": lambda at, scale: np.zeros(len(at.position), dtype=np.int64),
    "checker": checker,
    "bricks": bricks,
    "cabin": cabin,
    "slanted": slanted,
    "rings": rings,
    "wheel": wheel,
    "beach": beach,
    "mosaic": mosaic,
}


def color_of(material: Material, at: Surface) -> np.ndarray:
    """RGB (n, 3) in [0, 1] of surface points."""
    return np.asarray(material.colors, dtype=np.float64)[PATTERNS[material.pattern](at, material.scale)]
