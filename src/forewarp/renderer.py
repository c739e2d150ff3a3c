"""Volume rendering of a voxel field at one time: march rays, composite what they meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate as accumulated

import torch
from torch import Tensor

from forewarp.fields.grids import EMPTY, FieldAtTime, RadianceGrid, Shade
from forewarp.ops.backend import use_numba
from forewarp.ops.march import accumulate, march, render_weights, trace
from forewarp.scene.camera import Rays
from forewarp.scene.view import Rendering


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
        return Marched(
            **{name: torch.cat([getattr(part, name) for part in parts]) for name in names},
            ray_ids=torch.cat([part.ray_ids + begin for part, begin in zip(parts, begins)]),
            samples=sum(part.samples for part in parts),
        )


class Renderer:
    """March rays through occupied cells and composite the samples.

    ``w_k = T_k (1 - exp(-sigma_k delta))``, ``T_k = exp(-sum_{j<k} sigma_j delta)``,
    ``C = sum_k w_k c_k + T_end background``.

    Args:
        step: distance between samples, in voxels of the field (of the finest, if it has several).
        color_threshold: compute no colour for samples of less weight; 0: compute all.
        early_stop_eps: end a ray once its transmittance is below this, in images (rendered without gradient
            by the CPU kernel); 0: never.
    """

    def __init__(
        self, *, step: float = 0.5, color_threshold: float = 1e-4, early_stop_eps: float = 1e-4
    ) -> None:
        if not step > 0 or not 0 <= color_threshold < 1 or not 0 <= early_stop_eps < 1:
            raise ValueError(
                "renderer: expected step > 0 and 0 <= color_threshold < 1 and 0 <= early_stop_eps < 1, "
                f"but got {step=}, {color_threshold=}, {early_stop_eps=}"
            )
        self.step, self.color_threshold, self.early_stop_eps = step, color_threshold, early_stop_eps

    def with_threshold(self, color_threshold: float | None) -> Renderer:
        """Return a renderer with another ``color_threshold``; this one for None."""
        if color_threshold is None:
            return self
        return Renderer(step=self.step, color_threshold=color_threshold, early_stop_eps=self.early_stop_eps)

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
        plain = type(field) is RadianceGrid and not keep_all_weights and not torch.is_grad_enabled()
        if plain and use_numba(field.values):
            return self._traced(field, rays, background, shade, generator)
        count, step = len(rays), self.step * field.voxel_size
        ray_ids, distances, points = self._samples(field, rays, step, generator)
        at_once = hasattr(field, "look_up")
        density, color_of = field.look_up(points) if at_once else (field.density(points), None)
        weights, transmittance = render_weights(density * step, ray_ids, count)
        kept = slice(None)
        if self.color_threshold > 0:
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
        return Marched(
            rgb=rgb,
            depth=depth,
            opacity=opacity,
            transmittance=transmittance,
            weights=some_weights,
            colors=colors,
            ray_ids=some_rays,
            samples=len(ray_ids),
            all_weights=weights if keep_all_weights else None,
            all_ray_ids=ray_ids if keep_all_weights else None,
        )

    def _traced(
        self,
        grid: RadianceGrid,
        rays: Rays,
        background: Tensor,
        shade: Shade | None,
        generator: torch.Generator | None,
    ) -> Marched:
        """Render without gradient by one kernel, equal within ``early_stop_eps``: skip what is hidden."""
        step, activation = self.step * grid.voxel_size, grid.activation
        origins, directions, jitter = self._starts(grid, rays, generator)
        found = trace(
            origins,
            directions,
            rays.near,
            rays.far,
            step,
            grid.cells,
            jitter,
            raw=grid.raw_density,
            index=grid.index,
            fill=EMPTY,
            shift=activation.shift,
            scale=step / activation.density_scale,
            early_stop_eps=self.early_stop_eps,
            threshold=self.color_threshold or -1.0,  # 0 keeps all samples, even those of weight 0
        )
        ray_ids, weights = found.ray_ids, found.weights
        points = origins[ray_ids] + found.distances[:, None] * directions[ray_ids]
        colors = grid.colors(points, rays.directions[ray_ids], shade)
        opacity = found.opacity.clamp(max=1)
        return Marched(
            rgb=accumulate(weights, colors, ray_ids, len(rays)) + found.transmittance[:, None] * background,
            depth=found.distance / opacity.clamp(min=1e-6),
            opacity=opacity,
            transmittance=found.transmittance,
            weights=weights,
            colors=colors,
            ray_ids=ray_ids,
            samples=found.samples,
        )

    def picture(
        self,
        field: FieldAtTime,
        rays: Rays,
        background: Tensor,
        shade: Shade | None = None,
        chunk: int = 65536,
    ) -> Rendering:
        """Render an image's rays without gradient. Cost: time linear in the rays, memory in ``chunk``."""
        with torch.no_grad():
            parts = [
                self(field, rays[begin : begin + chunk], background, shade)
                for begin in range(0, len(rays), chunk)
            ]
        return Rendering.joined(parts)

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

    @classmethod
    def _samples(
        cls, field: FieldAtTime, rays: Rays, step: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Ray (P,), distance (P,) and lattice coordinates (P, 3) of each sample."""
        origins, directions, jitter = cls._starts(field, rays, generator)
        ray_ids, distances = march(origins, directions, rays.near, rays.far, step, field.cells, jitter)
        return ray_ids, distances, origins[ray_ids] + distances[:, None] * directions[ray_ids]
