"""Backward warping, the baseline: a network moves every sample to the canonical time (as in NDVG)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn

from forewarp.fields.grids import RadianceGrid
from forewarp.fields.networks import mlp
from forewarp.methods.method import Start
from forewarp.methods.voxel.model import Factory, VoxelMethod, VoxelSnapshot
from forewarp.methods.voxel.structure import EFFECTS
from forewarp.ops.backend import check_value
from forewarp.ops.encode import encoded_size, positional_encoding
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
        self.lattice, self.scale = Lattice(box, (2, 2, 2)), 0.5 * max(box.size)
        self.canonical_time = canonical_time
        self.frequencies, self.time_frequencies = frequencies, time_frequencies
        inputs = encoded_size(3, frequencies) + encoded_size(1, time_frequencies)
        self.network = mlp(inputs, 3, width=width, layers=layers, zero_last=True, leaky=True)

    def forward(self, points: Tensor, time: float) -> Tensor:
        """World points (P, 3) at ``time`` -> displacement (P, 3)."""
        place = self.lattice.normalised(self.lattice.to_lattice(points))
        clock = positional_encoding(points.new_tensor([[2 * time - 1]]), self.time_frequencies)
        inputs = [positional_encoding(place, self.frequencies), clock.expand(len(points), -1)]
        # Fade in over a twentieth of the sequence, to be continuous in time.
        gate = min(1.0, abs(time - self.canonical_time) * 20)
        return gate * self.scale * self.network(torch.cat(inputs, -1))


@dataclass(frozen=True, kw_only=True)
class MovedField(RadianceGrid):
    """The canonical grid, read at points that ``deformation`` displaces from ``time`` to the canonical time.

    Directions are not warped.
    """

    deformation: Deformation
    time: float

    def _moved(self, points: Tensor) -> Tensor:
        displacement = self.deformation(self.lattice.to_world(points), self.time)
        return points + displacement / points.new_tensor(self.lattice.spacing)

    def density(self, points: Tensor) -> Tensor:
        """Density (P,); 0 where the canonical position lies outside the box."""
        moved = self._moved(points)
        return super().density(moved) * self.lattice.holds(moved.detach())

    def features(self, points: Tensor) -> Tensor:
        """Colour features (P, C)."""
        return super().features(self._moved(points))

    @cached_property
    @torch.no_grad()
    def cells(self) -> Tensor:
        """Cells that the displacement carries near an occupied canonical cell."""
        source, lattice = super().cells, self.lattice
        coarse = Lattice(lattice.box, tuple(min(n, _NODES) for n in lattice.shape))
        nodes = coarse.to_world(coarse.all_voxels(source.device))
        moved = lattice.to_lattice(nodes + self.deformation(nodes, self.time))
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


class BackwardWarp(VoxelMethod):
    """Backward warping: the canonical grid, read at samples that a deformation network displaces.

    Args:
        start: scene, stage and numbers (see ``VoxelStage``).
        deformation: makes what displaces samples to the canonical time; nothing does in a static scene
            or in a stage without the effect ``motion``.
        shared: radiance, view_dependence, background and renderer: see ``VoxelMethod``.
    """

    effects = tuple(effect for effect in EFFECTS if effect.name in ("view_dependence", "background"))

    def __init__(self, start: Start, *, deformation: Factory, **shared) -> None:
        check_value("model.deformation", deformation, "a factory", callable, "choose another model")
        super().__init__(start, **shared)
        scene = start.scene
        self.moves = "motion" in self.stage.effects and len(scene.times) > 1
        self.deformation = deformation(scene.box, canonical_time=scene.canonical_time) if self.moves else None
        self.begin(start)

    def at(self, moment: Moment) -> VoxelSnapshot:
        """Return the field ``backward``: the displaced one, or the canonical one at the canonical time."""
        canonical = field = self.radiance()
        if self.deformation is not None and moment.time != self.canonical_time:
            field = MovedField(**vars(canonical), deformation=self.deformation, time=moment.time)
        return self.snapshot(moment, {"backward": field}, canonical)

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

    def backward_flow(self, points: Tensor, time: float) -> Tensor:
        """See ``HasBackwardFlow``; differentiable."""
        return torch.zeros_like(points) if self.deformation is None else self.deformation(points, time)

    displacement = backward_flow  # that of points which never move is to be 0 either way
