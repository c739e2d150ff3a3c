"""How much of each node's motion a particle takes: shares by distance, times what was learned."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.backend import match_threads, use_numba
from forewarp.ops.checks import check_shape

LEAST = 1e-20  # sum that is divided by: that of a particle at rest is 0
_WIDEST = 16  # nodes of a particle that the kernel knows


def skin_weights(shares: Tensor, learned: Tensor) -> Tensor:
    """The weights ``s_j exp(l_j) / sum_k s_k exp(l_k)`` of the nodes that particles follow.

    Args:
        shares: (N, L), >= 0; a row of zeros gives zeros.
        learned: (N, L), of any size: what counts is how far apart the numbers of a row are.

    Returns:
        (N, L). Differentiable in ``learned``, where a gradient is asked for.

    Raises:
        ValueError: for shapes that do not go together.

    Cost: an exponential a weight.

    >>> skin_weights(torch.tensor([[0.5, 0.5]]), torch.tensor([[1000.0, 1000.0]]))
    tensor([[0.5000, 0.5000]])
    """
    check_shape("shares", shares, ("N", "L"))
    check_shape("learned", learned, tuple(shares.shape))
    asks = torch.is_grad_enabled() and learned.requires_grad
    fast = use_numba(learned) and learned.dtype == torch.float32 and shares.dtype == torch.float32
    if not fast or asks or not 0 < shares.shape[1] <= _WIDEST:
        return skin_weights_reference(shares, learned)
    from forewarp.ops import kernels_skin

    match_threads()
    found = torch.empty(shares.shape)
    parts = (t.detach().contiguous().view(-1).numpy() for t in (shares, learned, found))
    kernels_skin.weigh(*parts, shares.shape[1])
    return found


def skin_weights_reference(shares: Tensor, learned: Tensor) -> Tensor:
    """``skin_weights`` in plain PyTorch, on any device and in any precision."""
    top = learned.detach().amax(-1, keepdim=True)  # a row less it means the same, and is safe
    own = shares * (learned - top).exp()
    return own / own.sum(-1, keepdim=True).clamp(min=LEAST)
