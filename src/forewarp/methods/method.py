"""The contract of a method: render any view at any moment, and learn from batches of images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from forewarp.fields.moving import MovingGaussians
from forewarp.ops.backend import check_value, is_number
from forewarp.scene.box import Box, Lattice
from forewarp.scene.cloud import Cloud, Ellipsoids, Handover
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Asks, Batch, Moment, Rendering, View


@dataclass(frozen=True)
class Start:
    """Everything a method is built from: the first argument of its constructor, before its own options.

    Attributes:
        scene: cameras, times, box, points known to be static; images through ``Frame.load``.
        stage: name of the stage.
        numbers: the method's own keys of the stage.
        frames: indices of the training frames in play at first, nearest to the canonical time first.
        handover: what the stage before left; None in the first stage.
        before: the fitted method of the stage before, if it is at hand.
        blank: a checkpoint is about to be loaded: build parts of the right shape only, from no image and
            no earlier stage.
        weights, literal, photo_on: see ``Objective``.
        shares: the run began from another run's method (``before``, in the first stage), which others begin
            from, too.
    """

    scene: Scene
    stage: str
    numbers: Mapping[str, Any]
    frames: Sequence[int] = ()
    handover: Handover | None = None
    before: Method | None = None
    blank: bool = False
    weights: Mapping[str, float] = field(default_factory=dict)
    literal: Sequence[str] = ()
    photo_on: Sequence[str] | None = None
    shares: bool = False


@dataclass(frozen=True)
class Step:
    """What a method answers to a batch.

    Attributes:
        terms: a function for each loss term by name, which computes it, () tensor, or returns None if the
            effect that it measures is off.
        squared_error: error of the best rendering, mean over pixels and channels.
        noted: numbers to log.
        gradients: of the weighted sum, by parameter name, if the method computes them itself; its terms then
            need no graph. They become ``.grad`` as they are, without a copy and without hooks of the
            parameters. None: autograd computes them.
        tensors: yields intermediate results by name, to find the first that is not finite.
    """

    terms: Mapping[str, Callable[[], Tensor | None]]
    squared_error: Tensor
    noted: Mapping[str, float] = field(default_factory=dict)
    gradients: Mapping[str, Tensor] | None = None
    tensors: Callable[[], Iterable[tuple[str, Tensor | None]]] = tuple


class Snapshot:
    """The scene frozen at one ``moment``; differentiable if gradients are on.

    ``renderings`` names the renderings that ``render`` can give, the best one last.
    """

    moment: Moment
    renderings: Sequence[str] = ("rendered",)

    def __repr__(self) -> str:
        """Name it and its time; a dataclass of tensors says no more with ``repr=False``."""
        return f"{type(self).__name__}(time={self.moment.time:g})"

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """Render ``view`` over ``background`` (3,) or (R, 3); by default the best rendering."""
        raise NotImplementedError

    def holds(self, moment: Moment) -> bool:
        """Return whether this snapshot also shows the scene at another moment."""
        return moment == self.moment


class Method(nn.Module):
    """A scene that can be learned: implement ``at`` and ``look``, everything else has a default.

    Optional abilities (trajectories, bounds, rest, points) are the protocols below.

    Attributes:
        terms: names of its loss terms.
        literal: terms that also have the form printed in the paper.
        numbers: its own keys of a stage.
        asks: what a batch should hold.
        effects: its optional parts (see ``methods.effect``).
        still_steps: steps after which a fit without effects shows what it can't explain, for a plan; None:
            no such fit is made.
        grows: dotted names of the parameters and buffers whose number of rows may change during training;
            they adopt a checkpoint's. A part of it may have a ``grows`` of its own.
        loose: those of them that ``misfit`` itself compares with the others, as they have rows of their own.
        earlier_names: pairs of what a name in ``state_dict`` was in earlier checkpoints, and what it is now;
            with a dot at the end, the beginnings of such names.
        on_cpu: why ``trainer=auto`` should run it on the CPU, in a few words; None: it should not.
        betas: of Adam.
    """

    terms: ClassVar[Sequence[str]] = ("photo",)
    literal: ClassVar[Sequence[str]] = ()
    numbers: ClassVar[Sequence[str]] = ()
    asks: Asks = Asks()
    effects: ClassVar[Sequence] = ()
    still_steps: ClassVar[int | None] = None
    grows: ClassVar[Sequence[str]] = ()
    loose: ClassVar[Sequence[str]] = ()
    earlier_names: ClassVar[Sequence[tuple[str, str]]] = ()
    on_cpu: ClassVar[str | None] = None
    betas: ClassVar[tuple[float, float]] = (0.9, 0.99)

    def at(self, moment: Moment) -> Snapshot:
        """Freeze the scene at a moment."""
        raise NotImplementedError

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """Compare the scene with a batch.

        A step whose numbers are not finite is repeated. Keep what a step counts in buffers, which are then
        restored.

        Args:
            batch: observations of one or several moments.
            factors: the weights of the terms that count in this step.
            generator: draws all random numbers.
        """
        raise NotImplementedError

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Group all parameters by learning rate, a key of ``stage.<name>.lr``."""
        return {"network": list(self.parameters())}

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make the optimiser from groups of ``params`` with their ``lr``: Adam."""
        return torch.optim.Adam(groups, betas=self.betas, eps=1e-8, fused=True)

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Follow the method's schedule before a step; return numbers to log.

        Draw random numbers from torch's default generator on the CPU, which a checkpoint keeps.

        Args:
            progress: fraction of the stage that is done, in [0, 1].
            step: number of the step.
            optimizer: to change if parameters are replaced.
        """
        return {}

    def warm_up(self) -> None:
        """Do once what should not count as training time, for example compile kernels."""

    def notes(self) -> dict[str, float]:
        """Return numbers for the next stage, which only the same method understands."""
        return {}

    def departures(self) -> list[str]:
        """List what differs from the publication."""
        return []

    def faults(self) -> list[str]:
        """List the faults of the released code that are on, each with its key."""
        return []

    def protocol(self) -> dict[str, str]:
        """Return what readers of the method's results should know: departures and kept faults, if any."""
        about = {"departures": self.departures(), "faults": self.faults()}
        return {name: "; ".join(notes) for name, notes in about.items() if notes}

    def outlines(self) -> dict[str, list[dict]]:
        """Return by name the steps of networks that pages draw, as ``fields.outline`` lists them."""
        return {}

    @property
    def size(self) -> tuple[str, int]:
        """What the cost grows with, and how many there are: voxels, particles, parameters."""
        return "parameters", parameter_count(self)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(self.parameters()).device

    def adopted(self) -> set[str]:
        """Return the names in ``state_dict`` that adopt a checkpoint's shape."""
        return {place + name for place, part in self._growing().items() for name in part.grows}

    def _growing(self) -> dict[str, nn.Module]:
        """The method and those of its parts that grow, by the beginning of their names in ``state_dict``."""
        parts = self.named_modules()
        return {f"{place}." if place else "": part for place, part in parts if hasattr(part, "grows")}

    def current_names(self, state: Mapping[str, Tensor], place: str = "") -> dict[str, Tensor]:
        """Return a stored ``state_dict`` by today's names; those of the method begin with ``place``."""

        def current(name: str) -> str:
            for was, now in ((place + was, place + now) for was, now in self.earlier_names):
                if name == was or (was.endswith(".") and str(name).startswith(was)):
                    return now + name.removeprefix(was)
            return name

        return {current(name): value for name, value in state.items()}

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """Return the name of a stored entry that contradicts the others; None if there is none.

        All tensors in ``grows`` need the same number of rows, as kernels index one by the rows of another. A
        part has a ``misfit(state, place)`` for what else must fit, as the voxels of a grid its lattice.
        """
        for place, part in self._growing().items():
            rows = None
            for name in part.grows:
                own, stored = part_of(part, name), state[place + name]
                fits = torch.is_tensor(stored) and (stored.dtype, stored.dim()) == (own.dtype, own.dim())
                if fits and name not in part.loose:
                    rows = len(stored) if rows is None else rows
                    fits = stored.shape == (rows, *own.shape[1:])
                if not fits:
                    return place + name
            if part is not self and (name := part.misfit(state, place)):
                return name
        return None

    @classmethod
    def check(
        cls, stage: str, numbers: Iterable[str], terms: Iterable[str], literal: Iterable[str] = ()
    ) -> None:
        """Refuse keys, terms and literal forms that this method does not know, before anything is read.

        Raises:
            ValueError: naming the first unknown one, and those that are known.
        """
        for key, expected, given, known in (
            (f"stage.{stage}", "a key of", numbers, cls.numbers),
            ("objective", "a term of", terms, cls.terms),
            ("objective.literal", "some of", literal, cls.literal),
        ):
            if unknown := [name for name in given if name not in known]:
                names = ", ".join(known) or "none"
                raise ValueError(f"{key}: expected {expected} {names}, but got '{unknown[0]}'")

    @classmethod
    def check_feasible(
        cls, scene: Scene, stage: str, numbers: Mapping[str, Any], device: torch.device
    ) -> None:
        """Refuse a scene that a stage with these ``numbers`` cannot be trained on, on this device.

        Called before the first stage is begun; a look at some pictures is all that it should cost.

        Raises:
            ValueError: naming what would be feasible.
        """

    def _load_from_state_dict(self, state_dict, prefix, *args, **kwargs) -> None:
        state = self.current_names(state_dict, prefix)
        state_dict.clear()
        state_dict.update(state)
        for name in self.adopted():  # including those of submodules, which load later
            if prefix + name in state_dict:
                place, _, last = name.rpartition(".")
                owner, own = self.get_submodule(place), part_of(self, name)
                empty = own.data.new_empty(state_dict[prefix + name].shape)
                if isinstance(own, nn.Parameter):
                    own.data = empty
                else:
                    setattr(owner, last, empty)  # a new tensor: caches know an index by its identity
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def misread(name: str, read: Callable[[], object]) -> str | None:
    """Return the name of a stored entry whose content ``read`` cannot read; None if it can."""
    try:
        read()
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return name
    return None


