"""Effects: a method's optional parts, and how a plan decides which of them a scene needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from forewarp.methods.method import Method
from forewarp.metrics.gain import Gain
from forewarp.scene.frame import Scene, Survey
from forewarp.scene.view import Target

CUT_OUT = 0.001  # share of transparent pixels below which the scene has a background
DISAGREEMENT = 0.01  # share of the foreground that no static shape explains, above which something moves
NARROW = 15.0  # degrees between the most different cameras below which direction cannot be observed


@dataclass(frozen=True)
class Effect:
    """An optional part of a method; off, it has no parameters and costs no time.

    Attributes:
        name: name of the config group ``model/<name>``.
        on: the usual option that switches it on; ``none`` switches it off.
        attribute: the method's attribute, perhaps a dotted name, that is None while the effect is off; by
            default ``name``.
        later: True: decide it after the coarse stage, by a trial with and without it. False: decide it by
            what ``Planning.coarse`` asks for.
        rules_out: returns True if the evidence makes a trial of a ``later`` effect pointless.
        with_it: returns further overrides, for the final run to be as its trial was.
        rests: True for what brings matter to rest: how much of it is evidence.
    """

    name: str
    on: str
    attribute: str | None = None
    later: bool = False
    rules_out: Callable[[Evidence], bool] = lambda evidence: False
    with_it: Callable[[Asked], Sequence[str]] = lambda asked: ()
    rests: bool = False

    @property
    def group(self) -> str:
        """Name of the effect's config group."""
        return f"model/{self.name}"

    def is_on(self, method: Method) -> bool:
        """Return whether the effect is on in a method."""
        part = method
        for name in (self.attribute or self.name).split("."):
            part = getattr(part, name, None)
        return part is not None


def switched(method: Method) -> dict[str, bool]:
    """Return which of a method's effects are on."""
    return {effect.name: effect.is_on(method) for effect in method.effects}


@dataclass(frozen=True)
class Decision:
    """The decision on an effect: the option chosen, the overrides (``overrides``) that choose it, the reason.

    ``on`` is False for the least that can be chosen.
    """

    effect: str
    choice: str
    overrides: tuple[str, ...]
    because: str
    on: bool = False


@dataclass
class Evidence:
    """What is known of a scene so far; a method's planning may extend it.

    Attributes:
        pictures: what the images alone say.
        gains: result of each trial, by effect.
        least: dB; a smaller gain counts as none.
        minutes: planned for the last stage; None: choose the cheapest option within noise of the best.
        slope: dB that the fine trial without effects gained in the second half of its ``steps``.
        steps: steps of that trial.
        step: seconds per step of that trial; None if unknown.
        at_rest: share of the matter that came to rest in trials with an effect that ``rests``, by effect;
            mean over seeds.
        most_steps: of the planned run's last stage, whatever its minutes; None: only they end it.
    """

    pictures: Survey
    gains: dict[str, Gain] = field(default_factory=dict)
    least: float = 0.1
    minutes: float | None = None
    slope: float = 0.0
    steps: int = 1
    step: float | None = None
    at_rest: dict[str, float] = field(default_factory=dict)
    most_steps: int | None = None

    @property
    def cut_out(self) -> bool:
        """Whether the subject is cut out, so that silhouettes say something."""
        return self.pictures.cut_out >= CUT_OUT

    @property
    def seen_to_move(self) -> str:
        """Describe what the images say of motion."""
        why = f"{self.pictures.times} times"
        if not self.cut_out:
            return why
        seen = self.pictures.disagreement
        return f"{why}; silhouettes: a static shape explains all but {seen:.1%} of the foreground"

    @property
    def no_direction(self) -> str | None:
        """Say why the images cannot show colour that depends on direction; None if they can."""
        spread = self.pictures.spread
        why = f"all cameras lie within {spread:.0f} degrees: direction is not seen"
        return why if spread < NARROW else None

    def price(self, gain: Gain) -> float:
        """Return the PSNR (dB) lost to the steps that an effect's extra time displaces.

        Assume that PSNR approaches its limit as ``1 / sqrt(steps)``, fitted to ``slope``. The price is 0 if
        no minutes are given, or if the trials had equal time.
        """
        if None in (self.minutes, self.step, gain.steps) or gain.times <= 1:
            return 0.0
        most = math.inf if self.most_steps is None else self.most_steps
        without, with_it = (min(max(60 * self.minutes / (self.step * k), 1.0), most) for k in (1, gain.times))
        scale = max(self.slope, 0.0) / (math.sqrt(2) - 1) * math.sqrt(self.steps)
        return scale * (1 / math.sqrt(with_it) - 1 / math.sqrt(without))

    def pays(self, effect: str) -> bool | None:
        """Return whether an effect's gain exceeds its noise and its price; None without a trial."""
        gain = self.gains.get(effect)
        return None if gain is None else gain.psnr > max(gain.noise, self.bound(effect)) + self.price(gain)

    def calls_for(self, effect: str, otherwise: bool) -> bool:
        """Return whether an effect pays; without a trial, ``otherwise``."""
        pays = self.pays(effect)
        return otherwise if pays is None else pays

    def hopeless(self, effect: str) -> bool:
        """Return whether the trials so far rule an effect out, so that no other seed need be tried."""
        gain = self.gains[effect]
        return gain.psnr + gain.noise < self.bound(effect)

    def bound(self, effect: str) -> float:
        """Return the gain (dB) below which an effect does not count."""
        return self.least

    def of_trial(self, effect: str) -> str:
        """Describe an effect's trial; an empty string without one."""
        gain = self.gains.get(effect)
        if gain is None:
            return ""
        price = self.price(gain)
        return f"; {gain}, {self.asked_of(effect)}" + (
            f", whose steps are worth {price:.2f} dB" if price >= 0.005 else ""
        )

    def asked_of(self, effect: str) -> str:
        """Say what an effect's gain must exceed beside its price."""
        return f"more than {max(self.gains[effect].noise, self.bound(effect)):.2f} asked"


