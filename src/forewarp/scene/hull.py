"""The visual hull: the points that lie inside all silhouettes."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.scene.camera import Camera


def visual_hull(points: Tensor, cameras: list[Camera], masks: list[Tensor], misses: int = 0) -> Tensor:
    """Select points inside the silhouette in all but ``misses`` of the views that see them.

    Args:
        points: (N, 3) world units.
        cameras: V cameras.
        masks: V masks (H, W) bool, True on the foreground; dilate them if the scene moves.
        misses: number of views that may disagree.

    Returns:
        (N,) bool. A point that fewer than half of the views see is outside.
    """
    covered, seen = sightings(points, cameras, masks)
    return (2 * seen >= len(cameras)) & (seen > misses) & (seen - covered <= misses)


def sightings(points: Tensor, cameras: list[Camera], masks: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Count the views inside whose silhouette each point lies, and those that see it, (N,) int32 each.

    Arguments are those of ``visual_hull``.
    """
    covered = torch.zeros(len(points), dtype=torch.int32)
    seen = torch.zeros(len(points), dtype=torch.int32)
    for camera, mask in zip(cameras, masks, strict=True):
        pixel, z = camera.project(points)
        column, row = pixel.floor().long().unbind(-1)
        visible = (z > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        on = mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
        covered += (visible & on).int()
        seen += visible.int()
    return covered, seen
