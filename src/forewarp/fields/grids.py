"""Voxel grids: learned values on a sparse lattice, and the density and colour that a renderer reads."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor, nn

from forewarp.fields.networks import mlp
from forewarp.ops.backend import check_value, is_number
from forewarp.ops.encode import encoded_size, positional_encoding
from forewarp.ops.grid import index_of, occupied_cells, trilinear
from forewarp.scene.box import Box, Lattice

EMPTY = -10.0  # raw density of an absent voxel: about exp(-10) times the density at raw 0


Shade = Callable[[Tensor, Tensor], Tensor]  # features (P, C) and directions (P, 3) -> colour (P, 3)


class FieldAtTime(Protocol):
    """Density and colour anywhere in ``lattice`` at one time: all that the renderer needs.

    Points (P, 3) are in lattice coordinates; directions (P, 3) have length 1.
    """

    lattice: Lattice
    voxel_size: float  # of the finest voxels, in world units; a ray's step is a share of this
    cells: Tensor  # (X-1, Y-1, Z-1) bool, that may hold matter

    def density(self, points: Tensor) -> Tensor:
        """Density (P,), per world unit of length."""

    def colors(self, points: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
        """Colour (P, 3); ``shade`` computes colour from features and directions."""


def shaded(features: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
    """Features (P, C) and directions (P, 3) -> colour (P, 3); without ``shade`` from the first 3 features."""
    return torch.sigmoid(features[:, :3]) if shade is None else shade(features, directions)


def mean_color(color_of: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """Colours (P, 3) of points (P, 3): the mean of what ``color_of`` gives along the six axes' directions."""
    towards = torch.cat([torch.eye(3), -torch.eye(3)]).to(points)
    return sum(color_of(d.expand(len(points), 3)) for d in towards) / len(towards)


@dataclass(frozen=True)
class Activation:
    """The density activation ``sigma = softplus(raw + shift) / density_scale`` (DirectVoxGO's).

    Attributes:
        shift: ``log(1 / (1 - alpha_init) - 1)``, so that raw 0 has opacity ``alpha_init`` over
            ``density_scale``.
        density_scale: a length in world units (the first stage's voxel size), so that learned values do not
            depend on the scene's scale.
    """

    shift: float
    density_scale: float

    def __post_init__(self) -> None:
        wanted, anew = "a length > 0 from the stage before", "delete the folder of that stage"
        check_value("density_scale", self.density_scale, wanted, lambda scale: 0 < scale < math.inf, anew)

    def sigma(self, raw: Tensor) -> Tensor:
        """Return the density per world unit of length, in the shape of ``raw``."""
        return torch.nn.functional.softplus(raw + self.shift) / self.density_scale

    def alpha(self, raw: Tensor, length: float) -> Tensor:
        """Return the opacity over ``length`` world units."""
        return -torch.expm1(-self.sigma(raw) * length)

    def raw(self, alpha: float, length: float) -> float:
        """Return the raw density whose opacity over ``length`` is ``alpha``."""
        sigma = -torch.log1p(-torch.tensor(alpha, dtype=torch.float64)) / length * self.density_scale
        return float(sigma + torch.log(-torch.expm1(-sigma)) - self.shift)  # expm1(sigma) may overflow


