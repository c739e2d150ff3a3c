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


def _axes(cameras) -> np.ndarray:
    return np.stack([np.asarray(camera.camera_to_world)[:3, :3] for camera in cameras])


def _centers(cameras) -> np.ndarray:
    return np.stack([np.asarray(camera.center) for camera in cameras])


def fitted(found, true) -> Similarity:
    """Fit the similarity that takes found cameras to true ones.

    The turn is the mean of what takes found axes to true ones: centres on a path that is nearly a line would
    leave the turn about that line open. Scale and shift fit the centres, least squares.
    """
    total = np.einsum("nij,nkj->ik", _axes(true), _axes(found))
    u, _, v = np.linalg.svd(total)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    source, target = _centers(found) @ turn.T, _centers(true)
    a, b = source - source.mean(0), target - target.mean(0)
    scale = float((a * b).sum() / (a * a).sum())
    return Similarity(scale, turn, target.mean(0) - scale * source.mean(0))


def pose_errors(found, true) -> tuple[Similarity, np.ndarray, np.ndarray]:
    """Compare cameras in pairs.

    Returns:
        the similarity from found to true; degrees (N,) between their axes; distances (N,) between their
        centres, as a share of the length of the true path.
    """
    similarity, centers = fitted(found, true), _centers(true)
    path = np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()
    away = np.linalg.norm(similarity(_centers(found)) - centers, axis=1) / path
    turns = np.einsum("nji,njk->nik", _axes(true), similarity.turn @ _axes(found))
    cosine = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    return similarity, np.degrees(np.arccos(np.clip(cosine, -1, 1))), away
