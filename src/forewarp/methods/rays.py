"""How networks and grids are asked along rays: samples of two passes, or rays marched at equal steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from forewarp import losses
from forewarp.fields.grids import Activation, VoxelGrid, adopted_in, misfit_in
from forewarp.fields.networks import Template, density_of
from forewarp.fields.occupancy import Occupancy
from forewarp.methods.method import (
    FRACTION,
    Method,
    Snapshot,
    Start,
    Step,
    check_least,
    check_number,
    steps_of,
)
from forewarp.methods.rows import RowsAdam, renew_parameters
from forewarp.ops.encode import positional_encoding
from forewarp.ops.march import warm_up
from forewarp.quadrature import Quadrature, Sampled
from forewarp.renderer import Marched, Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays
from forewarp.scene.frame import spread
from forewarp.scene.view import Batch, Moment, Rendering, View

CENTRES = "pixel centres at +0.5"
ALONG_RAYS = "near and far along unit rays"
ONE_TIME = "a step's rays are of one time"
BETWEEN_TIMES = "codes interpolated between training times"
NO_JUMP = "offsets without a jump at the canonical time"
JUMP = "offsets jump at the canonical time (continuous)"  # the fault that ``NO_JUMP`` mends


_PATIENCE = 20  # steps


class DeadStart:
    """Count steps in a row that show nothing to learn from, at any time of a run.

    The count is no part of a checkpoint: a run that goes on counts anew, and so ends a few steps later. A
    step that is repeated counts twice.

    Args:
        key: where the mend is typed.
        came: what such a step shows.
        advice: what to change.
    """

    def __init__(self, key: str, came: str, advice: str) -> None:
        self.key, self.came, self.advice, self.steps = key, came, advice, 0

    def look(self, alive: bool) -> None:
        """Note whether a step had anything to learn from.

        Raises:
            ValueError: if many steps in a row had nothing.
        """
        self.steps = 0 if alive else self.steps + 1
        if self.steps >= _PATIENCE:
            raise ValueError(
                f"{self.key}: expected matter somewhere, but got {self.came} in each of {_PATIENCE} steps, "
                f"which has no gradient: a dead start; {self.advice}"
            )


_LOOK_EVERY = 8  # steps between two looks for where matter is
_PICTURES = 64  # most whose outlines say where matter may be
# What differs from the publications in every preset, of those whose code is in PyTorch, and in JAX.
OF_PYTORCH = (CENTRES, ALONG_RAYS, "no centre crop at first")
OF_JAX = (ONE_TIME, BETWEEN_TIMES)


@dataclass(frozen=True)
class Field:
    """A template at one moment: ``encoded`` maps world points (..., 3) to its inputs (..., I), ``condition``
    unit directions (..., 3) to what colour also reads (..., D), ``activation`` raw density to density.
    """

    template: Template
    activation: Callable[[Tensor], Tensor]
    encoded: Callable[[Tensor], Tensor]
    condition: Callable[[Tensor], Tensor]

    def density(self, points: Tensor) -> Tensor:
        """World points (..., 3) -> density (...,), per world unit."""
        return self.activation(self.template.density(self.encoded(points)))

    def radiance(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., 3), unit directions that broadcast to them -> density (...,) and colour (..., 3)."""
        towards = self.condition(directions)
        raw, color = self.template(self.encoded(points), towards.expand(*points.shape[:-1], -1))
        return self.activation(raw), color


