"""How far found cameras are from true ones, after the similarity that fits them best."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Similarity:
    """``X -> scale * turn @ X + shift``."""

    scale: float
    turn: np.ndarray
    shift: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Move points (..., 3)."""
        return self.scale * points @ self.turn.T + self.shift


def fitted(source: np.ndarray, target: np.ndarray) -> Similarity:
    """The similarity that takes points (N, 3) to others, least squares (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, size, v = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    turn = u @ sign @ v
    scale = float((size * np.diag(sign)).sum() / (a**2).sum())
    return Similarity(scale, turn, target.mean(0) - scale * turn @ source.mean(0))


def pose_errors(found, true) -> tuple[Similarity, np.ndarray, np.ndarray]:
    """Compare cameras in pairs.

    Returns:
        the similarity from found to true; degrees (N,) between their axes; distances (N,) between their
        centres, as a share of the length of the true path.
    """
    centers = [np.stack([np.asarray(c.center) for c in cameras]) for cameras in (found, true)]
    similarity = fitted(*centers)
    path = np.linalg.norm(np.diff(centers[1], axis=0), axis=1).sum()
    away = np.linalg.norm(similarity(centers[0]) - centers[1], axis=1) / path
    turns = [
        np.asarray(t.camera_to_world)[:3, :3].T @ similarity.turn @ np.asarray(f.camera_to_world)[:3, :3]
        for f, t in zip(found, true)
    ]
    degrees = [np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) for turn in turns]
    return similarity, np.array(degrees), away
