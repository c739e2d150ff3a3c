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


def second_variation(volume: Tensor) -> Tensor:
    """Return the mean absolute second difference per axis, averaged over axes: 0 of anything linear.

    Args:
        volume: (X, Y, Z, C), at least 3 points an axis.

    Returns:
        (). Differentiable.

    Cost: three passes over the volume.
    """
    check_shape("volume", volume, ("X", "Y", "Z", "C"))
    if min(volume.shape[:3]) < 3:
        raise ValueError(
            f"second_variation: expected 3 points an axis or more, but got {tuple(volume.shape)}"
        )
    return sum(volume.diff(n=2, dim=axis).abs().mean() for axis in range(3)) / 3


def huber_variation(volume: Tensor) -> Tensor:
    """Return Huber's function of the first differences, summed over axes, points and channels.

    Its slope is the difference itself, at most 1.

    Args:
        volume: (X, Y, Z, C).

    Returns:
        (). Differentiable.

    Cost: three passes over the volume.
    """
    check_shape("volume", volume, ("X", "Y", "Z", "C"))
    steps = [volume.diff(dim=axis) for axis in range(3)]
    zero = volume.new_zeros(())
    return sum(torch.nn.functional.smooth_l1_loss(d, zero.expand_as(d), reduction="sum") for d in steps)


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
