"""The effects of the voxel methods: motion, up-sampling, inpainting, view dependence, static background."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import EMPTY, DirectRadiance, FieldAtTime, RadianceGrid, Shade
from forewarp.fields.networks import mlp
from forewarp.fields.outline import outline
from forewarp.methods.method import FRACTION, check_least, check_number
from forewarp.ops.backend import check_value
from forewarp.ops.encode import encoded_size, positional_encoding, spherical_harmonics_1
from forewarp.ops.grid import index_of, occupied_cells, trilinear
from forewarp.ops.splat import average_splat, with_copies
from forewarp.scene.box import Lattice


class Motion(nn.Module):
    """Warp the canonical radiance to any time.

    Args:
        trajectory: the canonical trajectory field.
        tau: lower bound of the splat's divisor; bounds its gradient.
        fade: coverage below which a voxel fades to empty space. At coverages below ``tau`` averages shrink
            to 0, and a raw density of 0 is fog.
        rest: copy voxels that move by less than this many voxels per axis instead of splatting them; only
            without gradient, or static voxels would never learn to move.
    """

    def __init__(
        self, trajectory: TrajectoryField, *, tau: float = 1e-2, fade: float = 0.5, rest: float = 0.05
    ) -> None:
        super().__init__()
        check_number("model.motion.tau", tau, "a number in (0, 1]", lambda share: 0 < share <= 1)
        check_number("model.motion.fade", fade, *FRACTION)
        check_number("model.motion.rest", rest, "a number in [0, 0.5)", lambda voxels: 0 <= voxels < 0.5)
        self.trajectory, self.tau, self.fade, self.rest = trajectory, tau, fade, rest

    def warp(self, canonical: RadianceGrid, voxels: Tensor, flow: Tensor) -> tuple[RadianceGrid, Tensor, int]:
        """Average-splat ``canonical`` along a flow.

        Args:
            canonical: the grid to warp.
            voxels: (N, 3), positions of its rows on the lattice.
            flow: (N, 3), world units.

        Returns:
            the warped grid, its coverage (M,), and the number of voxels that left the box.
        """
        values, shape = canonical.values, canonical.lattice.shape
        flow = flow / flow.new_tensor(canonical.lattice.spacing)
        learns = torch.is_grad_enabled() and (values.requires_grad or flow.requires_grad)
        moves = None if learns or self.rest == 0 else ~(flow.abs() < self.rest).all(-1)
        if moves is None or bool(moves.all()):
            splat = average_splat(values, voxels + flow, shape, self.tau)
        else:
            splat = average_splat(values[moves], voxels[moves] + flow[moves], shape, self.tau)
            splat = with_copies(splat, values[~moves], voxels[~moves], self.tau)
        share = (splat.coverage / max(self.fade, self.tau)).clamp(max=1.0)[:, None]
        density = splat.values[:, :1] * share + EMPTY * (1 - share)
        values = torch.cat([density, splat.values[:, 1:]], -1)
        return replace(canonical, index=splat.index, values=values), splat.coverage, splat.dropped


@dataclass(frozen=True)
class Crop:
    """The voxels ``low`` to ``high`` (inclusive) of a lattice."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels per axis."""
        return tuple(h - l + 1 for l, h in zip(self.low, self.high))

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """The region's part of an array over the lattice."""
        return tuple(slice(l, h + 1) for l, h in zip(self.low, self.high))

    def scaled(self, scale: int) -> Crop:
        """Return the same region on a lattice refined ``scale`` times; its corners do not move."""
        return Crop(tuple(v * scale for v in self.low), tuple(v * scale for v in self.high))


def occupied_crop(index: Tensor, margin: int) -> Crop:
    """Crop to the present voxels and a ``margin``, at least 2 voxels per axis; all if none is present."""
    present = (index >= 0).nonzero()
    if not len(present):
        return Crop((0, 0, 0), tuple(n - 1 for n in index.shape))
    low = [max(0, int(v) - margin) for v in present.amin(0)]
    high = [min(n - 1, max(int(v) + margin, l + 1)) for v, n, l in zip(present.amax(0), index.shape, low)]
    return Crop(tuple(min(l, h - 1) for l, h in zip(low, high)), tuple(high))


