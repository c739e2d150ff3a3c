"""What forward and backward warping share: a canonical grid that is warped to any time, and its stages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from forewarp.fields.grids import (
    Activation,
    DirectRadiance,
    FeatureRadiance,
    FieldAtTime,
    RadianceGrid,
    Shade,
    VoxelGrid,
    adopted_in,
    mean_color,
    misfit_in,
    shaded,
)
from forewarp.methods.method import Method, Snapshot, Start, Step
from forewarp.methods.voxel.effects import StaticBackground
from forewarp.methods.voxel.losses import LITERAL, TERMS, Seen, voxel_terms
from forewarp.methods.voxel.structure import Lattices, VoxelStage, box_of_all_times, resample
from forewarp.ops.grid import dilate, neighbour_pairs
from forewarp.ops.march import warm_up
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays
from forewarp.scene.cloud import Cloud
from forewarp.scene.frame import Scene
from forewarp.scene.paths import RandomPatches
from forewarp.scene.silhouettes import visual_hull
from forewarp.scene.view import Batch, Moment, Rendering, View

_NOTHING = 1e-3  # opacity over a voxel below which no colour is computed


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
        voxels, last = lattice.all_voxels(), torch.tensor(field.lattice.shape) - 1
        opacity, colors = torch.zeros(len(voxels)), torch.zeros(len(voxels), 3)
        for begin in range(0, len(voxels), chunk):
            points = field.lattice.to_lattice(lattice.to_world(voxels[begin : begin + chunk]))
            inside = ((points >= 0) & (points <= last)).all(-1).nonzero()[:, 0]
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


@dataclass(frozen=True)
class VoxelModel:
    """The options of both voxel methods: factories that still need the scene, or None for what is off.

    Call it with a ``Start`` to make the method.
    """

    radiance: Callable[..., nn.Module]
    view_dependence: Callable[..., nn.Module] | None = None
    background: Callable[..., StaticBackground] | None = None
    renderer: Renderer | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            choice = getattr(self, field.name)
            if choice is not None and not callable(choice):
                raise ValueError(
                    f"model.{field.name}: expected a factory or null, but got {choice!r}; "
                    f"choose model/{field.name}=none to switch it off"
                )

    def __call__(self, start: Start) -> VoxelMethod:
        """Make the method of a stage, from the stage before or afresh."""
        stage = VoxelStage(name=start.stage, **start.numbers)
        method = self.build(ground_of(self, start, stage), stage)
        if is_carried(start, stage):
            carried(method, start.before)
        elif not start.blank:
            set_start_density(method, stage.start_alpha)
        return method.begin(start, stage)

    @staticmethod
    def check(
        stage: str, numbers: Mapping[str, Any], terms: Iterable[str], literal: Iterable[str] = ()
    ) -> None:
        """Refuse keys and terms that no voxel method knows (see ``Method.check``)."""
        VoxelStage(name=stage, **numbers)
        VoxelMethod.check(stage, (), terms, literal)

    def build(self, ground: Ground, stage: VoxelStage) -> VoxelMethod:
        """Make the method on given lattices."""
        view_dependence = None
        if self.view_dependence is not None and "view_dependence" in stage.effects:
            view_dependence = self.view_dependence()
        features = 3 if view_dependence is None else view_dependence.features
        radiance = self.radiance(
            ground.lattice,
            ground.active,
            features=features,
            density_scale=ground.density_scale,
            box=ground.box,
        )
        background = None
        if self.background is not None and "background" in stage.effects:
            background = self.background(*ground.static, density_scale=ground.density_scale)
        common = {
            "canonical_time": ground.canonical_time,
            "view_dependence": view_dependence,
            "background": background,
        }
        return self._warp(radiance, ground, stage, features, common | {"renderer": self.renderer})

    def _warp(self, radiance, ground: Ground, stage: VoxelStage, features: int, common: dict) -> VoxelMethod:
        raise NotImplementedError


@dataclass(frozen=True)
class Ground:
    """The lattices that a voxel method is built on.

    Attributes:
        lattice: lattice of the canonical grid.
        active: (X, Y, Z) bool, its active voxels.
        density_scale: length that density is measured in, world units.
        box: the scene's box; normalises positions in all stages.
        frames: number of distinct training times; with one there is no motion.
        canonical_time: in [0, 1].
        static: lattice and active voxels of the static background, if the model has one.
    """

    lattice: Lattice
    active: Tensor
    density_scale: float
    box: Box
    frames: int
    canonical_time: float
    static: tuple[Lattice, Tensor] | None = None


def is_carried(start: Start, stage: VoxelStage) -> bool:
    """Return whether a stage continues with the grids of the stage before."""
    return stage.carry and not start.blank and isinstance(getattr(start.before, "radiance", None), VoxelGrid)


def ground_of(model: VoxelModel, start: Start, stage: VoxelStage) -> Ground:
    """Find the lattices and active voxels of a stage. Cost: a hull reads each of its images once."""
    scene, before = start.scene, start.before if is_carried(start, stage) else None
    box = scene.box if start.handover is None else start.handover.box
    if before is not None:
        resample(before.radiance, box, stage.at("num_voxels", 0.0), keep_alpha=stage.keep_alpha)
        lattice, active = before.radiance.lattice, before.radiance.index >= 0
        density_scale = before.radiance.activation.density_scale
    else:
        lattice = Lattice.of_count(box, stage.at("num_voxels", 0.0))
        known = {} if start.handover is None else start.handover.notes
        density_scale, active = known.get("density_scale", lattice.voxel_size), _first(start, lattice, stage)
        if not density_scale > 0:
            raise ValueError(
                f"stage.{start.stage}: expected a density_scale > 0 from the stage before, "
                f"but got {density_scale}; delete the folder of that stage"
            )
    static = None
    if model.background is not None and "background" in stage.effects:
        static = _static(scene.box.scaled(1.05), stage, getattr(before, "background", None))
    return Ground(lattice, active, density_scale, scene.box, len(scene.times), scene.canonical_time, static)


def carried(method: nn.Module, before: nn.Module) -> None:
    """Copy the learned values that two methods on the same lattice share."""
    for name in set(before.radiance.names) & set(method.radiance.names):
        method.radiance.parameter(name).data.copy_(before.radiance.parameter(name).data)
    own, theirs = method.state_dict(), before.state_dict()
    rest = {
        k: v
        for k, v in theirs.items()
        if torch.is_tensor(v)
        and k in own
        and own[k].shape == v.shape
        and (not k.startswith("radiance.") or k.startswith("radiance.network"))
    }
    method.load_state_dict(own | rest)


def set_start_density(method: nn.Module, alpha: float) -> None:
    """Give all active voxels the opacity ``alpha`` over one voxel."""
    for grid in (method.radiance, method.background):
        if grid is None:
            continue
        raw = grid.activation.raw(alpha, grid.lattice.voxel_size)
        with torch.no_grad():
            if "density" in grid.names:
                grid.parameter("density").fill_(raw)
            else:
                grid.network[-1].bias[0] = raw


def _static(box: Box, stage: VoxelStage, before: VoxelGrid | None) -> tuple[Lattice, Tensor]:
    """Return lattice and active voxels of the static background: of the stage before, or all of ``box``."""
    voxels = stage.at("background_num_voxels", 0.0)
    if before is None:
        lattice = Lattice.of_count(box, voxels)
        return lattice, torch.ones(lattice.shape, dtype=torch.bool)
    resample(before, box, voxels, keep_alpha=stage.keep_alpha)
    return before.lattice, before.index >= 0


def _first(start: Start, lattice: Lattice, stage: VoxelStage) -> Tensor:
    """Return the voxels (X, Y, Z) bool that are active at first: the visual hull, or all."""
    scene, every = start.scene, torch.ones(lattice.shape, dtype=torch.bool)
    hull = stage.start == "hull" or (stage.start == "auto" and scene.has_alpha)
    if start.blank or not hull:
        return every
    if not scene.has_alpha:
        raise ValueError(
            f"stage.{start.stage}.start: expected box, since the images of '{scene.name}' have no alpha, "
            "but got hull"
        )
    inside = _hull(scene, lattice, stage, list(start.frames))
    return inside if bool(inside.any()) else every


def _hull(scene: Scene, lattice: Lattice, stage: VoxelStage, frames: list[int]) -> Tensor:
    count, times = stage.hull_frames, [scene.train[i].time for i in frames]
    while count < len(frames) and times[count] == times[count - 1]:
        count += 1  # all views of each time: some neighbouring cameras alone bound nothing
    frames, masks = frames[:count], []
    for i in frames:
        pixels = max(1, round(stage.hull_grow * scene.train[i].camera.width))
        masks.append(dilate(scene.train[i].load()[..., 3] > 127, pixels))
    points = lattice.to_world(lattice.all_voxels())
    hull = visual_hull(points, [scene.train[i].camera for i in frames], masks, stage.hull_misses)
    return hull.reshape(lattice.shape)
