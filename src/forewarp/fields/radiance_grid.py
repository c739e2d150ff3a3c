"""Density and colour in space, as marched rays read them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from forewarp.ops.grid import occupied_cells, trilinear
from forewarp.scene.box import Lattice

EMPTY = -10.0  # raw density of an absent voxel: about exp(-10) of the opacity that raw 0 has


Shade = Callable[[Tensor, Tensor], Tensor]  # features (P, C) and directions (P, 3) -> colour (P, 3)


class FieldAtTime(Protocol):
    """Density and colour anywhere in ``lattice`` at one time; all that the renderer needs.

    ``cells`` (X-1, Y-1, Z-1) bool are those that may hold matter. ``density`` gives sigma (P,) per world
    unit and ``colors`` (P, 3) at points (P, 3) in lattice coordinates, seen along unit directions (P, 3).
    """

    lattice: Lattice

    @property
    def voxel_size(self) -> float:
        """The finest detail along a ray, world units: a step is a share of it."""

    @property
    def cells(self) -> Tensor:
        """Where matter may be."""

    def density(self, points: Tensor) -> Tensor:
        """Sigma (P,)."""

    def colors(self, points: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
        """Colour (P, 3); ``shade`` makes it of the features and the directions."""


def shaded(features: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
    """Features (P, C) seen along directions (P, 3) -> colour (P, 3); without ``shade`` the first 3 are it."""
    return torch.sigmoid(features[:, :3]) if shade is None else shade(features, directions)


@dataclass(frozen=True)
class Activation:
    """Raw density to density: ``sigma = softplus(raw + shift) / density_scale``, per world unit of length.

    ``density_scale`` is a length (the first stage's voxel), so that nothing depends on the scene's units;
    ``shift`` gives raw 0 an opacity of ``alpha_init`` over that length: ``log(1 / (1 - alpha_init) - 1)``.
    """

    shift: float
    density_scale: float

    def sigma(self, raw: Tensor) -> Tensor:
        """Density per world unit, the shape of ``raw``."""
        return torch.nn.functional.softplus(raw + self.shift) / self.density_scale

    def alpha(self, raw: Tensor, length: float) -> Tensor:
        """Opacity over ``length`` world units."""
        return -torch.expm1(-self.sigma(raw) * length)

    def raw(self, alpha: float, length: float) -> float:
        """The raw density whose opacity over ``length`` is ``alpha``."""
        sigma = -torch.log1p(-torch.tensor(alpha, dtype=torch.float64)) / length * self.density_scale
        return float(sigma + torch.log(-torch.expm1(-sigma)) - self.shift)  # expm1(sigma) may overflow


@dataclass(frozen=True)
class RadianceGrid:
    """Radiance on a sparse lattice: ``values`` (M, 1 + C) are raw density, then colour features;
    ``index`` (X, Y, Z) int32 holds a voxel's row, or -1 where space is empty.
    """

    lattice: Lattice
    index: Tensor
    values: Tensor
    activation: Activation
    alpha_threshold: float = 0.0

    @property
    def voxel_size(self) -> float:
        """The lattice's."""
        return self.lattice.voxel_size

    @property
    def raw_density(self) -> Tensor:
        """(M,)."""
        return self.values[:, 0]

    @property
    def color(self) -> Tensor:
        """Colour features (M, C)."""
        return self.values[:, 1:]

    @property
    def fill(self) -> Tensor:
        """What an absent voxel reads (1 + C,)."""
        return torch.nn.functional.pad(self.values.new_full((1,), EMPTY), (0, self.values.shape[1] - 1))

    @cached_property
    def cells(self) -> Tensor:
        """Cells whose corners are present and may exceed ``alpha_threshold`` over one voxel."""
        if self.alpha_threshold <= 0 or not len(self.values):
            return occupied_cells(self.index)
        low = self.activation.raw(self.alpha_threshold, self.lattice.voxel_size)
        return occupied_cells(self.index, self.raw_density.detach() > low)

    def density(self, points: Tensor) -> Tensor:
        """Sigma (P,) at lattice coordinates (P, 3)."""
        raw = trilinear(self.values[:, :1].contiguous(), self.index, points, self.fill[:1])
        return self.activation.sigma(raw[:, 0])

    def features(self, points: Tensor) -> Tensor:
        """Colour features (P, C) at lattice coordinates (P, 3)."""
        # Of all channels at once: the colours alone would be a copy of the grid.
        return trilinear(self.values, self.index, points, self.fill)[:, 1:]

    def colors(self, points: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
        """Colour (P, 3) at lattice coordinates (P, 3) seen along unit directions (P, 3)."""
        return shaded(self.features(points), directions, shade)

    def with_values(self, values: Tensor) -> RadianceGrid:
        """The same voxels with other values."""
        return replace(self, values=values)
