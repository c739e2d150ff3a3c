"""What forward and backward warping share: a canonical grid, how it is made, rendered and compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from forewarp import losses
from forewarp.fields.grids import (
    Activation,
    CanonicalRadiance,
    FieldAtTime,
    RadianceGrid,
    Shade,
    VoxelGrid,
    mean_color,
    shaded,
)
from forewarp.methods.method import Method, Snapshot, Start, Step, misread
from forewarp.methods.voxel.effects import Together
from forewarp.methods.voxel.structure import VoxelStage, first_voxels, refresh, resample
from forewarp.ops.backend import check_value, is_number
from forewarp.ops.grid import neighbour_pairs
from forewarp.ops.march import warm_up
from forewarp.renderer import Marched, Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import RandomPatches, Rays
from forewarp.scene.cloud import Cloud
from forewarp.scene.view import Asks, Batch, Moment, Rendering, View

SOLID = 0.1  # opacity over one voxel above which it counts as matter
_NOTHING = 1e-3  # opacity over a voxel below which no colour is computed
_STATIC_POINTS = 1024  # at most this many points known to be static in a step
_MARGIN = 2.0  # voxels around all matter that the next stage's box leaves

Factory = Callable[..., nn.Module]  # makes a part once the lattices are known


@dataclass(frozen=True, repr=False)
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
        draw = self.renderer if torch.is_grad_enabled() else self.renderer.image
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
        weights, printed: of the stage's loss terms (see ``Objective``); which have the printed form.
    """

    terms = ("photo", "point_color", "background_entropy", "flow_l1", "inpaint_diff", "tv_density", "tv_flow")
    terms += ("tv_depth", "static_points", "moving_opacity")
    literal = ("photo", "point_color", "background_entropy")  # their printed form differs
    numbers = tuple(field.name for field in fields(VoxelStage) if field.name != "name")
    still_steps = 150  # a step is of rays of many images
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
        box, notes = scene.box, {}
        if start.handover is not None:
            box, notes = start.handover.box, start.handover.notes
        lattice, active = _resampled(before and before.radiance, box, stage, "num_voxels")
        density_scale = notes.get("density_scale", lattice.voxel_size)
        if before is None:
            active = first_voxels(start, stage, lattice)
        view_dependence = self.used("view_dependence", view_dependence)
        shade = None if view_dependence is None else view_dependence()
        self.channels = 1 + (3 if shade is None else shade.features)  # of a radiance grid
        common = {"density_scale": density_scale}
        self.radiance = radiance(lattice, active, features=self.channels - 1, box=scene.box, **common)
        self.view_dependence, self.background = shade, None
        # The grids that follow a schedule, by its key.
        self.grids: dict[str, CanonicalRadiance] = {"num_voxels": self.radiance}
        if (background := self.used("background", background)) is not None:
            room, key = scene.box.scaled(1.05), "background_num_voxels"
            static = _resampled(before and before.background, room, stage, key)
            self.background = self.grids[key] = background(*static, **common)
        # By the same keys: a grid's present number of voxels, and the step at which it got them.
        self.followed = {key: [stage.at(key, 0.0), 0] for key in self.grids}
        # Voxels that were active at the start; meaningful on the first lattice only.
        self.home: Tensor = self.radiance.index >= 0

    def used(self, name: str, option: Factory | None) -> Factory | None:
        """Return the factory of an effect; None if the effect is off, or is not one of this stage's.

        Raises:
            ValueError: for what is neither a factory nor None, such as a number set in an option that was
                then switched off.
        """
        if option is not None:
            off = f"choose model/{name}=none to switch it off"
            check_value(f"model.{name}", option, "a factory or null", callable, off)
        return option if name in self.stage.effects else None

    def begin(self, start: Start) -> None:
        """Take over what the stage before has learned, or start with faint matter; prepare the loss terms."""
        before = _carried(start, self.stage)
        if before is not None:
            for key in self.grids.keys() - before.grids.keys():  # a background that only this stage has
                self.grids[key].fill(self.stage.start_alpha)
            copy_shared(before, self)
        elif not start.blank:
            for grid in self.grids.values():
                grid.fill(self.stage.start_alpha)
        if self.stage.near_share > 0:
            self.asks = Asks(near=self.stage.near_share)
        self.weights, self.printed = start.weights, frozenset(start.literal)
        self._photo_on = start.photo_on
        cameras = [frame.camera for frame in start.scene.train]
        self.patches = RandomPatches(cameras, patches=self.stage.patches) if cameras else None
        self.static_points, self._pairs = start.scene.still, []

    def snapshot(
        self, moment: Moment, fields: dict[str, FieldAtTime], canonical: RadianceGrid, **found
    ) -> VoxelSnapshot:
        """Make a snapshot; the static background, if there is one, joins every field."""
        static = None if self.background is None else self.background()
        if static is not None:
            fields = {name: Together(field, static) for name, field in fields.items()}
        shade = self.view_dependence
        return VoxelSnapshot(moment, fields, canonical, self.renderer, shade, background=static, **found)

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
        rays, keep_all = rays.to(self.device), bool({"point_color", "background_entropy"} & self.printed)
        renderings = {
            name: state.march(name, rays, background, generator=generator, keep_all_weights=keep_all)
            for name in self._compared(state)
        }
        best = list(renderings.values())[-1]
        noted = {"occupied_voxels": len(state.canonical.values), "samples": best.samples}
        noted["dropped_voxels"] = state.dropped
        if state.coverage is not None:
            noted["coverage"] = float(state.coverage.detach().clamp(max=1).mean())
        shares = batch.shares()
        terms = self.terms_of(state, renderings, rgb, generator, shares)
        error = losses.photometric(best.rgb.detach(), rgb, shares=shares)
        return Step(terms, error, noted, tensors=partial(_tensors, state, renderings))

    def terms_of(
        self,
        state: VoxelSnapshot,
        renderings: dict[str, Marched],
        rgb: Tensor,
        generator: torch.Generator,
        shares: Tensor | None = None,
    ) -> dict[str, Callable[[], Tensor | None]]:
        """Return the loss terms: what each function of ``losses`` is applied to.

        Those named in ``Start.literal`` have the form printed in the paper.

        Args:
            state: the method at the batch's time.
            renderings: renderings of the batch's R rays, by name; per-ray terms are summed over them.
            rgb: the true colours (R, 3).
            generator: draws random views, and some of the static points.
            shares: (R,) how often each ray counts; None: once.
        """
        seen, canonical, literal = renderings.values(), state.canonical, self.printed

        def of(effect: Any, loss: Callable[[Any], Tensor]) -> Callable[[], Tensor | None]:
            return lambda: None if effect is None else loss(effect)

        def photo() -> Tensor:
            form = {"literal": "photo" in literal, "shares": shares}
            return sum(losses.photometric(r.rgb, rgb, **form) for r in seen)

        def point_color() -> Tensor:
            ids = [r.all_ray_ids if "point_color" in literal else None for r in seen]
            samples = [(r.weights, r.colors, r.ray_ids) for r in seen]
            pairs = zip(samples, ids)
            return sum(losses.point_color(*s, rgb, all_ray_ids=every, shares=shares) for s, every in pairs)

        def background_entropy() -> Tensor:
            if "background_entropy" in literal:
                return sum(losses.sample_entropy(r.all_weights) for r in seen)
            return sum(losses.background_entropy(r.transmittance, shares) for r in seen)

        def tv_density() -> Tensor:
            grids = [grid for grid in (canonical, state.background) if grid is not None]
            return sum(losses.tv_density(g.raw_density, self._neighbours(g.index)) for g in grids)

        def tv_flow(flow: Tensor) -> Tensor:
            return losses.tv_flow(flow / state.length, self._neighbours(canonical.index))

        def static_points() -> Tensor | None:
            stray = self._stray(state.moment.time, generator)
            return None if stray is None else losses.static_points(stray)

        def moving_opacity(_: RadianceGrid) -> Tensor:
            alpha = canonical.activation.alpha(canonical.raw_density, canonical.lattice.voxel_size)
            return losses.moving_opacity(alpha)

        return {
            "photo": photo,
            "point_color": point_color,
            "background_entropy": background_entropy,
            "flow_l1": of(state.flow, lambda flow: losses.flow_l1(flow / state.length)),
            "inpaint_diff": of(state.inpaint_difference, losses.inpaint_diff),
            "tv_density": tv_density,
            "tv_flow": of(state.flow, tv_flow),
            "tv_depth": lambda: losses.tv_depth(*self._patches_of(state, generator)),
            "static_points": static_points,
            "moving_opacity": of(state.background, moving_opacity),
        }

    def _compared(self, state: VoxelSnapshot) -> list[str]:
        """Names of the renderings that the per-ray terms compare: those in ``photo_on``, or all.

        A stage without up-sampler has ``warped`` in the place of ``upsampled``.
        """
        names, wanted = list(state.fields), set(self._photo_on or ())
        if wanted & {"upsampled", "warped"}:
            wanted |= {"upsampled", "warped"}
        return [name for name in names if name in wanted] or names

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
        of_rows = {name: name for name in ("density", "color", "shading", "grid")} | {"features": "grid"}
        groups: dict[str, list[nn.Parameter]] = {}
        for name, parameter in self.named_parameters():
            part, last = name.split(".")[0], name.split(".")[-1]
            of_part = "flow" if part in ("motion", "deformation") else "network"
            groups.setdefault(of_rows.get(last, of_part), []).append(parameter)
        return groups

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Resample or refresh the grids that are due at ``progress``."""
        stage = self.stage
        due = stage.refresh_every and step and step % stage.refresh_every == 0
        for key, grid in self.grids.items():
            (present, since), num_voxels = self.followed[key], stage.at(key, progress)
            only_seen = stage.see_steps > 0 and step - since >= stage.see_steps
            if num_voxels != present:
                resample(grid, stage, optimizer, Lattice.of_count(grid.lattice.box, num_voxels), only_seen)
                self.followed[key] = [num_voxels, step]
            elif due and progress >= stage.refresh_from:
                confined = key == "num_voxels" and progress < stage.confine
                confined = confined and self.home.shape == grid.lattice.shape
                allowed = self.home.to(grid.index.device) if confined else None
                refresh(grid, stage, optimizer, only_seen, allowed)
        return {}

    def moved(self, points: Tensor, rows: Tensor, time: float) -> Tensor:
        """Move the canonical voxels ``rows`` (N,) bool, at ``points`` (M, 3), to ``time`` (M, 3)."""
        return self.trajectories(points, torch.tensor([time]))[:, 0]

    def displacement(self, points: Tensor, time: float) -> Tensor:
        """Return how far points (N, 3) are from the canonical time at ``time`` (N, 3); differentiable."""
        return self.trajectories(points, points.new_tensor([time]))[:, 0] - points

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
        return Box(low - margin, high + margin)

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
        """Return the length that density is measured in, and how far the lattices' schedule is."""
        schedule = {"home": self.home, "followed": self.followed}
        return {"density_scale": self.radiance.activation.density_scale, "lattices": schedule}

    def set_extra_state(self, state: dict) -> None:
        """Adopt a checkpoint's state."""
        scale, self.home, self.followed = self._read_state(state)
        for grid in self.grids.values():
            grid.activation = Activation(grid.activation.shift, scale)

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """See ``Method``; the lattices' schedule is of this stage's grids, too."""
        return super().misfit(state) or misread(
            "_extra_state", lambda: self._read_state(state["_extra_state"])
        )

    def _read_state(self, state: dict) -> tuple[float, Tensor, dict[str, list]]:
        scale, home = float(state["density_scale"]), state["lattices"]["home"]
        followed = {key: list(state["lattices"]["followed"][key]) for key in self.grids}
        fits = torch.is_tensor(home) and (home.dtype, home.dim()) == (torch.bool, 3) and 0 < scale < math.inf
        for present, since in followed.values():
            fits = fits and (present is None or is_number(present)) and is_number(since)
        if not fits:
            raise ValueError("expected a length, flags of a lattice, and a size and a step for each grid")
        return scale, home, followed