def part_of(method: nn.Module, name: str) -> Tensor:
    """Return a parameter or buffer by its dotted name."""
    place, _, last = name.rpartition(".")
    return getattr(method.get_submodule(place), last)


def those_that_hold(notes: Mapping[str, object]) -> list[str]:
    """Return the notes whose condition holds, in order."""
    return [note for note, holds in notes.items() if holds]


def parameter_count(method: nn.Module) -> int:
    """Return the number of learned parameters."""
    return sum(p.numel() for p in method.parameters())


Model = Callable[[Start], Method]  # makes the method of a stage


@runtime_checkable
class HasTrajectories(Protocol):
    """Follow points through time."""

    moves: bool  # False if the scene is static

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Return the paths (N, T, 3) of canonical points (N, 3) at ``times`` (T,), in world units."""


@runtime_checkable
class HasBackwardFlow(Protocol):
    """Say of every place, at any time, where what is there was at the canonical time."""

    def backward_flow(self, points: Tensor, time: float) -> Tensor:
        """Return the way (N, 3) from places (N, 3) at a time in [0, 1] to the canonical ones, world units."""


@runtime_checkable
class CarriesPixels(Protocol):
    """Follow what an image shows through time."""

    def carried(self, view: View, moment: Moment, to: Moment) -> Tensor:
        """Return where (R, 3) what the pixels of a view show at a moment is at another one, in world units;
        NaN where they show nothing.
        """


@runtime_checkable
class HasBounds(Protocol):
    """Bound all matter."""

    def bounds(self, times: list[float]) -> Box | None:
        """Return the box that holds all matter at all ``times``, in world units; None if there is none."""


@runtime_checkable
class HasMatter(Protocol):
    """Give the matter as points, for drawing, export and the next stage."""

    def matter(self) -> Cloud:
        """Return all canonical matter as points."""


@runtime_checkable
class HasEllipsoids(Protocol):
    """Be a cloud of soft ellipsoids, for programs that draw such."""

    def ellipsoids(self, time: float) -> Ellipsoids:
        """Return all of them as they are at a time in [0, 1], without gradients; a row is always the same."""

    def template(self) -> Ellipsoids:
        """Return them before any motion, with opacity and colours of the canonical time."""

    def movement(self, times: Sequence[float]) -> dict[str, Tensor]:
        """Return, by name, what makes ``ellipsoids`` at T times of the ``template``, and its coefficients."""


@runtime_checkable
class HasMovingGaussians(Protocol):
    """Be Gaussians that nodes with curves move, so that a file can hold all times of them."""

    def moving(self) -> MovingGaussians:
        """Return all of them, without gradients."""


@runtime_checkable
class HasLayers(Protocol):
    """Tell what moves from what rests, row by row of ``HasEllipsoids``.

    A snapshot also has ``share(view, rows)``: the share (R,) in [0, 1] of each pixel of a view that is rows
    (N,) bool, as nothing hides it.
    """

    def in_motion(self, frames: Sequence[Frame]) -> Tensor:
        """Return which rows (N,) bool move so that images like ``frames`` show it: about a pixel and more."""

    def only(self, rows: Tensor) -> Method:
        """Return a copy that has only some rows (N',) int64, or those of a mask (N,)."""


@runtime_checkable
class HasCommon(Protocol):
    """Be Gaussians some of which other runs have too, as they began from the same one (``Start.shares``)."""

    def common(self) -> Tensor | None:
        """Return, for each row of ``HasMovingGaussians``, the row of that run (N,) int64 which it still is;
        -1: of none; ascending but for these. None: the run began from no other.
        """


@runtime_checkable
class HasSolid(Protocol):
    """Of a snapshot: tell how opaque every place is, for meshes."""

    def solid(self, lattice: Lattice) -> tuple[Tensor, Tensor]:
        """Return the opacity (X, Y, Z) of a small cube around each point of a lattice, and its mean colour
        over all directions (X, Y, Z, 3); 0 where there is nothing.
        """


FRACTION = "a fraction in [0, 1]", lambda part: 0 <= part <= 1


def check_number(key: str, given: Any, wanted: str, good: Callable[[float], bool]) -> None:
    """Refuse what is no number, or no good one.

    Raises:
        ValueError: naming the key, and in words what it takes.
    """
    check_value(key, given, wanted, lambda value: is_number(value) and good(value))


def check_least(least: int = 0, *, of: str = "model", **given: Any) -> None:
    """Refuse what is no whole number of at least ``least``; ``given`` by their keys in ``of``.

    Raises:
        ValueError: naming the key.
    """
    for name, count in given.items():
        wanted = f"a whole number >= {least}"
        check_value(f"{of}.{name}", count, wanted, lambda number: type(number) is int and number >= least)


def check_effects(key: str, given: Sequence[str], names: Sequence[str]) -> None:
    """Refuse effects of a stage, ``stage.<name>.effects``, that are not among ``names``.

    Raises:
        ValueError: naming the key.
    """
    effects = list(given) if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    check_value(key, effects, f"some of {', '.join(names)}", lambda some: all(one in names for one in some))


def steps_of(
    key: str, given: Any, least: float = 1.0, *, from_start: bool = False
) -> list[tuple[float, float]]:
    """Return a schedule ``[[fraction, count], ...]`` as pairs: ``count`` from ``fraction`` of a stage on.

    Args:
        key: of the schedule.
        given: what is set there.
        least: the least count.
        from_start: whether the first fraction must be 0.

    Raises:
        ValueError: for something else, for nothing, or for fractions that do not ascend.
    """
    try:
        pairs = [(float(begin), float(count)) for begin, count in given]
    except (TypeError, ValueError):
        pairs = []
    fractions = [begin for begin, _ in pairs]
    good = pairs and all(0 <= begin <= 1 and count >= least for begin, count in pairs)
    if not good or fractions != sorted(fractions) or (from_start and fractions[0] != 0):
        form = "[[0, count], [fraction, count], ...]" if from_start else "[[fraction, count], ...]"
        wanted = f"{form} with ascending fractions and counts >= {least:g}"
        raise ValueError(f"{key}: expected {wanted}, but got {given}")
    return pairs


def value_at(steps: Sequence[Sequence[float]], fraction: float) -> float | None:
    """Return the value of a schedule, see ``steps_of``, at a fraction of a stage; None if it is empty.

    >>> value_at([[0, 4], [0.25, 2]], 0.3)
    2
    """
    value = None
    for begin, number in steps:
        if fraction >= begin or value is None:
            value = number
    return value
