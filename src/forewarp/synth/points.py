"""Sample surface points and follow their exact trajectories."""

from __future__ import annotations

import numpy as np
import torch

from forewarp.scene.frame import Truth
from forewarp.synth.raycast import LIFT_OFF, Posed
from forewarp.synth.world import World

# Candidates per wanted point: about half of the surface is never visible.
_SPARE = 4


def surface_points(
    world: World,
    count: int,
    centers: np.ndarray,
    rng: np.random.Generator,
    time: float = 0.0,
    among: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points uniformly by area on the surface that is visible at one time.

    Args:
        world: the world.
        count: number of points; fewer are drawn only if hardly anything is visible.
        centers: camera centres (C, 3); a point is visible if at least one camera sees it.
        rng: the same state gives the same points.
        time: time at which points must be visible.
        among: (F,) bool, faces to draw from; None: all that are there.

    Returns:
        faces (N,) and barycentric coordinates (N, 3), which ``World.points`` places at any time.
    """
    posed = Posed(world, time)
    drawn = _SPARE * count
    cumulative = np.cumsum(posed.area * (posed.there if among is None else posed.there & among))
    face = np.searchsorted(cumulative, rng.random(drawn) * cumulative[-1], side="right")
    # The square root makes the density even over the triangle.
    a, b = np.sqrt(rng.random(drawn)), rng.random(drawn)
    barycentric = np.stack([1 - a, a * (1 - b), a * b], -1)
    seen = np.flatnonzero(_is_seen(posed, face, barycentric, centers))[:count]
    return face[seen], barycentric[seen]


def trajectories(world: World, faces: np.ndarray, barycentric: np.ndarray, times: np.ndarray) -> Truth:
    """Follow surface points (N) over ``times`` (T,), the canonical time first; float32 world units."""
    points = np.stack([world.points(faces, barycentric, t) for t in times], 1)
    return Truth(torch.from_numpy(points.astype(np.float32)), torch.from_numpy(np.asarray(times, np.float64)))


def _is_seen(posed: Posed, face: np.ndarray, barycentric: np.ndarray, centers: np.ndarray) -> np.ndarray:
    point = np.einsum("nc,ncd->nd", barycentric, posed.corners[face])
    normal = posed.normal[face]
    seen = np.zeros(len(face), dtype=bool)
    for center in centers:
        towards = center - point
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        rows = np.flatnonzero(~seen & (np.einsum("nd,nd->n", normal, towards) > 0))
        seen[rows] = posed.is_free(point[rows] + LIFT_OFF * normal[rows], towards[rows])
    return seen
