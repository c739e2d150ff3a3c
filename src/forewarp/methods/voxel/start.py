"""Where a stage's voxels begin: in the box, in the visual hull, or where the stage before left them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.methods.method import Start
from forewarp.methods.voxel.stage import VoxelStage
from forewarp.methods.voxel.structure import resample
from forewarp.ops.grid import dilate
from forewarp.scene.box import Box, Lattice
from forewarp.scene.frame import Scene
from forewarp.scene.hull import visual_hull


@dataclass(frozen=True)
class Ground:
    """What a voxel method is built on.

    Attributes:
        lattice: the canonical lattice. active: (X, Y, Z) bool.
        density_scale: length that density is measured in, world units.
        box: the scene's; normalises positions, the same in all stages.
        frames: distinct training times; with one there is no motion.
        canonical_time: in [0, 1].
        still: lattice and active voxels of the static background; needed where the model has one.
    """

    lattice: Lattice
    active: Tensor
    density_scale: float
    box: Box
    frames: int
    canonical_time: float
    still: tuple[Lattice, Tensor] | None = None


class _HasBackground(Protocol):
    background: object


def is_carried(start: Start, stage: VoxelStage) -> bool:
    """Tell whether a stage goes on with the grids of the one before."""
    return stage.carry and not start.blank and isinstance(getattr(start.before, "radiance", None), VoxelGrid)


def ground_of(model: _HasBackground, start: Start, stage: VoxelStage) -> Ground:
    """Find where a stage begins. Cost: of a hull, one look at each of its images."""
    scene, before = start.scene, start.before if is_carried(start, stage) else None
    box = scene.box if start.handover is None else start.handover.box
    if before is not None:
        resample(before.radiance, box, stage.at("num_voxels", 0.0), keep_alpha=stage.keep_alpha)
        lattice, active = before.radiance.lattice, before.radiance.index >= 0
        density_scale = before.radiance.activation.density_scale
    else:
        lattice = Lattice.of_count(box, stage.at("num_voxels", 0.0))
        known = {} if start.handover is None else start.handover.notes
        density_scale, active = known.get("density_scale", lattice.voxel_size), _first(start, lattice, stage)
        if not density_scale > 0:
            raise ValueError(
                f"stage.{start.stage}: expected a density_scale > 0 from the stage before, "
                f"but got {density_scale}; delete the folder of that stage"
            )
    still = None
    if model.background is not None and "background" in stage.effects:
        still = _still(scene.box.scaled(1.05), stage, getattr(before, "background", None))
    return Ground(lattice, active, density_scale, scene.box, len(scene.times), scene.canonical_time, still)


def carried(method: nn.Module, before: nn.Module) -> None:
    """Give a method what one on the same lattice has learned, as far as they have the same parts."""
    for name in set(before.radiance.names) & set(method.radiance.names):
        method.radiance.parameter(name).data.copy_(before.radiance.parameter(name).data)
    own, theirs = method.state_dict(), before.state_dict()
    rest = {
        k: v
        for k, v in theirs.items()
        if torch.is_tensor(v)
        and k in own
        and own[k].shape == v.shape
        and (not k.startswith("radiance.") or k.startswith("radiance.network"))
    }
    method.load_state_dict(own | rest)


def set_start_density(method: nn.Module, alpha: float) -> None:
    """Let all active voxels begin with an opacity of ``alpha`` over a voxel."""
    for grid in (method.radiance, method.background):
        if grid is None:
            continue
        raw = grid.activation.raw(alpha, grid.lattice.voxel_size)
        with torch.no_grad():
            if "density" in grid.names:
                grid.parameter("density").fill_(raw)
            else:
                grid.network[-1].bias[0] = raw


def _still(box: Box, stage: VoxelStage, before: VoxelGrid | None) -> tuple[Lattice, Tensor]:
    """Lattice and active voxels of the static background, whose box holds every stage's: continued from the
    stage before, or all active.
    """
    voxels = stage.at("background_num_voxels", 0.0)
    if before is None:
        lattice = Lattice.of_count(box, voxels)
        return lattice, torch.ones(lattice.shape, dtype=torch.bool)
    resample(before, box, voxels, keep_alpha=stage.keep_alpha)
    return before.lattice, before.index >= 0


def _first(start: Start, lattice: Lattice, stage: VoxelStage) -> Tensor:
    """The voxels (X, Y, Z) bool that are active at first."""
    scene, every = start.scene, torch.ones(lattice.shape, dtype=torch.bool)
    hull = stage.start == "hull" or (stage.start == "auto" and scene.has_alpha)
    if start.blank or not hull:
        return every
    if not scene.has_alpha:
        raise ValueError(
            f"stage.{start.stage}.start: expected box, since the images of '{scene.name}' have no alpha, "
            "but got hull"
        )
    inside = _hull(scene, lattice, stage, list(start.frames))
    return inside if bool(inside.any()) else every


def _hull(scene: Scene, lattice: Lattice, stage: VoxelStage, frames: list[int]) -> Tensor:
    count, times = stage.hull_frames, [scene.train[i].time for i in frames]
    while count < len(frames) and times[count] == times[count - 1]:
        count += 1  # all views of a time that is in: neighbouring cameras alone bound nothing
    frames, masks = frames[:count], []
    for i in frames:
        pixels = max(1, round(stage.hull_grow * scene.train[i].camera.width))
        masks.append(dilate(scene.train[i].load()[..., 3] > 127, pixels))
    points = lattice.to_world(lattice.all_voxels())
    hull = visual_hull(points, [scene.train[i].camera for i in frames], masks, stage.hull_misses)
    return hull.reshape(lattice.shape)
