"""Decide which effects of the paper's method a scene needs, from evidence and trials, with the reason."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forewarp.fields.grids import FieldAtTime
from forewarp.methods.effect import Asked, Begin, Decision, Effect, Evidence, Rival
from forewarp.methods.voxel.effects import Together
from forewarp.methods.voxel.model import SOLID
from forewarp.metrics.image import low_passed
from forewarp.ops.grid import index_of, neighbour_pairs
from forewarp.scene.box import Lattice
from forewarp.scene.frame import Scene, spread
from forewarp.scene.silhouettes import Survey
from forewarp.scene.view import Target, View

if TYPE_CHECKING:
    from forewarp.methods.voxel.forward import ForwardWarp

REACH = 2.0  # distance of neighbours in voxels; a splat reaches one voxel to either side
_TIMES = 40  # at most this many times are examined


@dataclass(frozen=True)
class Movement:
    """What the trajectories of a coarse stage show.

    Attributes:
        moving: share of solid voxels that move by more than one voxel.
        distance: mean over these of their largest displacement, world units.
        torn: largest share, over all times, of solid voxels more than ``REACH`` voxels away from a neighbour,
            so that the splat leaves holes.
        at: the time of ``torn``.
        left_out: RMS movement, in voxels, that the first k = 0, 1, ... cosines cannot represent.
    """

    moving: float
    distance: float
    torn: float
    at: float
    left_out: tuple[float, ...]

    @property
    def enough(self) -> float:
        """Movement that cosines may leave out, in voxels: half a voxel, or a tenth of a large movement."""
        return max(0.5, 0.1 * self.left_out[0])

    def bases(self) -> int:
        """Return the smallest number of cosines that leaves out no more than ``enough``."""
        return next(k for k, rest in enumerate(self.left_out) if rest <= self.enough)


@torch.no_grad()
def movement_of(method: ForwardWarp, times: Sequence[float]) -> Movement:
    """Measure how a fitted method with motion moves. Cost: one flow per time, at most ``_TIMES``."""
    grid, trajectory = method.radiance(), method.motion.trajectory
    lattice, voxels = grid.lattice, method.radiance.voxels
    solid = grid.activation.alpha(grid.raw_density, lattice.voxel_size) > SOLID
    if not bool(solid.any()):
        return Movement(0.0, 0.0, 0.0, trajectory.canonical_time, (0.0,))
    voxels = voxels[solid]
    some = [times[i] for i in spread(len(times), _TIMES)]
    flows = [method.motion.flow(method.radiance, time)[solid] for time in some]
    far = torch.stack([flow.norm(dim=-1) for flow in flows]).amax(0)
    moves = far > lattice.voxel_size
    pairs = neighbour_pairs(index_of(voxels, lattice.shape))
    torn = [_torn(pairs, flow / flow.new_tensor(lattice.spacing)) for flow in flows]
    worst = max(range(len(torn)), key=torn.__getitem__)
    return Movement(
        moving=float(moves.float().mean()),
        distance=float(far[moves].mean()) if bool(moves.any()) else 0.0,
        torn=torn[worst],
        at=some[worst],
        left_out=_left_out(trajectory, lattice.to_world(voxels[moves]), some, lattice.voxel_size),
    )


def _torn(pairs: list[tuple[Tensor, Tensor]], flow: Tensor) -> float:
    """Return the share of voxels that a flow (N, 3), in voxels, tears from a neighbour; ``pairs`` by axis."""
    torn = torch.zeros(len(flow), dtype=torch.bool, device=flow.device)
    for (rows, other), step in zip(pairs, torch.eye(3, device=flow.device)):
        far = (step + flow[other] - flow[rows]).norm(dim=-1) > REACH
        torn[rows[far]] = torn[other[far]] = True
    return float(torn.float().mean())


def _left_out(trajectory, points: Tensor, times: Sequence[float], voxel_size: float) -> tuple[float, ...]:
    """RMS over points and times of the movement in the cosines above the k-th, k = 0 ... K, in voxels."""
    if not len(points):
        return (0.0,)
    coefficients = trajectory.coefficients(points[:: max(1, len(points) // 20_000)])  # (N, 3, K)
    basis = trajectory.basis(torch.tensor(times))
    rest = []
    for k in range(trajectory.bases + 1):
        left = coefficients[..., k:] @ basis[:, k:].T
        rest.append(float(left.square().sum(1).mean().sqrt()) / voxel_size)
    return tuple(rest)


_WIDER = 4.0  # positions are encoded in a box this much wider, which holds a static background too


@dataclass(frozen=True)
class Residual:
    """The errors that a coarse stage without view dependence leaves in its training images.

    Attributes:
        psnr: PSNR of the coarse stage, dB.
        by_direction: share of the squared error that view-dependent colour would remove: at each place a
            colour linear in the viewing direction is fitted to other images. Negative: the fit adds noise.
        allowed: PSNR of the best images that the last stage's lattice can represent.
    """

    psnr: float
    by_direction: float
    allowed: float


@torch.no_grad()
def residual(method: ForwardWarp, targets: Sequence[Target], voxel_size: float, rays: int = 1500) -> Residual:
    """Measure the errors in some training images.

    Args:
        method: fitted, without view dependence.
        targets: training views.
        voxel_size: voxel size of the last stage's lattice, world units.
        rays: number of pixels of each image.
    """
    generator = torch.Generator().manual_seed(0)
    places, directions, errors, views, bounds = [], [], [], [], []
    for number, target in enumerate(targets):
        camera = target.frame.camera
        pixels = torch.randperm(camera.width * camera.height, generator=generator)[:rays]
        shown = _seen(method, target, pixels)
        error = target.rgb.reshape(-1, 3)[pixels] - shown[0]
        places.append(shown[1]), directions.append(camera.rays(pixels).directions), errors.append(error)
        views.append(torch.full((len(pixels),), number))
        voxel = voxel_size * camera.fx / max(float(shown[2]), 1e-6)
        bounds.append(float((low_passed(target.rgb, voxel) - target.rgb).square().mean()))
    error = torch.cat(errors)
    share = _explained(
        torch.cat(places),
        torch.cat(directions),
        error,
        torch.cat(views),
        2 * method.radiance.lattice.voxel_size,
    )
    return Residual(_psnr(float(error.square().mean())), share, _psnr(sum(bounds) / len(bounds)))


def _psnr(error: float) -> float:
    return -10 * math.log10(max(error, 1e-10))


def _seen(method: ForwardWarp, target: Target, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return colours (R, 3), canonical positions (R, 3), NaN for none, and median depth of some pixels."""
    view, time = View(target.frame.camera, pixels), target.frame.time
    drawn = method.at(target.moment).render(view, target.background.to(method.device))
    place, box = _places(method, time), method.radiance.lattice.box
    rays = view.rays().to(method.device)
    found = method.renderer.picture(place, rays, rays.origins.new_zeros(3))
    solid = found.opacity > 0.5
    low, high = (found.rgb.new_tensor(end) for end in (box.scaled(_WIDER).low, box.scaled(_WIDER).high))
    at = low + (high - low) * found.rgb / found.opacity.clamp(min=1e-6)[:, None]
    at[~solid] = math.nan
    return (
        drawn.rgb.clamp(0, 1).cpu(),
        at.cpu(),
        found.depth[solid].median() if bool(solid.any()) else found.depth.new_tensor(1.0),
    )


