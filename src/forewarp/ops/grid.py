"""Lattices of voxels and pixels: trilinear reads, neighbours, occupied cells, block means, total variation.

A sparse lattice is ``values`` (M, C) and ``index`` (X, Y, Z) int32, which holds the row of each voxel, or -1
if it is absent; a dense grid has no -1. Points are in lattice coordinates.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from forewarp.ops.backend import arrays, check_shapes, match_threads, use_numba

_CORNERS = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]


def corner_weights(points: Tensor, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Return the 8 corners around each point and their trilinear weights; clamp points to the border.

    Args:
        points: (P, 3) lattice coordinates.
        shape: (X, Y, Z), at least 2 each.

    Returns:
        corners (P, 8, 3) int64 and weights (P, 8), differentiable in ``points``.
    """
    last = torch.tensor(shape, device=points.device) - 2
    # Clamp before the conversion, as a far point has no int64.
    base = torch.minimum(points.detach().nan_to_num().floor().clamp(min=0), last).long()
    fraction = (points - base).clamp(0, 1)
    offsets = torch.tensor(_CORNERS, device=points.device)
    weights = torch.where(offsets.bool(), fraction[:, None], 1 - fraction[:, None]).prod(-1)
    return base[:, None] + offsets, weights


def trilinear(values: Tensor, index: Tensor, points: Tensor, fill: Tensor) -> Tensor:
    """Interpolate trilinearly: ``sum_corners w(corner) values[index[corner]]``, ``fill`` for absent voxels.

    Args:
        values: (M, C).
        index: (X, Y, Z) int32, rows of ``values`` or -1.
        points: (P, 3) lattice coordinates; clamped to the border.
        fill: (C,), value of an absent voxel.

    Returns:
        (P, C). Differentiable in ``values`` and ``points``, not in ``fill``.

    Raises:
        ValueError: for other shapes, or an axis with a single voxel.

    Cost: 8 reads of C channels per point; the gradient of ``values`` is an (M, C) scatter.

    >>> v, i = torch.tensor([[1.0], [3.0]]), torch.arange(2, dtype=torch.int32).reshape(2, 1, 1)
    >>> trilinear(v, i.expand(2, 2, 2).contiguous(), torch.tensor([[0.5, 0.25, 0.75]]), torch.zeros(1))
    tensor([[2.]])
    """
    shapes = "values (M, C), index (X, Y, Z), points (P, 3), fill (C)"
    check_shapes(shapes, values, index, points, fill)
    if min(index.shape) < 2:
        raise ValueError(f"trilinear: expected at least 2 voxels an axis, but got {tuple(index.shape)}")
    if use_numba(values):
        return _NumbaTrilinear.apply(values, index, points, fill)
    return trilinear_reference(values, index, points, fill)


def trilinear_reference(values: Tensor, index: Tensor, points: Tensor, fill: Tensor) -> Tensor:
    """``trilinear`` in plain PyTorch, for any device."""
    corners, weights = corner_weights(points, tuple(index.shape))
    rows = index[corners[..., 0], corners[..., 1], corners[..., 2]].long()  # (P, 8)
    padded = torch.cat([values, fill[None].to(values)])
    rows = torch.where(rows < 0, len(values), rows)
    out = values.new_zeros(len(points), values.shape[1])
    for corner in range(8):
        out = out + weights[:, corner, None] * padded.index_select(0, rows[:, corner])
    return out


class _NumbaTrilinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, index, points, fill):
        from forewarp.ops.kernels import voxels as kernels

        match_threads()
        # Keep the large values only if the points need a gradient.
        ctx.save_for_backward(values if ctx.needs_input_grad[2] else None, index, points, fill)
        ctx.shape = values.shape
        out = values.new_empty(len(points), values.shape[1])
        kernels.gather(*arrays(values, index, points, fill, out))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        from forewarp.ops.kernels import voxels as kernels

        values, index, points, fill = ctx.saved_tensors
        chunks = min(4, match_threads())
        to_values = to_points = None
        if ctx.needs_input_grad[0]:
            parts = gradient.new_zeros(chunks, *ctx.shape)
            kernels.gather_backward_values(*arrays(index, points, gradient, parts))
            to_values = parts.sum(0) if chunks > 1 else parts[0]
        if ctx.needs_input_grad[2]:
            to_points = points.new_empty(points.shape)
            kernels.gather_backward_points(*arrays(values, index, points, fill, gradient, to_points))
        return to_values, None, to_points, None


