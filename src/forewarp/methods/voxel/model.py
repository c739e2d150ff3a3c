"""What forward and backward warping share: a canonical grid, how it is made, rendered and compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from forewarp.fields.grids import (
    Activation,
    FieldAtTime,
    RadianceGrid,
    Shade,
    VoxelGrid,
    mean_color,
    shaded,
)
from forewarp.methods.method import Method, Snapshot, Start, Step
from forewarp.methods.voxel.losses import LITERAL, TERMS, Seen, voxel_terms
from forewarp.methods.voxel.structure import Lattices, VoxelStage, first_voxels, resample
from forewarp.ops.grid import neighbour_pairs
from forewarp.ops.march import warm_up
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import RandomPatches, Rays
from forewarp.scene.cloud import Cloud
from forewarp.scene.view import Batch, Moment, Rendering, View

SOLID = 0.1  # opacity over one voxel above which it counts as matter
_NOTHING = 1e-3  # opacity over a voxel below which no colour is computed
_STATIC_POINTS = 1024  # at most this many points known to be static in a step
_MARGIN = 2.0  # voxels around all matter that the next stage's box leaves

Factory = Callable[..., nn.Module]  # makes a part once the lattices are known


@dataclass(frozen=True)
class VoxelSnapshot(Snapshot):
    """Everything a voxel method computed at one time; None for what it does not have.

    Attributes:
        moment: the snapshot's moment.
        fields: what is rendered, by name, the best last: ``warped`` or ``upsampled``, then ``inpainted``;
            ``backward`` alone for backward warping.
        canonical: the canonical grid.
        renderer, shade: how fields are rendered.
        flow: (N, 3), from each canonical voxel to the moment, world units.
        coverage: (M,), summed splat weight of each warped voxel.
        dropped: number of canonical voxels that left the box.
        inpaint_difference: what the inpainter adds.
        background: the static grid.
        length: the losses divide flow by it, so that their weights do not depend on the scene's scale: a
            third of the scene's longest side, in world units.
    """

    moment: Moment
    fields: dict[str, FieldAtTime]
    canonical: RadianceGrid
    renderer: Renderer
    shade: Shade | None = None
    flow: Tensor | None = None
    coverage: Tensor | None = None
    dropped: int = 0
    inpaint_difference: Tensor | None = None
    background: RadianceGrid | None = None
    length: float = 1.0

    @property
    def renderings(self) -> Sequence[str]:
        """Names of the fields."""
        return tuple(self.fields)

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot.render``; without gradients in chunks of rays, for images of any size."""
        field = self.fields[rendering or self.renderings[-1]]
        rays = view.rays().to(self.canonical.values.device)
        draw = self.renderer if torch.is_grad_enabled() else self.renderer.picture
        return draw(field, rays, background.to(rays.origins), self.shade)

    def march(self, name: str, rays: Rays, background: Tensor, **options):
        """Render one field along any rays; also return the samples."""
        return self.renderer(self.fields[name], rays, background, self.shade, **options)

    @torch.no_grad()
    def solid(self, lattice: Lattice, chunk: int = 1 << 18) -> tuple[Tensor, Tensor]:
        """See ``HasSolid``: the opacity over one voxel, of the best rendering's field."""
        field = self.fields[self.renderings[-1]]
        voxels = lattice.all_voxels()
        opacity, colors = torch.zeros(len(voxels)), torch.zeros(len(voxels), 3)
        for begin in range(0, len(voxels), chunk):
            points = field.lattice.to_lattice(lattice.to_world(voxels[begin : begin + chunk]))
            inside = field.lattice.holds(points).nonzero()[:, 0]
            points = points[inside].to(self.canonical.values)
            alpha = -torch.expm1(-field.density(points) * field.voxel_size)
            some = (alpha > _NOTHING).nonzero()[:, 0]
            rows = begin + inside[some.cpu()]
            seen = points[some]
            opacity[rows] = alpha[some].cpu()
            colors[rows] = mean_color(lambda d, p=seen: field.colors(p, d, self.shade), seen).cpu()
        return opacity.reshape(lattice.shape), colors.reshape(*lattice.shape, 3)

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time; the camera does not matter."""
        return moment.time == self.moment.time


class VoxelMethod(Method):
    """A canonical radiance grid that ``at`` warps to other times. An absent effect is None.

    A subclass makes its own parts, then calls ``begin``, which copies or fills in what is learned.

    Args:
        start: scene, stage and numbers (see ``VoxelStage``).
        radiance: makes the canonical radiance field.
        view_dependence: makes what turns features and directions into colour; None: the features are the
            colour.
        background: makes everything static, on a grid of its own; None: a constant background colour.
        renderer: marches the rays.

    Attributes:
        moves: False if the scene is static.
        half_extent: half the scene's longest side, in world units.
    """

    terms, literal = TERMS, LITERAL
    numbers = tuple(field.name for field in fields(VoxelStage) if field.name != "name")
    moves: bool

    def __init__(
        self,
        start: Start,
        *,
        radiance: Factory,
        view_dependence: Factory | None = None,
        background: Factory | None = None,
        renderer: Renderer | None = None,
    ) -> None:
        super().__init__()
        self.stage = stage = VoxelStage(name=start.stage, **start.numbers)
        self.renderer = (renderer or Renderer()).with_threshold(stage.color_threshold)
        scene, before = start.scene, _carried(start, stage)
        self.canonical_time, self.half_extent = scene.canonical_time, 0.5 * max(scene.box.size)
        self.lattices: Lattices | None = None
        box = scene.box if start.handover is None else start.handover.box
        if before is not None:
            resample(before.radiance, box, stage.at("num_voxels", 0.0), keep_alpha=stage.keep_alpha)
            lattice, active = before.radiance.lattice, before.radiance.index >= 0
            density_scale = before.radiance.activation.density_scale
        else:
            lattice = Lattice.of_count(box, stage.at("num_voxels", 0.0))
            active, density_scale = first_voxels(start, stage, lattice), _density_scale(start, lattice)
        common = {"density_scale": density_scale}
        view_dependence = self.used("view_dependence", view_dependence)
        shade = None if view_dependence is None else view_dependence()
        features = 3 if shade is None else shade.features
        self.channels = 1 + features  # of a radiance grid
        self.radiance = radiance(lattice, active, features=features, box=scene.box, **common)
        self.view_dependence, self.background = shade, None
        if (background := self.used("background", background)) is not None:
            static = _static_lattice(scene.box.scaled(1.05), stage, getattr(before, "background", None))
            self.background = background(*static, **common)

    def used(self, name: str, option: Factory | None) -> Factory | None:
        """Return the factory of an effect; None if the effect is off, or is not one of this stage's.

        Raises:
            ValueError: for what is neither a factory nor None, such as a number set in an option that was
                then switched off.
        """
        if option is not None and not callable(option):
            raise ValueError(
                f"model.{name}: expected a factory or null, but got {option!r}; "
                f"choose model/{name}=none to switch it off"
            )
        return option if name in self.stage.effects else None

    def begin(self, start: Start) -> None:
        """Take over what the stage before has learned, or start with faint matter; prepare the loss terms."""
        before = _carried(start, self.stage)
        if before is not None:
            ours, theirs = self.state_dict(), before.state_dict()
            alike = {k: v for k, v in theirs.items() if torch.is_tensor(v) and k in ours}
            self.load_state_dict(ours | {k: v for k, v in alike.items() if v.shape == ours[k].shape})
        elif not start.blank:
            for grid in filter(None, (self.radiance, self.background)):
                grid.fill(self.stage.start_alpha)
        self.lattices = Lattices(self.radiance, self.background, self.stage)
        self._terms, self._photo_on = voxel_terms(start.literal), start.photo_on
        self._keep_all_weights = bool({"point_color", "background_entropy"} & set(start.literal))
        cameras = [frame.camera for frame in start.scene.train]
        self.patches = RandomPatches(cameras, patches=self.stage.patches) if cameras else None
        self.static_points, self._pairs = start.scene.still, []

    @classmethod
    def check(
        cls, stage: str, numbers: Mapping[str, Any], terms: Iterable[str], literal: Iterable[str] = ()
    ) -> None:
        """See ``Method.check``; also refuse numbers out of range."""
        super().check(stage, numbers, terms, literal)
        if numbers:
            VoxelStage(name=stage, **numbers)

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method.look``; all rays of a batch have one time and are marched together."""
        state = self.at(batch.observations[0].moment)
        rays, rgb, background = batch.joined()
        rays, options = rays.to(self.device), {"keep_all_weights": self._keep_all_weights}
        seen = Seen(
            rgb,
            state,
            {
                name: state.march(name, rays, background, generator=generator, **options)
                for name in self._compared(state)
            },
            lambda: self._patches_of(state, generator),
            lambda: self._stray(batch.time, generator),
            self._neighbours,
        )
        best = list(seen.renderings.values())[-1]
        noted = {
            "occupied_voxels": len(state.canonical.values),
            "samples": best.samples,
            "dropped_voxels": state.dropped,
        }
        if state.coverage is not None:
            noted["coverage"] = float(state.coverage.detach().clamp(max=1).mean())
        return Step(
            {name: partial(term, seen) for name, term in self._terms.items()},
            (best.rgb.detach() - rgb).square().mean(),
            noted,
            tensors=seen.tensors,
        )

    def _compared(self, state: VoxelSnapshot) -> list[str]:
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
        """Return the pairs of neighbouring voxels, kept for the two grids that were asked for last."""
        pairs = next((pairs for known, pairs in self._pairs if known is index), None)
        if pairs is None:
            pairs = neighbour_pairs(index)
            self._pairs = [*self._pairs[-1:], (index, pairs)]
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

    def moved(self, points: Tensor, rows: Tensor, time: float) -> Tensor:
        """Move the canonical voxels ``rows`` (N,) bool, at ``points`` (M, 3), to ``time`` (M, 3)."""
        raise NotImplementedError

    def displacement(self, points: Tensor, time: float) -> Tensor:
        """Return how far points (N, 3) are from the canonical time at ``time`` (N, 3); differentiable."""
        raise NotImplementedError

    def warm_up(self) -> None:
        """Compile the kernels."""
        warm_up(self.device)

    @torch.no_grad()
    def bounds(self, times: list[float]) -> Box | None:
        """Bound all voxels more opaque than the stage's ``box_alpha`` at all times, with a margin."""
        grid = self.radiance()
        solid = grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size) > self.stage.box_alpha
        if not bool(solid.any()):
            return None
        home = grid.lattice.to_world(self.radiance.voxels)[solid]
        low, high = home.amin(0), home.amax(0)
        for time in times if self.moves else ():
            points = self.moved(home, solid, time)
            low, high = torch.minimum(low, points.amin(0)), torch.maximum(high, points.amax(0))
        margin = _MARGIN * grid.lattice.voxel_size  # added first, as a flat object has no box of its own
        return Box(tuple((low - margin).tolist()), tuple((high + margin).tolist()))

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


def _carried(start: Start, stage: VoxelStage) -> VoxelMethod | None:
    """Return the method of the stage before, if this stage continues with its grids."""
    before = start.before if stage.carry and not start.blank else None
    return before if isinstance(before, VoxelMethod) else None


def _density_scale(start: Start, lattice: Lattice) -> float:
    """Return the length that density is measured in: of the stage before, or a voxel."""
    notes = {} if start.handover is None else start.handover.notes
    density_scale = notes.get("density_scale", lattice.voxel_size)
    if not density_scale > 0:
        raise ValueError(
            f"stage.{start.stage}: expected a density_scale > 0 from the stage before, "
            f"but got {density_scale}; delete the folder of that stage"
        )
    return density_scale


def _static_lattice(box: Box, stage: VoxelStage, before: VoxelGrid | None) -> tuple[Lattice, Tensor]:
    """Return lattice and active voxels of the static background: of the stage before, or all of ``box``."""
    num_voxels = stage.at("background_num_voxels", 0.0)
    if before is None:
        lattice = Lattice.of_count(box, num_voxels)
        return lattice, torch.ones(lattice.shape, dtype=torch.bool)
    resample(before, box, num_voxels, keep_alpha=stage.keep_alpha)
    return before.lattice, before.index >= 0
