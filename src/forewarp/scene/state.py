"""What a method answers at one time, and what the renderer makes of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor

from forewarp.ops.grid import occupied_cells, trilinear
from forewarp.scene.box import Lattice

EMPTY = -10.0  # raw density of an absent voxel: 1e-6 of opacity over a voxel, whatever the shift


class FieldAtTime(Protocol):
    """Density and colour features anywhere in ``lattice`` at one time; all that the renderer needs.

    ``cells`` (X-1, Y-1, Z-1) bool are those that may hold matter. ``density`` gives sigma (P,) per world
    unit and ``features`` (P, C) at points (P, 3) in lattice coordinates.
    """

    lattice: Lattice

    @property
    def cells(self) -> Tensor:
        """Where matter may be."""

    def density(self, points: Tensor) -> Tensor:
        """Sigma (P,)."""

    def features(self, points: Tensor) -> Tensor:
        """Colour features (P, C)."""


@dataclass(frozen=True)
class Activation:
    """Raw density to density: ``sigma = softplus(raw + shift) / unit``, per world unit of length.

    ``unit`` is a length (the coarse voxel), so that nothing depends on the scene's units; ``shift`` is such
    that raw 0 has opacity ``alpha_init`` over one unit, ``log(1 / (1 - alpha_init) - 1)``.
    """

    shift: float
    unit: float

    def sigma(self, raw: Tensor) -> Tensor:
        """Density per world unit, the shape of ``raw``."""
        return torch.nn.functional.softplus(raw + self.shift) / self.unit

    def alpha(self, raw: Tensor, length: float) -> Tensor:
        """Opacity over ``length`` world units."""
        return -torch.expm1(-self.sigma(raw) * length)

    def raw(self, alpha: float, length: float) -> float:
        """The raw density whose opacity over ``length`` is ``alpha``."""
        sigma = -torch.log1p(-torch.tensor(alpha, dtype=torch.float64)) / length * self.unit
        return float(torch.log(torch.expm1(sigma)) - self.shift)


@dataclass(frozen=True)
class RadianceGrid:
    """Radiance on a sparse lattice: ``values`` (M, 1 + C) are raw density, then colour features;
    ``index`` (X, Y, Z) int32 holds a voxel's row, or -1 where space is empty.
    """

    lattice: Lattice
    index: Tensor
    values: Tensor
    activation: Activation
    skip_alpha: float = 0.0

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

    @property
    def cells(self) -> Tensor:
        """Cells whose corners are present and may exceed ``skip_alpha`` over one voxel."""
        if self.skip_alpha <= 0 or not len(self.values):
            return occupied_cells(self.index)
        low = self.activation.raw(self.skip_alpha, self.lattice.pitch)
        return occupied_cells(self.index, self.raw_density.detach() > low)

    def density(self, points: Tensor) -> Tensor:
        """Sigma (P,) at lattice coordinates (P, 3)."""
        raw = trilinear(self.values[:, :1].contiguous(), self.index, points, self.fill[:1])
        return self.activation.sigma(raw[:, 0])

    def features(self, points: Tensor) -> Tensor:
        """Colour features (P, C) at lattice coordinates (P, 3)."""
        return trilinear(self.color.contiguous(), self.index, points, self.fill[1:])

    def with_values(self, values: Tensor) -> RadianceGrid:
        """The same voxels with other values."""
        return replace(self, values=values)


@dataclass(frozen=True)
class State:
    """Everything a method computed at one time.

    ``fields`` are what is rendered, by name (``upsampled``, ``inpainted``, ``backward``), the best last;
    ``flow`` (N, 3) world units from canonical to ``time`` on the canonical ``index``; ``coverage`` (M,) of
    the warped voxels; ``dropped`` source voxels that left the box. None where a method has no such thing.
    """

    time: float
    fields: dict[str, FieldAtTime]
    canonical: RadianceGrid
    flow: Tensor | None = None
    coverage: Tensor | None = None
    dropped: int = 0
    inpaint_difference: Tensor | None = None


@dataclass(frozen=True)
class Rendering:
    """``rgb`` (R, 3), ``depth`` (R,) mean distance along the ray in world units (0 where nothing is met),
    ``opacity`` and ``transmittance`` (R,). Of the samples whose weight counts: ``weights`` (S,), their
    ``colors`` (S, 3) and ``ray_ids`` (S,). ``samples`` is how many were read.
    """

    rgb: Tensor
    depth: Tensor
    opacity: Tensor
    transmittance: Tensor
    weights: Tensor
    colors: Tensor
    ray_ids: Tensor
    samples: int = 0
    all_weights: Tensor | None = field(default=None, repr=False)
