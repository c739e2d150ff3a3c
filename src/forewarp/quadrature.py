"""Volume rendering of a network: samples along the whole ray, then more of them where matter was found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.ops.composite import dense_weights
from forewarp.ops.samples import by_importance, clip_to_box, midpoints, stratified, union
from forewarp.scene.box import Box
from forewarp.scene.rays import Rays
from forewarp.scene.view import Rendering

# Points (R, S, 3) -> density (R, S) >= 0 per world unit.
Density = Callable[[Tensor], Tensor]
# Points (R, S, 3) and unit directions (R, 3) -> density (R, S) and colour (R, S, 3).
Radiance = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
_FAR = 1e10  # the published length of the last interval
_POINTS = 1 << 17  # evaluated at once for an image


@dataclass(frozen=True)
class Sampled(Rendering):
    """A rendering, with ``depths``, ``density`` and ``weights`` (K, S) along the K rays that meet the box."""

    depths: Tensor
    density: Tensor
    weights: Tensor


@dataclass(frozen=True)
class Quadrature:
    """Place samples on rays, evaluate a network there, and composite (NeRF's quadrature).

    Args:
        samples: samples of the first pass, at least 3.
        fine_samples: added by the second pass where the first found weight; 0: one pass only.
        open_end: give the last sample an endless interval, as published. A density that is never 0 (softplus)
            then hides the background. False: end the interval with the ray.
        box: treat space outside as empty, without evaluating it; None: evaluate all from near to far.
    """

    samples: int = 64
    fine_samples: int = 128
    open_end: bool = True
    box: Box | None = None

    def __post_init__(self) -> None:
        if self.samples < 3 or self.fine_samples < 0:
            raise ValueError(
                "model.samples: expected samples >= 3 and fine_samples >= 0, but got "
                f"samples={self.samples}, fine_samples={self.fine_samples}"
            )

    def __call__(
        self,
        density: Density,
        radiance: Radiance,
        rays: Rays,
        background: Tensor,
        generator: torch.Generator | None = None,
    ) -> Sampled:
        """Render R rays.

        Args:
            density: evaluated by the first pass, without gradient.
            radiance: evaluated by the second pass, at the samples of both passes.
            rays: origins, unit directions, near and far.
            background: colour (3,) or (R, 3) behind everything.
            generator: jitters the samples; None: place them evenly.
        """
        near, far = self._stretch(rays)
        met = (far > near).nonzero()[:, 0]
        inner, far = rays[met], far[met]
        depths = stratified(near[met], far, self.samples, generator)
        if self.fine_samples:
            depths = self.refined(density, inner, depths, far, generator)
        behind = background.to(rays.origins).expand(len(rays), 3)
        seen = self.composite(radiance, inner, depths, far, behind[met])
        if len(met) == len(rays):
            return seen
        nothing = behind.new_zeros(len(rays))
        return Sampled(
            behind.index_copy(0, met, seen.rgb),
            nothing.index_copy(0, met, seen.depth),
            nothing.index_copy(0, met, seen.opacity),
            seen.depths,
            seen.density,
            seen.weights,
        )

    @torch.no_grad()
    def refined(
        self, density: Density, rays: Rays, depths: Tensor, far: Tensor, generator: torch.Generator | None
    ) -> Tensor:
        """Add F samples to ``depths`` (R, S) where density is found, (R, S + F); no gradient passes."""
        weights, _ = dense_weights(density(_points(rays, depths)) * self._intervals(depths, far))
        more = by_importance(midpoints(depths), weights[:, 1:-1], self.fine_samples, generator)
        return union(depths, more)

    def composite(
        self, radiance: Radiance, rays: Rays, depths: Tensor, far: Tensor, background: Tensor
    ) -> Sampled:
        """Composite the samples at ``depths`` (R, S) of rays that end at ``far`` (R,)."""
        density, color = radiance(_points(rays, depths), rays.directions)
        weights, through = dense_weights(density * self._intervals(depths, far))
        rgb = (weights[..., None] * color).sum(1) + through[:, None] * background
        opacity = weights.sum(1).clamp(max=1)
        depth = (weights * depths).sum(1) / opacity.clamp(min=1e-6)
        return Sampled(rgb, depth, opacity, depths, density, weights)

    @torch.no_grad()
    def picture(self, density: Density, radiance: Radiance, rays: Rays, background: Tensor) -> Rendering:
        """Render an image's rays without gradient. Cost: time linear in the rays, memory bounded."""
        chunk = max(1, _POINTS // (self.samples + self.fine_samples))
        behind = background.expand(len(rays), 3)
        parts = [
            self(density, radiance, rays[begin : begin + chunk], behind[begin : begin + chunk])
            for begin in range(0, len(rays), chunk)
        ]
        return Rendering(
            *(torch.cat([getattr(p, key) for p in parts]) for key in ("rgb", "depth", "opacity"))
        )

    def _stretch(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return where each ray starts and ends, (R,) each."""
        if self.box is None:
            return tuple(rays.origins.new_full((len(rays),), end) for end in (rays.near, rays.far))
        corners = (rays.origins.new_tensor(corner) for corner in (self.box.low, self.box.high))
        return clip_to_box(rays.origins, rays.directions, rays.near, rays.far, *corners)

    def _intervals(self, depths: Tensor, far: Tensor) -> Tensor:
        """Return the length (R, S) of each sample's interval: up to the next sample."""
        last = torch.full_like(far, _FAR) if self.open_end else (far - depths[:, -1]).clamp(min=0)
        return torch.cat([depths[:, 1:] - depths[:, :-1], last[:, None]], 1)


def _points(rays: Rays, depths: Tensor) -> Tensor:
    """Return the world points (R, S, 3) at distances (R, S) along rays."""
    return rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