def densify(grid: RadianceGrid, crop: Crop) -> Tensor:
    """Return the crop's values (1, 1 + C, x, y, z); absent voxels are empty space. Differentiable."""
    rows = grid.index[crop.slices].reshape(-1).long()
    padded = torch.cat([grid.values, grid.fill[None]])
    dense = padded.index_select(0, torch.where(rows < 0, len(padded) - 1, rows))
    return dense.reshape(1, *crop.shape, -1).permute(0, 4, 1, 2, 3)


def sparsify(grid: RadianceGrid, lattice: Lattice, crop: Crop, dense: Tensor) -> RadianceGrid:
    """Make a grid on ``lattice`` with ``dense`` (1, 1 + C, x, y, z) in ``crop`` and nothing elsewhere."""
    index = torch.full(lattice.shape, -1, dtype=torch.int32, device=dense.device)
    count = dense[0, 0].numel()
    rows = torch.arange(count, dtype=torch.int32, device=dense.device).reshape(crop.shape)
    index[crop.slices] = rows
    values = dense[0].permute(1, 2, 3, 0).reshape(count, -1)
    return replace(grid, lattice=lattice, index=index, values=values)


def convolve(layer: nn.Conv3d, x: Tensor) -> Tensor:
    """Apply a convolution to a volume (1, I, x, y, z), on one CPU thread by oneDNN as on several.

    With one thread PyTorch itself takes oneDNN only for volumes above some size, and is about seven times
    slower below it.
    """
    plain = x.device.type == "cpu" and x.dtype == torch.float32 and not torch.is_autocast_enabled("cpu")
    if not plain or torch.get_num_threads() > 1 or not torch.backends.mkldnn.is_available():
        return layer(x)
    return functional.conv3d(x.to_mkldnn(), layer.weight, layer.bias, padding=layer.padding).to_dense()


class ConvBlock(nn.Module):
    """Instance norm, convolution, ReLU: the paper's convolution layer.

    A single voxel is not normalised, as it has no statistics. Volumes at most 2 voxels deep stay in float32
    under autocast, as oneDNN's bfloat16 gradient of the weights reads uninitialised memory there.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm3d(inputs, affine=True)
        self.conv = nn.Conv3d(inputs, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(1, I, x, y, z) -> (1, O, x, y, z)."""
        if x[0, 0].numel() > 1:
            # Equal to instance norm for one volume, and keeps the channels last.
            x = functional.batch_norm(x, None, None, self.norm.weight, self.norm.bias, training=True)
        if x.shape[2] > 2:
            return functional.relu(convolve(self.conv, x), inplace=True)
        with torch.autocast(x.device.type, enabled=False):
            return functional.relu(self.conv(x.to(self.conv.weight.dtype)), inplace=True)


