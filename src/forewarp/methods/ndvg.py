"""NDVG: a voxel grid and a small network move each sample back to the canonical time, where a voxel radiance
field is, and say how much of it is hidden.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from forewarp import losses
from forewarp.fields.grids import density_shift
from forewarp.fields.networks import mlp
from forewarp.fields.occupancy import Occupancy
from forewarp.methods.method import Start, check_least, check_number, those_that_hold
from forewarp.methods.rays import JUMP, NO_JUMP, MarchedMethod, Marching, PointField, Terms, whole_grid
from forewarp.ops.backend import check_value
from forewarp.ops.encode import encoded_size, positional_encoding
from forewarp.ops.grid import dilate, second_variation, trilinear
from forewarp.scene.box import Box, Lattice
from forewarp.scene.frame import spread
from forewarp.scene.view import Batch, Moment

RELEASED = Marching(jitter=True, occupancy=100)
_HIDDEN = -100.0  # raw density that never comes back
_LEAST = 1e-4  # least density, in the unit of raw density, that a stage hands over: less hardly comes back
_OPAQUE = 1 - 1e-6  # most a sample may hide, so that what is behind keeps a gradient
_SIDE = 96  # cells along a side of the lattice by which a box is found, where there is no other
_LOOKS = 50  # times at which a finished stage is asked where matter is
_BOX = 1.05  # a tight box is made so much wider
_STILL = 1024  # at most this many points that never move, in a step


@dataclass(frozen=True)
class NDVGStage:
    """The numbers of a stage of NDVG, beside those of ``MarchedMethod``.

    Args:
        deformation_voxels: voxels of the deformation grid for each canonical voxel.
        view_dependence: False: three canonical features are the colour, from everywhere.
        alpha_init: opacity at first of a voxel of the last deformation grid.
        sink: how far raw density falls each time the grids grow.
        box_alpha: the next stage's box holds cells more opaque than this.
        carry: start from the canonical density of the stage before; False: from nothing, as published.
        masked: leave canonical voxels empty for good where the stage before has less than ``box_alpha``.
    """

    deformation_voxels: float = 1.675
    view_dependence: bool = True
    alpha_init: float = 1e-2
    sink: float = 1.0
    box_alpha: float = 1e-3
    carry: bool = False
    masked: bool = True

    @classmethod
    def of(cls, start: Start) -> NDVGStage:
        """Take a stage's numbers; ``ValueError`` for one that is out of range, naming its key."""
        made = cls(**{f.name: start.numbers[f.name] for f in fields(cls) if f.name in start.numbers})
        where = f"stage.{start.stage}"
        check_number(f"{where}.deformation_voxels", made.deformation_voxels, "a number > 0", lambda n: n > 0)
        check_number(f"{where}.sink", made.sink, "a number >= 0", lambda fall: fall >= 0)
        check_number(f"{where}.box_alpha", made.box_alpha, "a number in [0, 1)", lambda part: 0 <= part < 1)
        return made