@dataclass(frozen=True)
class RadianceGrid:
    """Radiance on a sparse lattice.

    Attributes:
        lattice: possible voxel positions.
        index: (X, Y, Z) int32, the row of each voxel in ``values``, -1 for absent voxels.
        values: (M, 1 + C), raw density, then colour features.
        activation: turns raw density into density.
        alpha_threshold: skip cells whose eight voxels all have at most this opacity over one voxel.
    """

    lattice: Lattice
    index: Tensor
    values: Tensor
    activation: Activation
    alpha_threshold: float = 0.0

    @property
    def voxel_size(self) -> float:
        """Voxel size of the lattice."""
        return self.lattice.voxel_size

    @property
    def raw_density(self) -> Tensor:
        """Raw density (M,)."""
        return self.values[:, 0]

    @property
    def color(self) -> Tensor:
        """Colour features (M, C)."""
        return self.values[:, 1:]

    @property
    def fill(self) -> Tensor:
        """Values (1 + C,) of an absent voxel."""
        return torch.nn.functional.pad(self.values.new_full((1,), EMPTY), (0, self.values.shape[1] - 1))

    @cached_property
    def cells(self) -> Tensor:
        """Cells with a corner whose opacity over one voxel exceeds ``alpha_threshold``."""
        if self.alpha_threshold <= 0 or not len(self.values):
            return occupied_cells(self.index)
        low = self.activation.raw(self.alpha_threshold, self.lattice.voxel_size)
        return occupied_cells(self.index, self.raw_density.detach() > low)

    def density(self, points: Tensor) -> Tensor:
        """Density (P,) at lattice coordinates (P, 3)."""
        raw = trilinear(self.values[:, :1].contiguous(), self.index, points, self.fill[:1])
        return self.activation.sigma(raw[:, 0])

    def features(self, points: Tensor) -> Tensor:
        """Colour features (P, C) at lattice coordinates (P, 3)."""
        # Read all channels, as a slice of the colours would copy the grid.
        return trilinear(self.values, self.index, points, self.fill)[:, 1:]

    def colors(self, points: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
        """Colour (P, 3) at lattice coordinates (P, 3) seen along unit directions (P, 3)."""
        return shaded(self.features(points), directions, shade)

    def read(
        self, points: Tensor, shade: Shade | None
    ) -> tuple[Tensor, Callable[[Tensor | slice, Tensor], Tensor]]:
        """Return the density (P,) at lattice coordinates (P, 3), and a function: rows (K,) of these points,
        directions (K, 3) -> colour (K, 3). Cost: one read of all channels.
        """
        values = trilinear(self.values, self.index, points, self.fill)
        sigma = self.activation.sigma(values[:, 0])
        return sigma, lambda rows, directions: shaded(values[rows, 1:], directions, shade)


class VoxelGrid(nn.Module):
    """Parameters (N, C) with one row per active voxel, and buffers with the voxels' positions.

    ``voxels`` (N, 3) are the active voxels' lattice positions, ``index`` (X, Y, Z) their rows or -1. Both
    change during training (``activate``, ``resample``), so a method that loads adopts a checkpoint's lattice
    and shapes, those of ``grows``.

    Args:
        lattice: possible voxel positions.
        active: (X, Y, Z) bool, the active voxels.
        channels: number of channels C by parameter name.
    """

    loose = ("index",)

    def __init__(self, lattice: Lattice, active: Tensor, channels: dict[str, int]) -> None:
        super().__init__()
        self.lattice = lattice
        self.names = tuple(channels)
        self.grows = ("voxels", "index", *channels)
        voxels = active.nonzero()
        self.register_buffer("voxels", voxels)
        self.register_buffer("index", index_of(voxels, lattice.shape))
        for name, c in channels.items():
            self.register_parameter(name, nn.Parameter(torch.zeros(len(voxels), c)))

    def extra_repr(self) -> str:
        """Describe shape, share of active voxels and parameters."""
        return f"{self.lattice.shape}, active={len(self.voxels) / self.lattice.count:.1%}, {self.names}"

    def read(self, name: str, points: Tensor) -> Tensor:
        """Interpolate a parameter (N, C) at world points (P, 3): (P, C); absent voxels count as 0."""
        values, at = getattr(self, name), self.lattice.to_lattice(points)
        return trilinear(values, self.index, at, values.new_zeros(values.shape[1]))

    def rows(self) -> list[nn.Parameter]:
        """Return the parameters (N, C), a row for each active voxel, in the order of ``names``."""
        return [getattr(self, name) for name in self.names]

    @torch.no_grad()
    def activate(self, active: Tensor, births: dict[str, float]) -> Tensor:
        """Make the voxels in ``active`` (X, Y, Z) the active ones.

        New voxels get ``births[name]``, or the mean of their active neighbours for names not in it.

        Returns:
            (N',) int64, the former row of each voxel, -1 for new ones.
        """
        voxels = active.nonzero().to(self.voxels.device)
        rows = self.index[voxels[:, 0], voxels[:, 1], voxels[:, 2]].long()
        new = (rows < 0).nonzero()[:, 0]
        for name in self.names:
            old = getattr(self, name)
            values = old.data[rows.clamp(min=0)] if len(old) else old.data.new_zeros(len(rows), old.shape[1])
            if name in births:
                values[new] = births[name]
            else:
                values[new] = self._neighbour_mean(old.data, voxels[new])
            # A new Parameter, as autograd keeps the shape of the old one while any graph lives.
            setattr(self, name, nn.Parameter(values))
        self._place(self.lattice, voxels)
        return rows

    @torch.no_grad()
    def resample(self, lattice: Lattice, active: Tensor, empty: dict[str, float]) -> None:
        """Interpolate the values to another lattice, trilinearly.

        Absent voxels count as ``empty[name]``; names not in it are averaged over the present voxels.
        """
        voxels = active.nonzero().to(self.voxels.device)
        points = self.lattice.to_lattice(lattice.to_world(voxels))
        ones = torch.ones(len(self.voxels), 1, device=points.device)
        share = trilinear(ones, self.index, points, ones.new_zeros(1)).clamp(min=1e-6)
        for name in self.names:
            p = getattr(self, name)
            fill = p.data.new_full((p.shape[1],), empty.get(name, 0.0))
            values = trilinear(p.data, self.index, points, fill)
            setattr(self, name, nn.Parameter(values if name in empty else values / share))
        self._place(lattice, voxels)

    def _place(self, lattice: Lattice, voxels: Tensor) -> None:
        self.lattice = lattice
        self.voxels = voxels
        self.index = index_of(voxels, lattice.shape)

    def _neighbour_mean(self, values: Tensor, voxels: Tensor) -> Tensor:
        last = voxels.new_tensor(self.lattice.shape) - 1
        total = values.new_zeros(len(voxels), values.shape[1])
        count = values.new_zeros(len(voxels), 1)
        for offset in torch.cartesian_prod(*[torch.arange(-1, 2)] * 3).to(voxels.device):
            at = voxels + offset
            inside = self.lattice.holds(at)
            x, y, z = torch.minimum(at.clamp(min=0), last).unbind(-1)
            row = torch.where(inside, self.index[x, y, z].long(), -1)
            there = (row >= 0)[:, None]
            if len(values):
                total += torch.where(there, values[row.clamp(min=0)], 0.0)
            count += there
        return total / count.clamp(min=1)

    def get_extra_state(self) -> dict:
        """Return the lattice in plain numbers."""
        box = self.lattice.box
        return {"low": list(box.low), "high": list(box.high), "shape": list(self.lattice.shape)}

    def set_extra_state(self, state: dict) -> None:
        """Adopt a checkpoint's lattice."""
        self.lattice = _lattice(state)

    def misfit(self, state: dict, prefix: str) -> str | None:
        """Return the name of a stored entry that contradicts the others, or None.

        Kernels do not check the index: a wrong one would crash the process.
        """
        try:
            lattice = _lattice(state[prefix + "_extra_state"])
        except (KeyError, TypeError, ValueError, OverflowError):
            return f"{prefix}_extra_state"
        voxels, index = (state[prefix + name] for name in ("voxels", "index"))
        if not bool(lattice.holds(voxels).all()):
            return f"{prefix}voxels"
        fits = index.shape == lattice.shape  # before one is made of a shape
        return None if fits and torch.equal(index, index_of(voxels, lattice.shape)) else f"{prefix}index"


def _lattice(state: dict) -> Lattice:
    return Lattice(Box(tuple(state["low"]), tuple(state["high"])), tuple(state["shape"]))


def density_shift(alpha_init: float, key: str = "model.radiance.alpha_init") -> float:
    """Return ``log(1 / (1 - alpha_init) - 1)``, the ``shift`` of ``Activation``.

    Raises:
        ValueError: for an opacity outside (0, 1), naming its ``key``.

    >>> round(density_shift(0.5), 6)
    0.0
    """
    check_value(key, alpha_init, "a number in (0, 1)", lambda alpha: is_number(alpha) and 0 < alpha < 1)
    return math.log(1 / (1 - alpha_init) - 1)


class CanonicalRadiance(VoxelGrid):
    """Density and colour at the canonical time, on the active voxels of a lattice.

    Args:
        lattice: possible voxel positions.
        active: (X, Y, Z) bool, the active voxels.
        channels: number of channels by parameter name.
        alpha_init: opacity over ``density_scale`` at raw density 0.
        density_scale: unit of length of densities, in world units.
        alpha_threshold: skip cells whose eight voxels all have at most this opacity over one voxel.
    """

    def __init__(
        self,
        lattice: Lattice,
        active: Tensor,
        channels: dict[str, int],
        *,
        alpha_init: float,
        density_scale: float,
        alpha_threshold: float,
    ) -> None:
        super().__init__(lattice, active, channels)
        self.activation = Activation(density_shift(alpha_init), density_scale)
        self.alpha_threshold = alpha_threshold

    def forward(self) -> RadianceGrid:
        """Return the canonical radiance grid, values (N, 1 + C)."""
        return RadianceGrid(self.lattice, self.index, self.values(), self.activation, self.alpha_threshold)

    def values(self) -> Tensor:
        """Return raw density and colour features (N, 1 + C)."""
        raise NotImplementedError

    def fill(self, alpha: float) -> None:
        """Give all active voxels the opacity ``alpha`` over one voxel."""
        raise NotImplementedError

    def births(self, alpha: float) -> dict[str, float]:
        """Return the raw density of new voxels of an opacity; other parameters get their neighbours' mean."""
        return {"density": self.activation.raw(alpha, self.lattice.voxel_size)}


class DirectRadiance(CanonicalRadiance):
    """Density and colour stored in the voxels, without a network: the cheap choice.

    Args:
        lattice, active: see ``CanonicalRadiance``.
        features: colour channels: 3 for colour, the rest for shading by direction.
        box: unused, as there is no network.
        numbers: alpha_init, density_scale and alpha_threshold: see ``CanonicalRadiance``.
    """

    def __init__(
        self, lattice: Lattice, active: Tensor, *, features: int, box: Box | None = None, **numbers: float
    ) -> None:
        channels = {"density": 1, "color": 3} | ({"shading": features - 3} if features > 3 else {})
        super().__init__(lattice, active, channels, **numbers)

    def values(self) -> Tensor:
        """See ``CanonicalRadiance``."""
        return torch.cat(self.rows(), -1)

    @torch.no_grad()
    def fill(self, alpha: float) -> None:
        """See ``CanonicalRadiance``."""
        self.density.fill_(self.births(alpha)["density"])


class FeatureRadiance(CanonicalRadiance):
    """The paper's F1: density and colour from a feature grid and the encoded position by a small MLP.

    Args:
        lattice, active: see ``CanonicalRadiance``.
        features: colour channels.
        grid_features: channels of the feature grid.
        width, layers: size of F1.
        frequencies: octaves of the positional encoding.
        box: normalises positions to [-1, 1] on all lattices; None: the first lattice's box.
        numbers: alpha_init, density_scale and alpha_threshold: see ``CanonicalRadiance``.
    """

    def __init__(
        self,
        lattice: Lattice,
        active: Tensor,
        *,
        features: int,
        grid_features: int = 12,
        width: int = 128,
        layers: int = 3,
        frequencies: int = 5,
        box: Box | None = None,
        **numbers: float,
    ) -> None:
        super().__init__(lattice, active, {"features": grid_features}, **numbers)
        self.reference, self.frequencies = Lattice(box or lattice.box, (2, 2, 2)), frequencies
        nn.init.normal_(self.features, std=0.1)
        inputs = grid_features + encoded_size(3, frequencies)
        self.network = mlp(inputs, 1 + features, width=width, layers=layers, zero_last=True)
        self._encoded: tuple[Tensor, Tensor] | None = None

    def values(self) -> Tensor:
        """See ``CanonicalRadiance``."""
        # Compare the tensor itself, as an id may be reused.
        if self._encoded is None or self._encoded[0] is not self.voxels:
            points = self.reference.to_lattice(self.lattice.to_world(self.voxels))
            encoded = positional_encoding(self.reference.normalised(points), self.frequencies)
            self._encoded = (self.voxels, encoded)
        return self.network(torch.cat([self._encoded[1], self.features], -1))

    @torch.no_grad()
    def fill(self, alpha: float) -> None:
        """See ``CanonicalRadiance``."""
        self.network[-1].bias[0] = self.activation.raw(alpha, self.lattice.voxel_size)


def read_strided(grid: VoxelGrid, points: Tensor, strides: Sequence[int]) -> Tensor:
    """Interpolate trilinearly between every s-th voxel, for each stride s.

    Args:
        grid: with one parameter (N, C). Along an axis of n voxels, where n - 1 is not a multiple of the last
            stride, zeros are added behind the last voxel until that is so, and stretch all over the box:
            voxels are then not where the lattice has them.
        points: (P, 3), world units.
        strides: ascending, the last a multiple of the others.

    Returns:
        (P, C S), the channels of the first stride first; 0 outside the box. Differentiable in the grid's
        values and in the points.

    Cost: as of S trilinear reads.
    """
    (values,), (index, strided) = grid.rows(), _indices(grid, tuple(strides))
    lattice = grid.lattice
    at, last = lattice.to_lattice(points), points.new_tensor(lattice.shape) - 1
    inside = lattice.holds(at)[..., None]
    at = at * ((points.new_tensor(index.shape) - 1) / last)
    zero = values.new_zeros(values.shape[1])
    read = [trilinear(values, one, at / stride, zero) for one, stride in zip(strided, strides)]
    return torch.cat(read, -1) * inside


def _indices(grid: VoxelGrid, strides: tuple[int, ...]) -> tuple[Tensor, list[Tensor]]:
    """Return the padded index, and every s-th entry of it; kept until the grid changes."""
    known = getattr(grid, "_strided", None)
    if known is None or known[0] is not grid.index or known[1] != strides:
        ends = [end for n in reversed(grid.index.shape) for end in (0, (1 - n) % strides[-1])]
        index = torch.nn.functional.pad(grid.index, ends, value=-1)
        known = grid.index, strides, (index, [index[::s, ::s, ::s].contiguous() for s in strides])
        grid._strided = known
    return known[2]
