"""An effect: a view dependence of somebody else's."""

import torch
from torch import nn


class Tint(nn.Module):
    """Three features are a colour, brightened by a learned share of the direction's height.

    Args:
        strength: of the direction at the beginning.
    """

    features = 3

    def __init__(self, *, strength=0.1):
        super().__init__()
        self.strength = nn.Parameter(torch.tensor(float(strength)))

    def forward(self, features, directions):
        """Features (S, 3), unit directions (S, 3) -> colour (S, 3) in [0, 1]."""
        return torch.sigmoid(features + self.strength * directions[:, 2:])
