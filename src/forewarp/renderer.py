"""Volume rendering of a field at one time."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from forewarp.ops.composite import accumulate, render_weights
from forewarp.ops.march import march
from forewarp.scene.rays import Rays
from forewarp.scene.state import FieldAtTime, Rendering


class Renderer:
    """Marches rays through the occupied cells and composites what they meet.

    Args:
        step: between samples, in voxels of the rendered lattice.
        color_threshold: samples of less weight have no colour computed; 0 for all.
    """

    def __init__(self, *, step: float = 0.5, color_threshold: float = 1e-4) -> None:
        if not step > 0 or not 0 <= color_threshold < 1:
            raise ValueError(
                "renderer: expected step > 0 and 0 <= color_threshold < 1, "
                f"but got {step=}, {color_threshold=}"
            )
        self.step, self.color_threshold = step, color_threshold

    def with_threshold(self, color_threshold: float | None) -> Renderer:
        """The same renderer with another ``color_threshold``; None: this one."""
        return self if color_threshold is None else Renderer(step=self.step, color_threshold=color_threshold)

    def __call__(
        self,
        field: FieldAtTime,
        rays: Rays,
        background: Tensor,
        view: Callable[[Tensor, Tensor], Tensor] | None = None,
        generator: torch.Generator | None = None,
        keep_all_weights: bool = False,
    ) -> Rendering:
        """Render rays.

        Args:
            field: density and features at one time.
            rays: R of them.
            background: (3,) or (R, 3), behind everything.
            view: features (S, C) and directions (S, 3) to colour (S, 3); None: the first 3 features are it.
            generator: jitters the samples by up to one step; None: the middle of each step.
            keep_all_weights: also return the weights of every sample (P,).
        """
        count, step = len(rays), self.step * field.lattice.pitch
        ray_ids, distances, points = self._samples(field, rays, step, generator)
        weights, transmittance = render_weights(field.density(points) * step, ray_ids, count)
        kept = slice(None)
        if self.color_threshold > 0:
            kept = (weights.detach() > self.color_threshold).nonzero()[:, 0]
        some_weights, some_rays = weights[kept], ray_ids[kept]
        features = field.features(points[kept])
        colors = (
            torch.sigmoid(features[:, :3]) if view is None else view(features, rays.directions[some_rays])
        )
        rgb = accumulate(some_weights, colors, some_rays, count) + transmittance[:, None] * background
        opacity = 1 - transmittance
        depth = accumulate(weights, distances[:, None], ray_ids, count)[:, 0] / opacity.clamp(min=1e-6)
        return Rendering(
            rgb=rgb,
            depth=depth,
            opacity=opacity,
            transmittance=transmittance,
            weights=some_weights,
            colors=colors,
            ray_ids=some_rays,
            samples=len(ray_ids),
            all_weights=weights if keep_all_weights else None,
        )

    @staticmethod
    def _samples(
        field: FieldAtTime, rays: Rays, step: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Ray (P,), distance (P,) and lattice coordinates (P, 3) of every sample."""
        lattice, count = field.lattice, len(rays)
        spacing = rays.origins.new_tensor(lattice.spacing)
        origins, directions = lattice.to_lattice(rays.origins), rays.directions / spacing
        jitter = torch.full((count,), 0.5) if generator is None else torch.rand(count, generator=generator)
        jitter = jitter.to(origins)
        ray_ids, distances = march(origins, directions, rays.near, rays.far, step, field.cells, jitter)
        return ray_ids, distances, origins[ray_ids] + distances[:, None] * directions[ray_ids]
