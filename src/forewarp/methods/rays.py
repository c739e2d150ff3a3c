"""How networks and grids are asked along rays: samples of two passes, or rays marched at equal steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from forewarp import losses
from forewarp.fields.grids import Activation, VoxelGrid
from forewarp.fields.networks import ScrewWarp, Template, TimeCodes
from forewarp.fields.occupancy import Occupancy
from forewarp.methods.method import (
    FRACTION,
    Method,
    Snapshot,
    Start,
    Step,
    check_least,
    check_number,
    misread,
    steps_of,
    those_that_hold,
)
from forewarp.methods.rows import RowsAdam, renew_parameters
from forewarp.ops.backend import check_value
from forewarp.ops.encode import encoded_size, positional_encoding
from forewarp.ops.march import warm_up
from forewarp.renderer import Marched, Quadrature, Renderer, Sampled, in_chunks
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays
from forewarp.scene.frame import spread
from forewarp.scene.view import Batch, Moment, Rendering, View

# What several methods do otherwise than published, and faults that they keep: one wording of each fact.
CENTRES = "pixel centres at +0.5"
ALONG_RAYS = "near and far along unit rays"
ONE_TIME = "a step's rays are of one time"
BETWEEN_TIMES = "codes interpolated between training times"
NO_JUMP = "offsets without a jump at the canonical time"
JUMP = "offsets jump at the canonical time (continuous)"  # the fault that ``NO_JUMP`` mends
# What differs from the publications in every preset, of those whose code is in PyTorch, and in JAX.
OF_PYTORCH = (CENTRES, ALONG_RAYS, "no centre crop at first")
OF_JAX = (ONE_TIME, BETWEEN_TIMES)

Terms = dict[str, Callable[[], Tensor | None]]  # see ``Step``

_PATIENCE = 20  # steps without a gradient after which a run ends
_LOOK_EVERY = 8  # steps between two looks for where matter is
_MASKS = 64  # most training images whose alpha says where matter may be
_RAYS = 4096  # of an image, marched at once
_THRESHOLD = "a weight in [0, 1)", lambda weight: 0 <= weight < 1
_YOUNG = 4  # steps between two of the first looks for where matter is


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


class RayMethod(Method):
    """A method that answers for any rays at a moment, without computing anything for the moment before.

    Attributes:
        sees_by_camera: whether colour depends on the id of the camera that looks.
    """

    sees_by_camera = False

    def along(self, moment: Moment, rays: Rays, background: Tensor) -> Rendering:
        """Render R rays over ``background`` (3,) or (R, 3)."""
        raise NotImplementedError

    def image(self, moment: Moment, rays: Rays, background: Tensor) -> Rendering:
        """Render an image's rays without gradient, in chunks for images of any size."""
        raise NotImplementedError

    def parts_of(self, batch: Batch) -> list[tuple[Moment, Rays, Tensor]]:
        """Return moment, rays and background of a batch of one time; by camera where that matters."""
        parts = []
        for part in batch.split() if self.sees_by_camera else [batch]:
            rays, _, background = part.joined()
            parts.append((part.observations[0].moment, rays.to(self.device), background.to(self.device)))
        return parts

    def compared(
        self, seen: Rendering, rgb: Tensor, terms: Terms, tensors: Mapping[str, Tensor], **noted: float
    ) -> Step:
        """Return the answer to a batch of ``rgb`` (R, 3): ``photo``, the error of what is ``seen``, and these
        ``terms``; ``tensors`` by name, and what is ``noted`` beside the mean opacity: see ``Step``.
        """
        error = (seen.rgb - rgb.to(seen.rgb.device)).square().mean()
        noted["opacity"] = float(seen.opacity.detach().mean())
        return Step({"photo": lambda: error} | terms, error.detach(), noted, tensors=tensors.items)

    def at(self, moment: Moment) -> RaySnapshot:
        """Fix the time; compute nothing yet."""
        return RaySnapshot(moment, self)