def index_of(voxels: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Return the index (X, Y, Z) int32 of distinct voxels (N, 3): their row, -1 elsewhere."""
    check_shapes("voxels (N, 3)", voxels)
    index = torch.full(shape, -1, dtype=torch.int32, device=voxels.device)
    x, y, z = voxels.long().unbind(-1)
    index[x, y, z] = torch.arange(len(voxels), dtype=torch.int32, device=voxels.device)
    return index


def dilate(mask: Tensor, by: int = 1) -> Tensor:
    """Grow a mask (X, Y, Z) or (H, W) by ``by`` in every direction, diagonals included."""
    grown = mask.clone()
    for _ in range(by):
        for axis, n in enumerate(mask.shape):
            before = grown.clone()
            grown.narrow(axis, 1, n - 1).logical_or_(before.narrow(axis, 0, n - 1))
            grown.narrow(axis, 0, n - 1).logical_or_(before.narrow(axis, 1, n - 1))
    return grown


def occupied_cells(index: Tensor, keep: Tensor | None = None) -> Tensor:
    """Return the cells (X-1, Y-1, Z-1) bool with at least one corner that is present and kept.

    Args:
        index: (X, Y, Z) int32.
        keep: (M,) bool over the rows; None: keep all.
    """
    cells = index >= 0
    if keep is not None:
        kept = torch.cat([keep.new_zeros(1), keep])  # -1 reads the first entry: False
        cells = kept.index_select(0, (index + 1).reshape(-1)).view(index.shape)
    for axis in range(3):
        n = cells.shape[axis] - 1
        cells = cells.narrow(axis, 0, n) | cells.narrow(axis, 1, n)
    return cells


def neighbour_pairs(index: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Return the rows of neighbouring present voxels: a pair of (E,) int64 tensors per axis."""
    pairs = []
    for axis in range(3):
        n = index.shape[axis] - 1
        first, second = index.narrow(axis, 0, n).reshape(-1), index.narrow(axis, 1, n).reshape(-1)
        both = ((first >= 0) & (second >= 0)).nonzero()[:, 0]
        pairs.append((first[both].long(), second[both].long()))
    return pairs


def block_sums(image: Tensor, by: int = 2) -> Tensor:
    """Sum each block of ``by`` x ``by`` pixels: (H, W, ...) -> (H / by, W / by, ...). Differentiable.

    Raises:
        ValueError: where ``by`` does not divide both sides.

    Cost: one read of the image.

    >>> import torch
    >>> block_sums(torch.arange(8).reshape(2, 4)).tolist()
    [[10, 18]]
    """
    height, width = image.shape[:2]
    if height % by or width % by:
        raise ValueError(f"image: expected sides that {by} divides, but got {width} x {height} pixels")
    blocks = image.reshape(height // by, by, width // by, by, *image.shape[2:])
    return blocks.sum((1, 3), dtype=None if image.is_floating_point() else torch.int32)


def block_means(image: Tensor, by: int = 2) -> Tensor:
    """Average each block of ``by`` x ``by`` pixels; otherwise as ``block_sums``.

    >>> import torch
    >>> block_means(torch.tensor([[1.0, 2.0], [3.0, 5.0]])).item()
    2.75
    """
    return block_sums(image, by) / by**2


def reduced_depth(depth: Tensor, by: int = 2) -> Tensor:
    """Average the foreground (> 0) of each block, (H, W) -> (H / by, W / by); 0 where there is none.

    >>> import torch
    >>> reduced_depth(torch.tensor([[2.0, 0.0], [4.0, 0.0]])).item()
    3.0
    """
    return block_sums(depth, by) / block_sums((depth > 0).to(depth.dtype), by).clamp(min=1)


def total_variation(values: Tensor, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Return the mean absolute first difference per axis, summed over axes.

    Args:
        values: (M, C) on a sparse lattice.
        pairs: rows of neighbours per axis (see ``grid.neighbour_pairs``).

    Returns:
        (), 0 without neighbours. Differentiable.

    Cost: two reads of C channels per pair.
    """
    check_shapes("values (M, C)", values)
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
    check_shapes("volume (X, Y, Z, C)", volume)
    if min(volume.shape[:3]) < 3:
        raise ValueError(
            f"second_variation: expected 3 points an axis or more, but got {tuple(volume.shape)}"
        )
    return sum(volume.diff(n=2, dim=axis).abs().mean() for axis in range(3)) / 3


def huber_variation(volume: Tensor) -> Tensor:
    """Return Huber's function of the first differences, summed over axes, points and channels.

    Its derivative is the difference itself, at most 1.

    Args:
        volume: (X, Y, Z, C).

    Returns:
        (). Differentiable.

    Cost: three passes over the volume.
    """
    check_shapes("volume (X, Y, Z, C)", volume)
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
    check_shapes("depth (B, S, S)", depth)
    mask = opacity.detach()
    across = (depth[:, :, 1:] - depth[:, :, :-1]).square() * torch.minimum(mask[:, :, 1:], mask[:, :, :-1])
    down = (depth[:, 1:] - depth[:, :-1]).square() * torch.minimum(mask[:, 1:], mask[:, :-1])
    return across.sum() / max(across.numel(), 1) + down.sum() / max(down.numel(), 1)
