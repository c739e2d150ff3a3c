"""The options of particles: effects, the numbers of a stage, and how a plan decides on effects."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, fields, replace

from forewarp.fields.curves import KINDS
from forewarp.methods.effect import Asked, Begin, Decision, Drop, Effect, Evidence
from forewarp.methods.method import Method
from forewarp.ops.backend import is_number
from forewarp.scene.frame import Scene
from forewarp.scene.silhouettes import Survey
from forewarp.scene.view import Target

_VIEWS = 100  # training images from which on more of them call for no more particles
CUT_OUT = 0.001  # share of transparent pixels below which silhouettes say nothing
DISAGREEMENT = 0.01  # share of the foreground that no static shape explains, above which something moves
NARROW = 15.0  # degrees between the most different cameras below which direction cannot be observed
AT_REST = 0.1  # least share of particles at rest for the background to be worth having
HARM = 0.2  # dB from which on the background costs too much
HOPELESS = 0.5  # of ``AT_REST``: so little at rest with one seed is little with all
RATES = {"means": 8e-3, "shade": 1e-3}  # learning rates of a trial


@dataclass(frozen=True)
class Effects:
    """The choice of each effect; None: off.

    Args:
        motion: the curves of the nodes, ``spline`` or ``cosines``.
        rotation: True: nodes also rotate what is beside them.
        view_dependence: degree 1 to 3 of the spherical harmonics by which colour depends on direction.
        color_over_time, opacity_over_time: number of cosines over time of each particle's colour and opacity.
        background: share of the scene's extent. Nodes that move (and, by rotating, move what is beside them)
            no farther than that from their mean position, or than a pixel, come to rest; particles that
            follow no others need no nodes any more.

    Raises:
        ValueError: naming the key of a choice that there is not.
    """

    motion: str | None = None
    rotation: bool | None = None
    view_dependence: int | None = None
    color_over_time: int | None = None
    opacity_over_time: int | None = None
    background: float | None = None

    def __post_init__(self) -> None:
        for name, expected, valid in (
            ("motion", " or ".join(KINDS), lambda choice: choice in KINDS),
            ("rotation", "true", lambda choice: choice is True),
            (
                "view_dependence",
                "a degree of 1 to 3",
                lambda choice: type(choice) is int and 1 <= choice <= 3,
            ),
            (
                "color_over_time",
                "a number of cosines >= 1",
                lambda choice: type(choice) is int and choice >= 1,
            ),
            (
                "opacity_over_time",
                "a number of cosines >= 1",
                lambda choice: type(choice) is int and choice >= 1,
            ),
            ("background", "a number > 0", lambda choice: is_number(choice) and choice > 0),
        ):
            choice = getattr(self, name)
            if choice is not None and not valid(choice):
                raise ValueError(
                    f"model.{name}: expected {expected}, or null, but got {choice!r}; "
                    f"choose model/{name}=none to switch it off"
                )

    def only(self, names: Sequence[str], times: int) -> Effects:
        """Switch off all effects but those named, and, in a scene of one time, those that need several."""
        kept = {name for name in names if times > 1 or name == "view_dependence"}
        if self.motion is None or "motion" not in kept:
            kept -= {"rotation", "background"}
        return replace(self, **{name: None for name in NAMES if name not in kept})


NAMES = tuple(field.name for field in fields(Effects))


def view_share(views: int) -> float:
    """Return how much so many training images tell of details, as a share in [0, 1] of a hundred's."""
    return min(1.0, views / _VIEWS)


