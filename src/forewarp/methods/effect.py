"""Effects: a method's optional parts, and what a scene's images say of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from forewarp.methods.method import Method
from forewarp.scene.frame import Survey

CUT_OUT = 0.001  # share of transparent pixels below which the scene has a background
# Share of the foreground that no static shape explains, up to which silhouettes stand still. Of nineteen
# scenes those that stand still have 0.0 %, the others from 0.37 % (things that appear) on.
STILL = 0.001
ENOUGH = 40  # images from which on it counts that nothing is seen to change
DRIFT_TIMES = 4  # of training for each cosine of a drift of exposure; fewer tell nothing of it
NARROW = 15.0  # degrees between the most different cameras below which direction cannot be observed
# Least shares of what a still fit leaves over that time, and direction, explain; within a gap, so that no
# order of sums decides. Time explains less than nothing of scenes that stand still and 0.12 or more where the
# light moves; direction up to 0.10 of a matte scene and from 0.20 on of a glossy one (docs/effects.md).
BY_TIME, BY_DIRECTION = 0.02, 0.15


@dataclass(frozen=True)
class Residual:
    """Errors that a still fit of a scene leaves in its training images.

    Attributes:
        by_time, by_direction: shares of the squared error that colours changing over time, or with the
            direction of view, explain, beyond what a constant colour does. Negative: they fit noise.
    """

    by_time: float
    by_direction: float


@dataclass(frozen=True)
class Evidence:
    """What is known of a scene: what its images say and, where silhouettes stand still, a still fit;
    ``unfit``: why there is none where one is called for.
    """

    pictures: Survey
    residual: Residual | None = None
    unfit: str | None = None

    @property
    def cut_out(self) -> bool:
        """Whether the subject is cut out, so that silhouettes say something."""
        return self.pictures.cut_out >= CUT_OUT

    @property
    def silhouettes_rest(self) -> bool:
        """Whether there are many silhouettes of several times, and one static shape explains them all."""
        seen = self.pictures
        return self.cut_out and seen.times > 1 and seen.frames >= ENOUGH and seen.disagreement <= STILL

    def of_time(self) -> tuple[bool, str]:
        """Tell whether anything may change over time, and why."""
        if self.pictures.times < 2:
            return False, "1 time: nothing can be seen to change"
        why = f"{self.pictures.times} times"
        if not self.cut_out:
            return True, f"{why}; without silhouettes, motion is taken for granted"
        why += f"; a static shape explains all but {self.pictures.disagreement:.1%} of the silhouettes"
        if self.residual is None:
            return True, why + (f", and {self.unfit}, so it is left on" if self.unfit else "")
        share = self.residual.by_time
        return share > BY_TIME, f"{why}, and time {max(share, 0):.0%} of what a still fit leaves over"

    def of_exposure(self) -> tuple[bool, str]:
        """Tell whether exposure may drift, and why."""
        if not self.pictures.one_camera:
            return False, "several cameras, each of which has an exposure of its own"
        times = self.pictures.times
        few = "" if times >= DRIFT_TIMES else ", too few to tell a drift"
        return not few, f"one camera, {times} times{few}"

    def of_direction(self) -> tuple[bool, str]:
        """Tell whether colour may depend on direction, and why."""
        spread = self.pictures.spread
        if spread < NARROW:
            return False, f"all cameras lie within {spread:.0f} degrees: direction is not seen"
        why = f"cameras differ by {spread:.0f} degrees"
        if self.residual is None:
            return True, why
        if self.residual.by_time > BY_TIME:
            return True, f"{why}, and changes over time hide what direction explains"
        share = self.residual.by_direction
        return share > BY_DIRECTION, f"{why}; it explains {max(share, 0):.0%} of what a still fit leaves over"

    def of_background(self) -> tuple[bool, str]:
        """Tell whether there is a background beside the subject, and why."""
        share = self.pictures.cut_out
        return not self.cut_out, f"{share:.0%} of the pixels are transparent"


def always(evidence: Evidence) -> tuple[bool, str]:
    """Leave an effect to the preset, as no image speaks against it."""
    return True, "as the preset has it"


@dataclass(frozen=True)
class Effect:
    """An optional part of a method; off, it has no parameters and costs no time.

    Attributes:
        name: name of the config group ``model/<name>``, where ``none`` switches it off.
        attribute: the method's attribute, perhaps a dotted name, that is None while the effect is off; by
            default ``name``.
        of: tells whether the evidence allows the effect, and why.
        needs: name of an effect without which this one does nothing.
    """

    name: str
    attribute: str | None = None
    of: Callable[[Evidence], tuple[bool, str]] = always
    needs: str | None = None

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
    """The option ``choice`` of an effect's config group, and why; ``on``: it is not ``none``."""

    effect: str
    choice: str
    because: str

    @property
    def on(self) -> bool:
        """Whether the effect is on."""
        return self.choice != "none"


def decide(
    effects: Sequence[Effect], evidence: Evidence, preset: Mapping[str, str], typed: Mapping[str, str]
) -> list[Decision]:
    """Decide on all effects of a method: the preset's choice, unless the evidence rules an effect out.

    Args:
        effects: in an order in which each comes after what it needs.
        evidence: of the scene.
        preset: the option of each effect that the preset has for such images.
        typed: those that the user typed, which win.
    """
    decisions: dict[str, Decision] = {}
    for effect in effects:
        allowed, why = effect.of(evidence)
        if effect.needs in decisions and not decisions[effect.needs].on:
            allowed, why = False, f"does nothing without {effect.needs.replace('_', ' ')}"
        choice = preset.get(effect.name, "none") if allowed else "none"
        if allowed and choice == "none":
            why = "off in the preset"
        if effect.name in typed:
            choice, why = typed[effect.name], f"as typed; {why}"
        decisions[effect.name] = Decision(effect.name, choice, why)
    return list(decisions.values())