def _places(method: ForwardWarp, time: float) -> FieldAtTime:
    """Return the field at a time with canonical positions in place of colours."""
    box = method.radiance.lattice.box.scaled(_WIDER)

    def placed(grid, voxels: Tensor):
        at = grid.lattice.to_world(voxels)
        low, high = at.new_tensor(box.low), at.new_tensor(box.high)
        share = ((at - low) / (high - low)).clamp(1e-4, 1 - 1e-4)
        return grid.with_values(torch.cat([grid.raw_density[:, None], torch.logit(share)], -1))

    field = placed(method.radiance(), method.radiance.voxels)
    if method.motion is not None and time != method.canonical_time:
        flow = method.motion.flow(method.radiance, time)
        field, _, _ = method.motion.warp(field, method.radiance.voxels, flow)
    if method.background is None:
        return field
    return Together(field, placed(method.background(), method.background.voxels))


def _explained(places: Tensor, directions: Tensor, errors: Tensor, views: Tensor, cell: float) -> float:
    """Return the share of the squared error that direction explains, beyond what position explains.

    Fit a colour linear in direction, and a constant one, in each cell of space to one half of the images, and
    compare their errors on the other half.

    Args:
        places: (P, 3), NaN where there is none.
        directions: (P, 3), unit vectors.
        errors: (P, 3).
        views: (P,), the image of each.
        cell: side of a cell, world units.
    """
    known = places.isfinite().all(-1)
    places, directions, errors, views = (x[known] for x in (places, directions, errors, views))
    if not len(places):
        return 0.0
    _, cells = torch.unique((places / cell).floor().long(), dim=0, return_inverse=True)
    count = int(cells.max()) + 1
    inputs = torch.cat([torch.ones_like(directions[:, :1]), directions.float()], -1).double()
    left = [0.0, 0.0]
    for half in (0, 1):
        fitted, other = views % 2 == half, views % 2 != half
        for kind, width in enumerate((1, 4)):
            weights = _fits(inputs[fitted, :width], errors[fitted].double(), cells[fitted], count)
            rest = errors[other] - torch.einsum("pi,pic->pc", inputs[other, :width], weights[cells[other]])
            left[kind] += float(rest.square().sum())
    return (left[0] - left[1]) / max(float(errors.square().sum()), 1e-12)


def _fits(inputs: Tensor, values: Tensor, cells: Tensor, count: int) -> Tensor:
    """Ridge regression of ``values`` (P, C) on ``inputs`` (P, I) in every cell: (cells, I, C)."""
    width = inputs.shape[1]
    squares = inputs.new_zeros(count, width, width).index_add_(0, cells, inputs[:, :, None] * inputs[:, None])
    products = inputs.new_zeros(count, width, values.shape[1]).index_add_(
        0, cells, inputs[:, :, None] * values[:, None]
    )
    ridge = torch.eye(width, dtype=inputs.dtype) * 2.0  # as strong as two images without error
    return torch.linalg.solve(squares + ridge, products)


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

    def evidence(self, pictures: Survey, **bounds) -> VoxelEvidence:
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
        evidence.movement = movement_of(method, scene.times) if method.moves else None
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
