"""Rays with near and far distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """R rays: ``origins`` (R, 3) and unit ``directions`` (R, 3) in world units; ``near`` and ``far``
    are distances along the unit direction, shared by all.
    """

    origins: Tensor
    directions: Tensor
    near: float
    far: float

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, rows) -> Rays:
        return Rays(self.origins[rows], self.directions[rows], self.near, self.far)

    def to(self, device) -> Rays:
        """Move the rays to another device."""
        return Rays(self.origins.to(device), self.directions.to(device), self.near, self.far)


def joined(parts: Sequence[Rays]) -> Rays:
    """Concatenate rays; take the least near and the greatest far."""
    if len(parts) == 1:
        return parts[0]
    origins, directions = (torch.cat([getattr(p, name) for p in parts]) for name in ("origins", "directions"))
    return Rays(origins, directions, min(p.near for p in parts), max(p.far for p in parts))