class NDVG(MarchedMethod):
    """``(d, m) = F(PE(G(x)), PE(x), PE(t))``, ``y = x + d``, ``alpha = m (1 - exp(-sigma(y) step))``,
    ``colour = m N(K(y), PE(y), PE(dir))``; ``d = 0`` at the canonical time.

    ``G`` (deformation), ``sigma`` and ``K`` (canonical) are voxel grids that start at 0; the mask ``m``
    starts at one half. A second stage goes on with ``G`` and ``F`` of the first, in a box around its matter.

    Args:
        start: scene, stage and numbers (see ``NDVGStage``).
        marching: see ``Marching``; its voxels are those of the deformation grid.
        width: of the networks of deformation and colour.
        channels: of the deformation grid, and of the canonical features.
        frequencies: octaves of the encoded features, places and times.
        direction_frequencies: octaves of the encoded directions.
        continuous: ``F(x, t) - F(x, canonical)`` in place of a jump to 0 at the canonical time.
    """

    terms = (*MarchedMethod.terms, "flow_l1", "tv_deformation", "canonical", "still")
    numbers = (*MarchedMethod.numbers, *(field.name for field in fields(NDVGStage)))

    def __init__(
        self,
        start: Start,
        *,
        marching: Marching = RELEASED,
        width: Sequence[int] = (64, 128),
        channels: Sequence[int] = (4, 12),
        frequencies: int = 5,
        direction_frequencies: int = 4,
        continuous: bool = False,
    ) -> None:
        tight = start.handover is not None and start.handover.tight
        box = start.handover.box if tight else start.scene.box
        super().__init__(start, marching, box, f"stage.{start.stage}.alpha_init")
        for key, pair in (("width", width), ("channels", channels)):
            check_value(f"model.{key}", pair, "two whole numbers >= 1", _is_pair)
        check_least(frequencies=frequencies, direction_frequencies=direction_frequencies)
        self.stage = NDVGStage.of(start)
        self.shift = density_shift(self.stage.alpha_init, self.alpha_key)
        self.canonical_time = start.scene.canonical_time
        self.octaves, self.continuous = (frequencies, direction_frequencies), continuous
        seen = start.handover and start.handover.frames_in_play
        self.never_seen = 0 if seen is None else len(start.scene.train) - seen  # by the first stage
        self.pulls = bool(start.weights.get("still"))
        viewed, first = self.stage.view_dependence, self.schedule[0][1]
        colors = {"density": 1, "color": channels[1] if viewed else 3}
        self.canonical = whole_grid(Lattice.of_count(box, first), colors)
        self.deformation = whole_grid(self.marching_lattice(first), {"features": channels[0]})
        inputs = encoded_size(channels[0] + 3 + 1, frequencies)
        self.network = mlp(inputs, 4, width=width[0], layers=4, zero_last=True)
        self.color = None
        if viewed:
            inputs = channels[1] + encoded_size(3, frequencies) + encoded_size(3, direction_frequencies)
            self.color = mlp(inputs, 3, width=width[1], layers=3)
            nn.init.zeros_(self.color[-1].bias)
        self.begin()
        if isinstance(start.before, NDVG) and not start.blank:
            self._go_on(start.before)
        elif not start.blank:
            self._clear([frame.camera for frame in start.scene.train])

    def marching_lattice(self, num_voxels: float) -> Lattice:
        """See ``MarchedMethod``: that of the deformation."""
        return Lattice.of_count(self.box, self.stage.deformation_voxels * num_voxels)

    def _clear(self, cameras: Sequence) -> None:
        """Empty the voxels nearer to a camera than it can see."""
        points = self.canonical.lattice.to_world(self.canonical.voxels)
        for center, near in {(tuple(camera.center.tolist()), camera.near) for camera in cameras}:
            close = (points - points.new_tensor(center)).norm(dim=-1) <= near
            self.canonical.density.data[close] = _HIDDEN

    @torch.no_grad()
    def _go_on(self, before: NDVG) -> None:
        """Take over the deformation of the stage before, and do not look where it found nothing."""
        nodes = self.deformation.lattice.to_world(self.deformation.voxels)
        self.deformation.features.copy_(before.deformation.read("features", nodes))
        self.network.load_state_dict(before.network.state_dict())
        if self.occupancy is not None:
            self.occupancy.settle(before.density_found, _some(self.times))
        voxels = self.canonical.lattice.to_world(self.canonical.voxels)
        if self.stage.carry:
            sigma = before.activation.sigma(before.canonical.read("density", voxels))
            raised = torch.expm1((sigma * self.activation.density_scale).double()).clamp(min=_LEAST)
            self.canonical.density.copy_(torch.log(raised) - self.shift)
        if self.stage.masked:
            old = before.canonical
            size = old.lattice.voxel_size
            solid = before.activation.alpha(old.density[:, 0], size) > before.stage.box_alpha
            near = dilate(solid.reshape(old.lattice.shape)).reshape(-1, 1).to(old.density)
            near = trilinear(near, old.index, old.lattice.to_lattice(voxels), near.new_zeros(1))
            self.canonical.density[near[:, 0] <= 0] = _HIDDEN

    @property
    def lattice_marched(self) -> Lattice:
        """See ``MarchedMethod``."""
        return self.deformation.lattice

    def field(self, moment: Moment) -> NDVGField:
        """See ``MarchedMethod``."""
        return NDVGField(self, moment.time)

    def carried(self, points: Tensor, time: float) -> tuple[Tensor, Tensor]:
        """World points (P, 3) -> what ``F`` says of them at a time: offset (P, 3), raw mask (P,)."""
        inputs = self.deformation.read("features", points), points, points.new_tensor([[time]])
        encoded = [positional_encoding(x, self.octaves[0]).expand(len(points), -1) for x in inputs]
        found = self.network(torch.cat(encoded, -1))
        return found[:, :3], found[:, 3]

    def backward_flow(self, points: Tensor, time: float) -> Tensor:
        """See ``HasBackwardFlow``."""
        return self.field(Moment(time)).offset(points)[0]

    def density_found(self, points: Tensor, time: float) -> Tensor:
        """As ``density_at``; 0 without a look in cells that were found to be empty."""
        if self.occupancy is None:
            return self.density_at(points, time)
        known = self.occupancy(points).nonzero()[:, 0]
        return points.new_zeros(len(points)).index_copy(0, known, self.density_at(points[known], time))

    def grow(self, num_voxels: float, optimizer: torch.optim.Optimizer) -> None:
        """See ``MarchedMethod``; raw density falls by ``sink``."""
        self.regrow(self.canonical, Lattice.of_count(self.box, num_voxels), optimizer)
        self.regrow(self.deformation, self.marching_lattice(num_voxels), optimizer)
        self.canonical.density.data -= self.stage.sink

    @torch.no_grad()
    def bounds(self, times: list[float]) -> Box | None:
        """Bound all matter more opaque than ``box_alpha`` across a cell, and a little more."""
        looked = deepcopy(self.occupancy) or Occupancy(self.box, side=_SIDE).to(self.device)
        looked.settle(self.density_at, _some(times))
        found = looked.bounds(self.stage.box_alpha)
        return None if found is None else found.scaled(_BOX)

    def extra_terms(self, field: NDVGField, batch: Batch, generator: torch.Generator) -> Terms:
        """Offer ``flow_l1``, the samples' offsets; ``tv_deformation``; ``canonical``, offsets of samples at
        the canonical time, which ``F`` should give as 0; ``still``, at points that never move.

        Means of offsets are, as published, over as many places a ray as fit on the box's diagonal; places
        that are empty or outside count as 0. So their weights do not depend on what is skipped.
        """

        def of_all(offsets: Tensor) -> Tensor:
            places = self.box.diagonal / (self.marching.step * self.lattice_marched.voxel_size)
            return len(field.points) / (places * len(batch)) * losses.flow_l1(offsets)

        def canonical() -> Tensor | None:
            if self.continuous or not len(field.points):
                return None
            count = max(1, len(field.points) // len(self.times))
            rows = torch.randint(len(field.points), (count,), generator=generator).to(self.device)
            return of_all(self.carried(field.points[rows], self.canonical_time)[0])

        def tv_deformation() -> Tensor:
            shape = self.deformation.lattice.shape
            return second_variation(self.deformation.features.reshape(*shape, -1))

        terms = {"flow_l1": lambda: of_all(field.offsets), "tv_deformation": tv_deformation}
        terms["still"] = lambda: self.stray(lambda points: field.offset(points)[0], _STILL, generator)
        return terms | {"canonical": canonical}

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Group parameters: ``density``, ``color`` and ``deformation`` (the grids), ``network``."""
        groups = {"density": [self.canonical.density], "color": [self.canonical.color]}
        groups |= {"deformation": [self.deformation.features], "network": list(self.network.parameters())}
        groups["network"] += [] if self.color is None else self.color.parameters()
        return groups

    def departures(self) -> list[str]:
        """See ``MarchedMethod``."""
        carried = "the second stage starts from the density of the first"
        return super().departures() + those_that_hold({NO_JUMP: self.continuous, carried: self.stage.carry})

    def faults(self) -> list[str]:
        """See ``Method``."""
        unseen = f"the first stage never sees the last {self.never_seen} images (iterations_per_time)"
        free = "points that never move are not looked at (weights.still)"
        loose = self.still is not None and not self.pulls
        return those_that_hold({JUMP: not self.continuous, unseen: self.never_seen > 0, free: loose})


class NDVGField(PointField):
    """NDVG at a time (see ``PointField``); keeps the ``points`` (P, 3) asked last, and their ``offsets``."""

    def __init__(self, method: NDVG, time: float) -> None:
        super().__init__(method)
        self.time = time

    def offset(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points (P, 3) -> offsets to their canonical places (P, 3), masks (P,) in (0, 1)."""
        method = self.method
        offset, hidden = method.carried(points, self.time)
        if self.time == method.canonical_time:
            offset = torch.zeros_like(offset)
        elif method.continuous:
            offset = offset - method.carried(points, method.canonical_time)[0]
        return offset, torch.sigmoid(hidden)

    def at_world(self, points: Tensor) -> tuple[Tensor, Callable]:
        """See ``PointField``. The density is the one whose opacity over a step is the masked one."""
        method, canonical = self.method, self.method.canonical
        self.points = points
        self.offsets, mask = self.offset(points)
        placed = points + self.offsets
        inside = canonical.lattice.holds(canonical.lattice.to_lattice(placed.detach()))
        step = method.marching.step * method.lattice_marched.voxel_size
        alpha = inside * mask * method.activation.alpha(canonical.read("density", placed)[:, 0], step)

        def color(rows: Tensor | slice, directions: Tensor) -> Tensor:
            there = placed[rows]
            features = canonical.read("color", there)
            if method.color is not None:
                place, direction = map(positional_encoding, (there, directions), method.octaves)
                features = method.color(torch.cat([features, place, direction], -1))
            return mask[rows, None] * torch.sigmoid(features)

        return -torch.log1p(-alpha.clamp(max=_OPAQUE)) / step, color


def _is_pair(given: object) -> bool:
    is_two = isinstance(given, list | tuple) and len(given) == 2
    return is_two and all(type(number) is int and number >= 1 for number in given)


def _some(times: Sequence[float]) -> list[float]:
    """At most so many of the times, spread evenly."""
    return [times[i] for i in spread(len(times), _LOOKS)]