@dataclass(frozen=True)
class Sampling:
    """How a method looks along rays, and what it takes for matter; one for all such methods.

    Args:
        samples, fine_samples, open_end: see ``Quadrature``. Without fine samples a method that has a network
            for each pass has one.
        inside_box: treat space outside the scene's box as empty, to save samples; not as published.
        density: ``relu`` as NeRF has it, with which some seeds start dead, or ``softplus``.
        occupancy: cells along a side of the lattice that notes where matter is (see ``Occupancy``), so that
            samples elsewhere are not evaluated; 0: evaluate all, as published.
        hull: where the lattice is and pictures have alpha, space that less than this share of the training
            pictures shows as covered is empty for good (see ``Occupancy.confine``); 0: no space is.
        jitter_in_pictures: draw the samples of pictures at random too, as HyperNeRF's code does.
    """

    samples: int = 64
    fine_samples: int = 128
    open_end: bool = True
    inside_box: bool = False
    density: str = "relu"
    occupancy: int = 0
    hull: float = 0.0
    jitter_in_pictures: bool = False

    def __post_init__(self) -> None:
        check_number("model.sampling.hull", self.hull, *FRACTION)
        check_least(of="model.sampling", occupancy=self.occupancy)

    def departures(self, density: str, jitters: bool) -> list[str]:
        """Name what differs from a publication with this density; ``jitters``: with random samples in
        pictures.
        """
        notes = [f"{self.density} density"] if self.density != density else []
        if not self.open_end:
            notes.append("the last interval ends with the ray")
        if not self.fine_samples:
            notes.append("one pass")
        if self.inside_box:
            notes.append("empty outside the scene's box")
        if self.occupancy:
            notes.append("empty space is not sampled")
        if self.jitter_in_pictures != jitters:
            notes.append(f"pictures are drawn with{'' if self.jitter_in_pictures else 'out'} random samples")
        return notes


