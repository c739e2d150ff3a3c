"""HyperNeRF: Nerfies, whose template has two more coordinates, so that a scene's topology may change."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from forewarp.fields.networks import Template, Trunk
from forewarp.methods.method import Start, check_least
from forewarp.methods.rays import Field, Sampling, WarpedMethod
from forewarp.ops.encode import positional_encoding
from forewarp.scene.view import Moment

RELEASED = Sampling(128, 128, density="softplus", jitter_in_pictures=True)
_FIRST = 1e-5  # standard deviation of the slice's first weights


class Slice(nn.Module):
    """The deformable slicing surface: observed points (..., 3) and a code -> ambient coordinates (..., A).

    >>> sum(p.numel() for p in Slice(8, 2, width=64, frequencies=6, layers=6, skip=5).parameters())
    26626
    """

    def __init__(self, code_size: int, ambient: int, *, width: int, frequencies: int, **trunk) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.trunk = Trunk(6 * frequencies + code_size, width=width, **trunk, glorot=True)
        self.head = nn.Linear(width, ambient)
        nn.init.normal_(self.head.weight, std=_FIRST)
        nn.init.zeros_(self.head.bias)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        """See the class; the encoding has no identity, and is not windowed."""
        encoded = positional_encoding(points, self.frequencies, identity=False)
        return self.head(self.trunk(torch.cat([encoded, code.expand(*points.shape[:-1], -1)], -1)))


class HyperNeRF(WarpedMethod):
    """``x' = T(x, code(t))``, ``w = H(x, code(t))``; ``N([PE(x'), PE(w)], PE(d))`` (HyperNeRF, equations 4
    to 7).

    ``w`` counts for nothing at first, and comes in after ``slice_from`` of the stage, by ``slice_in``.

    Args:
        start: scene, stage and numbers.
        slice_width: of the slice, which is as deep as the warp.
        ambient: coordinates beside the three of space.
        ambient_frequencies: octaves of their encoding.
        shared: sampling and the sizes of networks, warp and codes: see ``WarpedMethod``.
    """

    terms = ("photo", "coarse_photo", "still")
    shares = {"warp_in": 0.32, "slice_from": 0.004, "slice_in": 0.044}
    numbers = tuple(shares)
    jitters = True

    def __init__(
        self,
        start: Start,
        *,
        sampling: Sampling = RELEASED,
        slice_width: int = 64,
        ambient: int = 2,
        ambient_frequencies: int = 1,
        **shared,
    ) -> None:
        super().__init__(start, sampling=sampling, **shared)
        warp = self.warp_shape
        check_least(1, warp_frequencies=warp["frequencies"], ambient_frequencies=ambient_frequencies)
        self.ambient_frequencies = ambient_frequencies
        self.slice = Slice(self.codes.table.shape[1], ambient, width=slice_width, **warp)
        position, direction = self.sizes
        inputs = position + 2 * ambient * ambient_frequencies
        self.coarse, self.fine = self.passes(lambda: Template(inputs, direction, **self.shape))
        self.register_buffer("windows", torch.zeros(2))  # of the warp and of the ambient coordinates

    @property
    def octaves_in(self) -> float:
        """See ``WarpedMethod``."""
        return float(self.windows[0])

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; let octaves of the warp's encoding in, then the ambient coordinates."""
        shares = self.shares
        octaves = self.warp.octaves(progress, shares["warp_in"])
        begin, end = shares["slice_from"], max(shares["slice_in"], shares["slice_from"] + 1e-6)
        ambient = min(1.0, max(0.0, (progress - begin) / (end - begin)))
        self.windows.copy_(torch.tensor([octaves, ambient * self.ambient_frequencies]))
        return {"octaves": octaves, "ambient": ambient} | super().advance(progress, step, optimizer)

    def fields(self, moment: Moment) -> tuple[Field, Field]:
        """See ``SampledMethod``."""
        code, (octaves, ambient) = self.codes(moment.time), self.windows.tolist()

        def encoded(points: Tensor) -> Tensor:
            sliced, count = self.slice(points, code), self.ambient_frequencies
            beside = positional_encoding(sliced, count, window=ambient, identity=False)
            return torch.cat([self.position(self.warp(points, code, octaves)), beside], -1)

        return self.both(encoded, self.direction)
