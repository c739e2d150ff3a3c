"""Gaussian splatting: project moved Gaussians, rasterize them, and compare the image with the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from forewarp.ops.backend import check_shape, match_threads, use_numba

# Columns of a splat; the last three are not part of ``Splats.values``. Kernels pad them with zeros to SPLAT.
X, Y, CONIC_A, CONIC_B, CONIC_C, OPACITY, RED, GREEN, BLUE, DEPTH, REACH_X, REACH_Y, LOG_OPACITY = range(13)
SPLAT = 16
SIDE = 8  # pixels of a tile along both axes
MOST = 1 << 15  # splats of a tile that count, the nearest ones
LEAST_LOG = -math.log(255.0)  # what adds less than a 255th to a pixel is not seen
BLUR = 0.1  # square pixels; a pixel alone has a variance of 1/12
FLAT = 0.28209479177387814  # the first harmonic, 1 / sqrt(4 pi), which no direction changes
_LEAST = 1e-12  # length of a quaternion below which it rotates nothing


@dataclass(frozen=True)
class Pinhole:
    """A camera as ``project`` reads it.

    ``rotation`` (3, 3) world to camera, row by row in 9 numbers, ``center`` in world units; ``focal`` and
    ``middle`` in pixels, ``size`` (width, height). What is not farther than ``near`` along the axis is left
    out, and what lies more than ``margin`` pixels beside the picture. ``blur`` (square pixels) is added to
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
        """All of it in 28 numbers, of the dtype and on the device of ``like``."""
        parts = (self.rotation, self.center, self.focal, (self.skew,), self.middle, self.size, (self.near,))
        parts += ((self.blur, self.margin), self.radial, self.tangential, (self.reach,))
        return like.new_tensor([float(number) for part in parts for number in part])


