"""Gaussian splatting: project moved Gaussians, rasterize them, and compare the image with the truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad
from torch.utils.checkpoint import checkpoint

from forewarp.ops.backend import arrays, check_shapes, match_threads, use_numba
from forewarp.ops.layout import COLUMN, LOG_MIN_ALPHA, MAX_PER_TILE, SPLAT_WIDTH, TILE_SIZE
from forewarp.ops.lens import distort_with_jacobian

BLUR = 0.1  # square pixels; a pixel alone has a variance of 1/12
# Pairs of a splat and a pixel that the reference holds: with gradients some 12 tensors of them.
CHUNK = 1 << 22
FLAT = 0.28209479177387814  # the first harmonic, 1 / sqrt(4 pi), which no direction changes
DEEP = 0.03  # relative error of depth at which its loss turns from a square to a line
WIDE = 16  # pixels of a tile of the reference along both axes
_LEAST = 1e-12  # length of a quaternion below which it rotates nothing


@dataclass(frozen=True)
class Pinhole:
    """A camera as ``project`` reads it.

    ``rotation`` (3, 3) world to camera, row by row in 9 numbers, ``center`` in world units; ``focal`` and
    ``middle`` in pixels, ``size`` (width, height). What is not farther than ``near`` along the axis is left
    out, and what lies more than ``margin`` pixels beside the image. ``blur`` (square pixels) is added to
    every splat's variance. A lens has ``radial`` and ``tangential`` numbers as in ``ops.lens``; points of the
    plane at distance 1 whose square from the axis is ``reach`` or more it shows nowhere.
    """

    rotation: tuple[float, ...]
    center: tuple[float, float, float]
    focal: tuple[float, float]
    middle: tuple[float, float]
    size: tuple[int, int]
    near: float
    skew: float = 0.0
    blur: float = BLUR
    margin: float = 50.0
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    reach: float = 1e8

    def row(self, like: Tensor) -> Tensor:
        """Return all of it in 28 numbers, of the dtype and on the device of ``like``."""
        parts = (*self.rotation, *self.center, *self.focal, self.skew, *self.middle, *self.size, self.near)
        parts += (self.blur, self.margin, *self.radial, *self.tangential, self.reach)
        return like.new_tensor([float(number) for number in parts])


class Gaussians(NamedTuple):
    """Canonical particles, each a Gaussian: ``means`` (N, 3) world units, ``log_scales`` (N, 3),
    ``quaternions`` (N, 4) as w, x, y, z of any length, ``opacity`` (N, F) logits and ``colors`` (N, B, 3),
    each the coefficients of what a moment gives: F numbers ``opacity_basis``; B - T harmonics of direction,
    then T numbers ``color_basis``.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity: Tensor
    colors: Tensor


class Warp(NamedTuple):
    """How particles move: ``maps`` (M, 12) of nodes, each a matrix row by row and a shift, that are added to
    the identity; ``links`` (N, L) int32 the nodes of a particle and ``weights`` (N, L) their shares.
    """

    maps: Tensor
    links: Tensor
    weights: Tensor


class Splats(NamedTuple):
    """Gaussians on an image. ``values`` (N, 10), by ``COLUMN`` up to the depth: pixel, inverse covariance
    (A, B; B, C), opacity, colour, distance from the camera; ``reach`` (N, 2) pixels along both axes beyond
    which nothing is seen of it, 0 where it is not seen at all. Differentiable are the values.
    """

    values: Tensor
    reach: Tensor


def project(
    particles: Gaussians, warp: Warp, pinhole: Pinhole, color_basis: Tensor, opacity_basis: Tensor
) -> Splats:
    """Move particles and see them through a camera.

    With ``F = I + sum w_k D_k`` and ``b = sum w_k d_k`` a particle goes to ``F x + b``; with J the Jacobian
    of the pixel by the point, and ``T = J F R diag(s)``, its covariance in the image is ``T T^t + blur I``.
    Colour is ``max(0, 1/2 + sum_k Y_k(direction) c_k + sum_k f_k c'_k)`` with f the ``color_basis``, opacity
    ``sigmoid(sum_k g_k o_k)`` with g the ``opacity_basis``.

    Args:
        particles: N of them.
        warp: of the moment; particles whose weights are all 0 stay where they are.
        pinhole: the camera.
        color_basis: (T,), T < B, with B - T one of 1, 4, 9, 16.
        opacity_basis: (F,).

    Returns:
        ``Splats``. Differentiable in particles, maps and weights; directions, and how a lens bends around
        the point, are taken as they are.

    Raises:
        ValueError: for shapes that do not go together.

    Cost: about 500 operations a particle, twice that for gradients.
    """
    _check(particles, warp, color_basis, opacity_basis)
    if not use_numba(particles.means) or particles.means.dtype != torch.float32:
        return project_reference(particles, warp, pinhole, color_basis, opacity_basis)
    camera = pinhole.row(particles.means)
    return Splats(*_Project.apply(*particles, *warp, camera, color_basis, opacity_basis))


