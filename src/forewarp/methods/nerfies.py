"""Nerfies: a code for each instant bends space, by screws, to a template that all instants share."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.fields.networks import CameraCodes, Template, drawn
from forewarp.methods.method import Start
from forewarp.methods.rays import Field, Terms, WarpedMethod
from forewarp.renderer import Sampled
from forewarp.scene.view import Batch, Moment


class Nerfies(WarpedMethod):
    """``x' = T(x, code(t))``, a screw at every point; ``N(PE(x'), [PE(d), code(camera)])`` (Nerfies,
    equations 1 to 8). Two templates, coarse and fine, share the warp.

    Args:
        start: scene, stage and numbers.
        camera_code_size: channels of a camera's code; 0: no code of the camera.
        elastic_samples: of a step, most that the elastic regulariser looks at; null: all.
        shared: sampling and the sizes of networks, warp and codes: see ``WarpedMethod``.
    """

    terms = ("photo", "coarse_photo", "elastic", "still")

    def __init__(
        self, start: Start, *, camera_code_size: int = 2, elastic_samples: int | None = None, **shared
    ) -> None:
        super().__init__(start, **shared)
        cameras = {frame.camera_id for frame in start.scene.train}
        self.camera_codes = CameraCodes(cameras, camera_code_size) if camera_code_size else None
        self.sees_by_camera = self.camera_codes is not None
        position, direction = self.sizes
        condition = direction + camera_code_size
        self.coarse, self.fine = self.passes(lambda: Template(position, condition, **self.shape))
        self.register_buffer("window", torch.tensor(0.0))
        self.elastic_samples = elastic_samples

    @property
    def octaves_in(self) -> float:
        """See ``WarpedMethod``."""
        return float(self.window)

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; let octaves of the warp's encoding in."""
        octaves = self.warp.octaves(progress, self.shares["warp_in"])
        self.window.fill_(octaves)
        return {"octaves": octaves} | super().advance(progress, step, optimizer)

    def fields(self, moment: Moment) -> tuple[Field, Field]:
        """See ``SampledMethod``."""
        code, window = self.codes(moment.time), self.octaves_in

        def encoded(points: Tensor) -> Tensor:
            return self.position(self.warp(points, code, window))

        def condition(directions: Tensor) -> Tensor:
            towards = self.direction(directions)
            if self.camera_codes is None:
                return towards
            camera = self.camera_codes(moment.camera)
            return torch.cat([towards, camera.expand(*towards.shape[:-1], -1)], -1)

        return self.both(encoded, condition)

    def extra_terms(self, seen: Sampled, batch: Batch, generator: torch.Generator) -> Terms:
        """Offer also ``elastic``, at the samples of the coarse pass."""

        def elastic() -> Tensor:
            first = seen.coarse or seen
            weighted = torch.cat([first.points, first.weights.detach()[..., None]], -1).reshape(-1, 4)
            some = drawn(weighted, self.elastic_samples, generator)
            strain = self.warp.elastic(some[:, :3], self.codes(batch.time), self.octaves_in)
            return (some[:, 3] * strain).sum() * (len(weighted) / max(len(some), 1) / max(len(batch), 1))

        return {"elastic": elastic} | super().extra_terms(seen, batch, generator)
