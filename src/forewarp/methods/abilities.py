"""Optional abilities of a method, beside the contract: trajectories, bounds, points, ellipsoids."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud
from forewarp.scene.ellipsoids import Ellipsoids


@runtime_checkable
class HasTrajectories(Protocol):
    """Follow points through time."""

    moves: bool  # False if the scene is static

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Return the paths (N, T, 3) of canonical points (N, 3) at ``times`` (T,), in world units."""


@runtime_checkable
class HasBounds(Protocol):
    """Bound all matter."""

    def bounds(self, times: list[float]) -> Box | None:
        """Return the box that holds all matter at all ``times``, in world units; None if there is none."""


@runtime_checkable
class HasMatter(Protocol):
    """Give the matter as points, for drawing, export and the next stage."""

    def matter(self) -> Cloud:
        """Return all canonical matter as points."""


@runtime_checkable
class HasEllipsoids(Protocol):
    """Be a cloud of soft ellipsoids, for programs that draw such."""

    def ellipsoids(self, time: float) -> Ellipsoids:
        """Return all of them as they are at a time in [0, 1], without gradients; a row is always the same."""
