"""Rays."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """R rays: ``origins`` (R, 3) and unit ``directions`` (R, 3) in world units; ``near`` and ``far``
    are distances along the unit direction that hold for all of them.
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
        """The same rays on another device."""
        return Rays(self.origins.to(device), self.directions.to(device), self.near, self.far)
