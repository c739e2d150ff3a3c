"""T-NeRF: a NeRF whose network also takes the time, without any warp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.fields.template import Template, density_of
from forewarp.methods.method import Method, Snapshot, Start, Step
from forewarp.ops.encode import positional_encoding
from forewarp.quadrature import Quadrature, Sampled
from forewarp.scene.batch import Batch
from forewarp.scene.rays import Rays
from forewarp.scene.view import Moment, Rendering, View

_PATIENCE = 20  # steps in a row without any density, after which the network is dead


class TNeRF(Method):
    """``(x, d, t) -> (density, colour)``: ``N([PE(x), PE(t)], PE(d))``, the time at the skip as well.

    One network serves both passes; the first places the samples and has no gradient. Coordinates are in world
    units, directions have length 1, and the encodings have no factor of pi.

    Args:
        start: scene, stage and numbers.
        width, layers, skip: see ``fields.template.Trunk``.
        position_frequencies, time_frequencies, direction_frequencies: octaves of the encodings.
        density: ``relu`` as published, with which some seeds start dead, or ``softplus``.
        samples, fine_samples, open_end: see ``Quadrature``.
        inside_box: treat space outside the scene's box as empty, to save samples; not as published.
    """

    terms = ("photo",)

    def __init__(
        self,
        start: Start,
        *,
        width: int = 256,
        layers: int = 8,
        skip: int | None = 6,
        position_frequencies: int = 10,
        time_frequencies: int = 4,
        direction_frequencies: int = 4,
        density: str = "relu",
        samples: int = 64,
        fine_samples: int = 128,
        open_end: bool = True,
        inside_box: bool = False,
    ) -> None:
        super().__init__()
        self.frequencies = position_frequencies, time_frequencies, direction_frequencies
        if min(self.frequencies) < 0:
            raise ValueError(f"model: expected frequencies >= 0, but got {self.frequencies}")
        position, time, direction = (
            d * (1 + 2 * f) for d, f in zip((3, 1, 3), self.frequencies, strict=True)
        )
        self.network = Template(position + time, direction, width=width, layers=layers, skip=skip)
        self.activation, self.density_name = density_of(density), density
        self.quadrature = Quadrature(samples, fine_samples, open_end, start.scene.box if inside_box else None)
        self._blank_steps = 0

    def at(self, moment: Moment) -> TNeRFSnapshot:
        """Fix the time; compute nothing yet."""
        return TNeRFSnapshot(moment, self)

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method.look``; a batch holds one time, as no neighbours are asked for.

        Raises:
            ValueError: if the density is 0 everywhere for many steps, as it then has no gradient.
        """
        rays, rgb, background = batch.joined()
        seen = self.at(batch.observations[0].moment).sampled(rays.to(self.device), background, generator)
        self._refuse_a_dead_start(seen.density)
        error = (seen.rgb - rgb).square().mean()
        return Step(
            {"photo": lambda: error},
            error.detach(),
            {"samples": seen.depths.numel(), "opacity": float(seen.opacity.detach().mean())},
            tensors=lambda: ((name, getattr(seen, name)) for name in ("density", "weights", "rgb")),
        )

    def _refuse_a_dead_start(self, density: Tensor) -> None:
        blank = density.numel() > 0 and not bool((density > 0).any())
        self._blank_steps = self._blank_steps + 1 if blank else 0
        if self._blank_steps >= _PATIENCE:
            raise ValueError(
                f"model.density: expected matter somewhere, but got a density of 0 at every sample of "
                f"{_PATIENCE} steps, which {self.density_name} never leaves: a dead start; "
                "set another seed=N, or model.density=softplus"
            )

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make Adam with the published betas."""
        return torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-8, fused=True)

    def protocol(self) -> dict[str, str]:
        """List the departures from the paper, whose code was never released."""
        notes = ["pixel centres at +0.5", "near and far along unit rays", "no centre crop at first"]
        if self.density_name != "relu":
            notes.append(f"{self.density_name} density")
        if not self.quadrature.open_end:
            notes.append("the last interval ends with the ray")
        if self.quadrature.box is not None:
            notes.append("empty outside the scene's box")
        return {"departures": "; ".join(notes)}


@dataclass(frozen=True)
class TNeRFSnapshot(Snapshot):
    """A T-NeRF at one time. An image costs the same at every time: all its samples."""

    moment: Moment
    method: TNeRF

    def density(self, points: Tensor) -> Tensor:
        """World points (..., 3) -> density (...,), per world unit."""
        method = self.method
        return method.activation(method.network.density(self._encoded(points)))

    def radiance(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """World points (R, S, 3) and unit directions (R, 3) -> density (R, S) and colour (R, S, 3)."""
        method = self.method
        towards = positional_encoding(directions, method.frequencies[2])
        towards = towards[:, None].expand(*points.shape[:2], -1)
        raw, color = method.network(self._encoded(points), towards)
        return method.activation(raw), color

    def sampled(self, rays: Rays, background: Tensor, generator: torch.Generator | None = None) -> Sampled:
        """Render rays; also return what lies along them."""
        return self.method.quadrature(self.density, self.radiance, rays, background, generator)

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot.render``; without gradients in chunks of rays, for images of any size."""
        rays = view.rays().to(self.method.device)
        background = background.to(rays.origins)
        if torch.is_grad_enabled():
            return self.sampled(rays, background)
        return self.method.quadrature.picture(self.density, self.radiance, rays, background)

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time; the camera does not matter."""
        return moment.time == self.moment.time

    def _encoded(self, points: Tensor) -> Tensor:
        """Encode world points and the time for the trunk (..., I)."""
        position, time, _ = self.method.frequencies
        moment = positional_encoding(points.new_tensor([self.moment.time]), time)
        return torch.cat([positional_encoding(points, position), moment.expand(*points.shape[:-1], -1)], -1)
