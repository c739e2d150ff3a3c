"""Decide which effects of particles a scene needs: those that are missed while all others are on."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence

from forewarp.methods.effect import Asked, Begin, Decision, Drop, Effect, Evidence
from forewarp.methods.method import Method
from forewarp.scene.frame import Scene
from forewarp.scene.silhouettes import Pictures
from forewarp.scene.view import Target

CUT_OUT = 0.001  # share of transparent pixels below which silhouettes say nothing
DISAGREEMENT = 0.01  # share of the foreground that no static shape explains, above which something moves
NARROW = 15.0  # degrees between the most different cameras below which direction cannot be observed
AT_REST = 0.1  # least share of particles at rest for the background to be worth having
HARM = 0.2  # dB from which on the background costs too much
HOPELESS = 0.5  # of ``AT_REST``: so little at rest with one seed is little with all
RATES = {"means": 8e-3, "shade": 1e-3}  # learning rates of a trial

OF_NODES = ("rotation", "background")  # nothing without motion
STAND_INS = ("opacity_over_time", "color_over_time")  # for motion
# In the order in which they are left out; but see ``order``.
EFFECTS = (
    Effect("motion", "spline", attribute="nodes"),
    Effect("rotation", "nodes", attribute="nodes.turn"),
    Effect("background", "still", attribute="resting", rests=True),
    Effect("opacity_over_time", "cosines", attribute="fade"),
    Effect("color_over_time", "cosines", attribute="tint"),
    Effect("view_dependence", "harmonics", attribute="shade"),
)


class ParticlesEvidence(Evidence):
    """Evidence that decides the background by what rests, as it makes steps cheaper, not pictures better."""

    def pays(self, effect: str) -> bool | None:
        """Return whether an effect is missed; the background: whether much rests, at hardly any loss."""
        if effect == "background" and effect in self.gains:
            return self.at_rest.get(effect, 0.0) >= AT_REST and self.gains[effect].psnr >= -HARM
        return super().pays(effect)

    def hopeless(self, effect: str) -> bool:
        """See ``Evidence``; the background: very little rests, or it costs accuracy beyond noise."""
        if effect != "background":
            return super().hopeless(effect)
        gain = self.gains[effect]
        return self.at_rest.get(effect, 0.0) < HOPELESS * AT_REST or gain.psnr + gain.noise < -HARM

    def bound(self, effect: str) -> float:
        """See ``Evidence``; less in longer trials, as what is rough falls with the root of the steps."""
        return self.least / math.sqrt(longer(effect, self.pictures))

    def of_trial(self, effect: str) -> str:
        """Describe an effect's trial; the background: how much came to rest, too."""
        told = super().of_trial(effect)
        if not told or effect != "background":
            return told
        return f"; {self.at_rest.get(effect, 0.0):.1%} at rest, {AT_REST:.0%} asked{told}"

    def asked_of(self, effect: str) -> str:
        """See ``Evidence``; the background may cost a little."""
        return f"{-HARM} or more asked" if effect == "background" else super().asked_of(effect)


