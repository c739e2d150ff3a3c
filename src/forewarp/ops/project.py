"""Moved particles as a camera sees them: each a splat, a Gaussian on the picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from forewarp.ops.backend import match_threads, use_numba
from forewarp.ops.checks import check_shape

BLUR = 0.1  # square pixels; a pixel alone has a variance of 1/12
FLAT = 0.28209479177387814  # the first harmonic, 1 / sqrt(4 pi), which no direction changes
_LEAST = 1e-12  # length of a quaternion below which it turns nothing


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
    from forewarp.ops import kernels_project as kernels

    maps = torch.nn.functional.pad(maps, (0, 4))
    inputs = (means, log_scales, quaternions, opacity, colors, maps, links, weights, view, tints, fades)
    out = (means.new_empty if draw else means.new_zeros)(whole(len(means)), kernels.SPLAT)
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
        from forewarp.ops import kernels_chain

        shares = match_threads()
        *inputs, out = ctx.saved_tensors
        found = [torch.empty(t.shape) for t in inputs[:4]]
        maps = inputs[5].new_zeros(shares, *inputs[5].shape)
        weights = torch.empty(inputs[7].shape)
        order = (out[:, 10] > 0).nonzero()[:, 0].int()
        rows = slopes.new_zeros(whole(len(order)), kernels_chain.SLOPES)
        rows[: len(order), : slopes.shape[1]] = slopes[order.long()]
        room, colors, spots = room_for_colors(len(inputs[0]), (inputs[4].shape[1],))
        given = arrays(*inputs, out, order, rows, *found, room, spots, maps, weights)
        kernels_chain.chain(*given, False)
        return *found, *colors, maps.sum(0)[:, :12], None, weights, None, None, None
