"""T-NeRF: a NeRF whose network also takes the time, without any warp."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.fields.networks import Template
from forewarp.methods.method import Start
from forewarp.methods.rays import Field, SampledMethod, encoder
from forewarp.ops.encode import encoded_size
from forewarp.scene.view import Moment


class TNeRF(SampledMethod):
    """``(x, d, t) -> (density, colour)``: ``N([PE(x), PE(t)], PE(d))``, the time at the skip as well.

    One network serves both passes. Coordinates are in world units, directions have length 1, and the
    encodings have no factor of pi. (Named in D-NeRF, whose authors never released it.)

    Args:
        start: scene, stage and numbers.
        time_frequencies: octaves of the time's encoding.
        network: sampling, width, layers, skip and other octaves: see ``SampledMethod``.
    """

    def __init__(self, start: Start, *, time_frequencies: int = 4, **network) -> None:
        super().__init__(start, **network)
        self.moment = encoder("time", time_frequencies)
        position, direction = self.sizes
        self.network = Template(position + encoded_size(1, time_frequencies), direction, **self.shape)

    def fields(self, moment: Moment) -> tuple[None, Field]:
        """See ``SampledMethod``."""

        def encoded(points: Tensor) -> Tensor:
            time = self.moment(points.new_tensor([moment.time]))
            return torch.cat([self.position(points), time.expand(*points.shape[:-1], -1)], -1)

        return None, Field(self.network, self.activation, encoded, self.direction)
