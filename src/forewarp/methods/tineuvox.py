"""TiNeuVox: a small network moves each sample, a voxel grid is read there at three strides, and a network
that also knows position and time turns what was read into density and colour.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from forewarp.fields.grids import density_shift, read_strided
from forewarp.fields.networks import Template, mlp
from forewarp.methods.method import FRACTION, Start, check_least, check_number, those_that_hold
from forewarp.methods.rays import MarchedMethod, Marching, PointField, Terms, encoder, whole_grid
from forewarp.ops.encode import encoded_size
from forewarp.ops.grid import huber_variation
from forewarp.scene.box import Lattice
from forewarp.scene.view import Batch, Moment

RELEASED = Marching()
_STRIDES = (1, 2, 4)
_STILL_SHARE = 3  # as many points that never move as a third of a step's rays


class TiNeuVox(MarchedMethod):
    """``tau = T(PE(t))``, ``y = x + D(PE(x), tau)``, ``v = [V_1(y), V_2(y), V_4(y)]`` (one grid, read at
    strides 1, 2 and 4), ``(density, colour) = N([PE(v), PE(x), tau], PE(d))``.

    There is no canonical time: ``N`` reads the time and the place before the move as well.

    Args:
        start: scene, stage and numbers.
        marching: see ``Marching``.
        channels: of the grid.
        width: of the networks.
        alpha_init: opacity at first of a voxel of the last lattice.
        camera: let colour depend on the number of the camera that took a picture (the rig's two); who took no
            training picture sees by the mean of what the others' numbers give.
        padded: a fault of the released code: before it reads, it adds zeros at the grid's high ends, so that
            voxels lie elsewhere after the grid has grown. False: sizes of 4 k + 1.
        position_frequencies, time_frequencies, feature_frequencies, direction_frequencies: octaves.
    """

    terms = (*MarchedMethod.terms, "still", "tv_grid")
    numbers = (*MarchedMethod.numbers, "frozen_from")

    def __init__(
        self,
        start: Start,
        *,
        marching: Marching = RELEASED,
        channels: int = 4,
        width: int = 64,
        alpha_init: float = 1e-2,
        camera: bool = False,
        padded: bool = True,
        position_frequencies: int = 10,
        time_frequencies: int = 8,
        feature_frequencies: int = 2,
        direction_frequencies: int = 4,
    ) -> None:
        super().__init__(start, marching, start.scene.box)
        self.padded, self.sees_by_camera = padded, camera
        self.frozen_from = start.numbers.get("frozen_from", 1.0)
        check_number(f"stage.{start.stage}.frozen_from", self.frozen_from, *FRACTION)
        self.frozen = False
        self.position = encoder("position", position_frequencies)
        self.moment = encoder("time", time_frequencies)
        self.feature = encoder("feature", feature_frequencies)
        self.direction = encoder("direction", direction_frequencies)
        check_least(1, channels=channels, width=width)
        self.shift = density_shift(alpha_init, self.alpha_key)
        self.grid = whole_grid(self.marching_lattice(self.schedule[0][1]), {"features": channels})
        place, moment = encoded_size(3, position_frequencies), encoded_size(1, time_frequencies)
        direction, code = encoded_size(3, direction_frequencies), 5 * channels
        self.time_code = mlp(moment, code, width=width, layers=2)
        self.cameras = sorted({frame.camera_id for frame in start.scene.train} - {None}) or [0.5]
        self.camera_code = mlp(moment, code, width=width, layers=2) if camera else None
        self.offsets = mlp(place + code, 3, width=width, layers=3)
        read = encoded_size(len(_STRIDES) * channels, feature_frequencies)
        condition = direction + (code if camera else 0)
        self.head = Template(read + place + code, condition, width=width, layers=1, skip=None)
        self.begin()

    def marching_lattice(self, num_voxels: float) -> Lattice:
        """See ``MarchedMethod``; sizes are 4 k + 1 unless ``padded``."""
        lattice = Lattice.of_count(self.box, num_voxels)
        if self.padded:
            return lattice
        last = max(_STRIDES)
        return Lattice(self.box, tuple(last * max(1, round((n - 1) / last)) + 1 for n in lattice.shape))

    @property
    def lattice_marched(self) -> Lattice:
        """See ``MarchedMethod``."""
        return self.grid.lattice

    def field(self, moment: Moment) -> TiNeuVoxField:
        """See ``MarchedMethod``."""
        return TiNeuVoxField(self, moment)

    def read(self, points: Tensor) -> Tensor:
        """World points (P, 3) -> features (P, 3 C) at the three strides; 0 outside the box."""
        shape = self.grid.lattice.shape
        if not self.padded and any((n - 1) % max(_STRIDES) for n in shape):
            raise ValueError(f"model.padded: expected true for a grid of sizes {shape}, but got false")
        return read_strided(self.grid, points, _STRIDES)

    def code(self, network: nn.Module, number: float) -> Tensor:
        """A time, or a camera's number -> code (5 C,)."""
        return network(self.moment(self.grid.features.new_tensor([number])))

    def grow(self, num_voxels: float, optimizer: torch.optim.Optimizer) -> None:
        """See ``MarchedMethod``."""
        self.regrow(self.grid, self.marching_lattice(num_voxels), optimizer)
        self.frozen = False

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``; at last, where asked for, round the grid to half precision and let it stay."""
        noted = super().advance(progress, step, optimizer)
        if progress >= self.frozen_from:
            if not self.frozen:  # once; a run that goes on rounds what is round
                self.frozen, features = True, self.grid.features
                features.data = features.data.half().to(features)
            for group in optimizer.param_groups:
                group["lr"] *= group["name"] != "grid"
        return noted

    def extra_terms(self, field: TiNeuVoxField, batch: Batch, generator: torch.Generator) -> Terms:
        """Offer ``still``, at points that never move, and ``tv_grid``, the grid's total variation."""

        def tv_grid() -> Tensor:
            shape = self.grid.lattice.shape
            return huber_variation(self.grid.features.reshape(*shape, -1)) * (max(shape) / 128 / 6)

        count = max(1, len(batch) // _STILL_SHARE)
        return {"still": lambda: self.stray(field.offset, count, generator), "tv_grid": tv_grid}

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Group parameters: ``grid``, ``deformation``, and ``network`` (all other networks)."""
        groups = {"grid": [self.grid.features], "deformation": list(self.offsets.parameters())}
        known = {id(p) for group in groups.values() for p in group}
        return groups | {"network": [p for p in self.parameters() if id(p) not in known]}

    def departures(self) -> list[str]:
        """See ``MarchedMethod``."""
        return super().departures() + ([] if self.padded else ["grid sizes of 4 k + 1"])

    def faults(self) -> list[str]:
        """See ``Method``."""
        frozen = f"the grid stays as it is from {self.frozen_from:g} of the stage on (frozen_from)"
        padded = "the grid is padded with zeros (padded)"
        return those_that_hold({padded: self.padded, frozen: self.frozen_from < 1})


class TiNeuVoxField(PointField):
    """TiNeuVox at one moment (see ``PointField``)."""

    def __init__(self, method: TiNeuVox, moment: Moment) -> None:
        super().__init__(method)
        self.tau = method.code(method.time_code, moment.time)
        self.camera = None
        if method.camera_code is not None:
            known = [moment.camera] if moment.camera in method.cameras else method.cameras
            self.camera = sum(method.code(method.camera_code, camera) for camera in known) / len(known)

    def offset(self, points: Tensor) -> Tensor:
        """World points (P, 3) -> how far they are moved (P, 3), world units."""
        return self.method.offsets(self._placed(points))

    def _placed(self, points: Tensor) -> Tensor:
        """``[PE(x), tau]`` (P, I)."""
        return torch.cat([self.method.position(points), self.tau.expand(len(points), -1)], -1)

    def at_world(self, points: Tensor) -> tuple[Tensor, Callable]:
        """See ``PointField``."""
        method, placed = self.method, self._placed(points)
        read = method.feature(method.read(points + method.offsets(placed)))
        hidden = method.head.trunk(torch.cat([read, placed], -1))

        def color(rows: Tensor | slice, directions: Tensor) -> Tensor:
            condition = method.direction(directions)
            if self.camera is not None:
                condition = torch.cat([condition, self.camera.expand(len(directions), -1)], -1)
            return method.head.color(hidden[rows], condition)

        return method.activation.sigma(method.head.density_head(hidden)[:, 0]), color
