"""Backward warping, the baseline: a network moves every sample to the canonical time (as in NDVG)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from forewarp.fields.grids import RadianceGrid, Shade
from forewarp.fields.networks import mlp
from forewarp.methods.method import Start
from forewarp.methods.voxel.effects import Together
from forewarp.methods.voxel.model import Factory, VoxelMethod, VoxelSnapshot
from forewarp.methods.voxel.planning import EFFECTS
from forewarp.ops.encode import positional_encoding
from forewarp.ops.grid import dilate
from forewarp.scene.box import Box, Lattice
from forewarp.scene.view import Moment

_NODES = 32  # side of the lattice on which the occupied cells at a time are found


class Deformation(nn.Module):
    """The displacement of a point to the canonical time: encoded position and time -> world units.

    It is exactly 0 at the canonical time; published methods add a penalty instead.

    Args:
        box: normalises positions.
        canonical_time: in [0, 1].
        width, layers: size of the network.
        frequencies, time_frequencies: octaves of the encodings.
    """

    def __init__(
        self,
        box: Box,
        *,
        canonical_time: float,
        width: int = 64,
        layers: int = 4,
        frequencies: int = 5,
        time_frequencies: int = 5,
    ) -> None:
        super().__init__()
        self.lattice = Lattice(box, (2, 2, 2))
        self.canonical_time = canonical_time
        self.scale = 0.5 * max(box.size)
        self.frequencies, self.time_frequencies = frequencies, time_frequencies
        inputs = 3 * (1 + 2 * frequencies) + 1 + 2 * time_frequencies
        self.network = mlp(inputs, 3, width=width, layers=layers, zero_last=True, leaky=True)

    def forward(self, points: Tensor, time: float) -> Tensor:
        """World points (P, 3) at ``time`` -> displacement (P, 3)."""
        position = positional_encoding(
            self.lattice.normalised(self.lattice.to_lattice(points)), self.frequencies
        )
        clock = positional_encoding(points.new_tensor([[2 * time - 1]]), self.time_frequencies)
        inputs = torch.cat([position, clock.expand(len(points), -1)], -1)
        # Fade in over a twentieth of the sequence, to be continuous in time.
        gate = min(1.0, abs(time - self.canonical_time) * 20)
        return gate * self.scale * self.network(inputs)


@dataclass(frozen=True)
class MovedField:
    """The canonical grid, read at points displaced to the canonical time."""

    canonical: RadianceGrid
    deformation: Deformation
    time: float
    cells: Tensor

    @property
    def lattice(self) -> Lattice:
        """The canonical lattice, in whose coordinates points are given."""
        return self.canonical.lattice

    @property
    def voxel_size(self) -> float:
        """Voxel size of the canonical lattice."""
        return self.canonical.voxel_size

    def _moved(self, points: Tensor) -> Tensor:
        displacement = self.deformation(self.lattice.to_world(points), self.time)
        return points + displacement / points.new_tensor(self.lattice.spacing)

    def density(self, points: Tensor) -> Tensor:
        """Density (P,); 0 where the canonical position lies outside the box."""
        moved = self._moved(points)
        return self.canonical.density(moved) * self.lattice.holds(moved.detach())

    def colors(self, points: Tensor, directions: Tensor, shade: Shade | None) -> Tensor:
        """Colour (P, 3); directions are not warped."""
        return self.canonical.colors(self._moved(points), directions, shade)


class BackwardWarp(VoxelMethod):
    """Backward warping: the canonical grid, read at samples that a deformation network displaces.

    Args:
        start: scene, stage and numbers (see ``VoxelStage``).
        deformation: makes what displaces samples to the canonical time; not used in a static scene.
        shared: radiance, view_dependence, background and renderer: see ``VoxelMethod``.
    """

    effects = tuple(effect for effect in EFFECTS if effect.name in ("view_dependence", "background"))

    def __init__(self, start: Start, *, deformation: Factory, **shared) -> None:
        if not callable(deformation):
            raise ValueError(
                f"model.deformation: expected a factory, but got {deformation!r}; choose another model"
            )
        super().__init__(start, **shared)
        scene = start.scene
        self.moves = len(scene.times) > 1
        self.deformation = deformation(scene.box, canonical_time=scene.canonical_time) if self.moves else None
        self.begin(start)

    def at(self, moment: Moment) -> VoxelSnapshot:
        """Return the field ``backward``: the displaced one, or the canonical one at the canonical time."""
        canonical = field = self.radiance()
        time = moment.time
        if self.deformation is not None and time != self.canonical_time:
            field = MovedField(canonical, self.deformation, time, self._cells(canonical, time))
        static = None
        if self.background is not None:
            static = self.background()
            field = Together(field, static)
        return VoxelSnapshot(
            moment, {"backward": field}, canonical, self.renderer, self.view_dependence, background=static
        )

    @torch.no_grad()
    def _cells(self, canonical: RadianceGrid, time: float) -> Tensor:
        """Find the cells at ``time`` that the displacement carries near an occupied canonical cell."""
        source = canonical.cells
        lattice = canonical.lattice
        coarse = Lattice(lattice.box, tuple(min(n, _NODES) for n in lattice.shape))
        nodes = coarse.to_world(coarse.all_voxels(source.device))
        moved = lattice.to_lattice(nodes + self.deformation(nodes, time))
        reach = max(-(-n // m) for n, m in zip(lattice.shape, coarse.shape)) + 1
        near = dilate(source, reach)
        last = torch.tensor(source.shape, device=source.device) - 1
        x, y, z = torch.minimum(moved.round().long().clamp(min=0), last).unbind(-1)
        hit = near[x, y, z].reshape(coarse.shape)
        axes = [
            ((torch.arange(n, device=hit.device) + 0.5) / n * (m - 1)).round().long()
            for n, m in zip(source.shape, coarse.shape)
        ]
        return dilate(hit)[axes[0]][:, axes[1]][:, :, axes[2]]

    @torch.no_grad()
    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Return the paths (N, T, 3): invert the displacement by fixed-point iteration."""
        if self.deformation is None:
            return points[:, None].expand(-1, len(times), -1)
        paths = []
        # In float32 the canonical time is rounded; it must still displace nothing.
        canonical = times == times.new_tensor(self.canonical_time)
        for time in torch.where(canonical, self.canonical_time, times.double()).tolist():
            at = points.clone()
            for _ in range(10):
                at = points - self.deformation(at, time)
            paths.append(at)
        return torch.stack(paths, 1)

    def moved(self, points: Tensor, rows: Tensor, time: float) -> Tensor:
        """Move the canonical voxels ``rows`` (N,) bool, at ``points`` (M, 3), to ``time`` (M, 3)."""
        return self.trajectories(points, torch.tensor([time]))[:, 0]

    def displacement(self, points: Tensor, time: float) -> Tensor:
        """Return the displacement (N, 3) of points at ``time`` to the canonical time; differentiable."""
        return self.deformation(points, time)
