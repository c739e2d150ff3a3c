"""Make pictures smaller by the mean of square blocks of pixels."""

from __future__ import annotations

import torch
from torch import Tensor


def block_sums(picture: Tensor, by: int = 2) -> Tensor:
    """Sum each block of ``by`` x ``by`` pixels: (H, W, ...) -> (H / by, W / by, ...). Differentiable.

    Raises:
        ValueError: where ``by`` does not divide both sides.

    Cost: one read of the picture.

    >>> import torch
    >>> block_sums(torch.arange(8).reshape(2, 4)).tolist()
    [[10, 18]]
    """
    height, width = picture.shape[:2]
    if height % by or width % by:
        raise ValueError(f"picture: expected sides that {by} divides, but got {width} x {height} pixels")
    blocks = picture.reshape(height // by, by, width // by, by, *picture.shape[2:])
    return blocks.sum((1, 3), dtype=None if picture.is_floating_point() else torch.int32)


def block_means(picture: Tensor, by: int = 2) -> Tensor:
    """Average each block of ``by`` x ``by`` pixels; otherwise as ``block_sums``.

    >>> import torch
    >>> block_means(torch.tensor([[1.0, 2.0], [3.0, 5.0]])).item()
    2.75
    """
    return block_sums(picture, by) / by**2


def reduced_depth(depth: Tensor, by: int = 2) -> Tensor:
    """Average the foreground (> 0) of each block, (H, W) -> (H / by, W / by); 0 where there is none.

    >>> import torch
    >>> reduced_depth(torch.tensor([[2.0, 0.0], [4.0, 0.0]])).item()
    3.0
    """
    return block_sums(depth, by) / block_sums((depth > 0).to(depth.dtype), by).clamp(min=1)
