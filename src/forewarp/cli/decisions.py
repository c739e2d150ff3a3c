"""From evidence and trials to what a scene calls for, each with the number that decided it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from forewarp.methods.voxel.evidence import Movement, Pictures
from forewarp.methods.voxel.residual import Residual
from forewarp.report.effect import Gain

CUT_OUT = 0.001  # share of transparent pixels below which there is a real background
MOVING = 0.02  # share of solid voxels that move, above which something does
DISAGREEMENT = 0.01  # share of the foreground that no still thing explains
BY_DIRECTION = (
    0.0,
    0.05,
)  # share of the residual: above the first worth a trial, above the second enough alone
SPREAD = 15.0  # degrees between the most different cameras, below which direction cannot be told from place
TORN = (0.1, 0.3)  # share of solid voxels
HEADROOM = (3.0, 1.0)  # dB that the last lattice allows beyond what is reached: below these, as above
LATER = ("view", "inpainter", "upsampler")  # effects that are tried from the coarse stage on
DEAR = ("inpainter", "upsampler")  # of these the ones that see whole volumes


@dataclass(frozen=True)
class Decision:
    """``choice`` of an effect, the ``words`` of a command line that make it, ``because``, and whether it is
    ``on``: more than the least there can be.
    """

    effect: str
    choice: str
    words: tuple[str, ...]
    because: str
    on: bool = False


@dataclass
class Evidence:
    """All that is known of a scene so far; ``gains`` by effect.

    ``least`` (dB): a gain below it is none, however sure. ``minutes``: of the last stage that is planned;
    None: the cheapest within noise of the best. ``slope`` (dB): what ``steps`` bring the fine trial without
    any effect over half of them, ``step`` its seconds a step.
    """

    pictures: Pictures
    movement: Movement | None = None
    residual: Residual | None = None
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


def of_motion(evidence: Evidence, on: str) -> Decision:
    """Whether anything moves."""
    times, seen, moved = evidence.pictures.times, evidence.pictures.disagreement, evidence.movement
    if times < 2:
        return Decision("motion", "none", ("model/motion=none",), "1 time: nothing can be seen to move")
    share = moved.moving if moved is not None else 0.0
    why = f"{times} times; silhouettes: no still thing explains {seen:.1%} of the foreground"
    why = why if evidence.pictures.cut_out >= CUT_OUT else f"{times} times"
    why += f"; {share:.0%} of the solid voxels move" + (f", by {moved.distance:.2g}" if share else "")
    pays = evidence.pays("motion")
    pays = (share > MOVING or seen > DISAGREEMENT) if pays is None else pays
    return _switch("motion", pays, on, why + evidence.of_trial("motion"))


def of_bases(evidence: Evidence, usual: int, more: int) -> Decision:
    """How many cosines: as many as usual, or more."""
    left, pays = evidence.movement.left_out, evidence.pays("bases")
    moved = evidence.movement
    why = f"{moved.bases()} of {len(left) - 1} cosines leave out no more than {moved.enough:.1f} voxels"
    if pays is None:
        pays = len(left) > 2 and left[-2] > moved.enough  # the last one still has much to say
    else:
        why += f"; {more} of them against {usual}: " + evidence.of_trial("bases")[2:]
    return Decision("bases", str(more if pays else usual), (), why, pays)


def of_background(evidence: Evidence, moves: bool, on: str, start: Sequence[str]) -> Decision:
    """Whether what stands still has a grid of its own; ``start``: how a scene without silhouettes begins."""
    cut_out, pays = evidence.pictures.cut_out, evidence.pays("background")
    if cut_out >= CUT_OUT:
        why = f"{cut_out:.0%} of the pixels are transparent: the subject is cut out"
        return Decision("background", "none", ("model/background=none",), why)
    why = "0 % of the pixels are transparent"
    if not moves:
        why += ", but nothing moves: one field holds all"
        return Decision("background", "none", ("model/background=none", *start), why)
    chosen = _switch("background", pays is not False, on, why + evidence.of_trial("background"))
    return replace(chosen, words=(*chosen.words, *start))


def of_view(evidence: Evidence, on: str) -> Decision:
    """Whether colour depends on direction."""
    if evidence.pictures.spread < SPREAD:
        why = f"all cameras lie within {evidence.pictures.spread:.0f} degrees: direction is not seen"
        return Decision("view", "none", ("model/view=none",), why)
    share = evidence.residual.by_direction
    why = f"direction explains {max(share, 0):.1%} of what the coarse stage leaves" + evidence.of_trial(
        "view"
    )
    return _switch("view", _called(evidence, "view", share > BY_DIRECTION[1]), on, why)


def of_inpainter(evidence: Evidence, on: str) -> Decision:
    """Whether holes are to be filled."""
    moved = evidence.movement
    if moved is None:
        return Decision(
            "inpainter", "none", ("model/inpainter=none",), "0 % of the voxels move: nothing opens"
        )
    why = f"{moved.torn:.1%} of the solid voxels are torn from a neighbour at time {moved.at:.2f}"
    pays = _called(evidence, "inpainter", moved.torn > TORN[1])
    return _switch("inpainter", pays, on, why + evidence.of_trial("inpainter"))


def of_upsampler(evidence: Evidence, on: str) -> Decision:
    """Whether resolution limits."""
    left = evidence.residual
    why = f"the last lattice allows {left.allowed:.1f} dB, {left.psnr:.1f} are reached"
    pays = _called(evidence, "upsampler", left.allowed - left.psnr < HEADROOM[1])
    return _switch("upsampler", pays, on, why + evidence.of_trial("upsampler"))


def open_questions(evidence: Evidence) -> list[str]:
    """Effects that the evidence does not rule out: what is worth a trial from the coarse stage."""
    left, moved = evidence.residual, evidence.movement
    found = {
        "view": evidence.pictures.spread >= SPREAD and left.by_direction > BY_DIRECTION[0],
        "inpainter": moved is not None and moved.torn > TORN[0],
        "upsampler": left.allowed - left.psnr < HEADROOM[0],
    }
    return [effect for effect, is_open in found.items() if is_open]


def _called(evidence: Evidence, effect: str, alone: bool) -> bool:
    """What a trial says, or else the evidence alone."""
    pays = evidence.pays(effect)
    return alone if pays is None else pays


def _switch(effect: str, is_on: bool, on: str, because: str) -> Decision:
    choice = on if is_on else "none"
    return Decision(effect, choice, (f"model/{effect}={choice}",), because, is_on)
