"""Draw cameras and points from two sides."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from forewarp.capture.place import Limits
from forewarp.capture.sparse import Sparse
from forewarp.drawing.images import draw_discs, sample_lines

_SIDE, _GAP = 640, 0.06  # pixels of each drawing; share of it that stays free at its ends
_FIRST, _LAST, _BOX = (0.10, 0.25, 0.75), (0.85, 0.20, 0.15), (0.55, 0.55, 0.55)
_FRUSTA = 24  # cameras drawn with their view


def two_sides(sparse: Sparse, limits: Limits) -> Tensor:
    """Draw the capture from above (x to the right, y up) and from the side (z up): (H, 2 H, 3) in [0, 1].

    Cameras go from blue to red; grey is the box.
    """
    return torch.cat([_drawn(sparse, limits, axes) for axes in ((0, 1), (0, 2))], 1)


def _drawn(sparse: Sparse, limits: Limits, axes: tuple[int, int]) -> Tensor:
    cameras = list(sparse.cameras.values())
    centers = np.stack([np.asarray(camera.center) for camera in cameras])
    low, high = np.array(limits.box.low), np.array(limits.box.high)
    shown = np.concatenate([centers, low[None], high[None]])[:, axes]
    middle, span = (shown.max(0) + shown.min(0)) / 2, float((shown.max(0) - shown.min(0)).max())
    per_unit = _SIDE * (1 - 2 * _GAP) / span

    def at(points) -> Tensor:
        flat = (np.asarray(points)[..., axes] - middle) * per_unit * (1, -1) + _SIDE / 2
        return torch.from_numpy(np.ascontiguousarray(flat)).float()

    picture = torch.ones(_SIDE, _SIDE, 3)
    inside = ((sparse.points >= low) & (sparse.points <= high)).all(1)
    colors = torch.from_numpy(sparse.colors[inside]).float() / 255
    picture = draw_discs(picture, at(sparse.points[inside]), colors, torch.full((len(colors),), 0.8), 1.0)
    (x0, y0), (x1, y1) = (end[list(axes)] for end in (low, high))
    outline = np.zeros((1, 5, 3))
    outline[0][:, axes] = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    picture = _lines(picture, at(outline), torch.tensor([_BOX]), 0.6)
    share = torch.linspace(0, 1, len(cameras))[:, None]
    paint = torch.lerp(torch.tensor([_FIRST]), torch.tensor([_LAST]), share)
    picture = _lines(picture, at(np.stack([centers[:-1], centers[1:]], 1)), paint[:-1], 0.8)
    every = max(1, len(cameras) // _FRUSTA)
    views = np.concatenate([_frustum(camera, 0.08 * span) for camera in cameras[::every]])
    return _lines(picture, at(views), paint[::every].repeat_interleave(8, 0), 0.6)


def _lines(picture: Tensor, vertices: Tensor, colors: Tensor, radius: float) -> Tensor:
    """Draw polylines (N, T, 2), each of one colour (N, 3)."""
    points, line = sample_lines(vertices)
    return draw_discs(picture, points[:, :2], colors[line], torch.full((len(points),), 0.9), radius)


def _frustum(camera, depth: float) -> np.ndarray:
    """The eight edges (8, 2, 3) of a camera's view down to a depth."""
    u, v = torch.tensor([0, 1, 1, 0]) * camera.width, torch.tensor([0, 0, 1, 1]) * camera.height
    center = np.asarray(camera.center)
    corners = center + depth * np.asarray(camera.directions(u, v))
    sides = np.stack([np.broadcast_to(center, corners.shape), corners], 1)
    return np.concatenate([sides, np.stack([corners, np.roll(corners, -1, 0)], 1)])
