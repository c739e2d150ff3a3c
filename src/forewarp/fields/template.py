"""The network of NeRF and its successors: a trunk with a skip, then density, then colour."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

DENSITY: dict[str, Callable[[Tensor], Tensor]] = {"relu": torch.relu, "softplus": nn.functional.softplus}


class Trunk(nn.Module):
    """``layers`` linear layers with ReLU; layer ``skip`` reads the input again.

    Args:
        inputs: channels read by the first layer.
        width: channels of every layer.
        layers: number of layers, at least 1.
        skip: number of the layer, from 1, that also reads the input: 6 in PyTorch versions of NeRF, 5 in JAX
            versions; None: no layer.
        besides: channels that only the first layer reads, not the skip.
        glorot: start from Glorot's uniform weights and biases of 0, as JAX versions do; False: PyTorch's.

    >>> sum(p.numel() for p in Trunk(72).parameters())
    497664
    """

    def __init__(
        self,
        inputs: int,
        *,
        width: int = 256,
        layers: int = 8,
        skip: int | None = 6,
        besides: int = 0,
        glorot: bool = False,
    ) -> None:
        super().__init__()
        if min(inputs, width, layers) < 1 or not (skip is None or 2 <= skip <= layers):
            raise ValueError(
                "trunk: expected inputs, width and layers >= 1 and a skip in [2, layers] or null, "
                f"but got {inputs=}, {width=}, {layers=}, {skip=}"
            )
        self.skip = skip
        sizes = [inputs + besides, *[width] * (layers - 1)]
        self.layers = nn.ModuleList(
            nn.Linear(size + (inputs if number == skip else 0), width) for number, size in enumerate(sizes, 1)
        )

        if glorot:
            self.apply(start_as_glorot)

    def forward(self, x: Tensor, beside: Tensor | None = None) -> Tensor:
        """(..., I), and what the first layer reads beside it (..., B) -> (..., width)."""
        hidden = x if beside is None else torch.cat([x, beside], -1)
        for number, layer in enumerate(self.layers, 1):
            if number == self.skip:
                hidden = torch.cat([x, hidden], -1)
            hidden = torch.relu(layer(hidden))
        return hidden


class Template(nn.Module):
    """Density and colour at a point.

    Density is linear in the trunk's output and ignores the condition (a direction, a code). Colour passes a
    linear bottleneck, one layer of half the width that also reads the condition, and a sigmoid.

    Args:
        inputs: channels of the encoded point.
        condition: channels that only colour depends on.
        width, layers, skip, glorot: see ``Trunk``.

    >>> sum(p.numel() for p in Template(63, 27).parameters())
    595844
    """

    def __init__(
        self,
        inputs: int,
        condition: int,
        *,
        width: int = 256,
        layers: int = 8,
        skip: int | None = 6,
        glorot: bool = False,
    ) -> None:
        super().__init__()
        if condition < 1 or width < 2:
            raise ValueError(
                f"template: expected condition >= 1 and width >= 2, but got {condition=}, {width=}"
            )
        self.trunk = Trunk(inputs, width=width, layers=layers, skip=skip)
        self.density_head = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.shading = nn.Linear(width + condition, width // 2)
        self.color_head = nn.Linear(width // 2, 3)
        if glorot:
            self.apply(start_as_glorot)

    def density(self, x: Tensor) -> Tensor:
        """Encoded points (..., I) -> raw density (...,)."""
        return self.density_head(self.trunk(x))[..., 0]

    def forward(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Encoded points (..., I), condition (..., D) -> raw density (...,), colour (..., 3) in [0, 1]."""
        hidden = self.trunk(x)
        return self.density_head(hidden)[..., 0], self.color(hidden, condition)

    def color(self, hidden: Tensor, condition: Tensor) -> Tensor:
        """What the trunk gave (..., width), condition (..., D) -> colour (..., 3) in [0, 1]."""
        shaded = torch.relu(self.shading(torch.cat([self.bottleneck(hidden), condition], -1)))
        return torch.sigmoid(self.color_head(shaded))


def start_as_glorot(layer: nn.Module) -> None:
    """Give a linear layer Glorot's uniform weights and a bias of 0; leave others as they are."""
    if isinstance(layer, nn.Linear):
        nn.init.xavier_uniform_(layer.weight)
        nn.init.zeros_(layer.bias)


def density_of(name: str) -> Callable[[Tensor], Tensor]:
    """Return the density activation ``relu`` or ``softplus``; ValueError for another name."""
    if name not in DENSITY:
        raise ValueError(f"model.sampling.density: expected {' or '.join(DENSITY)}, but got {name!r}")
    return DENSITY[name]
