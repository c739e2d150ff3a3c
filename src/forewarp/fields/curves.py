"""Smooth curves over time, by a few coefficients of a basis; the field of every voxel's curve."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import mul

import torch
from torch import Tensor, nn

from forewarp.fields.grids import VoxelGrid
from forewarp.fields.networks import mlp
from forewarp.ops.backend import check_value
from forewarp.ops.curves import dct_basis, spline_basis, spline_shares
from forewarp.ops.encode import positional_encoding
from forewarp.ops.grid import corner_weights, index_of, trilinear
from forewarp.scene.box import Box, Lattice

KINDS = ("spline", "cosines")
COEFFICIENTS = ("network", "nodes")
PADDING = 0.2  # of the sequence, imagined before and after it: a cosine stands still at both ends


class Curve:
    """``sum_k c_k b_k(t)``. Cosines are exactly 0 at the canonical time; a spline is not: pictures of that
    time bend their own knots, and not what all others share.

    Args:
        kind: of ``KINDS``: ``spline``, whose knots bend their neighbourhood in time alone, or ``cosines``,
            the paper's DCT.
        count: of coefficients; a spline has at least 4, cosines at most one less than there are times. Of a
            ``straight`` spline two follow from the others, and it has two less, but no fewer than 4 of four
            times or more, and as many as there are times of fewer.
        times: how many distinct training times there are, at least 2.
        canonical_time: in [0, 1].
        straight: whether a spline ends without acceleration: what the first and the last picture leave open
            is then told by those beside them.
        exactly: take ``count`` as it is, as a file says.
    """

    def __init__(
        self,
        kind: str,
        count: int,
        times: int,
        canonical_time: float,
        *,
        straight: bool = False,
        exactly: bool = False,
    ) -> None:
        self.kind, self.times, self.canonical_time = kind, times, canonical_time
        self.straight = straight and kind == "spline"
        if exactly:
            self.count = count
        elif kind == "cosines":
            self.count = max(1, min(count, times - 1))
        else:
            self.count = max(min(times, 4), count - 2) if straight else max(4, count)

    @property
    def pieces(self) -> int:
        """How many cubics a spline has, each between two knots."""
        return self.count - (1 if self.straight else 3)

    def __call__(self, time: float | Tensor, beyond: float = 0.0) -> Tensor:
        """The basis (..., K) at a time in [0, 1]; a spline also takes times up to ``beyond`` outside."""
        if self.kind == "spline":
            return spline_basis(time, self.count, beyond=beyond, straight=self.straight)
        return dct_basis(time, self.count, self.times, self.canonical_time, PADDING)

    def summed(self, parts: Sequence[tuple[float, float]], beyond: float = 0.0) -> Tensor:
        """``sum_i f_i b(t_i)`` (K,) of times and factors: a difference of bases, say, at one go."""
        if self.kind == "spline":
            shares = [spline_shares(t, self.count, beyond=beyond, straight=self.straight) for t, _ in parts]
            factors = [factor for _, factor in parts]
            return torch.tensor([sum(map(mul, factors, of_one)) for of_one in zip(*shares)])
        return sum(factor * self(time) for time, factor in parts)

    def reach(self) -> Tensor | None:
        """From when to when (K, 2) each coefficient bends the curve; None where all do so at all times."""
        if self.kind == "cosines":
            return None
        knots = torch.arange(self.count, dtype=torch.float32) + self.straight
        return torch.stack([knots - 3, knots + 1], -1) / self.pieces


class TrajectoryField(nn.Module):
    """DCT coefficients (N, 3, K) of the flow of every voxel: the paper's F2, or learned at nodes.

    F2 is a network: encoded position (and grid features) -> coefficients. They may be evaluated at the nodes
    of a coarse lattice and interpolated to the voxels, which also smooths the motion; with ``nodes=0`` they
    are evaluated at every voxel, as in the paper. Without a network (``kind="nodes"``) they are learned at
    these nodes themselves, of which those around the active voxels are kept (``follow``). Bases beyond
    ``bases_in_play`` are 0.

    Args:
        box: normalises positions to [-1, 1]; the same in all stages, so that the network carries over.
        bases: K, reduced to ``frames - 1`` if larger.
        frames: T, the number of distinct training times, at least 2.
        canonical_time: time at which flow is exactly 0.
        kind: of ``COEFFICIENTS``.
        nodes: number of nodes along the box's mean side, at least 8; 0: no nodes.
        features: channels of the deformation feature grid, at the nodes or, without nodes, at ``voxels``; 0:
            none.
        voxels: lattice of the canonical voxels; None: that of the nodes.
        width, layers, frequencies: size of F2, octaves of the positional encoding.
        padding: lets objects move at the first and last frame (see ``dct_basis``).

    Raises:
        ValueError: for another kind, or learned nodes of which there are none.
    """

    def __init__(
        self,
        box: Box,
        *,
        bases: int,
        frames: int,
        canonical_time: float,
        kind: str = "network",
        nodes: int = 0,
        features: int = 0,
        voxels: Lattice | None = None,
        width: int = 64,
        layers: int = 4,
        frequencies: int = 5,
        padding: float = 0.0,
    ) -> None:
        super().__init__()
        check_value("model.trajectory.kind", kind, "network or nodes", lambda kind: kind in COEFFICIENTS)
        self.box, self.frames, self.canonical_time = box, frames, canonical_time
        self.bases = min(bases, frames - 1)
        self.scale = 0.5 * max(box.size)
        self.lattice = Lattice.of_count(box, max(nodes, 8) ** 3)
        self.at_nodes = nodes > 0
        self.frequencies, self.padding = frequencies, padding
        self.features = self.network = self.learned = None
        if kind == "nodes":
            other = "set preset.nodes=48, or model.trajectory.kind=network"
            check_value("model.trajectory.nodes", nodes, "a number > 0 of nodes", lambda n: n > 0, other)
            if voxels is not None:  # as far apart, but in the voxels' box alone
                share = math.prod(voxels.box.size) / math.prod(box.size)
                self.lattice = Lattice.of_count(voxels.box, max(nodes, 8) ** 3 * share)
            everywhere = torch.ones(self.lattice.shape, dtype=torch.bool)
            self.learned = VoxelGrid(self.lattice, everywhere, {"coefficients": 3 * self.bases})
        else:
            if features:
                places = self.lattice if self.at_nodes or voxels is None else voxels
                everywhere = torch.ones(places.shape, dtype=torch.bool)
                self.features = VoxelGrid(places, everywhere, {"grid": features})
            inputs = 3 * (1 + 2 * frequencies) + features
            layout = {"width": width, "layers": layers, "zero_last": True, "leaky": True}
            self.network = mlp(inputs, 3 * self.bases, **layout)
        self.register_buffer("bases_in_play", torch.tensor(self.bases))
        # Of the grid that was asked for last: its voxels, their places, and the nodes around them.
        self._nodes: tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]] | None = None
        self._followed: Tensor | None = None  # the voxels that the learned nodes are around

    def play(self, bases: float | None) -> int:
        """Use the first ``bases`` bases, all for None; return their number."""
        playing = self.bases if bases is None else min(int(bases), self.bases)
        self.bases_in_play.fill_(playing)
        return playing

    def coefficients(self, points: Tensor) -> Tensor:
        """Return the DCT coefficients (N, 3, K) at points (N, 3), in world units.

        Learned ones are interpolated; a node that is not kept counts as the mean of those that are.
        """
        coordinates = self.lattice.to_lattice(points)
        if self.learned is not None:
            values, index = self.learned.coefficients, self.learned.index
            read = trilinear(values, index, coordinates, values.new_zeros(values.shape[1]))
            ones = values.new_ones(len(values), 1)
            share = trilinear(ones, index, coordinates, ones.new_zeros(1))
            return self.scale * (read / share.clamp(min=1e-6)).reshape(-1, 3, self.bases)
        inputs = positional_encoding(self.lattice.normalised(coordinates), self.frequencies)
        if self.features is not None:
            inputs = torch.cat([inputs, self.features.read("grid", points)], -1)
        return self.scale * self.network(inputs).reshape(-1, 3, self.bases)

    def basis(self, time: float | Tensor) -> Tensor:
        """Return ``dct_basis`` at ``time`` (...,) as (..., K), 0 for bases not in play."""
        basis = dct_basis(time, self.bases, self.frames, self.canonical_time, self.padding)
        basis = basis.to(self.bases_in_play.device)
        return basis * (torch.arange(self.bases, device=basis.device) < self.bases_in_play)

    def flow(self, grid: VoxelGrid, time: float) -> Tensor:
        """Return the flow (N, 3) of a grid's active voxels from the canonical time, in world units.

        Cost: F2 on the nodes around the active voxels, then one trilinear read per voxel.
        """
        points, (nodes, index, coordinates) = self._around(grid)
        if not self.at_nodes:
            return _matmul(self.coefficients(points), self.basis(time))
        at_nodes, index = self._at_nodes(nodes, index, time)
        return trilinear(at_nodes, index, coordinates, at_nodes.new_zeros(3))

    def _at_nodes(self, nodes: Tensor, index: Tensor, time: float) -> tuple[Tensor, Tensor]:
        """Return the flow (M, 3) at nodes (M, 3) at a time, and which row is whose: of learned ones, all."""
        if self.learned is None:
            return _matmul(self.coefficients(nodes), self.basis(time)), index
        own = self.scale * self.learned.coefficients.reshape(-1, 3, self.bases)
        return _matmul(own, self.basis(time)), self.learned.index

    def _around(self, grid: VoxelGrid) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Return the places (N, 3) of a grid's active voxels, and ``_nodes_around`` of them."""
        if self._nodes is None or self._nodes[0] is not grid.voxels:
            points = grid.lattice.to_world(grid.voxels)
            self._nodes = grid.voxels, points, self._nodes_around(points)
        return self._nodes[1:]

    def _nodes_around(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        coordinates = self.lattice.to_lattice(points)
        corners = corner_weights(coordinates, self.lattice.shape)[0].reshape(-1, 3)
        mask = torch.zeros(self.lattice.shape, dtype=torch.bool, device=points.device)
        mask[corners[:, 0], corners[:, 1], corners[:, 2]] = True
        nodes = mask.nonzero()
        return self.lattice.to_world(nodes), index_of(nodes, self.lattice.shape), coordinates

    def follow(self, grid: VoxelGrid) -> tuple[list[nn.Parameter], list[nn.Parameter], Tensor] | None:
        """Keep the learned nodes around a grid's active voxels; new ones begin as their neighbours' mean.

        Returns:
            parameters before and after, and the former row of each row; None if nothing changed.
        """
        if self.learned is None or self._followed is grid.voxels:
            return None
        self._followed = grid.voxels
        active = self._around(grid)[1][1] >= 0
        if torch.equal(active, self.learned.index >= 0):
            return None
        before = self.learned.rows()
        rows = self.learned.activate(active, {})
        return before, self.learned.rows(), rows

    @torch.no_grad()
    def fit(self, paths: Callable[[Tensor, Tensor], Tensor], times: Sequence[float]) -> None:
        """Begin the learned nodes with the coefficients that come nearest to known paths, by least squares.

        Args:
            paths: points (M, 3) and times (T,) -> where the points are (M, T, 3), in world units.
            times: T, in [0, 1].
        """
        points = self.lattice.to_world(self.learned.voxels)
        when = points.new_tensor([self.canonical_time, *times])
        went = paths(points, when).to(points)
        flow = (went[:, 1:] - went[:, :1]).double()
        basis = self.basis(when[1:]).double()
        found = torch.linalg.lstsq(basis, flow.transpose(0, 1).flatten(1)).solution  # (K, 3 M)
        found = found.reshape(self.bases, -1, 3).permute(1, 2, 0) / self.scale
        self.learned.coefficients.copy_(found.flatten(1))

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Return the paths (N, T, 3) of canonical points (N, 3) at ``times`` (T,), in world units."""
        if not self.at_nodes or self.learned is not None:
            flow = _matmul(self.coefficients(points), self.basis(times).T)  # (N, 3, T)
            return points[:, None] + flow.transpose(1, 2)
        nodes, index, coordinates = self._nodes_around(points)
        at_nodes = self.coefficients(nodes).flatten(1)
        read = trilinear(at_nodes, index, coordinates, at_nodes.new_zeros(at_nodes.shape[1]))
        flow = _matmul(read.reshape(-1, 3, self.bases), self.basis(times).T)
        return points[:, None] + flow.transpose(1, 2)


def _matmul(coefficients: Tensor, basis: Tensor) -> Tensor:
    """Return ``coefficients @ basis``, in full precision under autocast as in ``Network``."""
    with torch.autocast(coefficients.device.type, enabled=False):
        return coefficients @ basis
