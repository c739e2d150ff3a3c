"""Small multilayer perceptrons."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Network(nn.Sequential):
    """Layers that stay in float32 under autocast: bfloat16 would blur a trajectory by a voxel."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., I) -> (..., O), in full precision."""
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float() if x.dtype in (torch.float16, torch.bfloat16) else x)


def mlp(
    inputs: int, outputs: int, *, width: int, layers: int, zero_last: bool = False, leaky: bool = False
) -> Network:
    """``layers`` linear layers, ReLU between them.

    Args:
        inputs, outputs: numbers of channels.
        width: channels of the hidden layers.
        layers: number of linear layers, at least 1.
        zero_last: start from zero outputs.
        leaky: use LeakyReLU with slope 0.01. Otherwise, at the learning rates of motion, one step may
            kill every ReLU of the last hidden layer, and all points then move alike.

    Raises:
        ValueError: for ``layers`` or ``width`` below 1.

    >>> len([m for m in mlp(33, 4, width=128, layers=3) if isinstance(m, nn.Linear)])
    3
    """
    if layers < 1 or width < 1:
        raise ValueError(f"mlp: expected layers >= 1 and width >= 1, but got {layers=}, {width=}")
    sizes = [inputs, *[width] * (layers - 1), outputs]
    parts: list[nn.Module] = []
    for a, b in zip(sizes[:-1], sizes[1:]):
        parts += [nn.Linear(a, b), nn.LeakyReLU(0.01) if leaky else nn.ReLU(inplace=True)]
    parts.pop()
    if zero_last:
        nn.init.zeros_(parts[-1].weight)
        nn.init.zeros_(parts[-1].bias)
    return Network(*parts)
