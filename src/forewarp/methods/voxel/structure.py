"""The numbers of a voxel method's stage, and how they change its grids: active voxels and lattices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.optim import Optimizer

from forewarp.fields.grids import EMPTY, VoxelGrid
from forewarp.methods.effect import Effect, Evidence
from forewarp.methods.method import FRACTION, Start, check_effects, check_number, steps_of, value_at
from forewarp.methods.rows import renew_parameters
from forewarp.ops.backend import check_value
from forewarp.ops.grid import dilate, trilinear
from forewarp.scene.box import Lattice
from forewarp.scene.frame import visual_hull

EFFECTS = (
    Effect("motion", of=Evidence.of_time),
    Effect("background", of=Evidence.of_background, needs="motion"),  # one grid holds all that stands still
    Effect("view_dependence", of=Evidence.of_direction),
    Effect("inpainter", needs="motion"),  # nothing opens
    Effect("upsampler"),
)
NAMES = tuple(effect.name for effect in EFFECTS)
CARRIED = ("all", "motion", "none")


@dataclass(frozen=True)
class VoxelStage:
    """The numbers of a stage. Fractions are fractions of the stage; opacities are over one voxel.

    Args:
        num_voxels: ``[[fraction, count], ...]``: about ``count`` voxels in the box from ``fraction`` on.
        background_num_voxels: as ``num_voxels``, for the static background's grid over the scene's box.
        effects: effects of the model to use in this stage, some of ``NAMES``.
        upsample: interpolate by this factor instead of the model's up-sampler; None: use the model's.
        carry: what the stage before passes on besides its box: ``all``, the grids and the motion, if it was a
            voxel method, else its motion; ``motion`` alone; ``none``. Old runs have True and False.
        start: voxels that are active at first: ``box`` (all), ``hull`` (the visual hull; needs alpha),
            ``matter`` (beside the points that the stage before left), or ``auto`` (the hull if the images
            have alpha, else the box).
        hull_grow: dilate the hull's silhouettes by this share of the image's width, as the scene moves.
        hull_misses: number of views that may disagree about a voxel of the hull.
        hull_frames: make the hull from this many frames nearest to the canonical time, and all frames of the
            same times. With many frames, objects that move fast are carved away.
        refresh_every: steps between updates of the active voxels; 0: never.
        refresh_from: fraction from which they are updated.
        keep_alpha: opacity above which a voxel stays active.
        birth_alpha: opacity of new voxels, below ``keep_alpha``.
        confine: fraction up to which new voxels appear only where voxels were active at the start, so that
            new matter cannot stand in for motion; 0: anywhere.
        see_steps: once a lattice is this many steps old, also deactivate voxels that no view has seen; 0:
            never.
        box_alpha: opacity of the matter that the next stage's box must hold.
        start_alpha: opacity of the first active voxels.
        color_threshold: the renderer's threshold in this stage; None: unchanged.
        bases: ``[[fraction, K], ...]``: use K trajectory bases from ``fraction`` on; empty: all.
        near_share: share of a step's rays that is drawn on and beside what the images show (needs alpha);
            rays count as much less as they are drawn more often there. 0: all are drawn anywhere.
        patches: number of patches that the depth term renders.
        name: name of the stage, for errors.

    Raises:
        ValueError: naming the key that is out of range.
    """

    num_voxels: Sequence[Sequence[float]]
    background_num_voxels: Sequence[Sequence[float]] = ((0.0, 262144),)
    effects: Sequence[str] = NAMES
    upsample: float | None = None
    carry: str | bool = "all"
    start: str = "box"
    hull_grow: float = 0.01
    hull_misses: int = 0
    hull_frames: int = 5
    refresh_every: int = 0
    refresh_from: float = 0.0
    keep_alpha: float = 1e-3
    birth_alpha: float = 5e-4
    confine: float = 0.0
    see_steps: int = 0
    box_alpha: float = 1e-2
    start_alpha: float = 0.05
    color_threshold: float | None = None
    bases: Sequence[Sequence[float]] = ()
    near_share: float = 0.0
    patches: int = 16
    name: str = "fine"

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        for key in ("num_voxels", "background_num_voxels", *(["bases"] if self.bases else [])):
            steps_of(f"{where}.{key}", getattr(self, key))
        check_effects(f"{where}.effects", self.effects, NAMES)
        if isinstance(self.carry, bool):  # of older runs
            object.__setattr__(self, "carry", "all" if self.carry else "none")
        check_value(f"{where}.carry", self.carry, "all, motion or none", lambda what: what in CARRIED)
        starts = ("auto", "box", "hull", "matter")
        check_value(f"{where}.start", self.start, "auto, box, hull or matter", lambda kind: kind in starts)
        check_number(f"{where}.confine", self.confine, *FRACTION)
        check_number(f"{where}.near_share", self.near_share, "a number in [0, 1)", lambda s: 0 <= s < 1)
        for key in ("box_alpha", "start_alpha"):
            check_number(f"{where}.{key}", getattr(self, key), "a number in (0, 1)", lambda a: 0 < a < 1)
        wanted = "0 < birth_alpha < keep_alpha < 1, or fog spreads"
        alphas = self.birth_alpha, self.keep_alpha
        check_value(where, alphas, wanted, lambda pair: 0 < pair[0] < pair[1] < 1)

    def at(self, key: str, fraction: float) -> float | None:
        """Return the value of the schedule ``key`` at a fraction; None if it is empty."""
        return value_at(getattr(self, key), fraction)


def first_voxels(start: Start, stage: VoxelStage, lattice: Lattice) -> Tensor:
    """Return the voxels (X, Y, Z) bool that are active at first: the visual hull, those beside matter, all.

    Cost: a hull reads each of its images once.

    Raises:
        ValueError: for a hull of images without alpha, or matter that no stage has left.
    """
    scene, everywhere = start.scene, torch.ones(lattice.shape, dtype=torch.bool)
    if stage.start == "matter" and not start.blank:
        if start.handover is None or start.handover.cloud is None or not len(start.handover.cloud):
            why = "as no stage before it left matter"
            raise ValueError(f"stage.{start.stage}.start: expected auto, box or hull, {why}, but got matter")
        at = lattice.to_lattice(start.handover.cloud.points).round().long()
        occupied = torch.zeros_like(everywhere)
        occupied[at[lattice.holds(at)].unbind(-1)] = True
        return dilate(occupied, 1)
    hull = stage.start == "hull" or (stage.start == "auto" and scene.has_alpha)
    if start.blank or not hull:
        return everywhere
    if not scene.has_alpha:
        why = f"since the images of '{scene.name}' have no alpha"
        raise ValueError(f"stage.{start.stage}.start: expected box, {why}, but got hull")
    frames, count = [scene.train[i] for i in start.frames], stage.hull_frames
    while count < len(frames) and frames[count].time == frames[count - 1].time:
        count += 1  # all views of each time: some neighbouring cameras alone bound nothing
    cameras = [frame.camera for frame in frames[:count]]
    grown = [max(1, round(stage.hull_grow * camera.width)) for camera in cameras]
    masks = [dilate(frame.load()[..., 3] > 127, pixels) for frame, pixels in zip(frames, grown)]
    points = lattice.to_world(lattice.all_voxels())
    inside = visual_hull(points, cameras, masks, stage.hull_misses)
    return inside.reshape(lattice.shape) if bool(inside.any()) else everywhere


def seen_rows(radiance: VoxelGrid, optimizer: Optimizer) -> Tensor:
    """Voxels (N,) bool that some view has seen: their colour has had a gradient since the moments began."""
    name = "color" if "color" in radiance.names else radiance.names[0]
    moments = optimizer.state.get(getattr(radiance, name), {}).get("exp_avg_sq")
    if moments is None:
        return torch.ones_like(radiance.voxels[:, 0], dtype=torch.bool)
    return moments.amax(-1) > 0


@torch.no_grad()
def refresh(
    radiance: VoxelGrid, stage: VoxelStage, optimizer: Optimizer, only_seen: bool, allowed: Tensor | None
) -> None:
    """Activate the occupied voxels and their neighbours, and deactivate all others.

    Leave an empty grid as it is, so that a scene that has not appeared yet can still appear.

    Args:
        radiance: the grid; its active voxels change in place.
        stage: for ``keep_alpha``, above which a voxel is occupied, and ``birth_alpha``, of new ones.
        optimizer: its moments follow the rows.
        only_seen: also deactivate voxels that no view has seen, inside of solid objects.
        allowed: (X, Y, Z) bool, where voxels may become active; None: anywhere.
    """
    grid = radiance()
    solid = grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size) > stage.keep_alpha
    if only_seen:
        solid = solid & seen_rows(radiance, optimizer)
    mask = torch.zeros(grid.lattice.shape, dtype=torch.bool, device=solid.device)
    mask[radiance.voxels[solid].unbind(-1)] = True
    active = dilate(mask, 1) if allowed is None else (dilate(mask, 1) & allowed) | mask
    if bool(mask.any()) and not torch.equal(active, radiance.index >= 0):
        before = radiance.rows()
        rows = radiance.activate(active, radiance.births(stage.birth_alpha))
        renew_parameters(optimizer, before, radiance.rows(), rows)


@torch.no_grad()
def resample(
    grid: VoxelGrid, stage: VoxelStage, optimizer: Optimizer | None, lattice: Lattice, only_seen: bool = False
) -> None:
    """Resample the grid to another lattice.

    Activate the voxels that are occupied by the stage's ``keep_alpha`` and their neighbours; if none is, all.
    The grid's moments in the optimiser start at 0. ``only_seen``: as of ``refresh``.
    """
    source = grid()
    points = source.lattice.to_lattice(lattice.to_world(lattice.all_voxels(source.values.device)))
    raw = source.values[:, :1].detach()
    if only_seen and optimizer is not None:
        raw = torch.where(seen_rows(grid, optimizer)[:, None], raw, EMPTY)
    raw = trilinear(raw.contiguous(), source.index, points, source.fill[:1])[:, 0]
    last = torch.tensor(source.lattice.shape, device=points.device) - 1
    slack = 1e-3  # in voxels: keep the border of an equal box in spite of rounding
    inside = ((points >= -slack) & (points <= last + slack)).all(-1)
    solid = (source.activation.alpha(raw, source.lattice.voxel_size) > stage.keep_alpha) & inside
    mask = dilate(solid.reshape(lattice.shape), 1)
    if not bool(mask.any()):
        mask = torch.ones_like(mask)
    before = grid.rows()
    grid.resample(lattice, mask, {"density": EMPTY})
    if optimizer is not None:
        renew_parameters(optimizer, before, grid.rows(), None)
