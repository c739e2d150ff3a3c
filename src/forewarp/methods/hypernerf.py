"""HyperNeRF: Nerfies, whose template has two more coordinates, so that a scene's topology may change."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from forewarp.fields.networks import ScrewWarp, Template, TimeCodes, Trunk
from forewarp.methods.method import FRACTION, Start, check_least, check_number
from forewarp.methods.rays import OF_JAX, Field, SampledMethod, Sampling, encoder
from forewarp.ops.encode import encoded_size, positional_encoding
from forewarp.quadrature import Sampled
from forewarp.scene.view import Batch, Moment

_FIRST = 1e-5  # standard deviation of the slice's first weights


class Slice(nn.Module):
    """The deformable slicing surface: observed points (..., 3) and a code -> ambient coordinates (..., A).

    >>> sum(p.numel() for p in Slice(8, 2).parameters())
    26626
    """

    def __init__(
        self,
        code_size: int,
        ambient: int,
        *,
        frequencies: int = 6,
        width: int = 64,
        layers: int = 6,
        skip: int | None = 5,
    ) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.trunk = Trunk(6 * frequencies + code_size, width=width, layers=layers, skip=skip, glorot=True)
        self.head = nn.Linear(width, ambient)
        nn.init.normal_(self.head.weight, std=_FIRST)
        nn.init.zeros_(self.head.bias)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        """See the class; the encoding has no identity, and is not windowed."""
        encoded = positional_encoding(points, self.frequencies, identity=False)
        return self.head(self.trunk(torch.cat([encoded, code.expand(*points.shape[:-1], -1)], -1)))


class HyperNeRF(SampledMethod):
    """``x' = T(x, code(t))``, ``w = H(x, code(t))``; ``N([PE(x'), PE(w)], PE(d))`` (HyperNeRF, equations 4
    to 7).

    ``w`` counts for nothing at first, and comes in after ``slice_from`` of the stage, by ``slice_in``.

    Args:
        start: scene, stage and numbers.
        sampling: see ``Sampling``.
        width, layers, skip: of the templates, see ``fields.networks.Trunk``.
        warp_width, warp_layers, warp_skip, slice_width: of the warp, and of the slice, as deep.
        position_frequencies, warp_frequencies, ambient_frequencies, direction_frequencies: octaves.
        code_size: channels of an instant's code.
        ambient: coordinates beside the three of space.
        still_points: of a step, most that the regulariser looks at; null: all.
    """

    terms = ("photo", "coarse_photo", "still")
    numbers = ("warp_in", "slice_from", "slice_in")
    published = "softplus"
    jitters = True
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
        slice_width: int = 64,
        position_frequencies: int = 8,
        warp_frequencies: int = 6,
        ambient_frequencies: int = 1,
        direction_frequencies: int = 4,
        code_size: int = 8,
        ambient: int = 2,
        still_points: int | None = 16384,
    ) -> None:
        super().__init__(start, sampling or Sampling(128, 128, density="softplus"))
        self.position = encoder("position", position_frequencies)
        self.direction = encoder("direction", direction_frequencies)
        check_least(1, warp_frequencies=warp_frequencies, ambient_frequencies=ambient_frequencies)
        self.ambient_frequencies = ambient_frequencies
        self.codes = TimeCodes(self.times, code_size)
        depth = {"frequencies": warp_frequencies, "layers": warp_layers, "skip": warp_skip}
        self.warp = ScrewWarp(code_size, width=warp_width, **depth)
        self.slice = Slice(code_size, ambient, width=slice_width, **depth)
        inputs = encoded_size(3, position_frequencies) + 2 * ambient * ambient_frequencies
        shape = {"width": width, "layers": layers, "skip": skip, "glorot": True}
        condition = encoded_size(3, direction_frequencies)
        self.coarse, self.fine = self.passes(lambda: Template(inputs, condition, **shape))
        self.numbers_of = {"warp_in": 0.32, "slice_from": 0.004, "slice_in": 0.044} | dict(start.numbers)
        for name in self.numbers:
            check_number(f"stage.{start.stage}.{name}", self.numbers_of[name], *FRACTION)
        self.register_buffer("windows", torch.zeros(2))  # of the warp and of the ambient coordinates
        self.still, self.still_points = start.scene.still, still_points

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; let octaves of the warp's encoding in, then the ambient coordinates."""
        given = self.numbers_of
        octaves = self.warp.octaves(progress, given["warp_in"])
        begin, end = given["slice_from"], max(given["slice_in"], given["slice_from"] + 1e-6)
        share = min(1.0, max(0.0, (progress - begin) / (end - begin)))
        self.windows.copy_(torch.tensor([octaves, share * self.ambient_frequencies]))
        return {"octaves": octaves, "ambient": share} | super().advance(progress, step, optimizer)

    def fields(self, moment: Moment) -> tuple[Field, Field]:
        """See ``SampledMethod``."""
        code, (octaves, ambient) = self.codes(moment.time), self.windows.tolist()

        def encoded(points: Tensor) -> Tensor:
            beside = positional_encoding(
                self.slice(points, code), self.ambient_frequencies, window=ambient, identity=False
            )
            return torch.cat([self.position(self.warp(points, code, octaves)), beside], -1)

        return self.both(encoded, self.direction)

    def extra_terms(
        self, seen: Sampled, batch: Batch, factors: Mapping[str, float], generator: torch.Generator
    ) -> dict[str, Callable[[], Tensor | None]]:
        """Offer ``still``, at points that never move."""

        def still() -> Tensor | None:
            window = float(self.windows[0])
            return self.warp.stray(self.still, self.codes.table, window, self.still_points, generator)

        return {"still": still}
