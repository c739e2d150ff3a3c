"""Optional abilities of a method, beside the contract: trajectories, bounds, rest, points, ellipsoids."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from torch import Tensor

from forewarp.scene.box import Box, Lattice
from forewarp.scene.cloud import Cloud, Ellipsoids


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
class HasRest(Protocol):
    """Find out while training what does not move, and compute no motion for it."""

    def at_rest(self) -> float:
        """Return the share of the matter that has come to rest, in [0, 1]."""


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

    def template(self) -> Ellipsoids:
        """Return them before any motion, with opacity and colours of the canonical time."""

    def movement(self, times: Sequence[float]) -> dict[str, Tensor]:
        """Return, by name, what makes ``ellipsoids`` at T times of the ``template``, and its coefficients."""


@runtime_checkable
class HasSolid(Protocol):
    """Of a snapshot: tell how opaque every place is, for meshes."""

    def solid(self, lattice: Lattice) -> tuple[Tensor, Tensor]:
        """Return the opacity (X, Y, Z) of a small cube around each point of a lattice, and its mean colour
        over all directions (X, Y, Z, 3); 0 where there is nothing.
        """