class SampledMethod(Method):
    """A network evaluated at samples along rays and composited: one of ``fields`` for each of two passes.

    Args:
        start: scene, stage and numbers.
        sampling: see ``Sampling``.
    """

    published = "relu"  # density in the publication
    jitters = False  # whether the released code draws the samples of pictures at random
    conventions = OF_PYTORCH
    sees_by_camera = False  # whether colour depends on the id of the camera that looks

    def __init__(self, start: Start, sampling: Sampling) -> None:
        super().__init__()
        box, self.sampling, self.times = start.scene.box, sampling, start.scene.times
        self.activation = density_of(sampling.density)
        self.occupancy = Occupancy(box, side=sampling.occupancy) if sampling.occupancy else None
        self.confined = self.occupancy is not None and sampling.hull > 0 and start.scene.has_alpha
        if self.confined and not start.blank:
            train = start.scene.train
            self.occupancy.confine([train[i] for i in spread(len(train), _PICTURES)], sampling.hull)
        self.quadrature = Quadrature(
            sampling.samples,
            sampling.fine_samples,
            sampling.open_end,
            box if sampling.inside_box or sampling.occupancy else None,
            self.occupancy,
        )
        alive = "density=softplus model.sampling.open_end=false"  # an open end would hide the background
        alive = alive if sampling.density == "relu" else "occupancy=0"
        advice = f"set another seed=N, or model.sampling.{alive}"
        self.dead_start = DeadStart("model.sampling", "a density of 0 along every ray", advice)

    def passes(self, make: Callable[[], Template]) -> tuple[Template | None, Template]:
        """Make a network for each pass; None in place of the first where there is one pass."""
        return make() if self.sampling.fine_samples else None, make()

    def both(
        self, encoded: Callable[[Tensor], Tensor], condition: Callable[[Tensor], Tensor]
    ) -> tuple[Field | None, Field]:
        """The field of each pass, by the networks ``coarse`` (or None) and ``fine``; see ``Field``."""
        networks = (self.coarse, self.fine)
        return tuple(n if n is None else Field(n, self.activation, encoded, condition) for n in networks)

    def fields(self, moment: Moment) -> tuple[Field | None, Field]:
        """Return the field of each pass at a moment.

        Where the first is None, one network serves both: its first pass places samples, and has no gradient.
        """
        raise NotImplementedError

    def extra_terms(
        self, seen: Sampled, batch: Batch, factors: Mapping[str, float], generator: torch.Generator
    ) -> dict[str, Callable[[], Tensor | None]]:
        """Return the loss terms beside the errors of the passes."""
        return {}

    def at(self, moment: Moment) -> SampledSnapshot:
        """Fix the time; compute nothing yet."""
        return SampledSnapshot(moment, self)

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method.look``; a batch holds one time, as no neighbours are asked for, seen by one or
        several cameras.

        Raises:
            ValueError: if the density of a pass is 0 at every sample, or no sample is left, for many steps:
                there is then no gradient.
        """
        rgb, parts = batch.joined()[1], batch.split() if self.sees_by_camera else [batch]
        seen = Sampled.joined([self._sampled(part, generator) for part in parts])
        passes = [seen] if seen.coarse is None else [seen.coarse, seen]
        self.dead_start.look(all(bool((one.density > 0).any()) for one in passes))
        error = (seen.rgb - rgb).square().mean()
        terms = {"photo": lambda: error}
        if "coarse_photo" in self.terms:
            terms["coarse_photo"] = lambda: seen.coarse and (seen.coarse.rgb - rgb).square().mean()
        return Step(
            terms | self.extra_terms(seen, batch, factors, generator),
            error.detach(),
            {"samples": seen.depths.numel(), "opacity": float(seen.opacity.detach().mean())},
            tensors=lambda: ((name, getattr(seen, name)) for name in ("density", "weights", "rgb")),
        )

    def _sampled(self, batch: Batch, generator: torch.Generator) -> Sampled:
        rays, _, background = batch.joined()
        snapshot = self.at(batch.observations[0].moment)
        return snapshot.sampled(rays.to(self.device), background.to(self.device), generator)

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; look now and then for where matter is."""
        if self.occupancy is None or step % _LOOK_EVERY:
            return {}
        self.occupancy.look(self._density_at, self.times, torch.default_generator)
        return {"occupied": float(self.occupancy.occupied.float().mean())}

    def _density_at(self, points: Tensor, time: float) -> Tensor:
        return self.fields(Moment(time))[1].density(points)

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make Adam with the published betas."""
        return torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-8, fused=True)

    def departures(self) -> list[str]:
        """See ``Method``; a subclass adds its own to those of the sampling and of the platform."""
        notes = [*self.conventions, *self.sampling.departures(self.published, self.jitters)]
        return notes + (["what pictures show as clear is empty from the start"] if self.confined else [])

    def faults(self) -> list[str]:
        """See ``Method``."""
        kept = self.jitters and self.sampling.jitter_in_pictures
        return ["pictures are drawn with random samples (jitter_in_pictures)"] if kept else []


@dataclass(frozen=True)
class SampledSnapshot(Snapshot):
    """Such a method at one moment. An image costs the same at every time: all its samples."""

    moment: Moment
    method: SampledMethod

    def sampled(self, rays: Rays, background: Tensor, generator: torch.Generator | None = None) -> Sampled:
        """Render rays; also return what lies along them."""
        first, second = self.method.fields(self.moment)
        coarse = None if first is None else first.radiance
        return self.method.quadrature(
            second.density, second.radiance, rays, background, generator, coarse=coarse
        )

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot.render``; without gradients in chunks of rays, for images of any size."""
        rays = view.rays().to(self.method.device)
        background = background.to(rays.origins)
        if torch.is_grad_enabled():
            return self.sampled(rays, background)
        first, second = self.method.fields(self.moment)
        places = (first or second).density
        jitter = torch.Generator().manual_seed(0) if self.method.sampling.jitter_in_pictures else None
        return self.method.quadrature.picture(places, second.radiance, rays, background, jitter)

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time, and the same camera where that matters."""
        alike = not self.method.sees_by_camera or moment.camera == self.moment.camera
        return alike and moment.time == self.moment.time


def encoder(of: str, frequencies: int) -> Callable[[Tensor], Tensor]:
    """Return ``positional_encoding`` with so many octaves, ``model.<of>_frequencies``."""
    check_least(**{f"{of}_frequencies": frequencies})
    return lambda x: positional_encoding(x, frequencies)


_RAYS = 4096  # of a picture, at once
_THRESHOLD = "a weight in [0, 1)", lambda weight: 0 <= weight < 1
_YOUNG = 4  # steps between two of the first looks for where matter is


@dataclass(frozen=True)
class Marching:
    """How a method marches; one for all such methods.

    Args:
        step: distance between samples, in voxels of the method's finest lattice.
        color_threshold: compute no colour for samples of less weight; 0: compute all.
        jitter: in training, shift the samples of each ray by up to one step.
        occupancy: cells along a side of the lattice that notes where matter is (see ``Occupancy``), so that
            samples elsewhere are not evaluated; 0: evaluate all in the box.
        look_every: steps between two looks for where matter is; 0: never look again.
    """

    step: float = 0.5
    color_threshold: float = 1e-4
    jitter: bool = False
    occupancy: int = 0
    look_every: int = 16

    def __post_init__(self) -> None:
        check_number("model.marching.step", self.step, "a number > 0", lambda step: step > 0)
        check_number("model.marching.color_threshold", self.color_threshold, *_THRESHOLD)
        check_least(of="model.marching", occupancy=self.occupancy, look_every=self.look_every)

    def departures(self) -> list[str]:
        """Name what differs from the publications."""
        notes = [ALONG_RAYS, ONE_TIME]
        return notes + (["empty space is not sampled"] if self.occupancy and self.look_every else [])


class PointField(Protocol):
    """A method at one moment, asked at world points."""

    def look_up(self, points: Tensor) -> tuple[Tensor, Callable[[Tensor | slice, Tensor], Tensor]]:
        """World points (P, 3) -> density (P,) per world unit, and a function: rows (K,) of these points and
        unit directions (K, 3) -> colour (K, 3).
        """


@dataclass(frozen=True)
class _Placed:
    """A ``PointField`` as the renderer asks it: in coordinates of the ``lattice`` whose cells are marched."""

    field: PointField
    lattice: Lattice
    cells: Tensor
    voxel_size: float

    def look_up(self, points: Tensor) -> tuple[Tensor, Callable[[Tensor | slice, Tensor], Tensor]]:
        return self.field.look_up(self.lattice.to_world(points))


class MarchedMethod(Method):
    """Rays marched at equal steps through a box, lattices that grow during a stage, Adam by rows.

    A subclass makes its lattices for ``num_voxels``, sets the ``shift`` of its ``activation``, ends its
    constructor with ``begin``, and says what it is at a moment (``field``) and how it grows (``grow``).

    Args:
        start: scene, stage and numbers.
        marching: see ``Marching``.
        box: outside, everything is empty.
        alpha_key: of the opacity at first.
        num_voxels: ``[[fraction, count], ...]``: about ``count`` voxels from ``fraction`` of the stage on.
    """

    terms = ("photo", "point_color", "background_entropy")
    numbers = ("num_voxels", "color_threshold")
    sees_by_camera = False  # whether colour depends on the id of the camera that looks

    def __init__(
        self, start: Start, marching: Marching, box: Box, alpha_key: str = "model.alpha_init"
    ) -> None:
        super().__init__()
        self.alpha_key = alpha_key
        self.box, self.times, self.marching = box, start.scene.times, marching
        self.still = start.scene.still
        where, numbers = f"stage.{start.stage}", start.numbers
        self.schedule = steps_of(
            f"{where}.num_voxels", numbers.get("num_voxels", ()), least=8, from_start=True
        )
        threshold = numbers.get("color_threshold")
        if threshold is not None:
            check_number(f"{where}.color_threshold", threshold, *_THRESHOLD)
        self.renderer = Renderer(step=marching.step, color_threshold=marching.color_threshold)
        self.renderer = self.renderer.with_threshold(threshold)
        self.occupancy = Occupancy(box, side=marching.occupancy, patience=8) if marching.occupancy else None
        self.dead_start = DeadStart(
            "preset.color_threshold",
            "no sample of so much weight",
            f"set it to 0, or a larger {self.alpha_key}, or preset.occupancy=0",
        )

    def begin(self) -> None:
        """Note where the schedule stands, once all parameters are there."""
        self.register_buffer("voxels", torch.tensor(self.schedule[0][1], dtype=torch.float64))
        self.register_buffer("raised", torch.ones(len(self.param_groups()), dtype=torch.float64))

    @property
    def last_voxels(self) -> float:
        """The number of voxels at the end of the stage."""
        return self.schedule[-1][1]

    @property
    def lattice_marched(self) -> Lattice:
        """The lattice that a step is a share of, as it is now."""
        raise NotImplementedError

    def marching_lattice(self, num_voxels: float) -> Lattice:
        """Return that lattice with about ``num_voxels`` voxels."""
        raise NotImplementedError

    @property
    def activation(self) -> Activation:
        """Density of raw density; its unit of length is a voxel of the last lattice."""
        return Activation(self.shift, self.marching_lattice(self.last_voxels).voxel_size)

    def field(self, moment: Moment) -> PointField:
        """Return what is to be asked at a moment."""
        raise NotImplementedError

    def grow(self, num_voxels: float, optimizer: torch.optim.Optimizer) -> None:
        """Resample the lattices to about ``num_voxels`` voxels."""
        raise NotImplementedError

    def extra_terms(
        self, field: PointField, batch: Batch, generator: torch.Generator
    ) -> dict[str, Callable[[], Tensor | None]]:
        """Return the loss terms beside those of the rays.

        ``field`` has been asked at the rays' samples, or where it sees by camera at those of the first.
        """
        return {}

    def some_still(self, count: int, generator: torch.Generator) -> Tensor | None:
        """Draw at most so many points that never move (P, 3); None where none is known."""
        if self.still is None or not len(self.still):
            return None
        rows = torch.randint(len(self.still), (min(count, len(self.still)),), generator=generator)
        return self.still[rows].to(self.device)

    def at(self, moment: Moment) -> MarchedSnapshot:
        """Fix the time; compute nothing yet."""
        return MarchedSnapshot(moment, self)

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method.look``; a batch holds one time, as no neighbours are asked for, seen by one or
        several cameras.

        Raises:
            ValueError: if no sample has a colour for many steps.
        """
        rgb, parts = batch.joined()[1], batch.split() if self.sees_by_camera else [batch]
        fields = [self.field(part.observations[0].moment) for part in parts]
        drawn = Marched.joined([self._drawn(*both, generator) for both in zip(fields, parts)])
        self.dead_start.look(len(drawn.weights) > 0)
        error = (drawn.rgb - rgb).square().mean()
        terms = {
            "photo": lambda: error,
            "point_color": lambda: losses.point_color(drawn.weights, drawn.colors, drawn.ray_ids, rgb),
            "background_entropy": lambda: losses.background_entropy(drawn.transmittance),
        }
        return Step(
            terms | self.extra_terms(fields[0], batch, generator),
            error.detach(),
            {"samples": drawn.samples, "opacity": float(drawn.opacity.detach().mean())},
            tensors=lambda: ((name, getattr(drawn, name)) for name in ("weights", "colors", "rgb")),
        )

    def _drawn(self, field: PointField, batch: Batch, generator: torch.Generator) -> Marched:
        rays, _, background = batch.joined()
        jitter = generator if self.marching.jitter else None
        return self.marched_through(field, rays.to(self.device), background.to(self.device), jitter)

    def marched_through(
        self, field: PointField, rays: Rays, background: Tensor, generator: torch.Generator | None = None
    ) -> Marched:
        """March rays through the occupied cells of a field; ``generator`` jitters the samples."""
        return self.renderer(self.placed(field), rays, background, generator=generator)

    def placed(self, field: PointField) -> _Placed:
        """Return a field as the renderer asks it."""
        everywhere = torch.ones(1, 1, 1, dtype=torch.bool, device=self.device)
        cells = everywhere if self.occupancy is None else self.occupancy.cells
        lattice = Lattice(self.box, tuple(n + 1 for n in cells.shape))
        return _Placed(field, lattice, cells, self.lattice_marched.voxel_size)

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; grow, after which optimiser and learning rates start anew; look for matter."""
        wanted = next(n for begin, n in reversed(self.schedule) if progress >= begin)
        if wanted != float(self.voxels):
            self.grow(wanted, optimizer)
            optimizer.state.clear()
            self.voxels.fill_(wanted)
            pairs = [(group["base_lr"], group["lr"]) for group in optimizer.param_groups]
            self.raised.copy_(torch.tensor([first / now if now else 1.0 for first, now in pairs]))
        for group, factor in zip(optimizer.param_groups, self.raised.tolist()):
            group["lr"] *= factor
        if self.occupancy is None:
            return {}
        pace, young = self.marching.look_every, int(self.occupancy.looks) < self.occupancy.patience
        if pace and step % (min(pace, _YOUNG) if young else pace) == 0:
            self.occupancy.look(self.density_at, self.times, torch.default_generator)
        return {"occupied": float(self.occupancy.occupied.float().mean())}

    def density_at(self, points: Tensor, time: float) -> Tensor:
        """World points (P, 3) and a time -> density (P,), per world unit."""
        return self.field(Moment(time)).look_up(points)[0]

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make Adam with the published betas; voxels that no sample touched keep their moments."""
        return RowsAdam(groups, betas=(0.9, 0.99), eps=1e-8)

    def warm_up(self) -> None:
        """Compile the kernels."""
        warm_up(self.device)

    def adopted(self) -> set[str]:
        """Let voxel grids adopt a checkpoint's lattices."""
        return adopted_in(self)

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """Return what in a stored grid contradicts its lattice, as kernels do not check the index."""
        return misfit_in(self, state)

    def get_extra_state(self) -> dict:
        """Return the box in plain numbers."""
        return {"low": list(self.box.low), "high": list(self.box.high)}

    def set_extra_state(self, state: dict) -> None:
        """Adopt a checkpoint's box."""
        self.box = Box(tuple(state["low"]), tuple(state["high"]))

    def departures(self) -> list[str]:
        """See ``Method``; a subclass adds its own to those of the marching."""
        return self.marching.departures()


