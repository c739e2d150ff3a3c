"""What methods share whose density and colour a network gives at samples along rays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.fields.occupancy import Occupancy
from forewarp.fields.template import Template, density_of
from forewarp.methods.checks import FRACTION, check_least, check_number
from forewarp.methods.dead_start import DeadStart
from forewarp.methods.departures import ALONG_RAYS, BETWEEN_TIMES, CENTRES, ONE_TIME
from forewarp.methods.method import Method, Snapshot, Start, Step
from forewarp.ops.encode import positional_encoding
from forewarp.quadrature import Quadrature, Sampled
from forewarp.scene.camera import Rays
from forewarp.scene.frame import spread
from forewarp.scene.view import Batch, Moment, Rendering, View

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
