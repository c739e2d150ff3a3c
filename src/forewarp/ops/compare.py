"""Particles drawn, compared with a picture, and the gradients of that, in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from forewarp.ops.backend import match_threads, use_numba
from forewarp.ops.checks import check_shape
from forewarp.ops.project import (
    Gaussians,
    Pinhole,
    Warp,
    _check,
    arrays,
    project_reference,
    projected,
    room_for_colors,
    whole,
)
from forewarp.ops.rasterize import SIDE, Tiles, kept_for, rasterize_reference, sorted_tiles


class Compared(NamedTuple):
    """``loss`` and ``squared``: sums over pixels and channels; ``particles``, ``maps`` and ``skin``: the
    gradients of ``factor`` times the loss; ``pull`` (N,) how strongly that pulls each over the
    picture, per pixel; 0 of particles that the picture does not show. ``order`` (V,): the rows of those that
    the picture may show, from near to far; ``distances`` (N,): from the camera, known of these alone. Where
    ``kinds`` of colours are asked for, ``particles.colors`` is a tuple of tensors.
    """

    loss: float
    squared: float
    particles: Gaussians
    maps: Tensor
    skin: Tensor | None
    pull: Tensor
    order: Tensor
    distances: Tensor


def compare(
    particles: Gaussians,
    warp: Warp,
    pinhole: Pinhole,
    tints: Tensor,
    fades: Tensor,
    pixels: Tensor,
    background: Tensor,
    *,
    width: float = 0.05,
    factor: float = 1.0,
    by_skin: bool = False,
    kinds: Sequence[int] | None = None,
) -> Compared:
    """The loss ``sum sqrt(e^2 + width^2) - width`` over pixels and channels, and its gradients.

    ``e`` is the picture of ``project`` and ``rasterize`` over ``background`` less the truth over the same:
    near 0 the loss is a square, far from it the error itself.

    Args:
        particles, warp, pinhole, tints, fades: as of ``project``.
        pixels: (H W, 4) uint8, the truth as straight RGBA.
        background: (3,).
        width: where the loss turns from a square to a line, > 0.
        factor: of the gradients.
        by_skin: whether gradients (N, L) by the numbers are wanted whose softmax the warp's weights are.
        kinds: how many coefficients of colour in turn have gradients (N, k, 3) in a tensor of their own;
            None: all (N, B, 3) are in one.

    Returns:
        ``Compared``; nothing in it has a graph.

    Raises:
        ValueError: for shapes that do not go together, or another kind of pixels.

    Cost: that of ``rasterize`` twice and of ``project`` thrice.
    """
    _check(particles, warp, tints, fades)
    check_shape("pixels", pixels, (pinhole.size[0] * pinhole.size[1], 4))
    check_shape("background", background, (3,))
    if pixels.dtype != torch.uint8 or not width > 0:
        raise ValueError(f"compare: expected uint8 pixels and width > 0, but got {pixels.dtype}, {width=}")
    if kinds is not None and sum(kinds) != particles.colors.shape[1]:
        raise ValueError(
            f"kinds: expected {particles.colors.shape[1]} coefficients in all, but got {tuple(kinds)}"
        )
    fast = use_numba(particles.means) and particles.means.dtype == torch.float32
    run = _compare_numba if fast else compare_reference
    return run(particles, warp, pinhole, tints, fades, pixels, background, width, factor, by_skin, kinds)


def compare_reference(
    particles: Gaussians,
    warp: Warp,
    pinhole: Pinhole,
    tints: Tensor,
    fades: Tensor,
    pixels: Tensor,
    background: Tensor,
    width: float,
    factor: float,
    by_skin: bool,
    kinds: Sequence[int] | None,
) -> Compared:
    """``compare`` in plain PyTorch, on any device and in any precision."""
    leaves = [t.detach().clone().requires_grad_() for t in (*particles, warp.maps, warp.weights)]
    with torch.enable_grad():
        own, own_warp = Gaussians(*leaves[:5]), Warp(leaves[5], warp.links, leaves[6])
        splats = project_reference(own, own_warp, pinhole, tints, fades)
        splats.numbers.retain_grad()
        planes = rasterize_reference(splats, *pinhole.size)
        behind = background.to(planes)
        drawn = planes[:3] + planes[4] * behind[:, None, None]
        straight = pixels.to(planes) / 255
        truth = torch.lerp(behind.expand_as(straight[:, :3]), straight[:, :3], straight[:, 3:])
        error = drawn.reshape(3, -1).T - truth
        loss = ((error.square() + width**2).sqrt() - width).sum()
        (factor * loss).backward()
    found = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]
    pull = splats.numbers.grad[:, :2].norm(dim=-1)
    squared = float(error.detach().square().sum())
    skin = _by_softmax(warp.weights.detach(), found[6]) if by_skin else None
    seen, away = (splats.reach[:, 0] > 0).nonzero()[:, 0], splats.numbers.detach()[:, 9]
    order = seen[away[seen].argsort(stable=True)]
    colors = found[4] if kinds is None else found[4].split(list(kinds), 1)
    gradients = Gaussians(*found[:4], colors)
    return Compared(float(loss.detach()), squared, gradients, found[5], skin, pull, order, away)


def _by_softmax(weights: Tensor, slopes: Tensor) -> Tensor:
    """From the gradients (N, L) by weights that are a softmax to those by the numbers it is of."""
    pulled = weights * slopes
    return pulled - weights * pulled.sum(-1, keepdim=True)


def _compare_numba(
    particles, warp, pinhole, tints, fades, pixels, background, width, factor, by_skin, kinds
) -> Compared:
    threads = match_threads()
    view = pinhole.row(particles.means)
    inputs, splats = projected(*particles, *warp, view, tints, fades)
    inputs, size = arrays(*inputs), pinhole.size
    tiles = sorted_tiles(splats.numpy(), -(-size[0] // SIDE), -(-size[1] // SIDE), threads)
    picture = pixels.contiguous().view(torch.int32).reshape(size[1], size[0])
    return _way_back(particles, inputs, splats, tiles, picture, background, width, factor, by_skin, kinds)


def compile_way_back(
    particles: Gaussians, warp: Warp, pinhole: Pinhole, tints: Tensor, fades: Tensor
) -> None:
    """Compile what leads from splats and a picture back to particles, by tiles in which nothing lies."""
    from forewarp.ops.kernels_rasterize import RECORD

    inputs, splats = projected(*particles, *warp, pinhole.row(particles.means), tints, fades, draw=False)
    width, height = pinhole.size
    many = -(-width // SIDE) * -(-height // SIDE)
    none, ends = np.zeros(0, np.int32), np.zeros(many + 1, np.int64)
    tiles = Tiles(none, np.zeros((0, RECORD), np.float32), none, ends, np.array([0, many]), 0)
    picture = torch.zeros(height, width, dtype=torch.int32)
    _way_back(particles, arrays(*inputs), splats, tiles, picture, torch.ones(3), 1.0, 1.0, False, None)


def _way_back(
    particles, inputs, splats, tiles, picture, background, width, factor, by_skin, kinds
) -> Compared:
    """Compare sorted splats with a picture (H, W) int32 of four bytes a pixel; lead the gradients back."""
    from forewarp.ops import kernels_chain, kernels_rasterize

    kept = kept_for(tiles)
    threads = len(kept)
    sums = torch.empty(threads, len(tiles.order), kernels_rasterize.GRADIENT)
    found = torch.zeros(threads, 2, dtype=torch.float64)
    kernels_rasterize.compare(
        tiles.records,
        tiles.entries,
        tiles.ends,
        tiles.shares,
        picture.numpy().view("uint32"),
        *arrays(background.float()),
        np.float32(width),
        *arrays(kept, sums, found),
    )
    seen, ranks = kernels_chain.ranked(tiles.order, len(particles.means))
    by_splat = torch.empty(whole(len(seen)), kernels_chain.SLOPES)
    pull = torch.zeros(len(particles.means))
    kernels_chain.slopes_of(splats.numpy(), seen, ranks, sums.numpy(), factor, by_splat.numpy(), pull.numpy())
    gradients = [torch.empty(t.shape) for t in particles[:4]]
    count, many = particles.colors.shape[:2]
    room, colors, spots = room_for_colors(count, (many,) if kinds is None else kinds)
    maps = torch.zeros(threads, *inputs[5].shape)
    skin = torch.empty(inputs[7].shape if by_skin else (0, 0))
    found_by = arrays(by_splat, *gradients, room, spots, maps, skin)
    kernels_chain.chain(*inputs, splats.numpy(), seen, *found_by, True)
    loss, squared = found.sum(0).tolist()
    return Compared(
        loss,
        squared,
        Gaussians(*gradients, colors[0] if kinds is None else colors),
        maps.sum(0)[:, :12],
        skin if by_skin else None,
        pull,
        torch.from_numpy(tiles.order),
        splats[: len(particles.means), 9],
    )
