"""What a method may be able to do beside the contract; what asks for it says so where it cannot."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud


@runtime_checkable
class HasTrajectories(Protocol):
    """Follows points of the canonical matter."""

    moves: bool  # whether there is any motion

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Give the paths (N, T, 3) of canonical points (N, 3) at ``times`` (T,), world units."""


@runtime_checkable
class HasBounds(Protocol):
    """Knows where its matter is."""

    def bounds(self, times: list[float]) -> Box | None:
        """Bound all matter at all of these times, world units; None where there is none."""


@runtime_checkable
class HasMatter(Protocol):
    """Gives the occupied part, for drawing, export, and the stage that follows."""

    def matter(self) -> Cloud:
        """Give all canonical matter as points."""