@dataclass(frozen=True)
class MarchedSnapshot(Snapshot):
    """Such a method at one moment."""

    moment: Moment
    method: MarchedMethod

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot.render``; without gradients in chunks of rays, for images of any size."""
        rays, field = view.rays().to(self.method.device), self.method.field(self.moment)
        background = background.to(rays.origins)
        if torch.is_grad_enabled():
            return self.method.marched_through(field, rays, background)
        behind = background.expand(len(rays), 3)
        chunks = [slice(begin, begin + _RAYS) for begin in range(0, len(rays), _RAYS)]
        parts = [self.method.marched_through(field, rays[some], behind[some]) for some in chunks]
        return Rendering.joined(parts)

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time, seen by the same camera."""
        return (moment.time, moment.camera) == (self.moment.time, self.moment.camera)


def whole_grid(lattice: Lattice, channels: dict[str, int]) -> VoxelGrid:
    """Make a grid of zeros of all voxels of a lattice."""
    return VoxelGrid(lattice, torch.ones(lattice.shape, dtype=torch.bool), channels)


def regrow(grid: VoxelGrid, lattice: Lattice, optimizer: torch.optim.Optimizer) -> None:
    """Interpolate such a grid to another lattice; its moments start at 0."""
    before = [grid.parameter(name) for name in grid.names]
    grid.resample(lattice, torch.ones(lattice.shape, dtype=torch.bool), dict.fromkeys(grid.names, 0.0))
    renew_parameters(optimizer, before, [grid.parameter(name) for name in grid.names], None)
