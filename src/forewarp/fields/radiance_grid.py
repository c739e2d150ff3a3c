"""Density and colour in space, as the renderer reads them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from forewarp.ops.grid import occupied_cells, trilinear
from forewarp.scene.box import Lattice

EMPTY = -10.0  # raw density of an absent voxel: about exp(-10) times the density at raw 0


Shade = Callable[[Tensor, Tensor], Tensor]  # features (P, C) and directions (P, 3) -> colour (P, 3)


class FieldAtTime(Protocol):
    """Density and colour anywhere in ``lattice`` at one time: all that the renderer needs.

    Points (P, 3) are in lattice coordinates; directions (P, 3) have length 1.
    """

    lattice: Lattice

    @property
    def voxel_size(self) -> float:
        """Size of the finest voxels, in world units; a ray's step is a share of this."""

    @property
    def cells(self) -> Tensor:
        """Cells (X-1, Y-1, Z-1) bool that may hold matter."""

    def density(self, points: Tensor) -> Tensor:
        """Density (P,), per world unit of length."""

    def colors(self, points: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
        """Colour (P, 3); ``shade`` computes colour from features and directions."""


def shaded(features: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
    """Features (P, C) and directions (P, 3) -> colour (P, 3); without ``shade`` from the first 3 features."""
    return torch.sigmoid(features[:, :3]) if shade is None else shade(features, directions)


def mean_color(color_of: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """Colours (P, 3) of points (P, 3): the mean of what ``color_of`` gives along the six axes' directions."""
    towards = torch.cat([torch.eye(3), -torch.eye(3)]).to(points)
    return sum(color_of(d.expand(len(points), 3)) for d in towards) / len(towards)


@dataclass(frozen=True)
class Activation:
    """The density activation ``sigma = softplus(raw + shift) / density_scale`` (DirectVoxGO's).

    Attributes:
        shift: ``log(1 / (1 - alpha_init) - 1)``, so that raw 0 has opacity ``alpha_init`` over
            ``density_scale``.
        density_scale: a length in world units (the first stage's voxel size), so that learned values do not
            depend on the scene's scale.
    """

    shift: float
    density_scale: float

    def sigma(self, raw: Tensor) -> Tensor:
        """Return the density per world unit of length, in the shape of ``raw``."""
        return torch.nn.functional.softplus(raw + self.shift) / self.density_scale

    def alpha(self, raw: Tensor, length: float) -> Tensor:
        """Return the opacity over ``length`` world units."""
        return -torch.expm1(-self.sigma(raw) * length)

    def raw(self, alpha: float, length: float) -> float:
        """Return the raw density whose opacity over ``length`` is ``alpha``."""
        sigma = -torch.log1p(-torch.tensor(alpha, dtype=torch.float64)) / length * self.density_scale
        return float(sigma + torch.log(-torch.expm1(-sigma)) - self.shift)  # expm1(sigma) may overflow


@dataclass(frozen=True)
class RadianceGrid:
    """Radiance on a sparse lattice.

    Attributes:
        lattice: possible voxel positions.
        index: (X, Y, Z) int32, the row of each voxel in ``values``, -1 for absent voxels.
        values: (M, 1 + C), raw density, then colour features.
        activation: turns raw density into density.
        alpha_threshold: skip cells whose eight voxels all have at most this opacity over one voxel.
    """

    lattice: Lattice
    index: Tensor
    values: Tensor
    activation: Activation
    alpha_threshold: float = 0.0

    @property
    def voxel_size(self) -> float:
        """Voxel size of the lattice."""
        return self.lattice.voxel_size

    @property
    def raw_density(self) -> Tensor:
        """Raw density (M,)."""
        return self.values[:, 0]

    @property
    def color(self) -> Tensor:
        """Colour features (M, C)."""
        return self.values[:, 1:]

    @property
    def fill(self) -> Tensor:
        """Values (1 + C,) of an absent voxel."""
        return torch.nn.functional.pad(self.values.new_full((1,), EMPTY), (0, self.values.shape[1] - 1))

    @cached_property
    def cells(self) -> Tensor:
        """Cells with a corner whose opacity over one voxel exceeds ``alpha_threshold``."""
        if self.alpha_threshold <= 0 or not len(self.values):
            return occupied_cells(self.index)
        low = self.activation.raw(self.alpha_threshold, self.lattice.voxel_size)
        return occupied_cells(self.index, self.raw_density.detach() > low)

    def density(self, points: Tensor) -> Tensor:
        """Density (P,) at lattice coordinates (P, 3)."""
        raw = trilinear(self.values[:, :1].contiguous(), self.index, points, self.fill[:1])
        return self.activation.sigma(raw[:, 0])

    def features(self, points: Tensor) -> Tensor:
        """Colour features (P, C) at lattice coordinates (P, 3)."""
        # Read all channels, as a slice of the colours would copy the grid.
        return trilinear(self.values, self.index, points, self.fill)[:, 1:]

    def colors(self, points: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
        """Colour (P, 3) at lattice coordinates (P, 3) seen along unit directions (P, 3)."""
        return shaded(self.features(points), directions, shade)

    def with_values(self, values: Tensor) -> RadianceGrid:
        """Return the same voxels with other values."""
        return replace(self, values=values)
