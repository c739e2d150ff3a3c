"""A method's optional parts, and how a plan finds out which of them a scene calls for."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from forewarp.methods.method import Method
from forewarp.report.gain import Gain
from forewarp.scene.batch import Target
from forewarp.scene.frame import Scene
from forewarp.scene.pictures import Pictures


@dataclass(frozen=True)
class Effect:
    """An optional part of a method, absent and free where it is off.

    ``name`` is its config group ``model/<name>`` and, where ``attribute`` names no other, the attribute of
    the method that is None where it is off; ``on`` is what it is usually switched on by, ``off`` what
    switches it off. ``later``: tried from the coarse stage on, with it and without, unless ``rules_out``
    says that the evidence speaks against it; otherwise decided while coarse stages are compared. ``with_it``
    are further overrides that make a run as it was tried.
    """

    name: str
    on: str
    off: str = "none"
    attribute: str | None = None
    later: bool = False
    rules_out: Callable[[Evidence], bool] = lambda evidence: False
    with_it: Callable[[Asked], Sequence[str]] = lambda asked: ()

    @property
    def group(self) -> str:
        """Its config group."""
        return f"model/{self.name}"

    def is_on(self, method: Method) -> bool:
        """Tell whether a method has it."""
        return getattr(method, self.attribute or self.name, None) is not None


def switched(method: Method) -> dict[str, bool]:
    """Tell of each of a method's effects whether it is on."""
    return {effect.name: effect.is_on(method) for effect in method.effects}


@dataclass(frozen=True)
class Decision:
    """``choice`` of an effect, the ``overrides`` that make it, ``because``, and whether it is ``on``:
    more than the least there can be.
    """

    effect: str
    choice: str
    overrides: tuple[str, ...]
    because: str
    on: bool = False


@dataclass
class Evidence:
    """All that is known of a scene so far; a method's planning adds what it looks at. ``gains`` by effect.

    ``least`` (dB): a gain below it is none, however sure. ``minutes``: of the last stage that is planned;
    None: the cheapest within noise of the best. ``slope`` (dB): what ``steps`` bring the fine trial without
    any effect over half of them, ``step`` its seconds a step.
    """

    pictures: Pictures
    gains: dict[str, Gain] = field(default_factory=dict)
    least: float = 0.1
    minutes: float | None = None
    slope: float = 0.0
    steps: int = 1
    step: float | None = None

    def price(self, gain: Gain) -> float:
        """What the steps are worth that an effect leaves no time for, dB; 0 where no time is given, or the
        trial was of equal time.

        PSNR is taken to approach its end as ``1 / sqrt(steps)``, fitted to the trials' ``slope``.
        """
        if None in (self.minutes, self.step, gain.steps) or gain.times <= 1:
            return 0.0
        steps = max(60 * self.minutes / self.step, 1.0)
        scale = max(self.slope, 0.0) / (math.sqrt(2) - 1) * math.sqrt(self.steps)
        return scale / math.sqrt(steps) * (math.sqrt(gain.times) - 1)

    def pays(self, effect: str) -> bool | None:
        """Whether an effect's trial beats its noise and its price; None where there was none."""
        gain = self.gains.get(effect)
        return None if gain is None else gain.psnr > max(gain.noise, self.least) + self.price(gain)

    def of_trial(self, effect: str) -> str:
        """The trial in words; nothing where there was none."""
        gain = self.gains.get(effect)
        if gain is None:
            return ""
        price = self.price(gain)
        return f"; {gain}" + (f", whose steps are worth {price:.2f} dB" if price >= 0.005 else "")


@dataclass(frozen=True)
class Asked:
    """The run that is planned: its ``stages`` in order, each with its numbers as configured; the ``preset``'s
    numbers; what was ``typed`` (key -> value), which is not asked; ``choose(effect)``, the option that
    switches an effect on; and whether there may be ``trials``.
    """

    stages: Mapping[str, Mapping]
    preset: Mapping
    typed: Mapping[str, str]
    choose: Callable[[str], str]
    trials: bool

    @property
    def coarse(self) -> str:
        """The first stage's name."""
        return next(iter(self.stages))

    @property
    def last(self) -> str:
        """The last stage's name."""
        return list(self.stages)[-1]


@dataclass(frozen=True)
class Begin:
    """Fit a coarse stage ``name`` and go on from it.

    ``overrides`` are all of its overrides, or, with ``change``, changes to those of the stage before.
    """

    name: str
    overrides: Sequence[str]
    change: bool = False


@dataclass(frozen=True)
class Rival:
    """Fit another coarse stage ``name`` that differs in ``overrides``, and go on with the better.

    It is the one with the ``effect`` if ``adds``, else the one without. The answer: whether the effect pays.
    """

    effect: str
    name: str
    overrides: Sequence[str]
    adds: bool = False


class Planning(Protocol):
    """How a method's effects are decided; the attribute ``planning`` of its model."""

    effects: Sequence[Effect]

    def evidence(self, pictures: Pictures, **bounds) -> Evidence:
        """Begin with what the pictures say."""

    def always(self, asked: Asked) -> tuple[Sequence[str], Sequence[str]]:
        """Name the overrides of every trial, and those of fine ones beside them."""

    def coarse(self, evidence: Evidence, asked: Asked) -> Generator[Begin | Rival, bool | None, None]:
        """Name the coarse stages to fit, one after the other, and hear of each rival whether it pays."""

    def look(
        self, evidence: Evidence, method: Method, scene: Scene, targets: Sequence[Target], asked: Asked
    ) -> None:
        """Add what the chosen coarse stage says."""

    def decide(self, evidence: Evidence, asked: Asked) -> list[Decision]:
        """Decide every effect."""
