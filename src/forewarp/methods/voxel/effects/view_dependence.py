"""The view-dependence effect: colour from features and a viewing direction."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from forewarp.fields.mlp import mlp
from forewarp.ops.encode import positional_encoding, spherical_harmonics_1


class SphericalHarmonics(nn.Module):
    """Spherical harmonics of degree 1: ``sigmoid(c + sum_i Y_i(d) s_i)``; no parameters of its own.

    ``c`` and ``s_i`` are a voxel's features, ``Y_i(d)`` the basis in direction ``d``.
    """

    features = 12

    def forward(self, features: Tensor, directions: Tensor) -> Tensor:
        """Features (S, 12), unit directions (S, 3) -> colour (S, 3) in [0, 1]."""
        basis = spherical_harmonics_1(directions)
        shading = features[:, 3:].reshape(-1, 3, 3)  # (S, basis, rgb)
        return torch.sigmoid(features[:, :3] + (basis[..., None] * shading).sum(1))


class ViewNetwork(nn.Module):
    """The paper's F4: a small MLP of the features and the encoded direction.

    Args:
        features: number of colour features.
        width, layers: size of the network.
        frequencies: octaves of the direction's encoding.
    """

    def __init__(self, *, features: int = 12, width: int = 64, layers: int = 2, frequencies: int = 4) -> None:
        super().__init__()
        self.features, self.frequencies = features, frequencies
        self.network = mlp(features + 3 * (1 + 2 * frequencies), 3, width=width, layers=layers)

    def forward(self, features: Tensor, directions: Tensor) -> Tensor:
        """Features (S, C), unit directions (S, 3) -> colour (S, 3) in [0, 1]."""
        encoded = positional_encoding(directions, self.frequencies)
        return torch.sigmoid(self.network(torch.cat([features, encoded], -1)))
