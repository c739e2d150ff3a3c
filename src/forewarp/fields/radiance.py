"""The canonical radiance field: density and colour features on a lattice at the canonical time."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from forewarp.fields.mlp import mlp
from forewarp.fields.radiance_grid import EMPTY, Activation, RadianceGrid
from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.ops.encode import positional_encoding
from forewarp.scene.box import Box, Lattice


def density_shift(alpha_init: float, key: str = "model.radiance.alpha_init") -> float:
    """Return ``log(1 / (1 - alpha_init) - 1)``, the ``shift`` of ``Activation``.

    Raises:
        ValueError: for an opacity outside (0, 1), naming its ``key``.

    >>> round(density_shift(0.5), 6)
    0.0
    """
    if not isinstance(alpha_init, int | float) or not 0 < alpha_init < 1:
        raise ValueError(f"{key}: expected a number in (0, 1), but got {alpha_init}")
    return math.log(1 / (1 - alpha_init) - 1)


class DirectRadiance(VoxelGrid):
    """Density and colour stored in the voxels, without a network: the cheap choice.

    Args:
        lattice: possible voxel positions.
        active: (X, Y, Z) bool, the active voxels.
        features: colour channels: 3 for colour, the rest for shading by direction.
        alpha_init: opacity over ``density_scale`` at raw density 0.
        density_scale: unit of length of densities, in world units.
        alpha_threshold: skip cells whose eight voxels all have at most this opacity over one voxel.
        box: unused, as there is no network.
    """

    def __init__(
        self,
        lattice: Lattice,
        active: Tensor,
        *,
        features: int,
        alpha_init: float,
        density_scale: float,
        alpha_threshold: float,
        box: Box | None = None,
    ) -> None:
        super().__init__(lattice, active, self._channels(features))
        self.activation = Activation(density_shift(alpha_init), density_scale)
        self.alpha_threshold = alpha_threshold

    @staticmethod
    def _channels(features: int) -> dict[str, int]:
        channels = {"density": 1, "color": 3}
        return channels | {"shading": features - 3} if features > 3 else channels

    def forward(self) -> RadianceGrid:
        """Return the canonical radiance grid, values (N, 1 + C)."""
        values = torch.cat([self.parameter(name) for name in self.names], -1)
        return RadianceGrid(self.lattice, self.index, values, self.activation, self.alpha_threshold)

    def births(self, alpha: float) -> dict[str, float]:
        """Return the values of new voxels by name: the density of opacity ``alpha``; colour is averaged."""
        return {"density": self.activation.raw(alpha, self.lattice.voxel_size)}

    def empties(self) -> dict[str, float]:
        """Return the values of absent voxels by name, for resampling."""
        return {"density": EMPTY}


class FeatureRadiance(VoxelGrid):
    """The paper's F1: density and colour from a feature grid and the encoded position by a small MLP.

    Args:
        lattice, active, features, alpha_init, density_scale, alpha_threshold: see ``DirectRadiance``.
        grid_features: channels of the feature grid.
        width, layers: size of F1.
        frequencies: octaves of the positional encoding.
        box: normalises positions to [-1, 1] on all lattices; None: the first lattice's box.
    """

    def __init__(
        self,
        lattice: Lattice,
        active: Tensor,
        *,
        features: int,
        alpha_init: float,
        density_scale: float,
        alpha_threshold: float,
        grid_features: int = 12,
        width: int = 128,
        layers: int = 3,
        frequencies: int = 5,
        box: Box | None = None,
    ) -> None:
        super().__init__(lattice, active, {"features": grid_features})
        self.reference = Lattice(box or lattice.box, (2, 2, 2))
        nn.init.normal_(self.features, std=0.1)
        self.network = mlp(
            grid_features + 3 * (1 + 2 * frequencies),
            1 + features,
            width=width,
            layers=layers,
            zero_last=True,
        )
        self.frequencies = frequencies
        self.activation = Activation(density_shift(alpha_init), density_scale)
        self.alpha_threshold = alpha_threshold
        self._encoded: tuple[Tensor, Tensor] | None = None

    def forward(self) -> RadianceGrid:
        """Return the canonical radiance grid, values (N, 1 + C)."""
        values = self.network(torch.cat([self._positions(), self.features], -1))
        return RadianceGrid(self.lattice, self.index, values, self.activation, self.alpha_threshold)

    def _positions(self) -> Tensor:
        # Compare the tensor itself, as an id may be reused.
        if self._encoded is None or self._encoded[0] is not self.voxels:
            points = self.reference.to_lattice(self.lattice.to_world(self.voxels))
            encoded = positional_encoding(self.reference.normalised(points), self.frequencies)
            self._encoded = (self.voxels, encoded)
        return self._encoded[1]

    def births(self, alpha: float) -> dict[str, float]:
        """Return nothing: new voxels get the mean features of their neighbours."""
        return {}

    def empties(self) -> dict[str, float]:
        """Return nothing: resampling averages over the present voxels."""
        return {}
