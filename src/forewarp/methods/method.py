"""The contract of a method: at a moment, what does a view see, and how is that learned?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from forewarp.scene.batch import Asks, Batch
from forewarp.scene.cloud import Handover
from forewarp.scene.frame import Scene
from forewarp.scene.view import Moment, Rendering, View


@dataclass(frozen=True)
class Start:
    """What a method is built from: the first argument of its constructor, before its own options.

    ``scene`` (cameras, times, box, points known to stand still; pictures through ``Frame.load``); the stage's
    name and its own ``numbers``; ``weights``, ``literal`` and ``photo_on`` of the objective; ``frames`` in
    play at first, nearest to the canonical time first; the ``handover`` and the fitted method of the stage
    ``before``, where there are such. A ``blank`` method is about to load a checkpoint: it needs the shape
    of its parts only, and looks at no picture and no stage before.
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


@dataclass(frozen=True)
class Step:
    """What a method makes of a batch.

    ``terms``: each loss term by name, computed when it is called, () tensor; None from one whose effect is
    off. ``squared_error``: mean over pixels and channels, of the best rendering. ``noted``: numbers to log.
    ``gradients``: None, or those of the weighted sum by parameter name, where the method computes them
    itself; what the terms then give needs no graph. ``tensors``: intermediate results by name, looked
    through where a number is not finite.
    """

    terms: Mapping[str, Callable[[], Tensor | None]]
    squared_error: Tensor
    noted: Mapping[str, float] = field(default_factory=dict)
    gradients: Mapping[str, Tensor] | None = None
    tensors: Callable[[], Iterable[tuple[str, Tensor | None]]] = tuple


class Snapshot:
    """The scene frozen at a ``moment``; differentiable where gradients are on.

    ``renderings`` names the pictures that it can give, the best last.
    """

    moment: Moment
    renderings: Sequence[str] = ("rendered",)

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``view`` over ``background`` (3,) or (R, 3); by the best rendering where none is named."""
        raise NotImplementedError

    def holds(self, moment: Moment) -> bool:
        """Tell whether this is also the scene at another moment."""
        return moment == self.moment


class Method(nn.Module):
    """A scene that is learned. Give ``at`` and ``look``; the rest has defaults.

    ``terms`` are the loss terms it knows, ``literal`` those of them with a printed form of their own, and
    ``numbers`` the keys of a stage; ``asks`` what it wants of the sampler; ``effects`` its optional parts
    (see ``methods.effect``). Parameters and buffers named in ``grows``, dotted in parts of it, may change
    their number of rows while they are trained, and adopt a checkpoint's. Optional abilities are protocols
    in ``methods.abilities``.
    """

    terms: ClassVar[Sequence[str]] = ("photo",)
    literal: ClassVar[Sequence[str]] = ()
    numbers: ClassVar[Sequence[str]] = ()
    asks: Asks = Asks()
    effects: ClassVar[Sequence] = ()
    grows: ClassVar[Sequence[str]] = ()

    def at(self, moment: Moment) -> Snapshot:
        """Freeze the scene."""
        raise NotImplementedError

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """Compare with a batch. ``factors`` are the terms that count in this step, with their weights; all
        that is random is drawn from ``generator``. A step may be looked at again where a number is not
        finite, so what it counts lies in buffers, which are then put back.
        """
        raise NotImplementedError

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Name every parameter's learning rate: a key of ``stage.<name>.lr``."""
        return {"network": list(self.parameters())}

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make what steps along the gradients, from groups of ``params`` with their ``lr``."""
        return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-8, fused=True)

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Follow the schedule before a step, at a ``progress`` in [0, 1] of the stage; numbers to log. What
        is random here is drawn from torch's own generator on the CPU, which a checkpoint keeps.
        """
        return {}

    def warm_up(self) -> None:
        """Do what is needed once before the clock runs, as compiling kernels."""

    def notes(self) -> dict[str, float]:
        """Tell the next stage of the same method what only that understands."""
        return {}

    def protocol(self) -> dict[str, str]:
        """Say what a reader of its numbers should know, beside the dataset's protocol."""
        return {}

    @property
    def size(self) -> tuple[str, int]:
        """What its cost follows, in a word, and how much of it there is: voxels, particles, parameters."""
        return "parameters", parameter_count(self)

    @property
    def device(self) -> torch.device:
        """Where it is computed."""
        return next(self.parameters()).device

    def adopted(self) -> set[str]:
        """Name the entries of ``state_dict`` whose shapes are a checkpoint's to say."""
        return set(self.grows)

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """Name an entry of a stored state that contradicts the others; None where all is well. All that
        ``grows`` has as many rows as the first: kernels read one by the row of the other.
        """
        rows = {tuple(getattr(state[name], "shape", ()))[:1] for name in self.grows[:1]}
        for name in self.grows:
            shape, own = tuple(getattr(state[name], "shape", ())), part_of(self, name)
            if shape[:1] not in rows or not shape or shape[1:] != tuple(own.shape[1:]):
                return name
            if state[name].dtype != own.dtype:
                return name
        return None

    @classmethod
    def check(
        cls, stage: str, numbers: Iterable[str], terms: Iterable[str], literal: Iterable[str] = ()
    ) -> None:
        """Refuse what a stage says and this method does not know, before anything is read."""
        for key, what, given, known in (
            (f"stage.{stage}", "a key of", numbers, cls.numbers),
            ("objective", "a term of", terms, cls.terms),
            ("objective.literal", "some of", literal, cls.literal),
        ):
            for name in given:
                if name not in known:
                    there = ", ".join(known) or "none"
                    raise ValueError(f"{key}: expected {what} {there}, but got '{name}'")

    def _load_from_state_dict(self, state_dict, prefix, *args, **kwargs) -> None:
        for name in self.grows:  # also of its parts, which load after it
            if prefix + name in state_dict:
                own = part_of(self, name)
                own.data = own.data.new_empty(state_dict[prefix + name].shape)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def part_of(method: nn.Module, name: str) -> Tensor:
    """Find a parameter or buffer by its dotted name."""
    place, _, last = name.rpartition(".")
    return getattr(method.get_submodule(place), last)


def parameter_count(method: nn.Module) -> int:
    """Count the learned numbers."""
    return sum(p.numel() for p in method.parameters())
