"""What forward and backward warping share: grids that follow a schedule, ray marching, loss terms."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor, nn

from forewarp.fields.radiance import DirectRadiance, FeatureRadiance
from forewarp.fields.radiance_grid import Activation, mean_color, shaded
from forewarp.fields.voxel_grid import adopted_in, misfit_in
from forewarp.methods.method import Method, Start, Step
from forewarp.methods.voxel.effects.background import StaticBackground
from forewarp.methods.voxel.snapshot import VoxelSnapshot
from forewarp.methods.voxel.stage import VoxelStage
from forewarp.methods.voxel.structure import Lattices, box_of_all_times
from forewarp.methods.voxel.terms import LITERAL, TERMS, Seen, voxel_terms
from forewarp.ops.grid import neighbour_pairs
from forewarp.ops.march import warm_up
from forewarp.renderer import Renderer
from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud
from forewarp.scene.paths import RandomPatches
from forewarp.scene.view import Batch

SOLID = 0.1  # opacity over one voxel above which it counts as matter
_STATIC_POINTS = 1024  # at most this many points known to be static in a step


class VoxelMethod(Method):
    """A canonical radiance grid that ``at`` warps to other times. An absent effect is None.

    Args:
        radiance: the canonical radiance field.
        canonical_time: at which nothing is warped.
        renderer: marches the rays.
        view_dependence: turns features and directions into colour; None: the features are the colour.
        background: everything static, on a grid of its own; None: a constant background colour.
    """

    terms, literal = TERMS, LITERAL
    moves: bool

    def __init__(
        self,
        radiance: DirectRadiance | FeatureRadiance,
        *,
        canonical_time: float,
        renderer: Renderer | None = None,
        view_dependence: nn.Module | None = None,
        background: StaticBackground | None = None,
    ) -> None:
        super().__init__()
        self.radiance, self.view_dependence, self.background = radiance, view_dependence, background
        self.canonical_time, self.renderer = canonical_time, renderer or Renderer()
        self.lattices: Lattices | None = None

    def begin(self, start: Start, stage: VoxelStage) -> VoxelMethod:
        """Prepare for a stage: its schedule, its loss terms, and what these need beside images."""
        self.stage, self.renderer = stage, self.renderer.with_threshold(stage.color_threshold)
        self.lattices = Lattices(self.radiance, self.background, stage)
        self._terms, self._photo_on = voxel_terms(start.literal), start.photo_on
        self._keep_all_weights = bool({"point_color", "background_entropy"} & set(start.literal))
        cameras = [frame.camera for frame in start.scene.train]
        self.patches = RandomPatches(cameras, patches=stage.patches) if cameras else None
        self.static_points, self._pairs = start.scene.still, []
        return self

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method.look``; all rays of a batch have one time and are marched together."""
        seen = self._seen(batch, generator)
        best, state = list(seen.renderings.values())[-1], seen.state
        noted = {
            "occupied_voxels": len(state.canonical.values),
            "samples": best.samples,
            "dropped_voxels": state.dropped,
        }
        if state.coverage is not None:
            noted["coverage"] = float(state.coverage.detach().clamp(max=1).mean())
        return Step(
            {name: partial(term, seen) for name, term in self._terms.items()},
            (best.rgb.detach() - seen.rgb).square().mean(),
            noted,
            tensors=seen.tensors,
        )

    def _seen(self, batch: Batch, generator: torch.Generator) -> Seen:
        state = self.at(batch.observations[0].moment)
        rays, rgb, background = batch.joined()
        march = partial(
            state.march,
            rays=rays.to(self.device),
            background=background,
            generator=generator,
            keep_all_weights=self._keep_all_weights,
        )
        renderings = {name: march(name) for name in self._wanted(state)}
        return Seen(
            rgb,
            state,
            renderings,
            lambda: self._patches_of(state, generator),
            lambda: self._stray(batch.time, generator),
            self._neighbours,
        )

    def _wanted(self, state: VoxelSnapshot) -> list[str]:
        """Names of the renderings that the per-ray terms compare: those in ``photo_on``, or all.

        A stage without up-sampler has ``warped`` in the place of ``upsampled``.
        """
        names = list(state.fields)
        if self._photo_on is None:
            return names
        known = {"upsampled", "warped"} if {"upsampled", "warped"} & set(self._photo_on) else set()
        return [n for n in names if n in {*self._photo_on, *known}] or names

    def _patches_of(self, state: VoxelSnapshot, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        rays = self.patches.draw(generator).to(self.device)
        shape = (self.patches.patches, self.patches.size, self.patches.size)
        black = torch.zeros(3, device=self.device)
        drawn = state.march(state.renderings[-1], rays, black, generator=generator)
        return drawn.depth.reshape(shape) / (rays.far - rays.near), drawn.opacity.reshape(shape)

    def _stray(self, time: float, generator: torch.Generator) -> Tensor | None:
        """Displacement (N, 3) of some of the static points, divided by half the scene's longest side."""
        if self.static_points is None or not self.moves:
            return None
        count = len(self.static_points)
        rows = torch.randint(count, (min(_STATIC_POINTS, count),), generator=generator)
        return self.displacement(self.static_points[rows].to(self.device), time) / self.half_extent

    def _neighbours(self, index: Tensor) -> list[tuple[Tensor, Tensor]]:
        for known, pairs in self._pairs:
            if known is index:
                return pairs
        pairs = neighbour_pairs(index)
        self._pairs = [
            *self._pairs[-1:],
            (index, pairs),
        ]  # of two grids at most
        return pairs

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Group parameters: ``density``, ``color``, ``shading`` and ``grid`` (rows of voxel grids), ``flow``
        (the trajectory or deformation network) and ``network`` (all other networks).
        """
        groups: dict[str, list[nn.Parameter]] = {}
        for name, parameter in self.named_parameters():
            head, last = name.split(".")[0], name.split(".")[-1]
            if last in ("density", "color", "shading"):
                kind = last
            elif last in ("features", "grid"):
                kind = "grid"
            elif head in ("motion", "deformation"):
                kind = "flow"
            else:
                kind = "network"
            groups.setdefault(kind, []).append(parameter)
        return groups

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Follow the schedule of the lattices."""
        self.lattices.follow(progress, step, optimizer)
        return {}

    def warm_up(self) -> None:
        """Compile the kernels."""
        warm_up(self.device)

    def bounds(self, times: list[float]) -> Box | None:
        """Bound all matter more opaque than the stage's ``box_alpha``, with a margin of two voxels."""
        return box_of_all_times(self, times, alpha=self.stage.box_alpha, pad=2.0)

    @torch.no_grad()
    def matter(self) -> Cloud:
        """Return the centres of solid canonical voxels; their colours are means over six directions."""
        grid = self.radiance()
        alpha = grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size)
        solid = alpha > SOLID
        points = grid.lattice.to_world(self.radiance.voxels[solid])
        colors = mean_color(lambda d: shaded(grid.color[solid], d, self.view_dependence), points)
        return Cloud(points, colors, alpha[solid], grid.lattice.voxel_size)

    def notes(self) -> dict[str, float]:
        """Pass on the length that density is measured in."""
        return {"density_scale": self.radiance.activation.density_scale}

    @property
    def size(self) -> tuple[str, int]:
        """Number of active voxels."""
        return "voxels", len(self.radiance.voxels)

    def adopted(self) -> set[str]:
        """Let voxel grids adopt a checkpoint's lattices."""
        return adopted_in(self)

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """Return what in a stored grid contradicts its lattice, as kernels do not check the index."""
        return misfit_in(self, state)

    def get_extra_state(self) -> dict:
        """Return the length that density is measured in, and the state of the lattices' schedule."""
        schedule = {} if self.lattices is None else self.lattices.state_dict()
        return {"density_scale": self.radiance.activation.density_scale, "lattices": schedule}

    def set_extra_state(self, state: dict) -> None:
        """Adopt a checkpoint's state."""
        for grid in (self.radiance, self.background):
            if grid is not None:
                grid.activation = Activation(grid.activation.shift, float(state["density_scale"]))
        if self.lattices is not None and state["lattices"]:
            self.lattices.load_state_dict(state["lattices"])
