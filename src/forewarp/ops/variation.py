"""Total variation, as means of first differences, which do not depend on the resolution."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.checks import check_shape


def total_variation(values: Tensor, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Return the mean absolute first difference per axis, summed over axes.

    Args:
        values: (M, C) on a sparse lattice.
        pairs: rows of neighbours per axis (see ``grid.neighbour_pairs``).

    Returns:
        (), 0 without neighbours. Differentiable.

    Cost: two reads of C channels per pair.
    """
    check_shape("values", values, ("M", "C"))
    total = values.new_zeros(())
    for first, second in pairs:
        if len(first):
            total = total + (values.index_select(0, first) - values.index_select(0, second)).abs().mean()
    return total


def patch_variation(depth: Tensor, opacity: Tensor) -> Tensor:
    """RegNeRF's depth term: squared first differences in patches, weighted by opacity without gradient.

    Args:
        depth: (B, S, S), in fractions of far - near.
        opacity: (B, S, S) in [0, 1].

    Returns:
        (), the mean over horizontal pairs plus the mean over vertical pairs of weight times squared
        difference; the weight of a pair is its lower opacity. 0 for single pixels. Differentiable in
        ``depth``.
    """
    check_shape("depth", depth, ("B", "S", "S"))
    mask = opacity.detach()
    across = (depth[:, :, 1:] - depth[:, :, :-1]).square() * torch.minimum(mask[:, :, 1:], mask[:, :, :-1])
    down = (depth[:, 1:] - depth[:, :-1]).square() * torch.minimum(mask[:, 1:], mask[:, :-1])
    return across.sum() / max(across.numel(), 1) + down.sum() / max(down.numel(), 1)