def _carried(start: Start, stage: VoxelStage) -> VoxelMethod | None:
    """Return the method of the stage before, if this stage continues with its grids."""
    before = start.before if stage.carry == "all" and not start.blank else None
    return before if isinstance(before, VoxelMethod) else None


def copy_shared(before: nn.Module, after: nn.Module) -> None:
    """Copy what two modules have in common; resample the first one's grids to the lattices of the other.

    Those of voxels have them by now; F2's features and learned nodes do not.
    """
    grids = dict(after.named_modules())
    for place, grid in before.named_modules():
        if place in grids and isinstance(grid, VoxelGrid) and grid.lattice != grids[place].lattice:
            empty = {name: 0.0 for name in grid.names if name != "coefficients"}
            grid.resample(grids[place].lattice, grids[place].index >= 0, empty)
    ours, theirs = after.state_dict(), before.state_dict()
    alike = {k: v for k, v in theirs.items() if torch.is_tensor(v) and k in ours}
    after.load_state_dict(ours | {k: v for k, v in alike.items() if v.shape == ours[k].shape})


def _tensors(state: VoxelSnapshot, renderings: Mapping[str, Marched]) -> Iterable[tuple[str, Tensor | None]]:
    """Yield everything that a step computed, from the grids to the renderings, by name."""
    for name in ("flow", "coverage", "inpaint_difference"):
        yield f"state.{name}", getattr(state, name)
    grids = {"canonical": state.canonical, "background": state.background, **state.fields}
    yield from ((f"state.{name}.values", getattr(grid, "values", None)) for name, grid in grids.items())
    for name, drawn in renderings.items():
        yield from ((f"{name}.{part}", getattr(drawn, part)) for part in ("rgb", "depth", "opacity"))


def _resampled(
    before: CanonicalRadiance | None, box: Box, stage: VoxelStage, key: str
) -> tuple[Lattice, Tensor]:
    """Return lattice and active voxels of a grid: those of ``before``, resampled to ``box``, or all.

    ``key`` is that of the grid's schedule.
    """
    lattice = Lattice.of_count(box, stage.at(key, 0.0))
    if before is None:
        return lattice, torch.ones(lattice.shape, dtype=torch.bool)
    resample(before, stage, None, lattice)
    return lattice, before.index >= 0
