"""Volume rendering at one time: of a voxel field by marching rays, of a network by quadrature along them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import accumulate as accumulated

import torch
from torch import Tensor

from forewarp.fields.grids import EMPTY, FieldAtTime, RadianceGrid, Shade
from forewarp.ops.backend import use_numba
from forewarp.ops.march import (
    Traced,
    accumulate,
    by_importance,
    clip_to_box,
    dense_weights,
    march,
    midpoints,
    render_weights,
    stratified,
    trace,
    union,
)
from forewarp.scene.box import Box
from forewarp.scene.camera import Rays
from forewarp.scene.view import Rendering

_RAYS = 1 << 16  # of an image, marched at once


@dataclass(frozen=True)
class Marched(Rendering):
    """A rendering, with the samples along its rays.

    Attributes:
        transmittance: (R,), what is left of a ray behind everything.
        weights, colors, ray_ids: (S,), (S, 3), (S,), of the samples heavy enough to have a colour.
        samples: number of samples whose density was read.
        all_weights, all_ray_ids: (P,), of all samples, if asked for.
    """

    transmittance: Tensor
    weights: Tensor
    colors: Tensor
    ray_ids: Tensor
    samples: int = 0
    all_weights: Tensor | None = field(default=None, repr=False)
    all_ray_ids: Tensor | None = field(default=None, repr=False)

    @staticmethod
    def joined(parts: Sequence[Marched]) -> Marched:
        """See ``Rendering``; without the weights of all samples."""
        if len(parts) == 1:
            return parts[0]
        begins = accumulated((len(part.rgb) for part in parts), initial=0)
        names = ("rgb", "depth", "opacity", "transmittance", "weights", "colors")
        columns = (torch.cat([getattr(part, name) for part in parts]) for name in names)
        ray_ids = torch.cat([part.ray_ids + begin for part, begin in zip(parts, begins)])
        return Marched(*columns, ray_ids, sum(part.samples for part in parts))


@torch.no_grad()
def in_chunks(render: Callable[[slice], Rendering], count: int, chunk: int) -> Rendering:
    """Join the renderings of so many rays, ``chunk`` at a time."""
    return Rendering.joined([render(slice(begin, begin + chunk)) for begin in range(0, count, chunk)])


@dataclass(eq=False, kw_only=True)
class Renderer:
    """March rays through occupied cells and composite the samples.

    ``w_k = T_k (1 - exp(-sigma_k delta))``, ``T_k = exp(-sum_{j<k} sigma_j delta)``,
    ``C = sum_k w_k c_k + T_end background``.

    Args:
        step: distance between samples, in voxels of the field (of the finest, if it has several).
        color_threshold: compute no colour for samples of less weight; 0: compute all.
        early_stop_eps: end a ray once its transmittance is below this, in images (rendered without gradient
            by the CPU kernel); 0: never.
        trace_first: in training on the CPU, too, a pass without gradient ends rays so, and leaves samples
            fainter than ``color_threshold`` out of the other, which has the gradient.
    """

    step: float = 0.5
    color_threshold: float = 1e-4
    early_stop_eps: float = 1e-4
    trace_first: bool = False

    def __post_init__(self) -> None:
        if not self.step > 0 or not 0 <= self.color_threshold < 1 or not 0 <= self.early_stop_eps < 1:
            expected = "step > 0 and 0 <= color_threshold < 1 and 0 <= early_stop_eps < 1"
            raise ValueError(f"renderer: expected {expected}, but got {self}")

    def with_threshold(self, color_threshold: float | None) -> Renderer:
        """Return a renderer with another ``color_threshold``; this one for None."""
        return self if color_threshold is None else replace(self, color_threshold=color_threshold)

    def __call__(
        self,
        field: FieldAtTime,
        rays: Rays,
        background: Tensor,
        shade: Shade | None = None,
        generator: torch.Generator | None = None,
        keep_all_weights: bool = False,
    ) -> Marched:
        """Render R rays.

        Args:
            field: density and colour at one time; ``look_up``, where one network gives both: points (P, 3)
                -> density (P,), and a function: rows (K,) of them, directions (K, 3) -> colour (K, 3).
            rays: origins, unit directions, near and far.
            background: colour (3,) or (R, 3) behind everything.
            shade: turns features and directions into colour; None: the first 3 features are the colour.
            generator: shifts each ray's samples by up to one step; None: sample the middle of each step.
            keep_all_weights: also return the weights and rays of all samples.

        Returns:
            colour, depth and opacity, differentiable in the field, with the samples. Depth is the mean
            distance of what is met, 0 where nothing is.
        """
        plain = type(field) is RadianceGrid and not keep_all_weights and use_numba(field.values)
        if plain and not torch.is_grad_enabled():
            return self._traced(field, rays, background, shade, generator)
        count, step = len(rays), self.step * field.voxel_size
        origins, directions, jitter = starts = self._starts(field, rays, generator)
        traced = plain and self.trace_first and self.color_threshold > 0
        if traced:
            found = self._trace(field, rays, *starts)
            ray_ids, distances, samples = found.ray_ids, found.distances, found.samples
        else:
            ray_ids, distances = march(origins, directions, rays.near, rays.far, step, field.cells, jitter)
            samples = len(ray_ids)
        points = origins[ray_ids] + distances[:, None] * directions[ray_ids]
        if traced:
            density, color_of = field.read(points, shade)
        elif hasattr(field, "look_up"):
            density, color_of = field.look_up(points)
        else:
            density, color_of = field.density(points), None
        weights, transmittance = render_weights(density * step, ray_ids, count)
        kept = slice(None)
        if self.color_threshold > 0 and not traced:
            kept = (weights.detach() > self.color_threshold).nonzero()[:, 0]
        some_weights, some_rays = weights[kept], ray_ids[kept]
        towards = rays.directions[some_rays]
        colors = color_of(kept, towards) if color_of else field.colors(points[kept], towards, shade)
        rgb = accumulate(some_weights, colors, some_rays, count) + transmittance[:, None] * background
        # Not 1 - transmittance: it rounds to 0 for thin matter, and depth would leave [near, far].
        moments = torch.stack([torch.ones_like(distances), distances], -1)
        opacity, depth = accumulate(weights, moments, ray_ids, count).unbind(-1)
        opacity = opacity.clamp(max=1)
        depth = depth / opacity.clamp(min=1e-6)
        every = (weights, ray_ids) if keep_all_weights else (None, None)
        found = rgb, depth, opacity, transmittance, some_weights, colors, some_rays
        return Marched(*found, samples, *every)

    def _traced(self, grid: RadianceGrid, rays: Rays, background: Tensor, shade, generator) -> Marched:
        """Render without gradient by one kernel, equal within ``early_stop_eps``: skip what is hidden."""
        origins, directions, jitter = self._starts(grid, rays, generator)
        found = self._trace(grid, rays, origins, directions, jitter)
        ray_ids, weights = found.ray_ids, found.weights
        points = origins[ray_ids] + found.distances[:, None] * directions[ray_ids]
        colors = grid.colors(points, rays.directions[ray_ids], shade)
        opacity, through = found.opacity.clamp(max=1), found.transmittance
        rgb = accumulate(weights, colors, ray_ids, len(rays)) + through[:, None] * background
        depth = found.distance / opacity.clamp(min=1e-6)
        return Marched(rgb, depth, opacity, through, weights, colors, ray_ids, found.samples)

    def _trace(
        self, grid: RadianceGrid, rays: Rays, origins: Tensor, directions: Tensor, jitter: Tensor
    ) -> Traced:
        """Find, without gradient, the samples that are neither hidden nor faint."""
        step, activation = self.step * grid.voxel_size, grid.activation
        return trace(
            origins, directions, rays.near, rays.far, step, grid.cells, jitter,
            raw=grid.raw_density.detach(), index=grid.index, fill=EMPTY, shift=activation.shift,
            scale=step / activation.density_scale, early_stop_eps=self.early_stop_eps,
            threshold=self.color_threshold or -1.0,  # 0 keeps all samples, even those of weight 0
        )  # fmt: skip

    def image(
        self, field: FieldAtTime, rays: Rays, background: Tensor, shade: Shade | None = None
    ) -> Rendering:
        """Render an image's rays without gradient. Cost: time linear in the rays, memory bounded."""
        return in_chunks(lambda part: self(field, rays[part], background, shade), len(rays), _RAYS)

    @staticmethod
    def _starts(
        field: FieldAtTime, rays: Rays, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Origins and directions (R, 3) in lattice coordinates, and the jitter (R,) of the samples."""
        lattice, count = field.lattice, len(rays)
        spacing = rays.origins.new_tensor(lattice.spacing)
        origins, directions = lattice.to_lattice(rays.origins), rays.directions / spacing
        jitter = torch.full((count,), 0.5) if generator is None else torch.rand(count, generator=generator)
        return origins, directions, jitter.to(origins)


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
            got = f"samples={self.samples}, fine_samples={self.fine_samples}"
            raise ValueError(f"model.sampling: expected samples >= 3 and fine_samples >= 0, but got {got}")

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
        depth, opacity = (nothing.index_copy(0, met, part) for part in (seen.depth, seen.opacity))
        return replace(seen, rgb=behind.index_copy(0, met, seen.rgb), depth=depth, opacity=opacity)

    def image(
        self,
        density: Density,
        radiance: Radiance,
        rays: Rays,
        background: Tensor,
        generator: torch.Generator | None = None,
    ) -> Rendering:
        """Render an image's rays without gradient. Cost: time linear in the rays, memory bounded."""
        chunk = max(1, _POINTS // (self.samples + self.fine_samples))
        behind, fields = background.expand(len(rays), 3), (density, radiance)
        return in_chunks(lambda part: self(*fields, rays[part], behind[part], generator), len(rays), chunk)

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
    mask = kept.reshape(*kept.shape, *[1] * (values.dim() - 1))
    return values.new_zeros(*kept.shape, *values.shape[1:]).masked_scatter(mask, values)


def _points(rays: Rays, depths: Tensor) -> Tensor:
    """Return the world points (R, S, 3) at distances (R, S) along rays."""
    return rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
