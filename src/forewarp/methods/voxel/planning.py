"""What a scene calls for of the paper's method: from evidence and trials, with the number that decided."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from forewarp.methods.effect import Asked, Begin, Decision, Effect, Evidence, Rival
from forewarp.methods.voxel.evidence import Movement, movement
from forewarp.methods.voxel.residual import Residual, residual
from forewarp.scene.batch import Target
from forewarp.scene.box import Lattice
from forewarp.scene.frame import Scene, spread
from forewarp.scene.pictures import Pictures

if TYPE_CHECKING:
    from forewarp.methods.voxel.forward_warp import ForwardWarp

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
VIEWS = 24  # training views whose residual is looked at
# Not asked while motion is learned: colour that depends on direction would explain it away.
PLAIN = ("model/view_dependence=none", "model/inpainter=none", "model/upsampler=none")


@dataclass
class VoxelEvidence(Evidence):
    """What a coarse stage of the forward method says beside the pictures: how things move, where anything
    does, and what is left of the training pictures.
    """

    movement: Movement | None = None
    residual: Residual | None = None


def of_motion(evidence: VoxelEvidence, on: str) -> Decision:
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


def of_bases(evidence: VoxelEvidence, usual: int, more: int) -> Decision:
    """How many cosines: as many as usual, or more."""
    left, pays = evidence.movement.left_out, evidence.pays("bases")
    moved = evidence.movement
    why = f"{moved.bases()} of {len(left) - 1} cosines leave out no more than {moved.enough:.1f} voxels"
    if pays is None:
        pays = len(left) > 2 and left[-2] > moved.enough  # the last one still has much to say
    else:
        why += f"; {more} of them against {usual}: " + evidence.of_trial("bases")[2:]
    return Decision("bases", str(more if pays else usual), (), why, pays)


def of_background(evidence: VoxelEvidence, moves: bool, on: str, start: Sequence[str]) -> Decision:
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
    return replace(chosen, overrides=(*chosen.overrides, *start))


def of_view(evidence: VoxelEvidence, on: str) -> Decision:
    """Whether colour depends on direction."""
    if evidence.pictures.spread < SPREAD:
        why = f"all cameras lie within {evidence.pictures.spread:.0f} degrees: direction is not seen"
        return Decision("view_dependence", "none", ("model/view_dependence=none",), why)
    share = evidence.residual.by_direction
    why = f"direction explains {max(share, 0):.1%} of what the coarse stage leaves" + evidence.of_trial(
        "view_dependence"
    )
    return _switch("view_dependence", _called(evidence, "view_dependence", share > BY_DIRECTION[1]), on, why)


def of_inpainter(evidence: VoxelEvidence, on: str) -> Decision:
    """Whether holes are to be filled."""
    moved = evidence.movement
    if moved is None:
        return Decision(
            "inpainter", "none", ("model/inpainter=none",), "0 % of the voxels move: nothing opens"
        )
    why = f"{moved.torn:.1%} of the solid voxels are torn from a neighbour at time {moved.at:.2f}"
    pays = _called(evidence, "inpainter", moved.torn > TORN[1])
    return _switch("inpainter", pays, on, why + evidence.of_trial("inpainter"))


def of_upsampler(evidence: VoxelEvidence, on: str) -> Decision:
    """Whether resolution limits."""
    left = evidence.residual
    why = f"the last lattice allows {left.allowed:.1f} dB, {left.psnr:.1f} are reached"
    pays = _called(evidence, "upsampler", left.allowed - left.psnr < HEADROOM[1])
    return _switch("upsampler", pays, on, why + evidence.of_trial("upsampler"))


def _called(evidence: VoxelEvidence, effect: str, alone: bool) -> bool:
    """What a trial says, or else the evidence alone."""
    pays = evidence.pays(effect)
    return alone if pays is None else pays


def _switch(effect: str, is_on: bool, on: str, because: str) -> Decision:
    choice = on if is_on else "none"
    return Decision(effect, choice, (f"model/{effect}={choice}",), because, is_on)


def _not_in_coarse(asked: Asked) -> tuple[str, ...]:
    return (f"stage.{asked.coarse}.effects=[motion,background]",)


def _as_tried(asked: Asked) -> tuple[str, ...]:
    """What is dear sees whole volumes: on the lattice that it was tried on."""
    return (*_not_in_coarse(asked), *_on_first_lattice(asked))


def _on_first_lattice(asked: Asked) -> tuple[str, ...]:
    return (f"stage.{asked.last}.num_voxels=[[0,{asked.stages[asked.last]['num_voxels'][0][1]}]]",)


def _view_is_out(evidence: VoxelEvidence) -> bool:
    return evidence.pictures.spread < SPREAD or evidence.residual.by_direction <= BY_DIRECTION[0]


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
    """How the paper's method finds its effects (see ``methods.effect.Planning``)."""

    effects = EFFECTS

    def evidence(self, pictures: Pictures, **bounds) -> VoxelEvidence:
        """Begin with what the pictures say."""
        return VoxelEvidence(pictures, **bounds)

    def always(self, asked: Asked) -> tuple[Sequence[str], Sequence[str]]:
        """Try later effects after the coarse stage alone, and on the first lattice of the last one."""
        return _not_in_coarse(asked), _on_first_lattice(asked)

    def coarse(self, evidence: VoxelEvidence, asked: Asked) -> Generator[Begin | Rival, bool | None, None]:
        """Ask: in how many cosines does something move, does it, what stands still behind it?"""
        pictures, start = evidence.pictures, _start(evidence, asked)
        if pictures.times < 2 or asked.typed.get("model/motion") == "none":
            still = ["model/motion=none", "model/background=none"]
            yield Begin("coarse-still", [*still, *PLAIN, *start])
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
        if start and not moves:  # one field holds all that stands still
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
        """Look at how things move, and at what the coarse stage leaves of some training pictures."""
        evidence.movement = movement(method, scene.times) if method.moves else None
        box = method.bounds(list(scene.times))
        box = method.radiance.lattice.box if box is None else box.intersection(scene.box.scaled(1.05))
        count = max(count for _, count in asked.stages[asked.last]["num_voxels"])
        some = [targets[i] for i in spread(len(targets), VIEWS)]
        evidence.residual = residual(method, some, Lattice.of_count(box, count).voxel_size)

    def decide(self, evidence: VoxelEvidence, asked: Asked) -> list[Decision]:
        """Decide all, overruled where something was typed."""
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
    """Keep the decision, or take what was typed in its place."""
    key = "preset.bases" if decision.effect == "bases" else f"model/{decision.effect}"
    if key not in asked.typed:
        return decision
    choice = asked.typed[key]
    kept = () if key == "preset.bases" else tuple(o for o in decision.overrides if o.split("=")[0] != key)
    on = choice != "none" and decision.effect != "bases"
    return Decision(decision.effect, choice, kept, f"as typed; {decision.because}", on)


def _start(evidence: VoxelEvidence, asked: Asked) -> list[str]:
    """How a scene without silhouettes begins: faint matter everywhere."""
    if evidence.pictures.cut_out >= CUT_OUT:
        return []
    return [f"stage.{asked.coarse}.start_alpha=1e-2", f"stage.{asked.coarse}.confine=0.0"]


def _bases(evidence: VoxelEvidence, asked: Asked) -> tuple[int, int]:
    """How many cosines are usual, and how many would be more."""
    usual = int(asked.preset["bases"])
    return usual, min(2 * usual, max(evidence.pictures.times - 1, 1))


def _more_bases(more: int, asked: Asked) -> list[str]:
    return [f"preset.bases={more}", f"stage.{asked.coarse}.bases=[[0,{more}]]"]