@dataclass(frozen=True, repr=False)
class RaySnapshot(Snapshot):
    """Such a method at one moment. An image costs the same at every time: all its samples."""

    moment: Moment
    method: RayMethod

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot.render``."""
        rays = view.rays().to(self.method.device)
        draw = self.method.along if torch.is_grad_enabled() else self.method.image
        return draw(self.moment, rays, background.to(rays.origins))

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time, and the same camera where that matters."""
        alike = not self.method.sees_by_camera or moment.camera == self.moment.camera
        return alike and moment.time == self.moment.time


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
        hull: where the lattice is and images have alpha, space that less than this share of the training
            images shows as covered is empty for good (see ``Occupancy.confine``); 0: no space is.
        jitter_in_pictures: draw the samples of images at random too, as HyperNeRF's code does.
    """

    samples: int = 64
    fine_samples: int = 128
    open_end: bool = True
    inside_box: bool = False
    density: str = "relu"
    occupancy: int = 0
    hull: float = 0.1
    jitter_in_pictures: bool = False

    def __post_init__(self) -> None:
        check_number("model.sampling.hull", self.hull, *FRACTION)
        check_least(of="model.sampling", occupancy=self.occupancy)
        known = ("relu", "softplus")
        check_value("model.sampling.density", self.density, " or ".join(known), lambda kind: kind in known)

    def departures(self, density: str, jitters: bool) -> list[str]:
        """List what differs from a publication's density, and whether it ``jitters`` samples in images."""
        without = "" if self.jitter_in_pictures else "out"
        notes = {
            f"{self.density} density": self.density != density,
            "the last interval ends with the ray": not self.open_end,
            "one pass": not self.fine_samples,
            "empty outside the scene's box": self.inside_box,
            "empty space is not sampled": self.occupancy > 0,
            f"pictures are drawn with{without} random samples": self.jitter_in_pictures != jitters,
        }
        return those_that_hold(notes)


class SampledMethod(RayMethod):
    """A network evaluated at samples along rays and composited: one of ``fields`` for each of two passes.

    Args:
        start: scene, stage and numbers.
        sampling: see ``Sampling``.
        width, layers, skip, glorot: of the networks, see ``fields.networks.Trunk``.
        position_frequencies, direction_frequencies: octaves of the encodings.
    """

    betas = (0.9, 0.999)  # of Adam, as published
    published = "relu"  # density in the publication
    jitters = False  # whether the released code draws the samples of images at random
    conventions = OF_PYTORCH

    def __init__(
        self,
        start: Start,
        *,
        sampling: Sampling = Sampling(),
        width: int = 256,
        layers: int = 8,
        skip: int | None = 6,
        position_frequencies: int = 10,
        direction_frequencies: int = 4,
        glorot: bool = False,
    ) -> None:
        super().__init__()
        box, self.sampling, self.times = start.scene.box, sampling, start.scene.times
        self.shape = {"width": width, "layers": layers, "skip": skip, "glorot": glorot}
        self.position = encoder("position", position_frequencies)
        self.direction = encoder("direction", direction_frequencies)
        self.sizes = encoded_size(3, position_frequencies), encoded_size(3, direction_frequencies)
        # An open end would hide the background from a softplus density.
        self.activation, mend = torch.relu, "density=softplus model.sampling.open_end=false"
        if sampling.density == "softplus":
            self.activation, mend = nn.functional.softplus, "occupancy=0"
        advice = f"set another seed=N, or model.sampling.{mend}"
        self.dead_start = DeadStart("model.sampling", "a density of 0 along every ray", advice)
        self.occupancy = Occupancy(box, side=sampling.occupancy) if sampling.occupancy else None
        self.confined = self.occupancy is not None and sampling.hull > 0 and start.scene.has_alpha
        if self.confined and not start.blank:
            train = start.scene.train
            self.occupancy.confine([train[i] for i in spread(len(train), _MASKS)], sampling.hull)
        within = box if sampling.inside_box or sampling.occupancy else None
        counts = sampling.samples, sampling.fine_samples
        self.quadrature = Quadrature(*counts, sampling.open_end, within, self.occupancy)

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

    def extra_terms(self, seen: Sampled, batch: Batch, generator: torch.Generator) -> Terms:
        """Return the loss terms beside the errors of the passes."""
        return {}

    def along(
        self, moment: Moment, rays: Rays, background: Tensor, generator: torch.Generator | None = None
    ) -> Sampled:
        """See ``RayMethod``; also return what lies along the rays. ``generator`` jitters the samples."""
        first, second = self.fields(moment)
        coarse = None if first is None else first.radiance
        return self.quadrature(second.density, second.radiance, rays, background, generator, coarse=coarse)

    def image(self, moment: Moment, rays: Rays, background: Tensor) -> Rendering:
        """See ``RayMethod``."""
        first, second = self.fields(moment)
        jitter = torch.Generator().manual_seed(0) if self.sampling.jitter_in_pictures else None
        return self.quadrature.image((first or second).density, second.radiance, rays, background, jitter)

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method.look``; a batch holds one time, as no neighbours are asked for, seen by one or
        several cameras.

        Raises:
            ValueError: if the density of a pass is 0 at every sample, or no sample is left, for many steps:
                there is then no gradient.
        """
        rgb = batch.joined()[1]
        seen = Sampled.joined([self.along(*part, generator) for part in self.parts_of(batch)])
        passes = [seen] if seen.coarse is None else [seen.coarse, seen]
        self.dead_start.look(all(bool((rendering.density > 0).any()) for rendering in passes))
        terms = self.extra_terms(seen, batch, generator)
        if "coarse_photo" in self.terms:
            terms = {**terms, "coarse_photo": lambda: seen.coarse and (seen.coarse.rgb - rgb).square().mean()}
        tensors = {"density": seen.density, "weights": seen.weights, "rgb": seen.rgb}
        return self.compared(seen, rgb, terms, tensors, samples=seen.depths.numel())

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; look now and then for where matter is."""
        if self.occupancy is None or step % _LOOK_EVERY:
            return {}
        self.occupancy.look(self.density_at, self.times, torch.default_generator)
        return {"occupied": float(self.occupancy.occupied.float().mean())}

    def density_at(self, points: Tensor, time: float) -> Tensor:
        """World points (P, 3) and a time -> density (P,), per world unit."""
        return self.fields(Moment(time))[1].density(points)

    def departures(self) -> list[str]:
        """See ``Method``; a subclass adds its own to those of the sampling and of the platform."""
        notes = [*self.conventions, *self.sampling.departures(self.published, self.jitters)]
        return notes + (["what pictures show as clear is empty from the start"] if self.confined else [])

    def faults(self) -> list[str]:
        """See ``Method``."""
        kept = self.jitters and self.sampling.jitter_in_pictures
        return ["pictures are drawn with random samples (jitter_in_pictures)"] if kept else []


