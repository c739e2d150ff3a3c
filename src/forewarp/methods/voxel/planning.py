"""Decide which effects of the paper's method a scene needs, from evidence and trials, with the reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forewarp.fields.grids import RadianceGrid
from forewarp.methods.effect import DISAGREEMENT, Asked, CoarseTrials, Decision, Effect, Evidence
from forewarp.methods.voxel.effects import Together
from forewarp.methods.voxel.model import SOLID
from forewarp.metrics.image import low_passed
from forewarp.ops.grid import index_of, neighbour_pairs
from forewarp.scene.box import Lattice
from forewarp.scene.frame import Scene, Survey, spread
from forewarp.scene.view import Target, View

if TYPE_CHECKING:
    from forewarp.methods.voxel.forward import ForwardWarp

MOVING = 0.02  # share of moving solid voxels above which the scene moves
REACH = 2.0  # distance of neighbours in voxels; a splat reaches one voxel to either side
# Pairs of bounds: beyond the first the effect is worth a trial, beyond the second it is chosen without one.
BY_DIRECTION = (0.0, 0.05)  # share of the error that direction explains
TORN = (0.1, 0.3)  # share of solid voxels
HEADROOM = (3.0, 1.0)  # dB that the last lattice allows beyond what is reached; the less, the more needed
VIEWS = 24  # training views whose errors are measured
# Off while motion is learned, as view-dependent colour would explain it away.
PLAIN = ("model/view_dependence=none", "model/inpainter=none", "model/upsampler=none")
_TIMES = 40  # at most this many times are examined
_POINTS = 20_000  # about the most voxels whose cosines are examined
_WIDER = 4.0  # positions are encoded in a box this much wider, which holds a static background too
_NARROWER = 1e-4  # shares of that box are kept away from its ends, where a logit is infinite


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
    left_out, distance = (0.0,), 0.0
    if bool(moves.any()):
        distance, points = float(far[moves].mean()), lattice.to_world(voxels[moves])
        coefficients = trajectory.coefficients(points[:: max(1, len(points) // _POINTS)])  # (N, 3, K)
        basis = trajectory.basis(torch.tensor(some))
        rests = [coefficients[..., k:] @ basis[:, k:].T for k in range(trajectory.bases + 1)]
        left_out = tuple(float(r.square().sum(1).mean().sqrt()) / lattice.voxel_size for r in rests)
    return Movement(float(moves.float().mean()), distance, torn[worst], some[worst], left_out)


def _torn(pairs: list[tuple[Tensor, Tensor]], flow: Tensor) -> float:
    """Return the share of voxels that a flow (N, 3), in voxels, tears from a neighbour; ``pairs`` by axis."""
    torn = torch.zeros(len(flow), dtype=torch.bool, device=flow.device)
    for (rows, neighbours), step in zip(pairs, torch.eye(3, device=flow.device)):
        far = (step + flow[neighbours] - flow[rows]).norm(dim=-1) > REACH
        torn[rows[far]] = torn[neighbours[far]] = True
    return float(torn.float().mean())


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
    generator, samples, bounds = torch.Generator().manual_seed(0), [], []
    for number, target in enumerate(targets):
        camera = target.frame.camera
        pixels = torch.randperm(camera.width * camera.height, generator=generator)
        pixels = pixels if target.valid is None else pixels[target.valid.flatten()[pixels]]
        pixels = pixels[:rays]
        rgb, places, depth = _seen(method, target, pixels)
        error = target.rgb.reshape(-1, 3)[pixels] - rgb
        views = torch.full((len(pixels),), number)
        samples.append((places, camera.rays(pixels).directions, error, views))
        voxel = voxel_size * camera.fx / max(depth, 1e-6)  # in pixels
        gap = low_passed(target.rgb, voxel) - target.rgb
        bounds.append(float((gap if target.valid is None else gap[target.valid]).square().mean()))
    places, directions, errors, views = (torch.cat(parts) for parts in zip(*samples))
    cell = 2 * method.radiance.lattice.voxel_size
    share = explained_by_direction(places, directions, errors, views, cell)
    reached, allowed = float(errors.square().mean()), sum(bounds) / len(bounds)
    return Residual(-10 * math.log10(max(reached, 1e-10)), share, -10 * math.log10(max(allowed, 1e-10)))


def _seen(method: ForwardWarp, target: Target, pixels: Tensor) -> tuple[Tensor, Tensor, float]:
    """Return colours (R, 3), canonical positions (R, 3), NaN for none, and median depth of some pixels."""
    view, time = View(target.frame.camera, pixels), target.frame.time
    drawn = method.at(target.moment).render(view, target.background.to(method.device))
    box = method.radiance.lattice.box.scaled(_WIDER)

    def placed(grid: RadianceGrid, voxels: Tensor) -> RadianceGrid:
        """Put canonical positions in place of colours."""
        at = grid.lattice.to_world(voxels)
        low, high = at.new_tensor(box.low), at.new_tensor(box.high)
        share = ((at - low) / (high - low)).clamp(_NARROWER, 1 - _NARROWER)
        return grid.with_values(torch.cat([grid.raw_density[:, None], torch.logit(share)], -1))

    field = placed(method.radiance(), method.radiance.voxels)
    if method.motion is not None and time != method.canonical_time:
        flow = method.motion.flow(method.radiance, time)
        field, _, _ = method.motion.warp(field, method.radiance.voxels, flow)
    if method.background is not None:
        field = Together(field, placed(method.background(), method.background.voxels))
    rays = view.rays().to(method.device)
    positions = method.renderer.image(field, rays, rays.origins.new_zeros(3))
    solid = positions.opacity > 0.5
    low, high = (positions.rgb.new_tensor(end) for end in (box.low, box.high))
    at = low + (high - low) * positions.rgb / positions.opacity.clamp(min=1e-6)[:, None]
    at[~solid] = math.nan
    depth = float(positions.depth[solid].median()) if bool(solid.any()) else 1.0
    return drawn.rgb.clamp(0, 1).cpu(), at.cpu(), depth


def explained_by_direction(
    places: Tensor, directions: Tensor, errors: Tensor, views: Tensor, cell: float
) -> float:
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
        fitted, checked = views % 2 == half, views % 2 != half
        for kind, width in enumerate((1, 4)):
            weights = _fits(inputs[fitted, :width], errors[fitted].double(), cells[fitted], count)
            fit = torch.einsum("pi,pic->pc", inputs[checked, :width], weights[cells[checked]])
            left[kind] += float((errors[checked] - fit).square().sum())
    return (left[0] - left[1]) / max(float(errors.square().sum()), 1e-12)


def _fits(inputs: Tensor, values: Tensor, cells: Tensor, count: int) -> Tensor:
    """Ridge regression of ``values`` (P, C) on ``inputs`` (P, I) in every cell: (cells, I, C)."""

    def summed(vectors: Tensor) -> Tensor:
        products = inputs[:, :, None] * vectors[:, None]
        return inputs.new_zeros(count, *products.shape[1:]).index_add_(0, cells, products)

    ridge = torch.eye(inputs.shape[1], dtype=inputs.dtype) * 2.0  # as strong as two images without error
    return torch.linalg.solve(summed(inputs) + ridge, summed(values))


@dataclass
class VoxelEvidence(Evidence):
    """The evidence of the images and of a coarse stage: how it moves (None: static), and its errors."""

    movement: Movement | None = None
    residual: Residual | None = None


def _not_in_coarse(asked: Asked) -> tuple[str, ...]:
    return (f"stage.{asked.coarse}.effects=[motion,background]",)


def _on_first_lattice(asked: Asked) -> tuple[str, ...]:
    return (f"stage.{asked.last}.num_voxels=[[0,{asked.stages[asked.last]['num_voxels'][0][1]}]]",)


def _as_tried(asked: Asked) -> tuple[str, ...]:
    """Keep the lattice of the trial, as an effect on whole volumes costs too much on a finer one."""
    return (*_not_in_coarse(asked), *_on_first_lattice(asked))


def _view_is_out(evidence: VoxelEvidence) -> bool:
    return evidence.no_direction is not None or evidence.residual.by_direction <= BY_DIRECTION[0]


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

    def coarse(self, evidence: VoxelEvidence, asked: Asked, trials: CoarseTrials) -> None:
        """Compare coarse stages: number of cosines, motion or none, static background or none."""
        start = _start(evidence, asked)
        if evidence.pictures.times < 2 or asked.typed.get("model/motion") == "none":
            trials.begin("coarse-still", ["model/motion=none", "model/background=none", *PLAIN, *start])
            return
        behind = "model/background=" + (asked.choose("background") if start else "none")
        trials.begin("coarse", [f"model/motion={asked.choose('motion')}", behind, *PLAIN, *start])
        if not asked.trials:
            return
        usual, more = _bases(evidence, asked)
        if more > usual and not asked.typed.keys() & {"preset.bases", "model/motion"}:
            trials.rival("bases", "coarse-bases", _more_bases(more, asked), adds=True)
        moves = "model/motion" in asked.typed
        if not moves:
            moves = trials.rival("motion", "coarse-still", ["model/motion=none"])
        if start and not moves:  # one grid holds the whole static scene
            trials.begin("coarse-still-alone", ["model/background=none"], change=True)
        elif start and "model/background" not in asked.typed:
            trials.rival("background", "coarse-alone", ["model/background=none"])

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
        motion = of_motion(evidence, asked)
        moves = motion.on and evidence.movement is not None
        return [
            motion,
            *([of_bases(evidence, asked)] if moves else []),
            of_background(evidence, asked, moves),
            of_view(evidence, asked),
            of_inpainter(evidence, asked),
            of_upsampler(evidence, asked),
        ]


def of_motion(evidence: VoxelEvidence, asked: Asked) -> Decision:
    """Decide on motion."""
    if evidence.pictures.times < 2:
        return asked.decided("motion", False, "1 time: nothing can be seen to move")
    moved = evidence.movement
    share = moved.moving if moved is not None else 0.0
    why = f"{evidence.seen_to_move}; {share:.0%} of the solid voxels move"
    why += (f", by {moved.distance:.2g}" if share else "") + evidence.of_trial("motion")
    alone = share > MOVING or evidence.pictures.disagreement > DISAGREEMENT
    return asked.decided("motion", evidence.calls_for("motion", alone), why)


def of_bases(evidence: VoxelEvidence, asked: Asked) -> Decision:
    """Decide on the number of cosines: the usual one, or more."""
    (usual, more), moved = _bases(evidence, asked), evidence.movement
    left = moved.left_out
    why = f"{moved.bases()} of {len(left) - 1} cosines leave out no more than {moved.enough:.1f} voxels"
    if "bases" in evidence.gains:
        why += f"; {more} of them against {usual}: " + evidence.of_trial("bases")[2:]
    if (typed := asked.typed.get("preset.bases")) is not None:
        return Decision("bases", typed, (), f"as typed; {why}")
    # Without a trial: more if the last cosine still matters.
    on = evidence.calls_for("bases", len(left) > 2 and left[-2] > moved.enough)
    overrides = tuple(_more_bases(more, asked)) if on else ()
    return Decision("bases", str(more if on else usual), overrides, why, on)


def of_background(evidence: VoxelEvidence, asked: Asked, moves: bool) -> Decision:
    """Decide on a grid for the static background."""
    start = _start(evidence, asked)
    if evidence.cut_out:
        why = f"{evidence.pictures.cut_out:.0%} of the pixels are transparent: the subject is cut out"
        return asked.decided("background", False, why)
    why, on = ", but nothing moves: one field holds all", False
    if moves:
        why, on = evidence.of_trial("background"), evidence.calls_for("background", True)
    return asked.decided("background", on, f"0 % of the pixels are transparent{why}", start)


def of_view(evidence: VoxelEvidence, asked: Asked) -> Decision:
    """Decide on view dependence."""
    if evidence.no_direction is not None:
        return asked.decided("view_dependence", False, evidence.no_direction)
    share = evidence.residual.by_direction
    why = f"direction explains {max(share, 0):.1%} of what the coarse stage leaves"
    on = evidence.calls_for("view_dependence", share > BY_DIRECTION[1])
    return asked.decided("view_dependence", on, why + evidence.of_trial("view_dependence"))


def of_inpainter(evidence: VoxelEvidence, asked: Asked) -> Decision:
    """Decide on inpainting."""
    moved = evidence.movement
    if moved is None:
        return asked.decided("inpainter", False, "0 % of the voxels move: nothing opens")
    why = f"{moved.torn:.1%} of the solid voxels are torn from a neighbour at time {moved.at:.2f}"
    on = evidence.calls_for("inpainter", moved.torn > TORN[1])
    return asked.decided("inpainter", on, why + evidence.of_trial("inpainter"))


def of_upsampler(evidence: VoxelEvidence, asked: Asked) -> Decision:
    """Decide on up-sampling."""
    left = evidence.residual
    why = f"the last lattice allows {left.allowed:.1f} dB, {left.psnr:.1f} are reached"
    on = evidence.calls_for("upsampler", left.allowed - left.psnr < HEADROOM[1])
    return asked.decided("upsampler", on, why + evidence.of_trial("upsampler"))


def _start(evidence: VoxelEvidence, asked: Asked) -> list[str]:
    """Return the overrides for a scene without silhouettes: start with faint matter everywhere."""
    if evidence.cut_out:
        return []
    return [f"stage.{asked.coarse}.start_alpha=1e-2", f"stage.{asked.coarse}.confine=0.0"]


def _bases(evidence: VoxelEvidence, asked: Asked) -> tuple[int, int]:
    """Return the usual number of cosines, and the larger one to try."""
    usual = int(asked.preset["bases"])
    return usual, min(2 * usual, max(evidence.pictures.times - 1, 1))


def _more_bases(more: int, asked: Asked) -> list[str]:
    return [f"preset.bases={more}", f"stage.{asked.coarse}.bases=[[0,{more}]]"]
