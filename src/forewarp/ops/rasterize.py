"""Splats drawn into a picture from near to far; a picture compared with the truth, tile by tile."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from forewarp.ops.backend import match_threads, use_numba
from forewarp.ops.checks import check_shape
from forewarp.ops.project import Splats, whole

SIDE = 8  # pixels of a tile along both axes
_LEAST = -math.log(255.0)
FEASIBLE = 1 << 27  # splats times pixels of the reference: with gradients ten float32 tensors of these, 5 GB


class Picture(NamedTuple):
    """``color`` (3, H, W) without background, ``far`` (H, W) the distance times coverage, and ``through``
    (H, W), what is let through to the background.
    """

    color: Tensor
    far: Tensor
    through: Tensor


def rasterize(splats: Splats, width: int, height: int) -> Picture:
    """Composite splats in the order of their distance.

    At a pixel whose centre is (dx, dy) from a splat, ``alpha = opacity exp(-(A dx^2 + 2 B dx dy + C dy^2) /
    2)``, 0 where that is below 1/255; from near to far ``T_i = prod_(j<i) (1 - alpha_j)`` and
    ``color = sum_i T_i alpha_i color_i``.

    Args:
        splats: of N particles.
        width, height: of the picture, pixels; any numbers >= 1.

    Returns:
        ``Picture``, differentiable in the splats' numbers. A tile of 8 x 8 pixels ends where nothing of it
        lets a thousandth through, and the kernel looks at its nearest 32,768 splats.

    Raises:
        ValueError: for other shapes or sizes.

    Cost: of the kernel, about 60 ns a splat and tile that it touches and 10 ns a splat; of the reference,
    N H W numbers of memory.
    """
    check_shape("splats.numbers", splats.numbers, ("N", 10))
    check_shape("splats.reach", splats.reach, (len(splats.numbers), 2))
    if width < 1 or height < 1:
        raise ValueError(f"picture: expected at least 1 x 1 pixels, but got {width} x {height}")
    if use_numba(splats.numbers) and splats.numbers.dtype == torch.float32:
        across, down = -(-width // SIDE), -(-height // SIDE)
        planes = _Rasterize.apply(splats.numbers, splats.reach, across, down)[:, :height, :width]
    else:
        planes = rasterize_reference(splats, width, height)
    return Picture(planes[:3], planes[3], planes[4])


def rasterize_reference(splats: Splats, width: int, height: int) -> Tensor:
    """``rasterize`` in plain PyTorch: planes (5, H, W) of colour, distance, and what is let through."""
    numbers = splats.numbers
    seen = (splats.reach[:, 0] > 0).nonzero()[:, 0]
    most = FEASIBLE / max(len(seen), 1)
    if width * height > most:
        wide, high = smaller(width, height, (most / (width * height)) ** 0.5)
        raise ValueError(
            f"rasterize: expected at most {FEASIBLE:,} splats times pixels without the kernels, but got "
            f"{len(seen):,} x {width} x {height}; install forewarp[cpu] and compute on the CPU, in float32, "
            f"or draw at most {wide} x {high} pixels"
        )
    order = seen[numbers.detach()[seen, 9].sort(stable=True).indices]
    u, v, a, b, c, solid = (numbers[order, k, None, None] for k in range(6))
    dx = torch.arange(width).to(numbers) + 0.5 - u  # (V, 1, W)
    dy = (torch.arange(height).to(numbers) + 0.5)[:, None] - v  # (V, H, 1)
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy + solid.log()
    alpha = torch.where(power > _LEAST, power.exp(), 0.0)
    passed = torch.cumprod(torch.cat([alpha.new_ones(1, height, width), 1 - alpha]), 0)
    weights = alpha * passed[:-1]
    shown = torch.einsum("vhw,vk->khw", weights, numbers[order, 6:])
    return torch.cat([shown, passed[-1:]])


def smaller(width: int, height: int, share: float) -> tuple[int, int]:
    """The sides of a picture of the same form, times a share of them.

    >>> smaller(400, 300, 0.3337)
    (133, 100)
    """
    return max(1, int(share * width)), max(1, int(share * height))


class Tiles(NamedTuple):
    """Splats sorted for drawing: rows in ``order`` of depth, their ``records``, the ``entries`` of tiles and
    where each tile's ``ends``, the ``shares`` of threads, and the longest tile's number of entries.
    """

    order: object
    records: object
    entries: object
    ends: object
    shares: object
    longest: int


def sorted_tiles(splats, across: int, down: int, threads: int) -> Tiles:
    """Sort splats (N, 16), a numpy array of ``kernels_project``, into ``across`` x ``down`` tiles."""
    from forewarp.ops import kernels_tiles as kernels

    order = kernels.by_depth(splats)
    records, entries, ends = kernels.sort_into_tiles(splats, order, across, down, threads)
    shares, longest = kernels.shared_out(ends, threads)
    return Tiles(order, records, entries, ends, shares, int(longest))


def kept_for(tiles: Tiles) -> Tensor:
    """Room for what a tile keeps between its way there and back, for each thread."""
    from forewarp.ops.kernels_rasterize import MOST

    return torch.empty(len(tiles.shares) - 1, 2 * max(min(tiles.longest, MOST), 1), SIDE * SIDE)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, numbers, reach, across, down):
        from forewarp.ops import kernels_rasterize as kernels

        threads = match_threads()
        log = numbers.detach()[:, 5:6].log()
        splats = torch.nn.functional.pad(torch.cat([numbers.detach(), reach, log], -1), (0, 3))
        tiles = sorted_tiles(splats.numpy(), across, down, threads)
        out = torch.empty(5, SIDE * down, SIDE * across)
        kernels.draw(tiles.records, tiles.entries, tiles.ends, tiles.shares, out.numpy())
        ctx.tiles, ctx.splats = tiles, splats
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, slopes):
        from forewarp.ops import kernels_chain, kernels_rasterize

        match_threads()
        tiles = ctx.tiles
        kept = kept_for(tiles)
        sums = torch.empty(len(kept), len(tiles.order), kernels_rasterize.GRADIENT)
        kernels_rasterize.pull(
            tiles.records,
            tiles.entries,
            tiles.ends,
            tiles.shares,
            slopes.contiguous().numpy(),
            kept.numpy(),
            sums.numpy(),
        )
        seen, ranks = kernels_chain.ranked(tiles.order, len(ctx.splats))
        by_splat, pull = torch.empty(whole(len(seen)), kernels_chain.SLOPES), torch.empty(len(ctx.splats))
        inputs = ctx.splats.numpy(), seen, ranks, sums.numpy()
        kernels_chain.slopes_of(*inputs, 1.0, by_splat.numpy(), pull.numpy())
        found = slopes.new_zeros(len(ctx.splats), 10)
        found[torch.from_numpy(seen).long()] = by_splat[: len(seen), :10]
        return found, None, None, None
