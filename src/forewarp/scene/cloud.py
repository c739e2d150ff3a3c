"""Matter as points, and the handover from one stage to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forewarp.scene.box import Box


@dataclass(frozen=True)
class Cloud:
    """Points of the canonical matter: ``points`` (N, 3) world units, ``colors`` (N, 3) in [0, 1], ``opacity``
    (N,) in [0, 1] of a cell about ``size`` world units across.
    """

    points: Tensor
    colors: Tensor
    opacity: Tensor
    size: float

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows) -> Cloud:
        return Cloud(self.points[rows], self.colors[rows], self.opacity[rows], self.size)


def far_apart(points: Tensor, count: int) -> Tensor:
    """Choose rows (count,) of points (N, 3) that are spread evenly: the farthest from their mean, then
    repeatedly the farthest from those chosen; all rows, if there are no more.

    Cost: N * count distances.
    """
    if len(points) <= count:
        return torch.arange(len(points), device=points.device)
    chosen = [int((points - points.mean(0)).square().sum(-1).argmax())]
    away = (points - points[chosen[0]]).square().sum(-1)
    for _ in range(count - 1):
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (points - points[chosen[-1]]).square().sum(-1))
    return torch.tensor(chosen, device=points.device)


@dataclass(frozen=True)
class Handover:
    """What a fitted stage passes on to the next stage, whatever their methods.

    Attributes:
        box: bounds of all matter at all training times, world units.
        tight: False if the stage found no matter and kept its own box.
        frames_in_play: training frames in use at the end of the stage.
        cloud: a sample of the canonical matter; None if the method has no ``matter``.
        times: (T,) some training times, and ``paths`` (N, T, 3), the cloud's points at these; None if the
            method has no trajectories.
        notes: numbers for stages of the same method.
    """

    box: Box
    tight: bool
    frames_in_play: int
    cloud: Cloud | None = None
    times: Tensor | None = None
    paths: Tensor | None = None
    notes: Mapping[str, float] = field(default_factory=dict)