class WarpedMethod(SampledMethod):
    """Nerfies and its successors: a code for each instant bends space, by screws, to a shared template.

    Octaves of the warp's encoding come in over the stage. Where a test time is not a training time, the codes
    beside it are interpolated.

    Args:
        start: scene, stage and numbers.
        sampling, skip, position_frequencies: see ``SampledMethod``.
        warp_width, warp_layers, warp_skip, warp_frequencies: of the warp, see ``ScrewWarp``.
        code_size: channels of an instant's code.
        still_points: of a step, most of the points that never move that a regulariser looks at; null: all.
        network: width, layers, direction_frequencies: see ``SampledMethod``.
    """

    octaves_in: float  # of the warp's encoding: how many count
    shares = {"warp_in": 0.32}  # of the stage, where its numbers do not say
    numbers = tuple(shares)
    published = "softplus"
    conventions = OF_JAX

    def __init__(
        self,
        start: Start,
        *,
        sampling: Sampling = Sampling(128, 128, density="softplus"),
        skip: int | None = 5,
        position_frequencies: int = 8,
        warp_width: int = 128,
        warp_layers: int = 6,
        warp_skip: int | None = 5,
        warp_frequencies: int = 6,
        code_size: int = 8,
        still_points: int | None = 16384,
        **network,
    ) -> None:
        network |= {"skip": skip, "position_frequencies": position_frequencies, "glorot": True}
        super().__init__(start, sampling=sampling, **network)
        check_least(warp_frequencies=warp_frequencies)
        self.codes = TimeCodes(self.times, code_size)
        self.warp_shape = {"frequencies": warp_frequencies, "layers": warp_layers, "skip": warp_skip}
        self.warp = ScrewWarp(code_size, width=warp_width, **self.warp_shape)
        self.shares = self.shares | dict(start.numbers)
        for name in self.numbers:
            check_number(f"stage.{start.stage}.{name}", self.shares[name], *FRACTION)
        self.still, self.still_points = start.scene.still, still_points

    def extra_terms(self, seen: Sampled, batch: Batch, generator: torch.Generator) -> Terms:
        """Offer ``still``, at points that never move."""

        stray, codes = self.warp.stray, self.codes.table
        return {"still": lambda: stray(self.still, codes, self.octaves_in, self.still_points, generator)}


def encoder(of: str, frequencies: int) -> Callable[[Tensor], Tensor]:
    """Return ``positional_encoding`` with so many octaves, ``model.<of>_frequencies``."""
    check_least(**{f"{of}_frequencies": frequencies})
    return lambda x: positional_encoding(x, frequencies)


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
    look_every: int = 0

    def __post_init__(self) -> None:
        check_number("model.marching.step", self.step, "a number > 0", lambda step: step > 0)
        check_number("model.marching.color_threshold", self.color_threshold, *_THRESHOLD)
        check_least(of="model.marching", occupancy=self.occupancy, look_every=self.look_every)


