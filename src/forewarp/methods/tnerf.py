"""T-NeRF: a NeRF whose network also takes the time, without any warp."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.fields.networks import Template
from forewarp.methods.method import Start
from forewarp.methods.rays import Field, SampledMethod, Sampling, encoder
from forewarp.ops.encode import encoded_size
from forewarp.scene.view import Moment


class TNeRF(SampledMethod):
    """``(x, d, t) -> (density, colour)``: ``N([PE(x), PE(t)], PE(d))``, the time at the skip as well.

    One network serves both passes. Coordinates are in world units, directions have length 1, and the
    encodings have no factor of pi. (Named in D-NeRF, whose authors never released it.)

    Args:
        start: scene, stage and numbers.
        sampling: see ``Sampling``.
        width, layers, skip: see ``fields.networks.Trunk``.
        position_frequencies, time_frequencies, direction_frequencies: octaves of the encodings.
    """

    def __init__(
        self,
        start: Start,
        *,
        sampling: Sampling | None = None,
        width: int = 256,
        layers: int = 8,
        skip: int | None = 6,
        position_frequencies: int = 10,
        time_frequencies: int = 4,
        direction_frequencies: int = 4,
    ) -> None:
        super().__init__(start, sampling or Sampling())
        self.position = encoder("position", position_frequencies)
        self.moment = encoder("time", time_frequencies)
        self.direction = encoder("direction", direction_frequencies)
        inputs = encoded_size(3, position_frequencies) + encoded_size(1, time_frequencies)
        condition = encoded_size(3, direction_frequencies)
        self.network = Template(inputs, condition, width=width, layers=layers, skip=skip)

    def fields(self, moment: Moment) -> tuple[None, Field]:
        """See ``SampledMethod``."""

        def encoded(points: Tensor) -> Tensor:
            time = self.moment(points.new_tensor([moment.time]))
            return torch.cat([self.position(points), time.expand(*points.shape[:-1], -1)], -1)

        return None, Field(self.network, self.activation, encoded, self.direction)
