"""A voxel method at one time: what it computed, and how it is rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.fields.radiance_grid import FieldAtTime, RadianceGrid, Shade, mean_color
from forewarp.methods.method import Snapshot
from forewarp.renderer import Renderer
from forewarp.scene.box import Lattice
from forewarp.scene.camera import Rays
from forewarp.scene.view import Moment, Rendering, View

_NOTHING = 1e-3  # opacity over a voxel below which no colour is computed


@dataclass(frozen=True)
class VoxelSnapshot(Snapshot):
    """Everything a voxel method computed at one time; None for what it does not have.

    Attributes:
        moment: the snapshot's moment.
        fields: what is rendered, by name, the best last: ``warped`` or ``upsampled``, then ``inpainted``;
            ``backward`` alone for backward warping.
        canonical: the canonical grid.
        renderer, shade: how fields are rendered.
        flow: (N, 3), from each canonical voxel to the moment, world units.
        coverage: (M,), summed splat weight of each warped voxel.
        dropped: number of canonical voxels that left the box.
        inpaint_difference: what the inpainter adds.
        background: the static grid.
        length: the losses divide flow by it, so that their weights do not depend on the scene's scale: a
            third of the scene's longest side, in world units.
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
        """Names of the fields."""
        return tuple(self.fields)

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot.render``; without gradients in chunks of rays, for images of any size."""
        field = self.fields[rendering or self.renderings[-1]]
        rays = view.rays().to(self.canonical.values.device)
        draw = self.renderer if torch.is_grad_enabled() else self.renderer.picture
        return draw(field, rays, background.to(rays.origins), self.shade)

    def march(self, name: str, rays: Rays, background: Tensor, **options):
        """Render one field along any rays; also return the samples."""
        return self.renderer(self.fields[name], rays, background, self.shade, **options)

    @torch.no_grad()
    def solid(self, lattice: Lattice, chunk: int = 1 << 18) -> tuple[Tensor, Tensor]:
        """See ``HasSolid``: the opacity over one voxel, of the best rendering's field."""
        field = self.fields[self.renderings[-1]]
        voxels, last = lattice.all_voxels(), torch.tensor(field.lattice.shape) - 1
        opacity, colors = torch.zeros(len(voxels)), torch.zeros(len(voxels), 3)
        for begin in range(0, len(voxels), chunk):
            points = field.lattice.to_lattice(lattice.to_world(voxels[begin : begin + chunk]))
            inside = ((points >= 0) & (points <= last)).all(-1).nonzero()[:, 0]
            points = points[inside].to(self.canonical.values)
            alpha = -torch.expm1(-field.density(points) * field.voxel_size)
            some = (alpha > _NOTHING).nonzero()[:, 0]
            rows = begin + inside[some.cpu()]
            seen = points[some]
            opacity[rows] = alpha[some].cpu()
            colors[rows] = mean_color(lambda d, p=seen: field.colors(p, d, self.shade), seen).cpu()
        return opacity.reshape(lattice.shape), colors.reshape(*lattice.shape, 3)

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time; the camera does not matter."""
        return moment.time == self.moment.time
