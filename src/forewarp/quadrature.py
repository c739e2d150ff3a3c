"""Volume rendering of a network: samples along the whole ray, then more of them where matter was found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from forewarp.ops.march import by_importance, clip_to_box, dense_weights, midpoints, stratified, union
from forewarp.scene.box import Box
from forewarp.scene.camera import Rays
from forewarp.scene.view import Rendering

# Points (..., 3) -> density (...,) >= 0 per world unit.
Density = Callable[[Tensor], Tensor]
# Points (..., 3) and unit directions that broadcast to them -> density (...,) and colour (..., 3).
Radiance = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
_FAR = 1e10  # the published length of the last interval
_POINTS = 1 << 17  # evaluated at once for an image
_PROBES = 64  # points of a ray that tell where kept ones begin and end


@dataclass(frozen=True)
class Sampled(Rendering):
    """A rendering, with ``depths``, ``density``, ``weights`` (K, S) and ``points`` (K, S, 3) along the K rays
    that meet the box, and what the first pass saw, where it has a gradient too (``coarse``). Its depth and
    opacity leave out a last sample without end.
    """

    depths: Tensor
    points: Tensor
    density: Tensor
    weights: Tensor
    coarse: Sampled | None = None

    @staticmethod
    def joined(parts: Sequence[Sampled]) -> Sampled:
        """See ``Rendering``."""
        if len(parts) == 1:
            return parts[0]
        coarse = None if parts[0].coarse is None else Sampled.joined([part.coarse for part in parts])
        names = [field.name for field in fields(Sampled) if field.name != "coarse"]
        return Sampled(*(torch.cat([getattr(part, name) for part in parts]) for name in names), coarse=coarse)


@dataclass(frozen=True)
class Quadrature:
    """Place samples on rays, evaluate a network there, and composite (NeRF's quadrature).

    Args:
        samples: samples of the first pass, at least 3.
        fine_samples: added by the second pass where the first found weight; 0: one pass only.
        open_end: give the last sample an endless interval, as published. A density that is never 0 (softplus)
            then hides the background. False: end the interval with the ray.
        box: treat space outside as empty, without evaluating it; None: evaluate all from near to far.
        kept: points (..., 3) -> bool (...,): treat all other points as empty, without evaluating them, and
            place samples between the first and the last kept point of a ray; with a box.
    """

    samples: int = 64
    fine_samples: int = 128
    open_end: bool = True
    box: Box | None = None
    kept: Callable[[Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        if self.samples < 3 or self.fine_samples < 0:
            raise ValueError(
                "model.sampling: expected samples >= 3 and fine_samples >= 0, but got "
                f"samples={self.samples}, fine_samples={self.fine_samples}"
            )

    def __call__(
        self,
        density: Density,
        radiance: Radiance,
        rays: Rays,
        background: Tensor,
        generator: torch.Generator | None = None,
        *,
        coarse: Radiance | None = None,
    ) -> Sampled:
        """Render R rays.

        Args:
            density: evaluated by the first pass, without gradient.
            radiance: evaluated by the second pass, at the samples of both passes.
            rays: origins, unit directions, near and far.
            background: colour (3,) or (R, 3) behind everything.
            generator: jitters the samples; None: place them evenly.
            coarse: evaluated by the first pass in place of ``density``, and rendered with a gradient.
        """
        near, far = self._stretch(rays)
        met = (far > near).nonzero()[:, 0]
        inner, far = rays[met], far[met]
        depths = stratified(near[met], far, self.samples, generator)
        behind = background.to(rays.origins).expand(len(rays), 3)
        first = None if coarse is None else self.composite(coarse, inner, depths, far, behind[met])
        if self.fine_samples:
            found = self._found(density, inner, depths, far) if first is None else first.weights.detach()
            more = by_importance(midpoints(depths), found[:, 1:-1], self.fine_samples, generator)
            depths = union(depths, more)
        seen = self.composite(radiance, inner, depths, far, behind[met])
        whole = [one and self._whole(one, met, behind) for one in (first, seen)]
        return replace(whole[1], coarse=whole[0])

    @torch.no_grad()
    def _found(self, density: Density, rays: Rays, depths: Tensor, far: Tensor) -> Tensor:
        """Return the weights (R, S) of the samples of the first pass."""
        points = _points(rays, depths)
        kept = None if self.kept is None else self.kept(points)
        found = density(points) if kept is None else _placed(kept, density(points[kept]))
        return dense_weights(found * self._intervals(depths, far))[0]

    def composite(
        self, radiance: Radiance, rays: Rays, depths: Tensor, far: Tensor, background: Tensor
    ) -> Sampled:
        """Composite the samples at ``depths`` (R, S) of rays that end at ``far`` (R,)."""
        points, towards = _points(rays, depths), rays.directions[:, None]
        kept = None if self.kept is None else self.kept(points)
        if kept is None:
            density, color = radiance(points, towards)
        else:
            only = radiance(points[kept], towards.expand_as(points)[kept])
            density, color = (_placed(kept, part) for part in only)
        weights, through = dense_weights(density * self._intervals(depths, far))
        rgb = (weights[..., None] * color).sum(1) + through[:, None] * background
        ended = weights[:, :-1] if self.open_end else weights
        opacity = ended.sum(1).clamp(max=1)
        depth = (ended * depths[:, : ended.shape[1]]).sum(1) / opacity.clamp(min=1e-6)
        return Sampled(rgb, depth, opacity, depths, points, density, weights)

    @staticmethod
    def _whole(seen: Sampled, met: Tensor, behind: Tensor) -> Sampled:
        """Add the rays that miss the box: they see what is behind (R, 3)."""
        if len(met) == len(behind):
            return seen
        nothing = behind.new_zeros(len(behind))
        return replace(
            seen,
            rgb=behind.index_copy(0, met, seen.rgb),
            depth=nothing.index_copy(0, met, seen.depth),
            opacity=nothing.index_copy(0, met, seen.opacity),
        )

    @torch.no_grad()
    def picture(
        self,
        density: Density,
        radiance: Radiance,
        rays: Rays,
        background: Tensor,
        generator: torch.Generator | None = None,
    ) -> Rendering:
        """Render an image's rays without gradient. Cost: time linear in the rays, memory bounded."""
        chunk = max(1, _POINTS // (self.samples + self.fine_samples))
        behind = background.expand(len(rays), 3)
        parts = [
            self(density, radiance, rays[begin : begin + chunk], behind[begin : begin + chunk], generator)
            for begin in range(0, len(rays), chunk)
        ]
        return Rendering.joined(parts)

    def _stretch(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return where each ray starts and ends, (R,) each."""
        if self.box is None:
            return tuple(rays.origins.new_full((len(rays),), end) for end in (rays.near, rays.far))
        corners = (rays.origins.new_tensor(corner) for corner in (self.box.low, self.box.high))
        ends = clip_to_box(rays.origins, rays.directions, rays.near, rays.far, *corners)
        return ends if self.kept is None else self._narrowed(rays, *ends)

    def _narrowed(self, rays: Rays, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Leave out what lies before the first and behind the last kept point; far <= near: there is none."""
        step = (far - near).clamp(min=0) / (_PROBES - 1)
        numbers = torch.arange(_PROBES, device=near.device)
        kept = self.kept(_points(rays, near[:, None] + step[:, None] * numbers))
        first = torch.where(kept, numbers, _PROBES).amin(1)
        last = torch.where(kept, numbers, -1).amax(1)
        return near + (first - 1).clamp(min=0) * step, near + (last + 1).clamp(max=_PROBES - 1) * step

    def _intervals(self, depths: Tensor, far: Tensor) -> Tensor:
        """Return the length (R, S) of each sample's interval: up to the next sample."""
        last = torch.full_like(far, _FAR) if self.open_end else (far - depths[:, -1]).clamp(min=0)
        return torch.cat([depths[:, 1:] - depths[:, :-1], last[:, None]], 1)


def _placed(kept: Tensor, values: Tensor) -> Tensor:
    """Put values (P, ...) of the kept samples where they are in (R, S, ...), 0 elsewhere."""
    return values.new_zeros(*kept.shape, *values.shape[1:]).masked_scatter(
        kept.reshape(*kept.shape, *[1] * (values.dim() - 1)), values
    )


def _points(rays: Rays, depths: Tensor) -> Tensor:
    """Return the world points (R, S, 3) at distances (R, S) along rays."""
    return rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