_SHAPES = "means (N, 3), log_scales (N, 3), quaternions (N, 4), opacity (N, F), colors (N, B, 3)"
_SHAPES += ", maps (M, 12), links (N, L), weights (N, L)"


def _check(particles: Gaussians, warp: Warp, color_basis: Tensor, opacity_basis: Tensor) -> None:
    check_shapes(_SHAPES, *particles, *warp, F=len(opacity_basis))
    plain = particles.colors.shape[1] - len(color_basis)
    if plain not in (1, 4, 9, 16):
        raise ValueError(
            f"colors: expected 1, 4, 9 or 16 coefficients of direction beside {len(color_basis)} of time, "
            f"but got {plain}"
        )


def harmonics(directions: Tensor, count: int) -> Tensor:
    """Return real spherical harmonics (N, count) of unit directions (N, 3); count is 1, 4, 9 or 16.

    >>> harmonics(torch.tensor([[0.0, 0.0, 1.0]]), 4)[0, ::2]
    tensor([0.2821, 0.4886])
    """
    x, y, z = directions.unbind(-1)
    c1 = math.sqrt(3 / (4 * math.pi))
    values = [torch.full_like(x, FLAT), -c1 * y, c1 * z, -c1 * x]
    a, b, c = (math.sqrt(f / math.pi) for f in (15 / 4, 5 / 16, 15 / 16))
    values += [a * x * y, -a * y * z, b * (2 * z * z - x * x - y * y), -a * x * z, c * (x * x - y * y)]
    a, b, c, d, e = (math.sqrt(f / math.pi) for f in (35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16))
    values += [-a * y * (3 * x * x - y * y), b * x * y * z, -c * y * (4 * z * z - x * x - y * y)]
    values += [d * z * (2 * z * z - 3 * x * x - 3 * y * y), -c * x * (4 * z * z - x * x - y * y)]
    values += [e * z * (x * x - y * y), -a * x * (x * x - 3 * y * y)]
    return torch.stack(values[:count], -1)


def rotations(quaternions: Tensor) -> Tensor:
    """Return the matrices (N, 3, 3) of quaternions (N, 4) of any length; of length 0 the identity."""
    usable = quaternions.square().sum(-1, keepdim=True) > _LEAST**2
    q = torch.where(usable, quaternions, quaternions.new_tensor([1.0, 0.0, 0.0, 0.0]))
    w, x, y, z = (q / q.square().sum(-1, keepdim=True).sqrt()).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def moved(means: Tensor, warp: Warp) -> tuple[Tensor, Tensor]:
    """Return where particles go (N, 3), and the linear part (N, 3, 3) of how."""
    maps = warp.maps[warp.links.long()]  # (N, L, 12)
    blended = (warp.weights[..., None] * maps).sum(1)
    linear = blended[:, :9].reshape(-1, 3, 3) + torch.eye(3).to(blended)
    return (linear @ means[..., None])[..., 0] + blended[:, 9:], linear


