"""Encodings of positions and directions."""

from __future__ import annotations

import torch
from torch import Tensor


def positional_encoding(x: Tensor, frequencies: int) -> Tensor:
    """``(x, sin(2^0 x), ..., sin(2^(F-1) x), cos(2^0 x), ..., cos(2^(F-1) x))``: NeRF's, sines first.

    Args:
        x: (..., D), normalised to [-1, 1].
        frequencies: F >= 0; 0 returns ``x``.

    Returns:
        (..., D * (1 + 2 F)). Differentiable in ``x``.

    >>> positional_encoding(torch.zeros(1, 3), 5).shape
    torch.Size([1, 33])
    """
    if frequencies < 0:
        raise ValueError(f"positional_encoding: expected frequencies >= 0, but got {frequencies}")
    if frequencies == 0:
        return x
    bands = 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    phase = (x[..., None, :] * bands[:, None]).flatten(-2)
    return torch.cat([x, torch.sin(phase), torch.cos(phase)], -1)


def spherical_harmonics_1(directions: Tensor) -> Tensor:
    """Spherical harmonics of degree 1 without their constant factors: ``(y, z, x)``.

    Args:
        directions: unit vectors (..., 3).

    Returns:
        (..., 3). Learned coefficients absorb the constants.
    """
    return directions[..., [1, 2, 0]]
