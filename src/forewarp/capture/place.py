"""Turn, scale and centre what was found, and propose near, far and a box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from forewarp.capture.sparse import Sparse
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.paths import mean_up

# Points beyond these quantiles are taken for outliers, unless they lie close to the rest.
_QUANTILES, _SLACK, _MARGIN = (0.02, 0.98), 0.25, 0.05
_NEAR, _FAR = 0.5, 1.25  # of the nearest and the farthest points, as what moves may be nearer
_ROLL = 0.01  # mean square of the sine by which a hand rolls a camera, and some more
_LEVEL = 1e-3  # sine of the angle between up and ahead below which all cameras look up or down
_MIDWAY = 0.5  # share of its points' median distance from which on a camera's view belongs to the box


@dataclass(frozen=True)
class Limits:
    """``near`` and ``far`` along the unit ray, and a ``box`` around all that is seen."""

    near: float
    far: float
    box: Box


def placed(sparse: Sparse) -> Sparse:
    """Turn upwards to z and the mean direction of view to y, put the points' median into the origin, and make
    the median distance between a camera and a point that it sees 1.
    """
    cameras = list(sparse.cameras.values())
    ahead = np.mean([np.asarray(camera.camera_to_world)[:3, 2] for camera in cameras], 0)
    turn = _turn(upwards(cameras), ahead)
    return sparse.moved(turn, np.median(sparse.points, axis=0), 1 / float(np.median(sparse.distances())))


def upwards(cameras: list[Camera]) -> np.ndarray:
    """Estimate the direction away from the ground (3,), unit length.

    A hand tilts a camera up and down, but holds it level: upwards is across all pictures' horizontal axes, as
    far as they tell, and else the mean of the pictures' upward axes.
    """
    mean = mean_up(cameras).numpy()
    level = np.stack([np.asarray(camera.camera_to_world)[:3, 0] for camera in cameras])
    up = np.linalg.solve(level.T @ level / len(level) + _ROLL * np.eye(3), _ROLL * mean)
    return up / np.linalg.norm(up)


def _turn(up: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Make the rotation (3, 3) that turns ``up`` to z, and ``ahead`` to y as far as it is level."""
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < _LEVEL:
        right = np.eye(3)[np.abs(up).argmin()]
        right = right - (right @ up) * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def limits_of(sparse: Sparse) -> Limits:
    """Propose limits from the points, whose outliers do not count, and from where the cameras look.

    What moves has hardly a point. It is before what stands still, so the box also holds the middle of every
    camera's view from half the distance of its points on.
    """
    distances = sparse.distances()
    low, high = np.quantile(distances, _QUANTILES)
    cameras = list(sparse.cameras.values())
    midway = []
    for row, camera in enumerate(cameras):
        own = distances[sparse.seen[:, 0] == row]
        if len(own):
            middle = torch.tensor([camera.width / 2, camera.height / 2])
            ahead = np.asarray(camera.directions(middle[0], middle[1]))
            midway.append(np.asarray(camera.center) + _MIDWAY * float(np.median(own)) * ahead)
    bounds = bounds_of(sparse.sure())
    ends = np.concatenate([np.array(bounds), np.array(midway).reshape(-1, 3)])
    pad = _MARGIN * float((bounds[1] - bounds[0]).max())
    box = Box(tuple(ends.min(0) - pad), tuple(ends.max(0) + pad))
    return Limits(_NEAR * float(low), _FAR * float(high), box)


def bounds_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bound points (N, 3) without their outliers: low (3,) and high (3,).

    The quantiles, and what lies within a quarter of their span beyond them.

    >>> line = np.linspace(0, 1, 101)[:, None].repeat(3, 1)
    >>> [end.tolist() for end in bounds_of(np.concatenate([line, [[90.0, 0.5, 0.5]]]))]
    [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
    """
    low, high = np.quantile(points, _QUANTILES, axis=0)
    slack = _SLACK * (high - low)
    inside = ((points >= low - slack) & (points <= high + slack)).all(1)
    kept = points[inside] if inside.any() else points
    return kept.min(0), kept.max(0)