class Gaussians(NamedTuple):
    """Canonical particles, each a Gaussian: ``means`` (N, 3) world units, ``log_scales`` (N, 3),
    ``quaternions`` (N, 4) as w, x, y, z of any length, ``opacity`` (N, F) logits and ``colors`` (N, B, 3),
    each the coefficients of what a moment gives: F numbers ``fades``; B - T harmonics of direction, then T
    numbers ``tints``.
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
    """``numbers`` (N, 10): u, v, the conic A, B, C, opacity, colour (3), distance; ``reach`` (N, 2) pixels
    along both axes beyond which nothing is seen of it, 0 where it is not seen at all. Differentiable are the
    numbers.
    """

    numbers: Tensor
    reach: Tensor


def project(particles: Gaussians, warp: Warp, pinhole: Pinhole, tints: Tensor, fades: Tensor) -> Splats:
    """Move particles and see them through a camera.

    With ``F = I + sum w_k D_k`` and ``b = sum w_k d_k`` a particle goes to ``F x + b``; with J the slopes of
    the pixel by the point, and ``T = J F R diag(s)``, its covariance in the picture is ``T T^t + blur I``.
    Colour is ``max(0, 1/2 + sum_k Y_k(direction) c_k + sum_k tint_k c'_k)``, opacity
    ``sigmoid(sum_k fade_k o_k)``.

    Args:
        particles: N of them.
        warp: of the moment; particles whose weights are all 0 stay where they are.
        pinhole: the camera.
        tints: (T,), T < B, with B - T one of 1, 4, 9, 16.
        fades: (F,).

    Returns:
        ``Splats``. Differentiable in particles, maps and weights; directions, and how a lens bends around
        the point, are taken as they are.

    Raises:
        ValueError: for shapes that do not go together.

    Cost: about 500 operations a particle, twice that for gradients.
    """
    _check(particles, warp, tints, fades)
    fast = use_numba(particles.means) and particles.means.dtype == torch.float32
    if not fast:
        return project_reference(particles, warp, pinhole, tints, fades)
    view = pinhole.row(particles.means)
    numbers, reach = _Project.apply(*particles, *warp, view, tints, fades)
    return Splats(numbers, reach)


def _check(particles: Gaussians, warp: Warp, tints: Tensor, fades: Tensor) -> None:
    count = len(particles.means)
    shapes = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "opacity": (len(fades),)}
    for name, shape in shapes.items():
        check_shape(name, getattr(particles, name), (count, *shape))
    check_shape("colors", particles.colors, (count, "B", 3))
    plain = particles.colors.shape[1] - len(tints)
    if plain not in (1, 4, 9, 16):
        raise ValueError(
            f"colors: expected 1, 4, 9 or 16 coefficients of direction beside {len(tints)} of time, "
            f"but got {plain}"
        )
    check_shape("maps", warp.maps, ("M", 12))
    check_shape("links", warp.links, (count, "L"))
    check_shape("weights", warp.weights, tuple(warp.links.shape))


def harmonics(directions: Tensor, count: int) -> Tensor:
    """Real spherical harmonics (N, count) of unit directions (N, 3); count is 1, 4, 9 or 16.

    >>> harmonics(torch.tensor([[0.0, 0.0, 1.0]]), 4)[0, ::2]
    tensor([0.2821, 0.4886])
    """
    x, y, z = directions.unbind(-1)
    one = math.sqrt(3 / (4 * math.pi))
    found = [torch.full_like(x, FLAT), -one * y, one * z, -one * x]
    two = [math.sqrt(f / math.pi) for f in (15 / 4, 5 / 16, 15 / 16)]
    found += [two[0] * x * y, -two[0] * y * z, two[1] * (2 * z * z - x * x - y * y), -two[0] * x * z]
    found += [two[2] * (x * x - y * y)]
    a, b, c, d, e = (math.sqrt(f / math.pi) for f in (35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16))
    found += [-a * y * (3 * x * x - y * y), b * x * y * z, -c * y * (4 * z * z - x * x - y * y)]
    found += [d * z * (2 * z * z - 3 * x * x - 3 * y * y), -c * x * (4 * z * z - x * x - y * y)]
    found += [e * z * (x * x - y * y), -a * x * (x * x - 3 * y * y)]
    return torch.stack(found[:count], -1)


def rotations(quaternions: Tensor) -> Tensor:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) of any length; of length 0 it is the identity."""
    square = quaternions.square().sum(-1, keepdim=True)
    usable = square > _LEAST**2
    none = torch.zeros_like(quaternions)
    none[:, 0] = 1
    q = torch.where(usable, quaternions, none)
    w, x, y, z = (q / q.square().sum(-1, keepdim=True).sqrt()).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def moved(means: Tensor, warp: Warp) -> tuple[Tensor, Tensor]:
    """Where particles go (N, 3), and the linear part (N, 3, 3) of how."""
    maps = warp.maps[warp.links.long()]  # (N, L, 12)
    blended = (warp.weights[..., None] * maps).sum(1)
    linear = blended[:, :9].reshape(-1, 3, 3) + torch.eye(3).to(blended)
    return (linear @ means[..., None])[..., 0] + blended[:, 9:], linear


def project_reference(
    particles: Gaussians, warp: Warp, pinhole: Pinhole, tints: Tensor, fades: Tensor
) -> Splats:
    """``project`` in plain PyTorch, on any device and in any precision."""
    means, log_scales, quaternions, opacity, colors = particles
    points, linear = moved(means, warp)
    rotation = means.new_tensor(pinhole.rotation).reshape(3, 3)
    away = points - means.new_tensor(pinhole.center)
    local = away @ rotation.T
    solid = torch.sigmoid(opacity @ fades)
    ahead = local[:, 2].detach() > pinhole.near
    x, y, z = torch.where(ahead[:, None], local, local.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
    plane = torch.stack([x / z, y / z], -1)
    seen = ahead & (255 * solid.detach() > 1) & (plane.detach().square().sum(-1) < pinhole.reach)
    plane = torch.where(seen[:, None], plane, 0.0)
    pixel, slopes = _through_lens(pinhole, plane)
    width, height = pinhole.size
    low, high = pixel.detach(), pixel.new_tensor([width, height]) - pixel.detach()
    seen = seen & (torch.cat([low, high], -1) > -pinhole.margin).all(-1)
    zero = torch.zeros_like(z)
    flat = torch.stack(
        [torch.stack([1 / z, zero, -x / z**2], -1), torch.stack([zero, 1 / z, -y / z**2], -1)], -2
    )
    rows = slopes.detach() @ flat @ rotation @ linear @ rotations(quaternions)  # (N, 2, 3)
    determinant = _covariance(rows.detach() * log_scales.detach().exp()[:, None], pinhole.blur)[3]
    seen = seen & (determinant > 0) & (determinant < 1e30)
    scales = torch.where(seen[:, None], log_scales, 0.0).exp()  # an infinite one's slope would be NaN
    root = torch.where(seen[:, None, None], rows * scales[:, None], 0.0)
    a, b, c, determinant = _covariance(root, pinhole.blur)
    distance = away.square().sum(-1).clamp(min=1e-30).sqrt()
    directions = (away / distance[:, None]).detach()
    plain = colors.shape[1] - len(tints)
    color = torch.einsum("nk,nkc->nc", harmonics(directions, plain), colors[:, :plain]) + 0.5
    color = (color + torch.einsum("k,nkc->nc", tints, colors[:, plain:])).clamp(min=0)
    conic = torch.stack([c, -b, a], -1) / determinant[:, None]
    numbers = torch.cat([pixel, conic, solid[:, None], color, distance[:, None]], -1)
    reach = 2 * torch.log((255 * solid.detach()).clamp(min=1))
    reach = (reach[:, None] * torch.stack([a, c], -1).detach()).sqrt()
    return Splats(torch.where(seen[:, None], numbers, 0.0), torch.where(seen[:, None], reach, 0.0))


def _covariance(root: Tensor, blur: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """a, b, c (N,) of ``root root^t + blur I`` of roots (N, 2, 3), and its determinant.

    The determinant's first part is the cross product's square: of a needle, a c - b b loses all digits.
    """
    covariance = root @ root.mT
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    normal = torch.linalg.cross(root[:, 0], root[:, 1])
    return a + blur, b, c + blur, normal.square().sum(-1) + blur * (a + c + blur)


def _through_lens(pinhole: Pinhole, plane: Tensor) -> tuple[Tensor, Tensor]:
    """Points of the plane at distance 1 -> pixels (N, 2), and the slopes (N, 2, 2) of that."""
    (k1, k2, k3), (p1, p2) = pinhole.radial, pinhole.tangential
    x, y = plane.unbind(-1)
    r2 = x * x + y * y
    scale = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    u = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * scale + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    xx, xy = scale + slope * x * x + 2 * p1 * y + 6 * p2 * x, slope * x * y + 2 * p1 * x + 2 * p2 * y
    yy = scale + slope * y * y + 2 * p2 * x + 6 * p1 * y
    inner = torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2)
    outer = plane.new_tensor([[pinhole.focal[0], pinhole.skew], [0.0, pinhole.focal[1]]])
    return torch.stack([u, v], -1) @ outer.T + plane.new_tensor(pinhole.middle), outer @ inner


def whole(count: int) -> int:
    """Round up to the sixteens that kernels treat side by side."""
    return -(-count // 16) * 16


def arrays(*tensors: Tensor) -> tuple:
    """Numpy views for kernels, contiguous."""
    return tuple(t.detach().contiguous().numpy() for t in tensors)


def room_for_colors(count: int, kinds: Sequence[int]) -> tuple[Tensor, tuple[Tensor, ...], Tensor]:
    """Room for gradients by the colours of so many particles, ``kinds`` coefficients each in a tensor of its
    own: the room, which the kernel fills, these tensors (N, k, 3), and where the kernel finds them in it.
    """
    room = torch.empty(3 * count * sum(kinds))
    parts = tuple(
        part.view(count, k, 3) for part, k in zip(room.split([3 * count * k for k in kinds]), kinds)
    )
    starts = accumulate(kinds, initial=0)
    spots = [(3 * (count * start + j), 3 * k) for start, k in zip(starts, kinds) for j in range(k)]
    return room, parts, torch.tensor(spots, dtype=torch.int64).reshape(-1, 2)


def projected(
    means, log_scales, quaternions, opacity, colors, maps, links, weights, view, tints, fades, *, draw=True
) -> tuple[tuple, Tensor]:
    """What the kernels of both ways read, where maps have 16 numbers each, and the splats (N up to a whole
    sixteen, 16) of the kernel; without ``draw`` nothing is computed, and they are 0.
    """
    from forewarp.ops.kernels import project as kernels

    maps = torch.nn.functional.pad(maps, (0, 4))
    inputs = (means, log_scales, quaternions, opacity, colors, maps, links, weights, view, tints, fades)
    out = (means.new_empty if draw else means.new_zeros)(whole(len(means)), SPLAT)
    if draw:
        kernels.project(*arrays(*inputs), out.detach().numpy())
    return inputs, out


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *tensors):
        match_threads()
        inputs, out = projected(*tensors)
        means = inputs[0]
        ctx.save_for_backward(*inputs, out)
        out = out[: len(means)]
        numbers, reach = torch.where(out[:, 10:11] > 0, out[:, :10], 0.0), out[:, 10:12]
        ctx.mark_non_differentiable(reach)
        return numbers, reach

    @staticmethod
    @once_differentiable
    def backward(ctx, slopes, _):
        from forewarp.ops.kernels import backward

        shares = match_threads()
        *inputs, out = ctx.saved_tensors
        found = [torch.empty(t.shape) for t in inputs[:4]]
        maps = inputs[5].new_zeros(shares, *inputs[5].shape)
        weights = torch.empty(inputs[7].shape)
        order = (out[:, 10] > 0).nonzero()[:, 0].int()
        rows = slopes.new_zeros(whole(len(order)), SPLAT)
        rows[: len(order), : slopes.shape[1]] = slopes[order.long()]
        room, colors, spots = room_for_colors(len(inputs[0]), (inputs[4].shape[1],))
        given = arrays(*inputs, out, order, rows, *found, room, spots, maps, weights)
        backward.chain(*given, False)
        return *found, *colors, maps.sum(0)[:, :12], None, weights, None, None, None


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
    alpha = torch.where(power > LEAST_LOG, power.exp(), 0.0)
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
    """Sort splats (N, 16), a numpy array of ``kernels.project``, into ``across`` x ``down`` tiles."""
    from forewarp.ops.kernels import rasterize as kernels

    order = kernels.by_depth(splats)
    records, entries, ends = kernels.sort_into_tiles(splats, order, across, down, threads)
    shares, longest = kernels.share_out(ends, threads)
    return Tiles(order, records, entries, ends, shares, int(longest))


def kept_for(tiles: Tiles) -> Tensor:
    """Room for what a tile keeps between its way there and back, for each thread."""
    return torch.empty(len(tiles.shares) - 1, 2 * max(min(tiles.longest, MOST), 1), SIDE * SIDE)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, numbers, reach, across, down):
        from forewarp.ops.kernels import rasterize as kernels

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
        from forewarp.ops.kernels import backward
        from forewarp.ops.kernels import rasterize as drawing

        match_threads()
        tiles = ctx.tiles
        kept = kept_for(tiles)
        sums = torch.empty(len(kept), len(tiles.order), SPLAT)
        drawing.pull(
            tiles.records,
            tiles.entries,
            tiles.ends,
            tiles.shares,
            slopes.contiguous().numpy(),
            kept.numpy(),
            sums.numpy(),
        )
        seen, ranks = backward.rank_rows(tiles.order, len(ctx.splats))
        by_splat, pull = torch.empty(whole(len(seen)), SPLAT), torch.empty(len(ctx.splats))
        inputs = ctx.splats.numpy(), seen, ranks, sums.numpy()
        backward.splat_gradients(*inputs, 1.0, by_splat.numpy(), pull.numpy())
        found = slopes.new_zeros(len(ctx.splats), 10)
        found[torch.from_numpy(seen).long()] = by_splat[: len(seen), :10]
        return found, None, None, None


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
    inputs, splats = projected(*particles, *warp, pinhole.row(particles.means), tints, fades, draw=False)
    width, height = pinhole.size
    many = -(-width // SIDE) * -(-height // SIDE)
    none, ends = np.zeros(0, np.int32), np.zeros(many + 1, np.int64)
    tiles = Tiles(none, np.zeros((0, DEPTH + 1), np.float32), none, ends, np.array([0, many]), 0)
    picture = torch.zeros(height, width, dtype=torch.int32)
    _way_back(particles, arrays(*inputs), splats, tiles, picture, torch.ones(3), 1.0, 1.0, False, None)


def _way_back(
    particles, inputs, splats, tiles, picture, background, width, factor, by_skin, kinds
) -> Compared:
    """Compare sorted splats with a picture (H, W) int32 of four bytes a pixel; lead the gradients back."""
    from forewarp.ops.kernels import backward
    from forewarp.ops.kernels import rasterize as drawing

    kept = kept_for(tiles)
    threads = len(kept)
    sums = torch.empty(threads, len(tiles.order), SPLAT)
    found = torch.zeros(threads, 2, dtype=torch.float64)
    drawing.compare(
        tiles.records,
        tiles.entries,
        tiles.ends,
        tiles.shares,
        picture.numpy().view("uint32"),
        *arrays(background.float()),
        np.float32(width),
        *arrays(kept, sums, found),
    )
    seen, ranks = backward.rank_rows(tiles.order, len(particles.means))
    by_splat = torch.empty(whole(len(seen)), SPLAT)
    pull = torch.zeros(len(particles.means))
    backward.splat_gradients(
        splats.numpy(), seen, ranks, sums.numpy(), factor, by_splat.numpy(), pull.numpy()
    )
    gradients = [torch.empty(t.shape) for t in particles[:4]]
    count, many = particles.colors.shape[:2]
    room, colors, spots = room_for_colors(count, (many,) if kinds is None else kinds)
    maps = torch.zeros(threads, *inputs[5].shape)
    skin = torch.empty(inputs[7].shape if by_skin else (0, 0))
    found_by = arrays(by_splat, *gradients, room, spots, maps, skin)
    backward.chain(*inputs, splats.numpy(), seen, *found_by, True)
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