def project_reference(
    particles: Gaussians, warp: Warp, pinhole: Pinhole, color_basis: Tensor, opacity_basis: Tensor
) -> Splats:
    """``project`` in plain PyTorch, on any device and in any precision."""
    means, log_scales, quaternions, opacity, colors = particles
    points, linear = moved(means, warp)
    rotation = means.new_tensor(pinhole.rotation).reshape(3, 3)
    away = points - means.new_tensor(pinhole.center)
    local = away @ rotation.T
    solid = torch.sigmoid(opacity @ opacity_basis)
    ahead = local[:, 2].detach() > pinhole.near
    x, y, z = torch.where(ahead[:, None], local, local.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
    plane = torch.stack([x / z, y / z], -1)
    seen = ahead & (255 * solid.detach() > 1) & (plane.detach().square().sum(-1) < pinhole.reach)
    plane = torch.where(seen[:, None], plane, 0.0)
    lensed, (xx, xy, yy) = distort_with_jacobian(plane, pinhole.radial, pinhole.tangential)
    focal = plane.new_tensor([[pinhole.focal[0], pinhole.skew], [0.0, pinhole.focal[1]]])
    pixel = lensed @ focal.T + plane.new_tensor(pinhole.middle)
    low, high = pixel.detach(), pixel.new_tensor(pinhole.size) - pixel.detach()
    seen = seen & (torch.cat([low, high], -1) > -pinhole.margin).all(-1)
    lens = focal @ torch.stack([xx, xy, xy, yy], -1).reshape(-1, 2, 2)
    zero = torch.zeros_like(z)
    flat = torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], -1).reshape(-1, 2, 3)
    rows = lens.detach() @ flat @ rotation @ linear @ rotations(quaternions)  # (N, 2, 3)
    determinant = _covariance(rows.detach() * log_scales.detach().exp()[:, None], pinhole.blur)[3]
    seen = seen & (determinant > 0) & (determinant < 1e30)
    scales = torch.where(seen[:, None], log_scales, 0.0).exp()  # an infinite one's gradient would be NaN
    root = torch.where(seen[:, None, None], rows * scales[:, None], 0.0)
    a, b, c, determinant = _covariance(root, pinhole.blur)
    depth = away.square().sum(-1).clamp(min=1e-30).sqrt()
    directions = (away / depth[:, None]).detach()
    plain = colors.shape[1] - len(color_basis)
    color = torch.einsum("nk,nkc->nc", harmonics(directions, plain), colors[:, :plain]) + 0.5
    color = (color + torch.einsum("k,nkc->nc", color_basis, colors[:, plain:])).clamp(min=0)
    conic = torch.stack([c, -b, a], -1) / determinant[:, None]
    values = torch.cat([pixel, conic, solid[:, None], color, depth[:, None]], -1)
    reach = 2 * torch.log((255 * solid.detach()).clamp(min=1))
    reach = (reach[:, None] * torch.stack([a, c], -1).detach()).sqrt()
    return Splats(torch.where(seen[:, None], values, 0.0), torch.where(seen[:, None], reach, 0.0))