@dataclass(frozen=True)
class Numbers:
    """The numbers of a stage that are the method's own. Shares are of the stage.

    Args:
        effects: those of the model's effects that the stage uses; one that only shapes particles uses none.
        density: particles there are in the end, times the square root of the pixels that show anything; of
            less than a hundred images, of their share of these pixels.
        first: share of them to begin with.
        full: share of them that this stage ends with.
        nodes: how many there are, times the square root of the particles at the beginning.
        knots: coefficients of each node's curve, times the square root of the times.
        straight: whether splines end without acceleration: two coefficients follow from the others.
        edges: neighbours that a node is kept rigid with.
        every: share between two rounds of density control, up to ``settled``.
        relink: rounds after which particles look again for the nodes beside them.
        rest: share from which nodes that do not move come to rest, where the model has a background.
        jitter, calm: deviation of the random shift of an image's time, which falls to 0 at the share
            ``calm``.
        time_offsets: largest learned correction of an image's time, times the mean distance of two training
            times; learned from ``calm`` on, of splines alone; 0: times are used as they are given.
        opacity_decay: share of their opacity that a step takes from the particles that its image shows, while
            the learning rate of opacity is its first; as that falls, so does the share.
        crowd_decay: extra opacity decay per step, scaled by ``max(0, 1 - covered_pixels /
            final_particle_count)``.
        loose: what is left of the weight of ``rigid`` at the end.
        name: name of the stage.

    Raises:
        ValueError: naming the stage's wrong key.
    """

    effects: Sequence[str] = NAMES
    density: float = 90.0
    first: float = 0.5
    full: float = 1.0
    nodes: float = 2.5
    knots: float = 2.2
    straight: bool = False
    edges: int = 6
    every: float = 0.01
    settled: float = 0.6
    relink: int = 5
    rest: float = 0.45
    jitter: float = 0.01
    calm: float = 0.4
    time_offsets: float = 0.0
    opacity_decay: float = 0.0
    crowd_decay: float = 0.0
    loose: float = 0.17
    name: str = "fine"

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        if not set(self.effects) <= set(NAMES):
            raise ValueError(
                f"{where}.effects: expected some of {', '.join(NAMES)}, but got {list(self.effects)}"
            )
        if not isinstance(self.straight, bool):
            raise ValueError(f"{where}.straight: expected true or false, but got {self.straight!r}")
        for keys, expected, valid in (
            (("first", "every", "loose", "full"), "a number in (0, 1]", lambda value: 0 < value <= 1),
            (("density", "nodes", "knots", "calm"), "a number > 0", lambda value: value > 0),
            (("edges", "relink"), "a whole number >= 1", lambda value: value >= 1 and value == int(value)),
            (("opacity_decay", "crowd_decay"), "a number in [0, 1)", lambda value: 0 <= value < 1),
            (("jitter", "settled", "rest", "time_offsets"), "a number >= 0", lambda value: value >= 0),
        ):
            for key in keys:
                value = getattr(self, key)
                if not (is_number(value) and valid(value)):
                    raise ValueError(f"{where}.{key}: expected {expected}, but got {value!r}")

    def most(self, covered: float, views: int) -> int:
        """Return how many particles there are in the end, by covered pixels and training images.

        >>> Numbers().most(20_000.0, 100), Numbers().most(20_000.0, 25)
        (12728, 6364)
        """
        return max(32, round(self.density * math.sqrt(covered * view_share(views))))

    def decay(self, most: float, covered: float) -> float:
        """Return the share of their opacity that a step takes from particles, by how crowded pixels are.

        >>> numbers = Numbers(crowd_decay=2.5e-3)
        >>> numbers.decay(10_000.0, 20_000.0), numbers.decay(10_000.0, 2000.0)
        (0.0, 0.002)
        """
        crowd = max(0.0, 1 - covered / most)
        return self.opacity_decay + self.crowd_decay * crowd * (1 - self.opacity_decay)

    def share_at(self, progress: float) -> float:
        """Return the share of all particles that there should be: it grows to ``full`` before ``settled``."""
        done = min(1.0, progress / max(0.8 * self.settled, 1e-6))
        return self.full * (self.first + (1 - self.first) * done)

    def motion(self, particles: int, times: int) -> tuple[int, int]:
        """Return how many nodes there are, and how many coefficients each has.

        >>> Numbers().motion(6364, 100)
        (199, 22)
        """
        knots = min(times + 2, round(self.knots * math.sqrt(times)))
        return max(4, round(self.nodes * math.sqrt(particles))), max(4, knots)


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

    def evidence(self, pictures: Survey, **bounds) -> Evidence:
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


def order(pictures: Survey) -> list[str]:
    """Return the names of the effects in the order in which they are left out.

    Where nothing is cut out, those that could stand in for motion go first: everything is visible all the
    time, and fading in and out mimics it. (In the room motion gains 0.8 dB with them, 4 dB without.)
    """
    names = [effect.name for effect in EFFECTS]
    if pictures.cut_out >= CUT_OUT:
        return names
    return [*STAND_INS, *(name for name in names if name not in STAND_INS)]


def longer(name: str, pictures: Survey) -> int:
    """Return how many times the usual steps trials of an effect have.

    Those of view dependence are longer: after few steps it makes up for a shape that is still rough. (A matte
    scene that stands still gains 0.4 dB by it after 700 steps, and 0.2 dB after 1,500, a glossy one 0.7 and
    0.6.) So are those of motion and background where nothing is cut out, as the start is so rough that all
    learn as fast at first. (The room gains 0.5 dB by motion after 700 steps, and 2.2 dB after 2,100.)
    """
    if name in ("motion", "background") and pictures.cut_out < CUT_OUT:
        return 3
    return 2 if name == "view_dependence" else 1


def unseen(name: str, pictures: Survey) -> str | None:
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
