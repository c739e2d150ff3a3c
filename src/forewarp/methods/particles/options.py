"""The options of particles: effects, the numbers of a stage, and how a plan decides on effects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from forewarp.fields.curves import KINDS
from forewarp.methods.effect import DISAGREEMENT, Asked, CoarseTrials, Decision, Effect, Evidence
from forewarp.methods.method import Method
from forewarp.ops.backend import is_number
from forewarp.scene.frame import Scene, Survey
from forewarp.scene.view import Target

_VIEWS = 100  # training images from which on more of them call for no more particles
AT_REST = 0.1  # least share of particles at rest for the background to be worth having
HARM = 0.2  # dB from which on the background costs too much
HOPELESS = 0.5  # of ``AT_REST``: so little at rest with one seed is little with all
RATES = {"means": 8e-3, "sh": 1e-3}  # learning rates of a trial


@dataclass(frozen=True)
class Effects:
    """The choice of each effect; None: off. Defaults are those of cut-out images.

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

    motion: str | None = "spline"
    rotation: bool | None = True
    view_dependence: int | None = 1
    color_over_time: int | None = 2
    opacity_over_time: int | None = None
    background: float | None = 0.03

    def __post_init__(self) -> None:
        for name, expected, valid in (
            ("motion", " or ".join(KINDS), lambda choice: choice in KINDS),
            ("rotation", "true", lambda choice: choice is True),
            ("view_dependence", "a degree of 1 to 3", lambda choice: _is_count(choice) and choice <= 3),
            ("color_over_time", "a number of cosines >= 1", _is_count),
            ("opacity_over_time", "a number of cosines >= 1", _is_count),
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


def _is_count(choice: object) -> bool:
    return type(choice) is int and choice >= 1


def view_share(views: int) -> float:
    """Return how much so many training images tell of details, as a share in [0, 1] of a hundred's."""
    return min(1.0, views / _VIEWS)


@dataclass(frozen=True)
class Numbers:
    """The numbers of a stage that are the method's own. Shares are of the stage.

    Args:
        effects: those of the model's effects that the stage uses; one that only shapes particles uses none.
        density: number of particles in the end, divided by the square root of the covered pixels (those that
            show anything); of less than a hundred images, by that of their share of these pixels.
        initial_share, final_share: shares of that number that the stage begins and ends with.
        nodes: number of nodes, divided by the square root of the number of particles at the beginning.
        knots: coefficients of each node's curve, divided by the square root of the number of times; at most
            half as many as times and four more, or what lies between two of them would be left open.
        natural_splines: whether splines end without acceleration: two coefficients follow from the others.
        edges: neighbours that a node is kept rigid with.
        density_interval: share between two rounds of density control, up to ``density_until``.
        relink: rounds after which particles look again for the nodes beside them.
        rest_from: share from which nodes that do not move come to rest, where the model has a background.
        jitter: deviation of the random shift of an image's time, which falls to 0 at ``jitter_until``.
        time_offsets: largest learned correction of an image's time, times the mean distance of two training
            times; learned from ``jitter_until`` on, of splines alone; 0: times are used as they are given.
        opacity_decay: share of their opacity that a step takes from the particles that its image shows, while
            the learning rate of opacity is its first; as that falls, so does the share.
        crowd_decay: extra opacity decay per step, scaled by ``max(0, 1 - covered_pixels / final_count)``.
        hidden_decay: as ``opacity_decay``, of the particles that the image does not show.
        rigid_final_factor: factor that the weight of ``rigid`` falls to by the end.
        shell: far planes of the cameras at which particles stand behind all that images show; what is outside
            the box is at rest; at least 1. 0: particles begin in the box, and all may move. Images with alpha
            have none.
        name: name of the stage.

    Raises:
        ValueError: naming the stage's wrong key.
    """

    effects: Sequence[str] = NAMES
    density: float = 90.0
    initial_share: float = 0.5
    final_share: float = 1.0
    nodes: float = 2.5
    knots: float = 2.2
    natural_splines: bool = True
    edges: int = 6
    density_interval: float = 0.01
    density_until: float = 0.6
    relink: int = 5
    rest_from: float = 0.45
    jitter: float = 0.01
    jitter_until: float = 0.4
    time_offsets: float = 1.5
    opacity_decay: float = 0.0
    crowd_decay: float = 2.5e-3
    hidden_decay: float = 0.0
    rigid_final_factor: float = 0.17
    shell: float = 0.0
    name: str = "fine"

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        if not set(self.effects) <= set(NAMES):
            raise ValueError(
                f"{where}.effects: expected some of {', '.join(NAMES)}, but got {list(self.effects)}"
            )
        if not isinstance(self.natural_splines, bool):
            raise ValueError(
                f"{where}.natural_splines: expected true or false, but got {self.natural_splines!r}"
            )
        shares = "initial_share", "final_share", "density_interval", "rigid_final_factor"
        for keys, expected, valid in (
            (shares, "a number in (0, 1]", lambda value: 0 < value <= 1),
            (("density", "nodes", "knots", "jitter_until"), "a number > 0", lambda value: value > 0),
            (("edges", "relink"), "a whole number >= 1", lambda value: value >= 1 and value == int(value)),
            (
                ("opacity_decay", "crowd_decay", "hidden_decay"),
                "a number in [0, 1)",
                lambda value: 0 <= value < 1,
            ),
            (
                ("density_until", "rest_from", "jitter", "time_offsets"),
                "a number >= 0",
                lambda value: value >= 0,
            ),
            (("shell",), "0 or a number >= 1", lambda value: value == 0 or value >= 1),
        ):
            for key in keys:
                value = getattr(self, key)
                if not (is_number(value) and valid(value)):
                    raise ValueError(f"{where}.{key}: expected {expected}, but got {value!r}")

    def final_count(self, covered_pixels: float, views: int) -> int:
        """Return how many particles there are in the end.

        >>> Numbers().final_count(20_000.0, 100), Numbers().final_count(20_000.0, 25)
        (12728, 6364)
        """
        return max(32, round(self.density * math.sqrt(covered_pixels * view_share(views))))

    def decay(self, final_count: float, covered_pixels: float) -> float:
        """Return the share of their opacity that a step takes from particles, by how crowded pixels are.

        >>> Numbers().decay(10_000.0, 20_000.0), Numbers().decay(10_000.0, 2000.0)
        (0.0, 0.002)
        """
        crowd = max(0.0, 1 - covered_pixels / final_count)
        return self.opacity_decay + self.crowd_decay * crowd * (1 - self.opacity_decay)

    def share_at(self, progress: float) -> float:
        """Return the share of ``final_count`` at a progress: it is reached a little before control ends."""
        done = min(1.0, progress / max(0.8 * self.density_until, 1e-6))
        return self.final_share * (self.initial_share + (1 - self.initial_share) * done)

    def motion(self, particles: int, times: int) -> tuple[int, int]:
        """Return how many nodes there are, and how many coefficients each has.

        >>> Numbers().motion(6364, 100)
        (199, 22)
        """
        knots = min(times // 2 + 4, round(self.knots * math.sqrt(times)))
        return max(4, round(self.nodes * math.sqrt(particles))), max(4, knots)


OF_NODES = ("rotation", "background")  # nothing without motion
STAND_INS = ("opacity_over_time", "color_over_time")  # for motion
# In the order in which they are left out; but see ``order``.
EFFECTS = (
    Effect("motion", "spline", attribute="nodes"),
    Effect("rotation", "nodes", attribute="nodes.rotations"),
    Effect("background", "still", attribute="resting", rests=True),
    Effect("opacity_over_time", "cosines"),
    Effect("color_over_time", "cosines"),
    Effect("view_dependence", "harmonics", attribute="sh"),
)


class ParticlesEvidence(Evidence):
    """Evidence that decides the background by what rests, as it makes steps cheaper, not images better."""

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
        return self.least / math.sqrt(longer(effect, self))

    def of_trial(self, effect: str) -> str:
        """Describe an effect's trial; the background: how much came to rest, too."""
        trial = super().of_trial(effect)
        if trial and effect == "background":
            return f"; {self.at_rest.get(effect, 0.0):.1%} at rest, {AT_REST:.0%} asked{trial}"
        return trial

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

    def coarse(self, evidence: Evidence, asked: Asked, trials: CoarseTrials) -> None:
        """Begin with every effect that the images can show, and leave out one after the other."""
        seen = {e.name: unseen(e.name, evidence) is None for e in EFFECTS}
        on = {name: asked.choose(name) if seen[name] else "none" for name in seen}
        trials.begin("coarse", _choices(on))
        moves = asked.typed.get("model/motion") != "none"
        for name in [name for name in order(evidence) if seen[name] and asked.trials]:
            if f"model/{name}" in asked.typed or (name in OF_NODES and not moves):
                continue
            off = (name, *OF_NODES) if name == "motion" else (name,)
            pays = trials.drop(name, _choices(dict.fromkeys(off, "none")), longer=longer(name, evidence))
            moves = pays if name == "motion" else moves

    def look(
        self, evidence: Evidence, method: Method, scene: Scene, targets: Sequence[Target], asked: Asked
    ) -> None:
        """Add nothing: the coarse stage knows no effect."""

    def decide(self, evidence: Evidence, asked: Asked) -> list[Decision]:
        """Decide on all effects; what the user typed wins."""
        decisions: dict[str, Decision] = {}
        for effect in EFFECTS:
            name, why = effect.name, unseen(effect.name, evidence)
            if name in OF_NODES and not decisions["motion"].on:
                why = "0 nodes: nothing moves"
            on = why is None and self._called_for(name, evidence)
            decisions[name] = asked.decided(name, on, why or _because(name, evidence))
        return list(decisions.values())

    def _called_for(self, name: str, evidence: Evidence) -> bool:
        """Return what the trials say. Without trials nodes move and turn unless silhouettes deny it, and come
        to rest where images are cut out.
        """
        moves = not evidence.cut_out or evidence.pictures.disagreement > DISAGREEMENT
        alone = name in ("motion", "rotation") or (name == "background" and evidence.cut_out)
        return evidence.calls_for(name, moves and alone)


def order(evidence: Evidence) -> list[str]:
    """Return the names of the effects in the order in which they are left out.

    Where nothing is cut out, those that could stand in for motion go first: everything is visible all the
    time, and fading in and out mimics it. (In the room motion gains 0.8 dB with them, 4 dB without.)
    """
    names = [effect.name for effect in EFFECTS]
    if evidence.cut_out:
        return names
    return [*STAND_INS, *(name for name in names if name not in STAND_INS)]


def longer(name: str, evidence: Evidence) -> int:
    """Return how many times the usual steps trials of an effect have.

    Those of view dependence are longer: after few steps it makes up for a shape that is still rough. (A matte
    scene that stands still gains 0.4 dB by it after 700 steps, and 0.2 dB after 1,500, a glossy one 0.7 and
    0.6.) So are those of motion and background where nothing is cut out, as the start is so rough that all
    learn as fast at first. (The room gains 0.5 dB by motion after 700 steps, and 2.2 dB after 2,100.)
    """
    if name in ("motion", "background") and not evidence.cut_out:
        return 3
    return 2 if name == "view_dependence" else 1


def unseen(name: str, evidence: Evidence) -> str | None:
    """Say why the images cannot show an effect; None if they can."""
    if name == "view_dependence":
        return evidence.no_direction
    return "1 time: nothing can be seen to change" if evidence.pictures.times < 2 else None


def _because(name: str, evidence: Evidence) -> str:
    if name == "motion":
        return evidence.seen_to_move + evidence.of_trial(name)
    return evidence.of_trial(name)[2:] or f"{evidence.pictures.times} times, and no trial"


def _choices(choices: dict[str, str]) -> tuple[str, ...]:
    return tuple(f"model/{name}={choice}" for name, choice in choices.items())
