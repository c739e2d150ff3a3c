"""D-NeRF: a network carries every point back to where it was at the canonical time, where a NeRF is."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from forewarp.fields.networks import Template, Trunk
from forewarp.methods.method import Start
from forewarp.methods.rays import JUMP, NO_JUMP, Field, SampledMethod, Sampling, encoder
from forewarp.ops.encode import encoded_size
from forewarp.quadrature import Sampled
from forewarp.scene.view import Batch, Moment


class DNeRF(SampledMethod):
    """``x' = x + F(PE(x), PE(t))``, ``x' = x`` at the canonical time; ``N(PE(x'), PE(d))``.

    One network serves both passes. The offsets take what is seen at a time back to the canonical time, so a
    point cannot be followed forwards (D-NeRF, equations 1 to 4).

    Args:
        start: scene, stage and numbers.
        sampling: see ``Sampling``.
        width, layers, skip: see ``fields.networks.Trunk``; of the offsets' network and of the field's.
        position_frequencies, time_frequencies, direction_frequencies: octaves of the encodings.
        continuous: ``F(x, t) - F(x, canonical)`` in place of a jump to 0 at the canonical time.
    """

    terms = ("photo", "second_time")

    def __init__(
        self,
        start: Start,
        *,
        sampling: Sampling | None = None,
        width: int = 256,
        layers: int = 8,
        skip: int | None = 6,
        position_frequencies: int = 10,
        time_frequencies: int = 10,
        direction_frequencies: int = 4,
        continuous: bool = False,
    ) -> None:
        super().__init__(start, sampling or Sampling())
        self.position = encoder("position", position_frequencies)
        self.moment = encoder("time", time_frequencies)
        self.direction = encoder("direction", direction_frequencies)
        self.continuous = continuous
        self.canonical_time = start.scene.canonical_time
        point, time = encoded_size(3, position_frequencies), encoded_size(1, time_frequencies)
        shape = {"width": width, "layers": layers, "skip": skip}
        self.offsets = Trunk(point, besides=time, **shape)
        self.offset_head = nn.Linear(width, 3)
        self.template = Template(point, encoded_size(3, direction_frequencies), **shape)

    def offset(self, points: Tensor, time: float) -> Tensor:
        """How far points (..., 3) are from their canonical places at a time (..., 3), world units."""
        if time == self.canonical_time:
            return torch.zeros_like(points)
        found = self._carried(points, time)
        return found - self._carried(points, self.canonical_time) if self.continuous else found

    def _carried(self, points: Tensor, time: float) -> Tensor:
        moment = self.moment(points.new_tensor([time])).expand(*points.shape[:-1], -1)
        return self.offset_head(self.offsets(self.position(points), moment))

    def fields(self, moment: Moment) -> tuple[None, Field]:
        """See ``SampledMethod``."""

        def encoded(points: Tensor) -> Tensor:
            return self.position(points + self.offset(points, moment.time))

        return None, Field(self.template, self.activation, encoded, self.direction)

    def extra_terms(
        self, seen: Sampled, batch: Batch, factors: Mapping[str, float], generator: torch.Generator
    ) -> dict[str, Callable[[], Tensor]]:
        """Offer ``second_time``: squared differences of the offsets at a time up to the next training time,
        summed, as published; its authors have it off.
        """

        def second_time() -> Tensor:
            time = batch.time
            beside = _neighbours(self.times, time)
            drawn = torch.rand(2, generator=generator).tolist()
            other = beside[int(drawn[0] * len(beside))] if beside else time
            between = time + drawn[1] * (other - time)
            return (self.offset(seen.points, time) - self.offset(seen.points, between)).square().sum()

        return {"second_time": second_time}

    def departures(self) -> list[str]:
        """See ``SampledMethod``."""
        return super().departures() + ([NO_JUMP] if self.continuous else [])

    def faults(self) -> list[str]:
        """See ``Method``."""
        return super().faults() + ([] if self.continuous else [JUMP])


def _neighbours(times: tuple[float, ...], time: float) -> list[float]:
    """The training times just before and after one of them, where there are."""
    place = times.index(time)
    return [times[i] for i in (place - 1, place + 1) if 0 <= i < len(times)]
