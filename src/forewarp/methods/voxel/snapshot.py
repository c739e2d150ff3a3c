"""What a voxel method computed at one time, and the pictures of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.fields.radiance_grid import FieldAtTime, RadianceGrid, Shade
from forewarp.methods.method import Snapshot
from forewarp.renderer import Renderer
from forewarp.scene.rays import Rays
from forewarp.scene.view import Moment, Rendering, View


@dataclass(frozen=True)
class VoxelSnapshot(Snapshot):
    """Everything a voxel method computed at one time.

    ``fields`` are what is rendered, by name, the best last: ``warped`` or ``upsampled``, then ``inpainted``;
    ``backward`` of the opponent;
    ``flow`` (N, 3) world units from canonical to the moment on the canonical ``index``; ``coverage`` (M,) of
    the warped voxels; ``dropped`` source voxels that left the box; ``background`` all that stands still. None
    where a method has no such thing. ``length`` is what the loss measures flow in, world units: a third of
    the scene's longest side, 1 for the usual box of 3, so that no weight depends on the scene's units.
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
        """The fields' names."""
        return tuple(self.fields)

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot``; without gradients in chunks of rays, so that a picture may be of any size."""
        field = self.fields[rendering or self.renderings[-1]]
        rays = view.rays().to(self.canonical.values.device)
        draw = self.renderer if torch.is_grad_enabled() else self.renderer.picture
        return draw(field, rays, background.to(rays.origins), self.shade)

    def march(self, name: str, rays: Rays, background: Tensor, **options):
        """Render one field along any rays, with what lies along them."""
        return self.renderer(self.fields[name], rays, background, self.shade, **options)

    def holds(self, moment: Moment) -> bool:
        """Tell whether it is the same time; which camera looks does not matter."""
        return moment.time == self.moment.time
