"""Nerfies: a code for each instant bends space, by screws, to a template that all instants share."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from forewarp.fields.networks import CameraCodes, ScrewWarp, Template, TimeCodes, drawn
from forewarp.methods.method import FRACTION, Start, check_least, check_number
from forewarp.methods.rays import OF_JAX, Field, SampledMethod, Sampling, encoder
from forewarp.ops.encode import encoded_size
from forewarp.quadrature import Sampled
from forewarp.scene.view import Batch, Moment


class Nerfies(SampledMethod):
    """``x' = T(x, code(t))``, a screw at every point; ``N(PE(x'), [PE(d), code(camera)])`` (Nerfies,
    equations 1 to 8).

    Two templates, coarse and fine, share the warp. Octaves of its encoding come in over the stage. Where a
    test time is not a training time, the codes beside it are interpolated.

    Args:
        start: scene, stage and numbers.
        sampling: see ``Sampling``.
        width, layers, skip: of the templates, see ``fields.networks.Trunk``.
        warp_width, warp_layers, warp_skip: of the warp.
        position_frequencies, warp_frequencies, direction_frequencies: octaves of the encodings.
        code_size, camera_code_size: channels of the codes; 0: no code of the camera.
        elastic_samples, still_points: of a step, most that the two regularisers look at; null: all.
    """

    terms = ("photo", "coarse_photo", "elastic", "still")
    numbers = ("warp_in",)
    published = "softplus"
    conventions = OF_JAX

    def __init__(
        self,
        start: Start,
        *,
        sampling: Sampling | None = None,
        width: int = 256,
        layers: int = 8,
        skip: int | None = 5,
        warp_width: int = 128,
        warp_layers: int = 6,
        warp_skip: int | None = 5,
        position_frequencies: int = 8,
        warp_frequencies: int = 6,
        direction_frequencies: int = 4,
        code_size: int = 8,
        camera_code_size: int = 2,
        elastic_samples: int | None = None,
        still_points: int | None = 16384,
    ) -> None:
        super().__init__(start, sampling or Sampling(128, 128, density="softplus"))
        self.position = encoder("position", position_frequencies)
        self.direction = encoder("direction", direction_frequencies)
        check_least(warp_frequencies=warp_frequencies)
        self.codes = TimeCodes(self.times, code_size)
        self.warp = ScrewWarp(
            code_size, frequencies=warp_frequencies, width=warp_width, layers=warp_layers, skip=warp_skip
        )
        cameras = {frame.camera_id for frame in start.scene.train}
        self.camera_codes = CameraCodes(cameras, camera_code_size) if camera_code_size else None
        self.sees_by_camera = self.camera_codes is not None
        sizes = (
            encoded_size(3, position_frequencies),
            encoded_size(3, direction_frequencies) + camera_code_size,
        )
        shape = {"width": width, "layers": layers, "skip": skip, "glorot": True}
        self.coarse, self.fine = self.passes(lambda: Template(*sizes, **shape))
        self.warp_in = start.numbers.get("warp_in", 0.32)
        check_number(f"stage.{start.stage}.warp_in", self.warp_in, *FRACTION)
        self.register_buffer("window", torch.tensor(0.0))
        self.still, self.still_points = start.scene.still, still_points
        self.elastic_samples = elastic_samples

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; let octaves of the warp's encoding in."""
        octaves = self.warp.octaves(progress, self.warp_in)
        self.window.fill_(octaves)
        return {"octaves": octaves} | super().advance(progress, step, optimizer)

    def fields(self, moment: Moment) -> tuple[Field, Field]:
        """See ``SampledMethod``."""
        code, window = self.codes(moment.time), float(self.window)

        def encoded(points: Tensor) -> Tensor:
            return self.position(self.warp(points, code, window))

        def condition(directions: Tensor) -> Tensor:
            towards = self.direction(directions)
            if self.camera_codes is None:
                return towards
            camera = self.camera_codes(moment.camera)
            return torch.cat([towards, camera.expand(*towards.shape[:-1], -1)], -1)

        return self.both(encoded, condition)

    def extra_terms(
        self, seen: Sampled, batch: Batch, factors: Mapping[str, float], generator: torch.Generator
    ) -> dict[str, Callable[[], Tensor | None]]:
        """Offer ``elastic``, at the samples of the coarse pass, and ``still``, at points that never move."""
        window = float(self.window)

        def elastic() -> Tensor:
            found = seen.coarse or seen
            both = torch.cat([found.points, found.weights.detach()[..., None]], -1).reshape(-1, 4)
            some = drawn(both, self.elastic_samples, generator)
            strain = self.warp.elastic(some[:, :3], self.codes(batch.time), window)
            return (some[:, 3] * strain).sum() * (len(both) / max(len(some), 1) / max(len(batch), 1))

        def still() -> Tensor | None:
            return self.warp.stray(self.still, self.codes.table, window, self.still_points, generator)

        return {"elastic": elastic, "still": still}