class ParticlesPlanning:
    """Decide the effects of particles (see ``methods.effect.Planning``)."""

    effects = EFFECTS
    # In a short trial effects make up for what is still rough: by up to 0.5 dB where they are not called for.
    steps, trial_steps, least = 150, 700, 0.6

    def evidence(self, pictures: Pictures, **bounds) -> Evidence:
        """Begin the evidence with what the images say."""
        return ParticlesEvidence(pictures, **bounds)

    def always(self, asked: Asked) -> tuple[Sequence[str], Sequence[str]]:
        """Shape particles without any effect, so that all trials continue from the same; let them learn
        faster than usual, as trials have few steps. (At the usual rate a still scene had 2.3 dB more with
        motion than without after 1,000 steps, as nodes go faster than particles; after 3,000 it had 0.7 dB
        less.)
        """
        rates = [f"stage.{asked.last}.lr.{name}={rate:g}" for name, rate in RATES.items()]
        return [f"stage.{asked.coarse}.effects=[]"], rates

    def coarse(self, evidence: Evidence, asked: Asked) -> Generator[Begin | Drop, bool | None, None]:
        """Begin with every effect that the pictures can show, and leave out one after the other."""
        seen = {e.name: unseen(e.name, evidence.pictures) is None for e in EFFECTS}
        on = {name: asked.choose(name) if seen[name] else "none" for name in seen}
        yield Begin("coarse", _choices(on))
        moves = asked.typed.get("model/motion") != "none"
        for name in [name for name in order(evidence.pictures) if seen[name] and asked.trials]:
            if f"model/{name}" in asked.typed or (name in OF_NODES and not moves):
                continue
            off = (name, *OF_NODES) if name == "motion" else (name,)
            times_longer = longer(name, evidence.pictures)
            pays = yield Drop(name, _choices(dict.fromkeys(off, "none")), times_longer)
            moves = pays if name == "motion" else moves

    def look(
        self, evidence: Evidence, method: Method, scene: Scene, targets: Sequence[Target], asked: Asked
    ) -> None:
        """Add nothing: the coarse stage knows no effect."""

    def decide(self, evidence: Evidence, asked: Asked) -> list[Decision]:
        """Decide on all effects; what the user typed wins."""
        found: dict[str, Decision] = {}
        for effect in EFFECTS:
            name, why = effect.name, unseen(effect.name, evidence.pictures)
            if name in OF_NODES and not found["motion"].on:
                why = "0 nodes: nothing moves"
            pays = why is None and self._called(name, evidence)
            typed = asked.typed.get(effect.group)
            choice = typed or (asked.choose(name) if pays else effect.off)
            why = ("as typed; " if typed else "") + (why or _because(name, evidence))
            found[name] = Decision(
                name, choice, () if typed else _choices({name: choice}), why, choice != effect.off
            )
        return list(found.values())

    def _called(self, name: str, evidence: Evidence) -> bool:
        """Return what the trials say. Without trials nodes move and turn unless silhouettes deny it, and come
        to rest where pictures are cut out.
        """
        pays = evidence.pays(name)
        if pays is not None:
            return pays
        cut_out = evidence.pictures.cut_out >= CUT_OUT
        moves = not cut_out or evidence.pictures.disagreement > DISAGREEMENT
        return moves and (name in ("motion", "rotation") or (name == "background" and cut_out))


def order(pictures: Pictures) -> list[str]:
    """Return the names of the effects in the order in which they are left out.

    Where nothing is cut out, those that could stand in for motion go first: everything is visible all the
    time, and fading in and out mimics it. (In the room motion gains 0.8 dB with them, 4 dB without.)
    """
    names = [effect.name for effect in EFFECTS]
    if pictures.cut_out >= CUT_OUT:
        return names
    return [*STAND_INS, *(name for name in names if name not in STAND_INS)]


def longer(name: str, pictures: Pictures) -> int:
    """Return how many times the usual steps trials of an effect have.

    Those of view dependence are longer: after few steps it makes up for a shape that is still rough. (A matte
    scene that stands still gains 0.4 dB by it after 700 steps, and 0.2 dB after 1,500, a glossy one 0.7 and
    0.6.) So are those of motion and background where nothing is cut out, as the start is so rough that all
    learn as fast at first. (The room gains 0.5 dB by motion after 700 steps, and 2.2 dB after 2,100.)
    """
    if name in ("motion", "background") and pictures.cut_out < CUT_OUT:
        return 3
    return 2 if name == "view_dependence" else 1


def unseen(name: str, pictures: Pictures) -> str | None:
    """Say why pictures cannot show an effect; None if they can."""
    if name == "view_dependence":
        why = f"all cameras lie within {pictures.spread:.0f} degrees: direction is not seen"
        return why if pictures.spread < NARROW else None
    return "1 time: nothing can be seen to change" if pictures.times < 2 else None


def _because(name: str, evidence: Evidence) -> str:
    pictures = evidence.pictures
    if name != "motion":
        return evidence.of_trial(name)[2:] or f"{pictures.times} times, and no trial"
    why = f"{pictures.times} times"
    if pictures.cut_out >= CUT_OUT:
        why += f"; silhouettes: a static shape explains all but {pictures.disagreement:.1%} of the foreground"
    return why + evidence.of_trial(name)


def _choices(choices: dict[str, str]) -> tuple[str, ...]:
    return tuple(f"model/{name}={choice}" for name, choice in choices.items())