def _covariance(root: Tensor, blur: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return a, b, c (N,) of ``root root^t + blur I`` of roots (N, 2, 3), and its determinant.

    The determinant's first part is the cross product's square: of a needle, a c - b b loses all digits.
    """
    covariance = root @ root.mT
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    normal = torch.linalg.cross(root[:, 0], root[:, 1])
    return a + blur, b, c + blur, normal.square().sum(-1) + blur * (a + c + blur)


def _whole(count: int) -> int:
    """Round up to the sixteens that kernels treat side by side."""
    return -(-count // 16) * 16


def _projected(*tensors: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
    """Return what the kernels of both passes read, and the kernel's splats (N up to a whole sixteen, 16).

    Args:
        tensors: Gaussians, a warp, whose maps get 16 numbers each, the camera's row and both bases.
    """
    from forewarp.ops.kernels import project as kernels

    inputs = (*tensors[:5], pad(tensors[5], (0, 4)), *tensors[6:])
    splats = tensors[0].new_empty(_whole(len(tensors[0])), SPLAT_WIDTH)
    kernels.project(*arrays(*inputs, splats))
    return inputs, splats


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *tensors):
        match_threads()
        inputs, splats = _projected(*tensors)
        ctx.save_for_backward(*inputs, splats)
        splats = splats[: len(tensors[0])]
        reach = splats[:, COLUMN.reach_x : COLUMN.log_opacity]
        ctx.mark_non_differentiable(reach)
        return torch.where(reach[:, :1] > 0, splats[:, : COLUMN.reach_x], 0.0), reach

    @staticmethod
    @once_differentiable
    def backward(ctx, by_values, _):
        threads = match_threads()
        *inputs, splats = ctx.saved_tensors
        seen = (splats[:, COLUMN.reach_x] > 0).nonzero()[:, 0]
        rows = by_values.new_zeros(_whole(len(seen)), SPLAT_WIDTH)
        rows[: len(seen), : by_values.shape[1]] = by_values[seen]
        kinds, seen = [inputs[4].shape[1]], seen.int().numpy()
        gradients, colors, maps, weights = _chain(inputs, splats, seen, rows, threads, kinds)
        return *gradients, *colors, maps, None, weights, None, None, None


def _chain(inputs, splats, seen, by_splat, threads, kinds, *, by_weights=True, softmax=False) -> tuple:
    """Carry gradients by splats (V', 16) of the rows ``seen`` to the Gaussians, maps and weights.

    Returns:
        gradients by all of the Gaussians but the colours; by colours, ``kinds`` coefficients (N, k, 3) in a
        tensor of their own; by maps; and by weights, or by the numbers whose softmax they are, if
        ``by_weights``.
    """
    from forewarp.ops.kernels import project as kernels

    count, starts = len(inputs[0]), accumulate(kinds, initial=0)
    gradients = [torch.empty(t.shape) for t in inputs[:4]]
    room = torch.empty(3 * count * sum(kinds))
    colors = [part.view(count, k, 3) for part, k in zip(room.split([3 * count * k for k in kinds]), kinds)]
    # Where the kernel finds a coefficient in the room: that of the first Gaussian, and from one to the next.
    spots = [(3 * (count * start + j), 3 * k) for start, k in zip(starts, kinds) for j in range(k)]
    spots = torch.tensor(spots, dtype=torch.int64).reshape(-1, 2)
    maps = torch.zeros(threads, *inputs[5].shape)
    weights = torch.empty(inputs[7].shape if by_weights else (0, 0))
    outputs = arrays(by_splat, *gradients, room, spots, maps, weights)
    kernels.chain(*arrays(*inputs, splats), seen, *outputs, softmax)
    return gradients, colors, maps.sum(0)[:, :12], weights


class Image(NamedTuple):
    """``color`` (3, H, W) without background, ``depth`` (H, W) the distance times coverage, and
    ``transmittance`` (H, W), what is let through to the background.
    """

    color: Tensor
    depth: Tensor
    transmittance: Tensor


def rasterize(splats: Splats, width: int, height: int, chunk: int = CHUNK) -> Image:
    """Composite splats in the order of their depth.

    At a pixel whose centre is (dx, dy) from a splat, ``alpha = opacity exp(-(A dx^2 + 2 B dx dy + C dy^2) /
    2)``, 0 where that is below 1/255; from near to far ``T_i = prod_(j<i) (1 - alpha_j)`` and
    ``color = sum_i T_i alpha_i color_i``.

    Args:
        splats: of N particles.
        width, height: of the image, pixels; any numbers >= 1.
        chunk: pairs of a splat and a pixel that are in memory at once where there is no kernel.

    Returns:
        ``Image``, differentiable in the splats' values. A tile of 8 x 8 pixels ends where nothing of it
        lets a thousandth through, and the kernel looks at its nearest 32,768 splats.

    Raises:
        ValueError: for other shapes or sizes.

    Cost: of the kernel, about 60 ns a splat and tile that it touches and 10 ns a splat; of the reference,
    some 50 bytes of memory for each pair of a chunk.
    """
    check_shapes("splats.values (N, 10), splats.reach (N, 2)", *splats)
    if width < 1 or height < 1:
        raise ValueError(f"image: expected at least 1 x 1 pixels, but got {width} x {height}")
    if use_numba(splats.values) and splats.values.dtype == torch.float32:
        planes = _Rasterize.apply(*splats, width, height)[:, :height, :width]
    else:
        planes = rasterize_reference(splats, width, height, chunk)
    return Image(planes[:3], planes[3], planes[4])


def rasterize_reference(splats: Splats, width: int, height: int, chunk: int = CHUNK) -> Tensor:
    """``rasterize`` in plain PyTorch: planes (5, H, W) of colour, depth, and what is let through.

    Splats are sorted by depth and into tiles. As many tiles at a time are blended as have ``chunk`` pairs of
    a splat and a pixel, at least one; the backward pass computes them anew.
    """
    values = splats.values
    across, down = -(-width // WIDE), -(-height // WIDE)
    rows, ends = _rows_of_tiles(splats, across, down)
    lengths = torch.diff(ends, prepend=ends.new_zeros(1))
    longest_first = lengths.argsort(descending=True)
    begins, lengths = (ends - lengths)[longest_first], lengths[longest_first]
    tiles = torch.stack([longest_first % across, longest_first // across, begins, lengths], 1)
    planes, keep = [], values.requires_grad and torch.is_grad_enabled()
    for piece in tiles.split(_pieces(lengths.tolist(), chunk)):
        given = values, rows, piece
        planes.append(checkpoint(_blend, *given, use_reentrant=False) if keep else _blend(*given))
    planes = torch.cat(planes) + values[:0].sum()  # differentiable even where nothing is seen
    image = planes[longest_first.argsort()].reshape(down, across, 5, WIDE, WIDE)
    return image.permute(2, 0, 3, 1, 4).reshape(5, down * WIDE, across * WIDE)[:, :height, :width]


def _rows_of_tiles(splats: Splats, across: int, down: int) -> tuple[Tensor, Tensor]:
    """Return the rows of the splats that each tile touches, from near to far, and where each tile's end."""
    seen = (splats.reach[:, 0] > 0).nonzero()[:, 0]
    order = seen[splats.values.detach()[seen, COLUMN.depth].sort(stable=True).indices]
    middle, reach = splats.values.detach()[order, :2], splats.reach[order]
    most = middle.new_tensor([across, down]) - 1
    low = ((middle - reach) / WIDE).floor().nan_to_num().clamp(min=0)
    high = torch.minimum(((middle + reach) / WIDE).floor().nan_to_num(), most)
    wide, tall = (high - low + 1).clamp(min=0).long().unbind(-1)
    count = wide * tall
    splat = torch.arange(len(order), device=order.device).repeat_interleave(count)
    number = torch.arange(len(splat), device=order.device) - (count.cumsum(0) - count)[splat]
    low = low.long()[splat]
    tile = (low[:, 1] + number // wide[splat]) * across + low[:, 0] + number % wide[splat]
    ends = torch.bincount(tile, minlength=across * down).cumsum(0)
    return order[splat[tile.argsort(stable=True)]], ends


def _pieces(lengths: Sequence[int], chunk: int) -> list[int]:
    """Return how many tiles at a time, of falling ``lengths``, have at most ``chunk`` pairs when padded.

    >>> _pieces([9, 4, 3, 0, 0], 10 * WIDE**2)
    [1, 2, 2]
    """
    counts: list[int] = []
    while (done := sum(counts)) < len(lengths):
        most = chunk // (max(lengths[done], 1) * WIDE**2)
        counts.append(min(max(1, most), len(lengths) - done))
    return counts


def _blend(values: Tensor, rows: Tensor, tiles: Tensor) -> Tensor:
    """Composite the splats of tiles (G, 4), each its column and row, where its ``rows`` begin and how many.

    Returns:
        (G, 5, side, side): colour, depth, and what is let through.
    """
    begin, length = tiles[:, 2:, None].unbind(1)
    place = torch.arange(int(length[0]), device=values.device)
    entries = (begin + place).clamp(max=max(len(rows) - 1, 0))
    own = values[rows[entries]]
    x, y, a, b, c, solid = own[..., : COLUMN.red, None, None].unbind(2)
    side = torch.arange(WIDE, device=values.device)[:, None] + 0.5
    centers = WIDE * tiles[:, None, :2] + side  # (G, side, 2)
    dx, dy = centers[:, None, None, :, 0] - x, centers[:, None, :, None, 1] - y
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy + solid.log()
    inside = (place < length)[..., None, None]
    alpha = torch.where(inside & (power > LOG_MIN_ALPHA), power.exp(), 0.0)
    passed = torch.cumprod(torch.cat([alpha.new_ones(len(tiles), 1, WIDE, WIDE), 1 - alpha], 1), 1)
    shown = torch.einsum("glhw,glk->gkhw", alpha * passed[:, :-1], own[..., COLUMN.red :])
    return torch.cat([shown, passed[:, -1:]], 1)


class _Tiles(NamedTuple):
    """Splats sorted for drawing: rows in ``order`` of depth, and the ``lists`` that kernels read: records,
    the entries of tiles, where each tile's end, and the tiles of each thread. ``longest`` is the longest
    tile's number of entries.
    """

    order: np.ndarray
    lists: tuple[np.ndarray, ...]
    longest: int


def _sorted_tiles(splats: np.ndarray, width: int, height: int, threads: int) -> _Tiles:
    """Sort splats (N, 16) by depth and into the tiles of an image; of equal depths the first comes first."""
    from forewarp.ops.kernels import rasterize as kernels

    seen = np.flatnonzero(splats[:, COLUMN.reach_x] > 0).astype(np.int32)
    bits = splats[seen, COLUMN.depth].view(np.uint32)  # of positive numbers they are ordered as the numbers
    order = np.argsort(bits.astype(np.uint16), kind="stable")  # of 16 bits NumPy sorts by counting
    order = seen[order[np.argsort((bits >> 16).astype(np.uint16)[order], kind="stable")]]
    records, entries, ends = kernels.sort_into_tiles(splats, order, *_tiles(width, height), threads)
    # Runs of tiles of about as much work each: a tile without entries costs about as much as four entries.
    work = ends + 4 * np.arange(len(ends))
    starts = np.searchsorted(work[:-1] * threads, work[-1] * np.arange(threads))
    return _Tiles(order, (records, entries, ends, np.append(starts, len(ends) - 1)), int(np.diff(ends).max()))


def _tiles(width: int, height: int) -> tuple[int, int]:
    """Return how many tiles an image has across and down."""
    return -(-width // TILE_SIZE), -(-height // TILE_SIZE)


def _kept_for(tiles: _Tiles) -> Tensor:
    """Make room for what each thread keeps of a tile between the forward and the backward pass."""
    return torch.empty(
        len(tiles.lists[3]) - 1, 2 * max(min(tiles.longest, MAX_PER_TILE), 1), TILE_SIZE * TILE_SIZE
    )


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, reach, width, height):
        from forewarp.ops.kernels import rasterize as kernels

        threads, (across, down) = match_threads(), _tiles(width, height)
        log_opacity = values.detach()[:, COLUMN.opacity, None].log()
        splats = pad(torch.cat([values.detach(), reach, log_opacity], -1), (0, SPLAT_WIDTH - len(COLUMN)))
        tiles = _sorted_tiles(splats.numpy(), width, height, threads)
        out = torch.empty(5, TILE_SIZE * down, TILE_SIZE * across)
        kernels.draw(*tiles.lists, out.numpy())
        ctx.tiles, ctx.splats = tiles, splats
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, by_planes):
        from forewarp.ops.kernels import rasterize as kernels

        match_threads()
        tiles, splats = ctx.tiles, ctx.splats
        kept = _kept_for(tiles)
        sums = torch.empty(len(kept), len(tiles.order), SPLAT_WIDTH)
        kernels.pull(*tiles.lists, *arrays(by_planes, kept, sums))
        seen, by_splat, _ = _splat_gradients(splats, tiles, sums, 1.0)
        by_values = by_planes.new_zeros(len(splats), COLUMN.depth + 1)
        by_values[torch.from_numpy(seen).long()] = by_splat[: len(seen), : COLUMN.depth + 1]
        return by_values, None, None, None


def _splat_gradients(splats: Tensor, tiles: _Tiles, sums: Tensor, factor: float) -> tuple:
    """Return the rows of splats that are seen, ``factor`` times the gradients by their columns (V', 16), from
    sums over pixels, and the lengths (N,) of those by the pixel.
    """
    from forewarp.ops.kernels import project as kernels

    # Rows lie side by side in memory: in the order of depth half of the time would be waiting.
    ranks = np.full(len(splats), -1, np.int32)
    ranks[tiles.order] = np.arange(len(tiles.order))
    seen = np.flatnonzero(ranks >= 0).astype(np.int32)
    by_splat, pixel_gradient = torch.empty(_whole(len(seen)), SPLAT_WIDTH), torch.zeros(len(splats))
    inputs = (*arrays(splats), seen, ranks[seen], *arrays(sums), factor)
    kernels.splat_gradients(*inputs, *arrays(by_splat, pixel_gradient))
    return seen, by_splat, pixel_gradient


class ImageLoss(NamedTuple):
    """``loss`` and ``squared``: sums over pixels and channels; ``depth``: that of depth, over pixels by their
    confidence; ``particles``, ``maps`` and ``skin``: the gradients of ``factor`` times the loss, and of
    depth's by its weight; ``pixel_gradient`` (N,): the length of theirs by the pixel where a particle lies, 0
    of particles that the image does not show. ``order`` (V,): the rows of those that the image may show, from
    near to far; ``distances`` (N,): from the camera, known of these alone. Where ``kinds`` of colours are
    asked for, ``particles.colors`` is a tuple of tensors.
    """

    loss: float
    squared: float
    depth: float
    particles: Gaussians
    maps: Tensor
    skin: Tensor | None
    pixel_gradient: Tensor
    order: Tensor
    distances: Tensor


def compare(
    particles: Gaussians, warp: Warp, pinhole: Pinhole, color_basis: Tensor, opacity_basis: Tensor,
    pixels: Tensor, background: Tensor, *, width: float = 0.05, factor: float = 1.0, by_skin: bool = False,
    kinds: Sequence[int] | None = None, loss: Callable[[Tensor, Tensor], Tensor] | None = None,
    valid: Tensor | None = None, sensed: Tensor | None = None, by_depth: float = 1.0, deep: float = DEEP,
    chunk: int = CHUNK,
) -> ImageLoss:  # fmt: skip
    """The loss ``sum sqrt(e^2 + width^2) - width`` over pixels and channels, and its gradients.

    ``e`` is the image of ``project`` and ``rasterize`` over ``background`` less the truth over the same:
    near 0 the loss is a square, far from it the error itself. A ``loss`` of the image takes its place.

    Where depth is known it has a loss of the same form besides, of ``e = sum_i w_i (d_i / d - 1)``, with w_i
    what splat i shows of itself in a pixel, and d_i its distance: what lies at the known distance d is as it
    should be however opaque it is, as opacity is for the colours to tell.

    Args:
        particles, warp, pinhole, color_basis, opacity_basis: as of ``project``.
        pixels: (H W, 4) uint8, the truth as straight RGBA.
        background: (3,).
        width: where the loss turns from a square to a line, > 0.
        factor: of the gradients.
        by_skin: whether gradients (N, L) by the numbers are wanted whose softmax the warp's weights are.
        kinds: how many coefficients of colour in turn have gradients (N, k, 3) in a tensor of their own;
            None: all (N, B, 3) are in one.
        loss: called with the image and the truth (H, W, 3), returns a differentiable (); autograd leads from
            it to the kernels. None: the loss above, which a kernel computes together with its gradients.
        valid: (H W,) bool; elsewhere the image counts as equal to the truth. None: all pixels count.
        sensed: (2, H W), distances along the pixels' rays, 0 where not known, and their confidence in [0, 1].
        by_depth: weight of the loss of depth beside the other.
        deep: relative error at which the loss of depth turns from a square to a line, > 0.
        chunk: as of ``rasterize``.

    Returns:
        ``ImageLoss``; nothing in it has a graph.

    Raises:
        ValueError: for shapes that do not go together, or another kind of pixels.

    Cost: that of ``rasterize`` twice and of ``project`` thrice; with a ``loss``, of ``rasterize`` thrice and
    of the loss.
    """
    _check(particles, warp, color_basis, opacity_basis)
    count = math.prod(pinhole.size)
    check_shapes("pixels (P, 4), background (3)", pixels, background, P=count)
    if pixels.dtype != torch.uint8 or not width > 0:
        raise ValueError(f"compare: expected uint8 pixels and width > 0, but got {pixels.dtype}, {width=}")
    if kinds is not None and sum(kinds) != particles.colors.shape[1]:
        raise ValueError(
            f"kinds: expected {particles.colors.shape[1]} coefficients in all, but got {tuple(kinds)}"
        )
    for shape, plane in (("valid (P)", valid), ("sensed (2, P)", sensed)):
        if plane is not None:
            check_shapes(shape, plane, P=count)
    if loss is not None or not use_numba(particles.means) or particles.means.dtype != torch.float32:
        seen, rest = (particles, warp, pinhole, color_basis, opacity_basis), (valid, sensed, by_depth, deep)
        return compare_reference(seen, pixels, background, width, factor, by_skin, kinds, loss, *rest, chunk)
    threads, (across, down), camera = match_threads(), pinhole.size, pinhole.row(particles.means)
    inputs, splats = _projected(*particles, *warp, camera, color_basis, opacity_basis)
    tiles = _sorted_tiles(splats.numpy(), across, down, threads)
    image, planes = pixels.contiguous().view(torch.int32).reshape(down, across), None
    if valid is not None or sensed is not None:
        planes = splats.new_zeros(3, down, across)
        planes[0] = 1.0 if valid is None else valid.reshape(down, across)
        if sensed is not None:
            inverse, trust = _inverse_and_trust(sensed.to(splats))
            planes[1:] = torch.stack([inverse, by_depth * trust]).reshape(2, down, across)
    options = width, factor, by_skin, kinds, planes, deep
    found = _compare_sorted(inputs, splats, tiles, image, background, *options)
    return found._replace(depth=found.depth / (by_depth or 1.0))


def compare_reference(
    seen: tuple, pixels, background, width, factor, by_skin, kinds, loss=None, valid=None, sensed=None,
    by_depth=1.0, deep=DEEP, chunk=CHUNK,
) -> ImageLoss:  # fmt: skip
    """``compare`` in plain PyTorch, on any device and in any precision; a ``loss`` by ``project`` and
    ``rasterize``, which use kernels. ``seen`` are the arguments of ``project``.
    """
    particles, warp, pinhole, *bases = seen
    leaves = [t.detach().clone().requires_grad_() for t in (*particles, warp.maps, warp.weights)]
    with torch.enable_grad():
        own, own_warp = Gaussians(*leaves[:5]), Warp(leaves[5], warp.links, leaves[6])
        splats = (project if loss else project_reference)(own, own_warp, pinhole, *bases)
        splats.values.retain_grad()
        if loss:
            color, far, transmittance = rasterize(splats, *pinhole.size, chunk)
        else:
            planes = rasterize_reference(splats, *pinhole.size, chunk)
            color, far, transmittance = planes[:3], planes[3], planes[4]
        behind = background.to(color)
        drawn = color + transmittance * behind[:, None, None]
        straight = pixels.to(color) / 255
        truth = torch.lerp(behind.expand_as(straight[:, :3]), straight[:, :3], straight[:, 3:])
        shown = drawn.reshape(3, -1).T
        shown = shown if valid is None else torch.where(valid[:, None], shown, truth)
        error = shown - truth
        if loss:
            value = loss(shown.reshape(*drawn.shape[1:], 3), truth.reshape(*drawn.shape[1:], 3))
        else:
            value = ((error.square() + width**2).sqrt() - width).sum()
        of_depth = value.new_zeros(())
        if sensed is not None:
            inverse, trust = _inverse_and_trust(sensed.to(far))
            wrong = far.flatten() * inverse + transmittance.flatten() - 1
            of_depth = (trust * ((wrong.square() + deep**2).sqrt() - deep)).sum()
        (factor * (value + by_depth * of_depth)).backward()
    found = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]
    pixel_gradient = splats.values.grad[:, :2].norm(dim=-1)
    squared = float(error.detach().square().sum())
    weights, pulled = warp.weights.detach(), warp.weights.detach() * found[6]
    skin = pulled - weights * pulled.sum(-1, keepdim=True) if by_skin else None  # which a softmax makes
    seen, away = (splats.reach[:, 0] > 0).nonzero()[:, 0], splats.values.detach()[:, COLUMN.depth]
    order = seen[away[seen].argsort(stable=True)]
    colors = found[4] if kinds is None else found[4].split(list(kinds), 1)
    gradients = Gaussians(*found[:4], colors)
    losses = float(value.detach()), squared, float(of_depth.detach())
    return ImageLoss(*losses, gradients, found[5], skin, pixel_gradient, order, away)


def _inverse_and_trust(sensed: Tensor) -> tuple[Tensor, Tensor]:
    """Return inverse distances (H W,) and their confidence, both 0 where none is known."""
    distance, trust = sensed
    known = distance > 0
    return torch.where(known, 1 / distance, 0.0), torch.where(known, trust, 0.0)


def compile_backward_kernels(
    particles: Gaussians, warp: Warp, pinhole: Pinhole, color_basis: Tensor, opacity_basis: Tensor
) -> None:
    """Compile the backward kernels on empty tiles."""
    maps, camera, (width, height) = pad(warp.maps, (0, 4)), pinhole.row(particles.means), pinhole.size
    inputs = (*particles, maps, warp.links, warp.weights, camera, color_basis, opacity_basis)
    splats, count = torch.zeros(_whole(len(particles.means)), SPLAT_WIDTH), math.prod(_tiles(width, height))
    none, records = np.zeros(0, np.int32), np.zeros((0, COLUMN.depth + 1), np.float32)
    tiles = _Tiles(none, (records, none, np.zeros(count + 1, np.int64), np.array([0, count])), 0)
    image = torch.zeros(height, width, dtype=torch.int32)
    _compare_sorted(inputs, splats, tiles, image, torch.ones(3), 1.0, 1.0, False, None)


def _compare_sorted(
    inputs, splats, tiles, image, background, width, factor, by_skin, kinds, planes=None, deep=DEEP
) -> ImageLoss:
    """Compare sorted splats with an image (H, W) int32 of four bytes a pixel, and the kernel's ``planes``
    (3, H, W), if any; carry the gradients back.
    """
    from forewarp.ops.kernels import rasterize as kernels

    kept, (count, coefficients) = _kept_for(tiles), inputs[4].shape[:2]
    sums = torch.empty(len(kept), len(tiles.order), SPLAT_WIDTH)
    scores = torch.zeros(len(kept), 3, dtype=torch.float64)
    (high, wide), edge = image.shape, (0, -image.shape[1] % TILE_SIZE, 0, -image.shape[0] % TILE_SIZE)
    image, planes = (part if part is None or not any(edge) else pad(part, edge) for part in (image, planes))
    truth = image.numpy().view("uint32"), wide, high, *arrays(background.float()), np.float32(width)
    beside = None if planes is None else planes.numpy()
    kernels.compare(*tiles.lists, *truth, beside, np.float32(deep), *arrays(kept, sums, scores))
    seen, by_splat, pixel_gradient = _splat_gradients(splats, tiles, sums, factor)
    gradients, colors, maps, skin = _chain(
        inputs, splats, seen, by_splat, len(kept), kinds or [coefficients], by_weights=by_skin, softmax=True
    )
    gradients = Gaussians(*gradients, colors[0] if kinds is None else tuple(colors))
    order, depth = torch.from_numpy(tiles.order), splats[:count, COLUMN.depth]
    skin = skin if by_skin else None
    return ImageLoss(*scores.sum(0).tolist(), gradients, maps, skin, pixel_gradient[:count], order, depth)
