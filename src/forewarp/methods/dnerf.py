"""D-NeRF: a network carries every point back to where it was at the canonical time, where a NeRF is."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from forewarp.fields.networks import Template, Trunk
from forewarp.methods.method import Start
from forewarp.methods.rays import JUMP, NO_JUMP, Field, SampledMethod, Terms, encoder
from forewarp.ops.encode import encoded_size
from forewarp.renderer import Sampled
from forewarp.scene.view import Batch, Moment


class DNeRF(SampledMethod):
    """``x' = x + F(PE(x), PE(t))``, ``x' = x`` at the canonical time; ``N(PE(x'), PE(d))``.

    One network serves both passes. The offsets take what is seen at a time back to the canonical time, so a
    point cannot be followed forwards (D-NeRF, equations 1 to 4).

    Args:
        start: scene, stage and numbers.
        time_frequencies: octaves of the time's encoding.
        continuous: ``F(x, t) - F(x, canonical)`` in place of a jump to 0 at the canonical time.
        network: sampling, width, layers, skip (of the offsets' network and of the field's) and other octaves:
            see ``SampledMethod``.
    """

    terms = ("photo", "second_time")

    def __init__(
        self, start: Start, *, time_frequencies: int = 10, continuous: bool = False, **network
    ) -> None:
        super().__init__(start, **network)
        self.moment = encoder("time", time_frequencies)
        self.continuous, self.canonical_time = continuous, start.scene.canonical_time
        self.offsets = Trunk(self.sizes[0], besides=encoded_size(1, time_frequencies), **self.shape)
        self.offset_head = nn.Linear(self.shape["width"], 3)
        self.template = Template(*self.sizes, **self.shape)

    def backward_flow(self, points: Tensor, time: float) -> Tensor:
        """See ``HasBackwardFlow``; of points (..., 3)."""
        if time == self.canonical_time:
            return torch.zeros_like(points)
        offset = self._raw_offset(points, time)
        return offset - self._raw_offset(points, self.canonical_time) if self.continuous else offset

    def _raw_offset(self, points: Tensor, time: float) -> Tensor:
        moment = self.moment(points.new_tensor([time])).expand(*points.shape[:-1], -1)
        return self.offset_head(self.offsets(self.position(points), moment))

    def fields(self, moment: Moment) -> tuple[None, Field]:
        """See ``SampledMethod``."""

        def encoded(points: Tensor) -> Tensor:
            return self.position(points + self.backward_flow(points, moment.time))

        return None, Field(self.template, self.activation, encoded, self.direction)

    def extra_terms(self, seen: Sampled, batch: Batch, generator: torch.Generator) -> Terms:
        """Offer ``second_time``: squared differences of the offsets at a time up to the next training time,
        summed, as published; its authors have it off.
        """

        def second_time() -> Tensor:
            time = batch.time
            place = self.times.index(time)
            beside = [self.times[i] for i in (place - 1, place + 1) if 0 <= i < len(self.times)]
            drawn = torch.rand(2, generator=generator).tolist()
            neighbour = beside[int(drawn[0] * len(beside))] if beside else time
            between = time + drawn[1] * (neighbour - time)
            return (
                (self.backward_flow(seen.points, time) - self.backward_flow(seen.points, between))
                .square()
                .sum()
            )

        return {"second_time": second_time}

    def departures(self) -> list[str]:
        """See ``SampledMethod``."""
        return super().departures() + ([NO_JUMP] if self.continuous else [])

    def faults(self) -> list[str]:
        """See ``Method``."""
        return super().faults() + ([] if self.continuous else [JUMP])
