"""Particles at a moment."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.methods.method import Snapshot
from forewarp.methods.particles.camera import Pinholes
from forewarp.ops.gaussians import Gaussians, Warp, project, rasterize
from forewarp.scene.view import Moment, Rendering, View

_NOTHING = 1e-6  # opacity below which a pixel has no depth


class ParticlesSnapshot(Snapshot):
    """Canonical ``gaussians``, the ``warp`` of a moment, and what time makes of colour and opacity."""

    def __init__(
        self,
        moment: Moment,
        gaussians: Gaussians,
        warp: Warp,
        tints: Tensor,
        fades: Tensor,
        pinholes: Pinholes,
    ) -> None:
        self.moment = moment
        self.gaussians, self.warp, self.tints, self.fades = gaussians, warp, tints, fades
        self.pinholes = pinholes

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot``. Single pixels and crops are taken from the whole picture, which costs little."""
        pinhole = self.pinholes(view.camera)
        splats = project(self.gaussians, self.warp, pinhole, self.tints, self.fades)
        color, far, through = rasterize(splats, *pinhole.size)
        color, far, through = color.reshape(3, -1).T, far.reshape(-1), through.reshape(-1)
        if view.indices is not None:
            rows = view.indices.to(color.device)
            color, far, through = color[rows], far[rows], through[rows]
        opacity = 1 - through
        depth = torch.where(opacity > _NOTHING, far / opacity.clamp(min=_NOTHING), 0.0)
        return Rendering(color + through[:, None] * background.to(color), depth, opacity)

    def holds(self, moment: Moment) -> bool:
        """Tell whether it is the same time; which camera looks does not matter."""
        return moment.time == self.moment.time
