"""A learned warp by screws: Nerfies' deformation field, which HyperNeRF shares."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from forewarp.fields.template import Trunk
from forewarp.ops.encode import encoded_size, positional_encoding
from forewarp.ops.nodes import geman_mcclure, move_by_screw, stretch

_ELASTIC, _STILL = 0.03, 1e-3  # scales of the two robust terms: of log stretches, and in world units
_JITTER = 1e-3  # world units
_FIRST = 1e-4  # first weights of the heads are uniform in [0, this)


class ScrewWarp(nn.Module):
    """Move observed points to the template: ``x' = exp(w, v) x`` with ``(w, v) = W(PE(x), code)``.

    Args:
        code_size: channels of a code.
        frequencies: octaves of the points' encoding.
        width, layers, skip: see ``Trunk``.

    >>> sum(p.numel() for p in ScrewWarp(8).parameters())
    95494
    """

    def __init__(
        self, code_size: int, *, frequencies: int = 6, width: int = 128, layers: int = 6, skip: int | None = 5
    ) -> None:
        super().__init__()
        self.frequencies = frequencies
        inputs = encoded_size(3, frequencies) + code_size
        self.trunk = Trunk(inputs, width=width, layers=layers, skip=skip, glorot=True)
        self.turn, self.shift = nn.Linear(width, 3), nn.Linear(width, 3)
        for head in (self.turn, self.shift):
            nn.init.uniform_(head.weight, 0, _FIRST)
            nn.init.zeros_(head.bias)

    def forward(self, points: Tensor, code: Tensor, window: float) -> Tensor:
        """World points (..., 3) by a code (D,), or one each (..., D) -> template points (..., 3).

        ``window``: how many octaves of the encoding count (see ``positional_encoding``).
        """
        encoded = positional_encoding(points, self.frequencies, window=window)
        hidden = self.trunk(torch.cat([encoded, code.expand(*points.shape[:-1], -1)], -1))
        return move_by_screw(points, self.turn(hidden), self.shift(hidden))

    def octaves(self, progress: float, warp_in: float) -> float:
        """How many octaves of the encoding count at ``progress`` of a stage: all from ``warp_in`` on."""
        return self.frequencies * min(1.0, progress / max(warp_in, 1e-6))

    def elastic(self, points: Tensor, code: Tensor, window: float) -> Tensor:
        """How far the warp at points (P, 3) is from rigid (P,), in [0, 2]: robust squared logarithms of the
        singular values of its Jacobian.

        Cost: the warp, and three times its gradient, through which gradients pass too.
        """
        points = points.detach().requires_grad_()
        moved = self(points, code, window)
        rows = [torch.autograd.grad(moved[:, i].sum(), points, create_graph=True)[0] for i in range(3)]
        jacobian = torch.stack(rows, 1)
        return geman_mcclure(stretch(jacobian) / _ELASTIC**2)

    def stray(
        self, still: Tensor | None, table: Tensor, window: float, most: int | None, generator: torch.Generator
    ) -> Tensor | None:
        """How far the warp moves points that should stay (P, 3): mean in [0, 2]; None without such points.

        ``most`` of them are drawn (None: all), and for each one of the codes in ``table`` (T, D).
        """
        if still is None or not len(still):
            return None
        points = drawn(still.to(table), most, generator)
        codes = table[torch.randint(len(table), (len(points),), generator=generator).to(table.device)]
        noise = torch.randn(points.shape, generator=generator).to(points)
        near = points + _JITTER * noise
        return geman_mcclure((self(near, codes, window) - near).square().sum(-1) / _STILL**2).mean()


def drawn(rows: Tensor, count: int | None, generator: torch.Generator) -> Tensor:
    """Draw ``count`` different rows of a tensor (N, ...) at random, or take all where there are no more."""
    if count is None or len(rows) <= count:
        return rows
    return rows[torch.randperm(len(rows), generator=generator)[:count].to(rows.device)]
