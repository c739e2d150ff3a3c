"""Decide which effects of the paper's method a scene needs, from evidence and trials, with the reason."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from forewarp.methods.effect import Asked, Begin, Decision, Effect, Evidence, Rival
from forewarp.methods.voxel.evidence import Movement, Residual, movement, residual
from forewarp.scene.box import Lattice
from forewarp.scene.frame import Scene, spread
from forewarp.scene.silhouettes import Pictures
from forewarp.scene.view import Target

if TYPE_CHECKING:
    from forewarp.methods.voxel.forward_warp import ForwardWarp

CUT_OUT = 0.001  # share of transparent pixels below which the scene has a background
MOVING = 0.02  # share of moving solid voxels above which the scene moves
DISAGREEMENT = 0.01  # share of the foreground that no static shape explains
NARROW = 15.0  # degrees between the most different cameras below which direction cannot be observed
# Pairs of bounds: beyond the first the effect is worth a trial, beyond the second it is chosen without one.
BY_DIRECTION = (0.0, 0.05)  # share of the error that direction explains
TORN = (0.1, 0.3)  # share of solid voxels
HEADROOM = (3.0, 1.0)  # dB that the last lattice allows beyond what is reached; the less, the more needed
VIEWS = 24  # training views whose errors are measured
# Off while motion is learned, as view-dependent colour would explain it away.
PLAIN = ("model/view_dependence=none", "model/inpainter=none", "model/upsampler=none")


@dataclass
class VoxelEvidence(Evidence):
    """The evidence of the images and of a coarse stage: how it moves (None: static), and its errors."""

    movement: Movement | None = None
    residual: Residual | None = None


def of_motion(evidence: VoxelEvidence, on: str) -> Decision:
    """Decide on motion."""
    times, seen, moved = evidence.pictures.times, evidence.pictures.disagreement, evidence.movement
    if times < 2:
        return Decision("motion", "none", ("model/motion=none",), "1 time: nothing can be seen to move")
    share = moved.moving if moved is not None else 0.0
    why = f"{times} times; silhouettes: a static shape explains all but {seen:.1%} of the foreground"
    why = why if evidence.pictures.cut_out >= CUT_OUT else f"{times} times"
    why += f"; {share:.0%} of the solid voxels move" + (f", by {moved.distance:.2g}" if share else "")
    pays = evidence.pays("motion")
    pays = (share > MOVING or seen > DISAGREEMENT) if pays is None else pays
    return _switch("motion", pays, on, why + evidence.of_trial("motion"))


def of_bases(evidence: VoxelEvidence, usual: int, more: int) -> Decision:
    """Decide on the number of cosines: the usual one, or more."""
    left, pays = evidence.movement.left_out, evidence.pays("bases")
    moved = evidence.movement
    why = f"{moved.bases()} of {len(left) - 1} cosines leave out no more than {moved.enough:.1f} voxels"
    if pays is None:
        pays = len(left) > 2 and left[-2] > moved.enough  # the last cosine still matters
    else:
        why += f"; {more} of them against {usual}: " + evidence.of_trial("bases")[2:]
    return Decision("bases", str(more if pays else usual), (), why, pays)


def of_background(evidence: VoxelEvidence, moves: bool, on: str, start: Sequence[str]) -> Decision:
    """Decide on a grid for the static background; ``start``: overrides for scenes without silhouettes."""
    cut_out, pays = evidence.pictures.cut_out, evidence.pays("background")
    if cut_out >= CUT_OUT:
        why = f"{cut_out:.0%} of the pixels are transparent: the subject is cut out"
        return Decision("background", "none", ("model/background=none",), why)
    why = "0 % of the pixels are transparent"
    if not moves:
        why += ", but nothing moves: one field holds all"
        return Decision("background", "none", ("model/background=none", *start), why)
    chosen = _switch("background", pays is not False, on, why + evidence.of_trial("background"))
    return replace(chosen, overrides=(*chosen.overrides, *start))


def of_view(evidence: VoxelEvidence, on: str) -> Decision:
    """Decide on view dependence."""
    if evidence.pictures.spread < NARROW:
        why = f"all cameras lie within {evidence.pictures.spread:.0f} degrees: direction is not seen"
        return Decision("view_dependence", "none", ("model/view_dependence=none",), why)
    share = evidence.residual.by_direction
    why = f"direction explains {max(share, 0):.1%} of what the coarse stage leaves" + evidence.of_trial(
        "view_dependence"
    )
    return _switch("view_dependence", _called(evidence, "view_dependence", share > BY_DIRECTION[1]), on, why)


def of_inpainter(evidence: VoxelEvidence, on: str) -> Decision:
    """Decide on inpainting."""
    moved = evidence.movement
    if moved is None:
        return Decision(
            "inpainter", "none", ("model/inpainter=none",), "0 % of the voxels move: nothing opens"
        )
    why = f"{moved.torn:.1%} of the solid voxels are torn from a neighbour at time {moved.at:.2f}"
    pays = _called(evidence, "inpainter", moved.torn > TORN[1])
    return _switch("inpainter", pays, on, why + evidence.of_trial("inpainter"))


def of_upsampler(evidence: VoxelEvidence, on: str) -> Decision:
    """Decide on up-sampling."""
    left = evidence.residual
    why = f"the last lattice allows {left.allowed:.1f} dB, {left.psnr:.1f} are reached"
    pays = _called(evidence, "upsampler", left.allowed - left.psnr < HEADROOM[1])
    return _switch("upsampler", pays, on, why + evidence.of_trial("upsampler"))


def _called(evidence: VoxelEvidence, effect: str, alone: bool) -> bool:
    """Return what the trial says; without a trial, what the evidence ``alone`` says."""
    pays = evidence.pays(effect)
    return alone if pays is None else pays


def _switch(effect: str, is_on: bool, on: str, because: str) -> Decision:
    choice = on if is_on else "none"
    return Decision(effect, choice, (f"model/{effect}={choice}",), because, is_on)


def _not_in_coarse(asked: Asked) -> tuple[str, ...]:
    return (f"stage.{asked.coarse}.effects=[motion,background]",)


def _as_tried(asked: Asked) -> tuple[str, ...]:
    """Keep the lattice of the trial, as an effect on whole volumes costs too much on a finer one."""
    return (*_not_in_coarse(asked), *_on_first_lattice(asked))


def _on_first_lattice(asked: Asked) -> tuple[str, ...]:
    return (f"stage.{asked.last}.num_voxels=[[0,{asked.stages[asked.last]['num_voxels'][0][1]}]]",)


def _view_is_out(evidence: VoxelEvidence) -> bool:
    return evidence.pictures.spread < NARROW or evidence.residual.by_direction <= BY_DIRECTION[0]


def _inpainter_is_out(evidence: VoxelEvidence) -> bool:
    return evidence.movement is None or evidence.movement.torn <= TORN[0]


def _upsampler_is_out(evidence: VoxelEvidence) -> bool:
    return evidence.residual.allowed - evidence.residual.psnr >= HEADROOM[0]


EFFECTS = (
    Effect("motion", "dct"),
    Effect("background", "grid"),
    Effect("view_dependence", "sh", later=True, rules_out=_view_is_out, with_it=_not_in_coarse),
    Effect("inpainter", "unet3d", later=True, rules_out=_inpainter_is_out, with_it=_as_tried),
    Effect("upsampler", "learned", later=True, rules_out=_upsampler_is_out, with_it=_as_tried),
)


class VoxelPlanning:
    """Decide the effects of the paper's method (see ``methods.effect.Planning``)."""

    effects = EFFECTS
    steps, trial_steps, least = 3000, 250, 0.1

    def evidence(self, pictures: Pictures, **bounds) -> VoxelEvidence:
        """Begin the evidence with what the images say."""
        return VoxelEvidence(pictures, **bounds)

    def always(self, asked: Asked) -> tuple[Sequence[str], Sequence[str]]:
        """Keep later effects out of the coarse stage; run fine trials on the last stage's first lattice."""
        return _not_in_coarse(asked), _on_first_lattice(asked)

    def coarse(self, evidence: VoxelEvidence, asked: Asked) -> Generator[Begin | Rival, bool | None, None]:
        """Compare coarse stages: number of cosines, motion or none, static background or none."""
        pictures, start = evidence.pictures, _start(evidence, asked)
        if pictures.times < 2 or asked.typed.get("model/motion") == "none":
            static = ["model/motion=none", "model/background=none"]
            yield Begin("coarse-still", [*static, *PLAIN, *start])
            return
        behind = "model/background=" + (asked.choose("background") if start else "none")
        yield Begin("coarse", [f"model/motion={asked.choose('motion')}", behind, *PLAIN, *start])
        if not asked.trials:
            return
        usual, more = _bases(evidence, asked)
        if more > usual and not asked.typed.keys() & {"preset.bases", "model/motion"}:
            yield Rival("bases", "coarse-bases", _more_bases(more, asked), adds=True)
        moves = "model/motion" in asked.typed
        if not moves:
            moves = yield Rival("motion", "coarse-still", ["model/motion=none"])
        if start and not moves:  # one grid holds the whole static scene
            yield Begin("coarse-still-alone", ["model/background=none"], change=True)
        elif start and "model/background" not in asked.typed:
            yield Rival("background", "coarse-alone", ["model/background=none"])

    def look(
        self,
        evidence: VoxelEvidence,
        method: ForwardWarp,
        scene: Scene,
        targets: Sequence[Target],
        asked: Asked,
    ) -> None:
        """Measure how the coarse stage moves, and its errors in some training images."""
        evidence.movement = movement(method, scene.times) if method.moves else None
        box = method.bounds(list(scene.times))
        box = method.radiance.lattice.box if box is None else box.intersection(scene.box.scaled(1.05))
        count = max(count for _, count in asked.stages[asked.last]["num_voxels"])
        some = [targets[i] for i in spread(len(targets), VIEWS)]
        evidence.residual = residual(method, some, Lattice.of_count(box, count).voxel_size)

    def decide(self, evidence: VoxelEvidence, asked: Asked) -> list[Decision]:
        """Decide on all effects; what the user typed wins."""
        start = _start(evidence, asked)
        motion = overruled(of_motion(evidence, asked.choose("motion")), asked)
        moves, found = motion.on and evidence.movement is not None, []
        if moves:
            usual, more = _bases(evidence, asked)
            bases = of_bases(evidence, usual, more)
            found.append(replace(bases, overrides=tuple(_more_bases(more, asked)) if bases.on else ()))
        found += [
            of_background(evidence, moves, asked.choose("background"), start),
            of_view(evidence, asked.choose("view_dependence")),
            of_inpainter(evidence, asked.choose("inpainter")),
            of_upsampler(evidence, asked.choose("upsampler")),
        ]
        return [motion, *(overruled(decision, asked) for decision in found)]