@dataclass(frozen=True)
class Asked:
    """The run to plan.

    Attributes:
        stages: the configured numbers of each stage, in order.
        preset: the preset's numbers.
        typed: overrides that the user typed (key -> value); they are kept, not decided.
        choose: returns the option that switches an effect on.
        trials: whether trials may be run.
    """

    stages: Mapping[str, Mapping]
    preset: Mapping
    typed: Mapping[str, str]
    choose: Callable[[str], str]
    trials: bool

    @property
    def coarse(self) -> str:
        """Name of the first stage."""
        return next(iter(self.stages))

    @property
    def last(self) -> str:
        """Name of the last stage."""
        return list(self.stages)[-1]

    def decided(self, effect: str, on: bool, because: str, others: Sequence[str] = ()) -> Decision:
        """Return the decision on an effect, but what the user typed for it; ``others``: further overrides."""
        typed = self.typed.get(f"model/{effect}")
        if typed is not None:
            return Decision(effect, typed, tuple(others), f"as typed; {because}", typed != "none")
        choice = self.choose(effect) if on else "none"
        return Decision(effect, choice, (f"model/{effect}={choice}", *others), because, on)


class CoarseTrials(Protocol):
    """What a method may try with coarse stages, each of a name and of overrides."""

    def begin(self, name: str, overrides: Sequence[str], *, change: bool = False) -> None:
        """Fit a coarse stage and continue from it; with ``change`` of the coarse stage before."""

    def rival(self, effect: str, name: str, overrides: Sequence[str], *, adds: bool = False) -> bool:
        """Fit another coarse stage, which differs in ``overrides``; continue from the better one.

        The rival has the ``effect`` if it ``adds`` it, else it lacks it. Return whether the effect pays.
        """

    def drop(self, effect: str, overrides: Sequence[str], *, longer: int = 1) -> bool:
        """Continue the coarse stage with and, by ``overrides``, without an effect, at equal steps.

        If the effect is not missed, all later trials do without it. Return whether it pays. ``longer``: how
        many times the usual steps.
        """


class Planning(Protocol):
    """How a method's effects are decided: the attribute ``planning`` of its model.

    ``steps`` and ``trial_steps`` are the steps of a coarse stage and of a trial, and ``least`` the gain (dB)
    below which an effect does not count, unless the user says.
    """

    effects: Sequence[Effect]
    steps: int
    trial_steps: int
    least: float

    def evidence(self, pictures: Survey, **bounds) -> Evidence:
        """Begin the evidence with what the images say."""

    def always(self, asked: Asked) -> tuple[Sequence[str], Sequence[str]]:
        """Return the overrides of every trial, and the additional ones of fine trials."""

    def coarse(self, evidence: Evidence, asked: Asked, trials: CoarseTrials) -> None:
        """Fit coarse stages, and try what they tell of effects."""

    def look(
        self, evidence: Evidence, method: Method, scene: Scene, targets: Sequence[Target], asked: Asked
    ) -> None:
        """Add to the evidence what the chosen coarse stage shows."""

    def decide(self, evidence: Evidence, asked: Asked) -> list[Decision]:
        """Decide on every effect."""