class Pointwise(nn.Conv3d):
    """A 1 x 1 x 1 convolution, as a matrix product over the last channels."""

    def __init__(self, inputs: int, outputs: int, *, zero: bool = False) -> None:
        super().__init__(inputs, outputs, 1)
        if zero:  # start as 0
            nn.init.zeros_(self.weight)
            nn.init.zeros_(self.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(1, I, x, y, z) -> (1, O, x, y, z), channels last."""
        return functional.linear(x.movedim(1, -1), self.weight.flatten(1), self.bias).movedim(-1, 1)


class UNet3d(nn.Module):
    """The inpainter: a U-Net with 4 encoder and 3 decoder levels, on the occupied box only.

    It sees the warped grid but not the time, so that it cannot learn motion. It outputs features for a
    learned up-sampler, or, without one, a residual that starts as 0.

    Args:
        channels: 1 + C of the radiance grid.
        width: channels of the first level, doubled at each further level; a multiple of 16.
        levels: encoder levels.
        margin: voxels around the occupied box.
        coverage_channel: also feed in the splat's coverage.
        head: own the layer that makes the residual; False for a learned up-sampler, which has one.
    """

    def __init__(
        self,
        *,
        channels: int,
        width: int = 64,
        levels: int = 4,
        margin: int = 4,
        coverage_channel: bool = False,
        head: bool = True,
    ) -> None:
        super().__init__()
        check_value("model.inpainter.width", width, "a multiple of 16", lambda number: number % 16 == 0)
        check_least(2, of="model.inpainter", levels=levels)
        self.channels, self.width, self.margin = channels, width, margin
        self.coverage_channel = coverage_channel
        widths = [width * 2**level for level in range(levels)]
        inputs = [channels + coverage_channel, *widths[:-1]]
        self.encode = nn.ModuleList(
            nn.Sequential(ConvBlock(i, max(o // 2, i)), ConvBlock(max(o // 2, i), o))
            for i, o in zip(inputs, widths)
        )
        self.decode = nn.ModuleList(
            nn.Sequential(ConvBlock(deep + skip, skip), ConvBlock(skip, skip))
            for deep, skip in zip(widths[:0:-1], widths[-2::-1])
        )
        self.head = Pointwise(width, channels, zero=True) if head else None

    def features(self, dense: Tensor) -> Tensor:
        """(1, I, x, y, z) -> (1, width, x, y, z); any size of at least one voxel."""
        x, skips = self.encode[0](dense), []
        for block in self.encode[1:]:
            skips.append(x)
            x = block(functional.max_pool3d(x, 2, ceil_mode=True))
        for block, skip in zip(self.decode, reversed(skips)):
            # To the size of the skip, as odd sizes do not double.
            x = functional.interpolate(x, size=skip.shape[2:], mode="nearest")
            x = block(torch.cat([x, skip], 1))
        return x

    def residual(self, features: Tensor) -> Tensor:
        """Features (1, width, x, y, z) -> residual of the warped grid (1, 1 + C, x, y, z)."""
        return self.head(features).to(self.head.weight.dtype)  # half precision ends with the convolutions


def refined(lattice: Lattice, scale: float) -> Lattice:
    """Return the lattice of the same box with the spacing divided by ``scale``."""
    return Lattice(lattice.box, tuple(max(2, round((n - 1) * scale) + 1) for n in lattice.shape))


class TrilinearUpsampler(nn.Module):
    """Interpolate to a lattice ``scale`` times finer, in occupied cells only.

    Args:
        scale: above 1, not necessarily whole.
    """

    def __init__(self, *, scale: float = 2.0) -> None:
        super().__init__()
        none = "or choose model/upsampler=none"
        check_value("model.upsampler.scale", scale, "a number > 1", lambda times: times > 1, none)
        self.scale = scale

    def forward(self, grid: RadianceGrid) -> RadianceGrid:
        """Return the grid on the finer lattice; differentiable in its values.

        Cost: one trilinear read per fine voxel in occupied cells.
        """
        fine = refined(grid.lattice, self.scale)
        cells = occupied_cells(grid.index)
        axes = [
            (torch.arange(n, device=cells.device) * ((m - 1) / (n - 1))).long().clamp(max=m - 2)
            for n, m in zip(fine.shape, grid.lattice.shape)
        ]
        voxels = cells[axes[0]][:, axes[1]][:, :, axes[2]].nonzero()
        points = grid.lattice.to_lattice(fine.to_world(voxels))
        values = trilinear(grid.values, grid.index, points, grid.fill)
        return replace(grid, lattice=fine, index=index_of(voxels, fine.shape), values=values)


class LearnedUpsampler(TrilinearUpsampler):
    """Interpolate, then add detail by two convolutions at the fine resolution: the paper's up-layer.

    Its last layer starts as 0, so that training starts from plain interpolation. An inpainter asks for
    ``residual`` alone.

    Args:
        scale: a whole number > 1.
        channels: 1 + C of the radiance grid.
        width: channels at the fine resolution.
        margin: voxels around the occupied box.
        features: channels of the inpainter's features; 0: read the warped grid.
        recompute: save memory: keep one fine volume for the backward pass instead of five, for a third more
            of the convolutions' time.
    """

    def __init__(
        self,
        *,
        scale: int = 2,
        channels: int,
        width: int = 16,
        margin: int = 2,
        features: int = 0,
        recompute: bool = True,
    ) -> None:
        super().__init__(scale=scale)
        wanted = "a whole number for the learned layer"
        check_value("model.upsampler.scale", scale, wanted, lambda times: times == int(times))
        self.scale, self.margin, self.recompute = int(scale), margin, recompute
        self.project = Pointwise(features or channels, width)
        self.layers = nn.Sequential(ConvBlock(width, width), ConvBlock(width, width))
        self.head = Pointwise(width, channels, zero=True)

    def residual(self, features: Tensor, crop: Crop) -> Tensor:
        """Coarse features (1, F, x, y, z) of ``crop`` -> detail (1, 1 + C, x', y', z') of the fine crop."""
        first, second = self.layers
        volume = self.project(features)  # to few channels first, as all the cost is at the fine resolution
        volume = self._run(lambda coarse: first(interpolate_dense(coarse, crop, self.scale)), volume)
        volume = self._run(lambda fine: self.head(second(fine)), volume)
        return volume.to(self.head.weight.dtype)  # half precision ends with the convolutions

    def _run(self, part: Callable[[Tensor], Tensor], volume: Tensor) -> Tensor:
        if not self.recompute:
            return part(volume)
        return checkpoint(part, volume, use_reentrant=False, preserve_rng_state=False)

    def forward(self, grid: RadianceGrid) -> RadianceGrid:
        """Up-sample a warped grid without an inpainter: interpolation plus learned detail."""
        crop = occupied_crop(grid.index, self.margin)
        dense = densify(grid, crop)
        fine = interpolate_dense(dense, crop, self.scale) + self.residual(dense, crop)
        return sparsify(grid, refined(grid.lattice, self.scale), crop.scaled(self.scale), fine)


def interpolate_dense(dense: Tensor, crop: Crop, scale: int) -> Tensor:
    """Interpolate (1, C, x, y, z) of ``crop`` to the lattice ``scale`` times finer."""
    return functional.interpolate(dense, size=crop.scaled(scale).shape, mode="trilinear", align_corners=True)


def filling(inputs: Tensor, crop: Crop, inpainter: nn.Module, upsampler: nn.Module | None) -> Tensor:
    """(1, I, x, y, z) of ``crop`` -> what fills its holes, by the inpainter and, if it is learned, the
    up-sampler: (1, 1 + C, x', y', z').
    """
    features = inpainter.features(inputs)
    if isinstance(upsampler, LearnedUpsampler):
        return upsampler.residual(features, crop)
    return inpainter.residual(features)


def outline_of(inpainter: UNet3d, upsampler: nn.Module | None, side: int = 64) -> list[dict]:
    """List the steps of ``filling`` for a cube of ``side`` voxels (see ``fields.outline``)."""
    parts = copy.deepcopy(nn.ModuleList(filter(None, (inpainter, upsampler)))).to("meta")
    for part in parts:
        part.recompute = False  # which would hide the steps
    given = torch.empty(1, inpainter.channels + inpainter.coverage_channel, side, side, side, device="meta")
    crop, (net, *rest) = Crop((0, 0, 0), (side - 1,) * 3), parts
    return outline(lambda dense: filling(dense, crop, net, *rest or [None]), given)


def inpaint(
    warped: RadianceGrid, coverage: Tensor | None, inpainter: nn.Module, upsampler: TrilinearUpsampler | None
) -> tuple[RadianceGrid, RadianceGrid, Tensor]:
    """Return the up-sampled grid before and after inpainting, and their difference, on the occupied box."""
    crop = occupied_crop(warped.index, inpainter.margin)
    dense = inputs = densify(warped, crop)
    if inpainter.coverage_channel:
        cover = warped.values.new_ones(len(warped.values)) if coverage is None else coverage.clamp(max=1)
        cover = densify(replace(warped, values=cover[:, None]), crop).clamp(min=0)
        inputs = torch.cat([dense, cover], 1)
    learned = isinstance(upsampler, LearnedUpsampler)
    residual = filling(inputs, crop, inpainter, upsampler)
    lattice, region = warped.lattice, crop
    if upsampler is not None:
        scale = int(upsampler.scale)
        lattice, region = refined(lattice, scale), crop.scaled(scale)
        dense = interpolate_dense(dense, crop, scale)
        residual = residual if learned else interpolate_dense(residual, crop, scale)
    upsampled = sparsify(warped, lattice, region, dense)
    return upsampled, sparsify(warped, lattice, region, dense + residual), residual


class SphericalHarmonics(nn.Module):
    """Spherical harmonics of degree 1: ``sigmoid(c + sum_i Y_i(d) s_i)``; no parameters of its own.

    ``c`` and ``s_i`` are a voxel's features, ``Y_i(d)`` the basis in direction ``d``.
    """

    features = 12

    def forward(self, features: Tensor, directions: Tensor) -> Tensor:
        """Features (S, 12), unit directions (S, 3) -> colour (S, 3) in [0, 1]."""
        basis = spherical_harmonics_1(directions)
        shading = features[:, 3:].reshape(-1, 3, 3)  # (S, basis, rgb)
        return torch.sigmoid(features[:, :3] + (basis[..., None] * shading).sum(1))


class ViewNetwork(nn.Module):
    """The paper's F4: a small MLP of the features and the encoded direction.

    Args:
        features: number of colour features.
        width, layers: size of the network.
        frequencies: octaves of the direction's encoding.
    """

    def __init__(self, *, features: int = 12, width: int = 64, layers: int = 2, frequencies: int = 4) -> None:
        super().__init__()
        self.features, self.frequencies = features, frequencies
        self.network = mlp(features + encoded_size(3, frequencies), 3, width=width, layers=layers)

    def forward(self, features: Tensor, directions: Tensor) -> Tensor:
        """Features (S, C), unit directions (S, 3) -> colour (S, 3) in [0, 1]."""
        encoded = positional_encoding(directions, self.frequencies)
        return torch.sigmoid(self.network(torch.cat([features, encoded], -1)))


class StaticBackground(DirectRadiance):
    """Density and colour of everything static, over the whole scene's box; usually the finer grid.

    Arguments as for ``DirectRadiance``; the colour has three channels and does not depend on direction.
    """


@dataclass(frozen=True)
class Together:
    """Two fields in one: ``sigma = sigma_m + sigma_s``, ``c = (sigma_m c_m + sigma_s c_s) / sigma``.

    Points are in coordinates of the ``static`` lattice, whose box must contain that of ``moving``.
    """

    moving: FieldAtTime
    static: RadianceGrid

    @property
    def lattice(self) -> Lattice:
        """Lattice of the static grid."""
        return self.static.lattice

    @property
    def voxel_size(self) -> float:
        """The smaller of the two voxel sizes."""
        return min(self.moving.voxel_size, self.static.voxel_size)

    @cached_property
    def cells(self) -> Tensor:
        """Cells in which either field may hold matter."""
        return self.static.cells | overlapped(self.moving.cells, self.moving.lattice, self.lattice)

    def _in_moving(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return which rows of the points lie in the moving lattice, and these in its coordinates."""
        inner = self.moving.lattice.to_lattice(self.lattice.to_world(points))
        rows = self.moving.lattice.holds(inner).nonzero()[:, 0]
        return rows, inner[rows]

    def density(self, points: Tensor) -> Tensor:
        """Density (P,)."""
        rows, inner = self._in_moving(points)
        moving = points.new_zeros(len(points)).index_copy(0, rows, self.moving.density(inner))
        return self.static.density(points) + moving

    def colors(self, points: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
        """Colour (P, 3): the mean of both fields' colours, weighted by density."""
        rows, inner = self._in_moving(points)
        static = self.static.colors(points, directions, None)
        moving = self.moving.colors(inner, directions[rows], shade)
        sigma = self.moving.density(inner)
        # The floor avoids 0 / 0 where both fields are empty.
        share = sigma / (sigma + self.static.density(points[rows])).clamp(min=torch.finfo(sigma.dtype).tiny)
        mixed = torch.lerp(static[rows], moving, share[:, None])
        return static.index_copy(0, rows, mixed)


def overlapped(cells: Tensor, source: Lattice, target: Lattice) -> Tensor:
    """Find the cells of lattice ``target`` that overlap a True cell of lattice ``source``.

    Args:
        cells: cells of ``source``, (X-1, Y-1, Z-1) bool.

    Returns:
        cells of ``target``, (X'-1, Y'-1, Z'-1) bool.

    Cost: along each axis in turn, a cumulative sum and two reads per target cell.
    """
    counts = cells.int()
    for axis in range(3):
        edges = torch.arange(target.shape[axis], dtype=torch.float64, device=cells.device)
        edges = edges * target.spacing[axis] + (target.box.low[axis] - source.box.low[axis])
        edges, last = edges / source.spacing[axis], cells.shape[axis]
        low, high = edges[:-1].floor().clamp(0, last).long(), edges[1:].ceil().clamp(0, last).long()
        total = counts.cumsum(axis, dtype=torch.int32)
        total = torch.cat([torch.zeros_like(total.narrow(axis, 0, 1)), total], axis)
        counts = total.index_select(axis, high) - total.index_select(axis, low)
    return counts > 0