class PointField:
    """A method at one moment. A subclass says what is ``at_world`` points; the renderer asks for it in
    coordinates of the ``lattice`` whose ``cells`` are marched: those that may hold matter.
    """

    def __init__(self, method: MarchedMethod) -> None:
        self.method = method
        everywhere = torch.ones(1, 1, 1, dtype=torch.bool, device=method.device)
        self.cells = everywhere if method.occupancy is None else method.occupancy.cells
        self.lattice = Lattice(method.box, tuple(n + 1 for n in self.cells.shape))
        self.voxel_size = method.lattice_marched.voxel_size

    def at_world(self, points: Tensor) -> tuple[Tensor, Callable]:
        """World points (P, 3) -> density (P,) per world unit, and a function: rows (K,) of these points and
        unit directions (K, 3) -> colour (K, 3).
        """
        raise NotImplementedError

    def look_up(self, points: Tensor) -> tuple[Tensor, Callable]:
        """See ``at_world``, for points in lattice coordinates."""
        return self.at_world(self.lattice.to_world(points))


class MarchedMethod(RayMethod):
    """Rays marched at equal steps through a box, lattices that grow during a stage, Adam by rows.

    A subclass makes its lattices for ``num_voxels``, sets the ``shift`` of its ``activation``, ends its
    constructor with ``begin``, and says what it is at a moment (``field``) and how it grows (``grow``).

    Args:
        start: scene, stage and numbers: ``num_voxels``, ``[[fraction, count], ...]``: about ``count`` voxels
            from ``fraction`` of the stage on; ``color_threshold``, in place of the marching's.
        marching: see ``Marching``.
        box: outside, everything is empty.
        alpha_key: of the opacity at first.
    """

    lattice_marched: Lattice  # that a step is a share of, as it is now
    terms = ("photo", "point_color", "background_entropy")
    numbers = ("num_voxels", "color_threshold")

    def __init__(
        self, start: Start, marching: Marching, box: Box, alpha_key: str = "model.alpha_init"
    ) -> None:
        super().__init__()
        self.box, self.times, self.marching, self.alpha_key = box, start.scene.times, marching, alpha_key
        self.still = start.scene.still
        where, num_voxels = f"stage.{start.stage}", start.numbers.get("num_voxels", ())
        self.schedule = steps_of(f"{where}.num_voxels", num_voxels, least=8, from_start=True)
        threshold = start.numbers.get("color_threshold")
        if threshold is None:
            threshold = marching.color_threshold
        check_number(f"{where}.color_threshold", threshold, *_THRESHOLD)
        self.renderer = Renderer(step=marching.step, color_threshold=threshold)
        self.occupancy = Occupancy(box, side=marching.occupancy) if marching.occupancy else None
        advice = f"set it to 0, or a larger {alpha_key}, or preset.occupancy=0"
        self.dead_start = DeadStart("preset.color_threshold", "no sample of so much weight", advice)

    def begin(self) -> None:
        """Note where the schedule stands, once all parameters are there."""
        self.register_buffer("voxels", torch.tensor(self.schedule[0][1], dtype=torch.float64))
        self.register_buffer("raised", torch.ones(len(self.param_groups()), dtype=torch.float64))

    def marching_lattice(self, num_voxels: float) -> Lattice:
        """Return ``lattice_marched`` with about ``num_voxels`` voxels."""
        raise NotImplementedError

    @property
    def activation(self) -> Activation:
        """Density of raw density; its unit of length is a voxel of the stage's last lattice."""
        return Activation(self.shift, self.marching_lattice(self.schedule[-1][1]).voxel_size)

    def field(self, moment: Moment) -> PointField:
        """Return what is to be asked at a moment."""
        raise NotImplementedError

    def grow(self, num_voxels: float, optimizer: torch.optim.Optimizer) -> None:
        """Resample the lattices to about ``num_voxels`` voxels."""
        raise NotImplementedError

    @staticmethod
    def regrow(grid: VoxelGrid, lattice: Lattice, optimizer: torch.optim.Optimizer) -> None:
        """Interpolate a grid of all voxels to another lattice; its moments start at 0."""
        before = grid.rows()
        grid.resample(lattice, torch.ones(lattice.shape, dtype=torch.bool), dict.fromkeys(grid.names, 0.0))
        renew_parameters(optimizer, before, grid.rows(), None)

    def extra_terms(self, field: PointField, batch: Batch, generator: torch.Generator) -> Terms:
        """Return the loss terms beside those of the rays.

        ``field`` has been asked at the rays' samples, or where it sees by camera at those of the first.
        """
        return {}

    def stray(
        self, offset: Callable[[Tensor], Tensor], count: int, generator: torch.Generator
    ) -> Tensor | None:
        """Mean square of the ``offset`` (P, 3) of at most so many points (P, 3) that never move; None where
        none is known.
        """
        if self.still is None or not len(self.still):
            return None
        rows = torch.randint(len(self.still), (min(count, len(self.still)),), generator=generator)
        return offset(self.still[rows].to(self.device)).square().mean()

    def along(self, moment: Moment, rays: Rays, background: Tensor) -> Marched:
        """See ``RayMethod``; also return the samples."""
        return self.renderer(self.field(moment), rays, background)

    def image(self, moment: Moment, rays: Rays, background: Tensor) -> Rendering:
        """See ``RayMethod``."""
        field, behind = self.field(moment), background.expand(len(rays), 3)
        return in_chunks(lambda some: self.renderer(field, rays[some], behind[some]), len(rays), _RAYS)

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method.look``; a batch holds one time, as no neighbours are asked for, seen by one or
        several cameras.

        Raises:
            ValueError: if no sample has a colour for many steps.
        """
        rgb, jitter = batch.joined()[1], generator if self.marching.jitter else None
        parts = [(self.field(moment), *part) for moment, *part in self.parts_of(batch)]
        drawn = Marched.joined([self.renderer(*part, generator=jitter) for part in parts])
        self.dead_start.look(len(drawn.weights) > 0)
        terms = {
            "point_color": lambda: losses.point_color(drawn.weights, drawn.colors, drawn.ray_ids, rgb),
            "background_entropy": lambda: losses.background_entropy(drawn.transmittance),
        }
        terms |= self.extra_terms(parts[0][0], batch, generator)
        tensors = {"weights": drawn.weights, "colors": drawn.colors, "rgb": drawn.rgb}
        return self.compared(drawn, rgb, terms, tensors, samples=drawn.samples)

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; grow, after which optimiser and learning rates start anew; look for matter."""
        num_voxels = next(n for begin, n in reversed(self.schedule) if progress >= begin)
        if num_voxels != float(self.voxels):
            self.grow(num_voxels, optimizer)
            optimizer.state.clear()
            self.voxels.fill_(num_voxels)
            pairs = [(group["base_lr"], group["lr"]) for group in optimizer.param_groups]
            self.raised.copy_(torch.tensor([first / now if now else 1.0 for first, now in pairs]))
        for group, factor in zip(optimizer.param_groups, self.raised.tolist()):
            group["lr"] *= factor
        if self.occupancy is None:
            return {}
        every, young = self.marching.look_every, int(self.occupancy.looks) < self.occupancy.patience
        if every and step % (min(every, _YOUNG) if young else every) == 0:
            self.occupancy.look(self.density_at, self.times, torch.default_generator)
        return {"occupied": float(self.occupancy.occupied.float().mean())}

    def density_at(self, points: Tensor, time: float) -> Tensor:
        """World points (P, 3) and a time -> density (P,), per world unit."""
        return self.field(Moment(time)).at_world(points)[0]

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make Adam with the published betas; voxels that no sample touched keep their moments."""
        return RowsAdam(groups, betas=self.betas, eps=1e-8)

    def warm_up(self) -> None:
        """Compile the kernels."""
        warm_up(self.device)

    def get_extra_state(self) -> dict:
        """Return the box in plain numbers."""
        return {"low": list(self.box.low), "high": list(self.box.high)}

    def set_extra_state(self, state: dict) -> None:
        """Adopt a checkpoint's box."""
        self.box = _box(state)

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """See ``Method``; the box is one, too."""
        return super().misfit(state) or misread("_extra_state", lambda: _box(state["_extra_state"]))

    def departures(self) -> list[str]:
        """See ``Method``; a subclass adds its own to those of the marching."""
        looks = self.marching.occupancy and self.marching.look_every
        return [ALONG_RAYS, ONE_TIME, *(["empty space is not sampled"] if looks else [])]


def _box(state: dict) -> Box:
    return Box(tuple(state["low"]), tuple(state["high"]))


def whole_grid(lattice: Lattice, channels: dict[str, int]) -> VoxelGrid:
    """Make a grid of zeros of all voxels of a lattice."""
    return VoxelGrid(lattice, torch.ones(lattice.shape, dtype=torch.bool), channels)