def overruled(decision: Decision, asked: Asked) -> Decision:
    """Replace a decision by what the user typed for it, if anything."""
    key = "preset.bases" if decision.effect == "bases" else f"model/{decision.effect}"
    if key not in asked.typed:
        return decision
    choice = asked.typed[key]
    kept = () if key == "preset.bases" else tuple(o for o in decision.overrides if o.split("=")[0] != key)
    on = choice != "none" and decision.effect != "bases"
    return Decision(decision.effect, choice, kept, f"as typed; {decision.because}", on)


def _start(evidence: VoxelEvidence, asked: Asked) -> list[str]:
    """Return the overrides for a scene without silhouettes: start with faint matter everywhere."""
    if evidence.pictures.cut_out >= CUT_OUT:
        return []
    return [f"stage.{asked.coarse}.start_alpha=1e-2", f"stage.{asked.coarse}.confine=0.0"]


def _bases(evidence: VoxelEvidence, asked: Asked) -> tuple[int, int]:
    """Return the usual number of cosines, and the larger one to try."""
    usual = int(asked.preset["bases"])
    return usual, min(2 * usual, max(evidence.pictures.times - 1, 1))


def _more_bases(more: int, asked: Asked) -> list[str]:
    return [f"preset.bases={more}", f"stage.{asked.coarse}.bases=[[0,{more}]]"]
