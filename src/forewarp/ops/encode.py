"""Encodings of positions and directions."""

from __future__ import annotations

import torch
from torch import Tensor


def positional_encoding(
    x: Tensor, frequencies: int, *, window: float | None = None, identity: bool = True
) -> Tensor:
    """``(x, sin(2^0 x), ..., sin(2^(F-1) x), cos(2^0 x), ..., cos(2^(F-1) x))``: NeRF's, sines first.

    Args:
        x: (..., D); without a factor of pi, so in the units that the network is meant for.
        frequencies: F >= 0, without the identity >= 1; 0 returns ``x``.
        window: how many octaves count, in [0, F] (Nerfies' coarse-to-fine annealing): octave k is multiplied
            by ``(1 - cos(pi clip(window - k, 0, 1))) / 2``; ``x`` itself is not. None: all of them.
        identity: whether ``x`` itself comes first.

    Returns:
        (..., D * (1 + 2 F)), or (..., D * 2 F) without the identity. Differentiable in ``x``.

    >>> positional_encoding(torch.zeros(1, 3), 5).shape
    torch.Size([1, 33])
    >>> positional_encoding(torch.zeros(1, 1), 2, window=1.5, identity=False)
    tensor([[0.0000, 0.0000, 1.0000, 0.5000]])
    """
    if frequencies < 0 or not (identity or frequencies):
        least = "frequencies >= 0" if identity else "frequencies >= 1 without the identity"
        raise ValueError(f"positional_encoding: expected {least}, but got {frequencies}")
    if frequencies == 0:
        return x
    bands = 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    phase = (x[..., None, :] * bands[:, None]).flatten(-2)
    waves = [torch.sin(phase), torch.cos(phase)]
    if window is not None:
        octaves = torch.arange(frequencies, dtype=x.dtype, device=x.device)
        shares = (1 - torch.cos(torch.pi * (window - octaves).clamp(0, 1))) / 2
        shares = shares.repeat_interleave(x.shape[-1])
        waves = [shares * wave for wave in waves]
    return torch.cat([x, *waves] if identity else waves, -1)


def encoded_size(size: int, frequencies: int) -> int:
    """Return how many numbers ``positional_encoding`` makes of ``size``, with the identity.

    >>> encoded_size(3, 10)
    63
    """
    return size * (1 + 2 * frequencies)


def spherical_harmonics_1(directions: Tensor) -> Tensor:
    """Spherical harmonics of degree 1 without their constant factors: ``(y, z, x)``.

    Args:
        directions: unit vectors (..., 3).

    Returns:
        (..., 3). Learned coefficients absorb the constants.
    """
    return directions[..., [1, 2, 0]]
