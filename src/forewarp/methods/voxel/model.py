"""Build a voxel method for a stage, from the options of ``model=forward`` or ``model=backward``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from forewarp.fields.trajectory import TrajectoryField
from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.methods.method import Start
from forewarp.methods.voxel.backward_warp import BackwardWarp, Deformation
from forewarp.methods.voxel.effects.background import StaticBackground
from forewarp.methods.voxel.effects.motion import Motion
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler, TrilinearUpsampler
from forewarp.methods.voxel.forward_warp import ForwardWarp
from forewarp.methods.voxel.method import VoxelMethod
from forewarp.methods.voxel.planning import VoxelPlanning
from forewarp.methods.voxel.stage import VoxelStage
from forewarp.methods.voxel.structure import resample
from forewarp.ops.grid import dilate
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.frame import Scene
from forewarp.scene.silhouettes import visual_hull


@dataclass(frozen=True)
class VoxelModel:
    """The options of both voxel methods: factories that still need the scene, or None for what is off.

    Call it with a ``Start`` to make the method.
    """

    radiance: Callable[..., nn.Module]
    view_dependence: Callable[..., nn.Module] | None = None
    background: Callable[..., StaticBackground] | None = None
    renderer: Renderer | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            choice = getattr(self, field.name)
            if choice is not None and not callable(choice):
                raise ValueError(
                    f"model.{field.name}: expected a factory or null, but got {choice!r}; "
                    f"choose model/{field.name}=none to switch it off"
                )

    def __call__(self, start: Start) -> VoxelMethod:
        """Make the method of a stage, from the stage before or afresh."""
        stage = VoxelStage(name=start.stage, **start.numbers)
        method = self.build(ground_of(self, start, stage), stage)
        if is_carried(start, stage):
            carried(method, start.before)
        elif not start.blank:
            set_start_density(method, stage.start_alpha)
        return method.begin(start, stage)

    @staticmethod
    def check(
        stage: str, numbers: Mapping[str, Any], terms: Iterable[str], literal: Iterable[str] = ()
    ) -> None:
        """Refuse keys and terms that no voxel method knows (see ``Method.check``)."""
        VoxelStage(name=stage, **numbers)
        VoxelMethod.check(stage, (), terms, literal)

    def build(self, ground: Ground, stage: VoxelStage) -> VoxelMethod:
        """Make the method on given lattices."""
        view_dependence = None
        if self.view_dependence is not None and "view_dependence" in stage.effects:
            view_dependence = self.view_dependence()
        features = 3 if view_dependence is None else view_dependence.features
        radiance = self.radiance(
            ground.lattice,
            ground.active,
            features=features,
            density_scale=ground.density_scale,
            box=ground.box,
        )
        background = None
        if self.background is not None and "background" in stage.effects:
            background = self.background(*ground.static, density_scale=ground.density_scale)
        common = {
            "canonical_time": ground.canonical_time,
            "view_dependence": view_dependence,
            "background": background,
        }
        return self._warp(radiance, ground, stage, features, common | {"renderer": self.renderer})

    def _warp(self, radiance, ground: Ground, stage: VoxelStage, features: int, common: dict) -> VoxelMethod:
        raise NotImplementedError


@dataclass(frozen=True)
class ForwardModel(VoxelModel):
    """The options of the paper's method, ``ForwardWarp``."""

    planning: ClassVar[VoxelPlanning] = VoxelPlanning()

    motion: Callable[..., Motion] | None = None
    trajectory: Callable[..., TrajectoryField] | None = None
    upsampler: Callable[..., nn.Module] | None = None
    inpainter: Callable[..., nn.Module] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.motion is not None and self.trajectory is None:
            raise ValueError(
                "model.trajectory: expected a factory, but got null; choose another model/motion or model"
            )

    def _warp(self, radiance, ground: Ground, stage: VoxelStage, features: int, common: dict) -> ForwardWarp:
        effects, motion, inpainter = stage.effects, None, None
        if self.motion is not None and ground.frames > 1 and "motion" in effects:
            time = ground.canonical_time
            motion = self.motion(self.trajectory(ground.box, frames=ground.frames, canonical_time=time))
        if self.inpainter is not None and "inpainter" in effects:
            learned = stage.upsample is None and "upsampler" in effects and self._learns_to_upsample
            inpainter = self.inpainter(channels=1 + features, head=not learned)
        upsampler = self._upsampler(features, inpainter, stage)
        return ForwardWarp(radiance, motion=motion, upsampler=upsampler, inpainter=inpainter, **common)

    @property
    def _learns_to_upsample(self) -> bool:
        made = getattr(self.upsampler, "func", self.upsampler)
        return isinstance(made, type) and issubclass(made, LearnedUpsampler)

    def _upsampler(self, features: int, inpainter: nn.Module | None, stage: VoxelStage) -> nn.Module | None:
        if stage.upsample is not None:
            return TrilinearUpsampler(scale=stage.upsample)
        if self.upsampler is None or "upsampler" not in stage.effects:
            return None
        if self._learns_to_upsample:
            return self.upsampler(channels=1 + features, features=0 if inpainter is None else inpainter.width)
        return self.upsampler()


@dataclass(frozen=True)
class BackwardModel(VoxelModel):
    """The options of the baseline, ``BackwardWarp``: the same grid with a deformation network."""

    deformation: Callable[..., Deformation] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.deformation is None:
            raise ValueError("model.deformation: expected a factory, but got null; choose another model")

    def _warp(self, radiance, ground: Ground, stage: VoxelStage, features: int, common: dict) -> BackwardWarp:
        time = ground.canonical_time
        deformation = self.deformation(ground.box, canonical_time=time) if ground.frames > 1 else None
        return BackwardWarp(radiance, deformation=deformation, **common)


@dataclass(frozen=True)
class Ground:
    """The lattices that a voxel method is built on.

    Attributes:
        lattice: lattice of the canonical grid.
        active: (X, Y, Z) bool, its active voxels.
        density_scale: length that density is measured in, world units.
        box: the scene's box; normalises positions in all stages.
        frames: number of distinct training times; with one there is no motion.
        canonical_time: in [0, 1].
        static: lattice and active voxels of the static background, if the model has one.
    """

    lattice: Lattice
    active: Tensor
    density_scale: float
    box: Box
    frames: int
    canonical_time: float
    static: tuple[Lattice, Tensor] | None = None


def is_carried(start: Start, stage: VoxelStage) -> bool:
    """Return whether a stage continues with the grids of the stage before."""
    return stage.carry and not start.blank and isinstance(getattr(start.before, "radiance", None), VoxelGrid)


def ground_of(model: VoxelModel, start: Start, stage: VoxelStage) -> Ground:
    """Find the lattices and active voxels of a stage. Cost: a hull reads each of its images once."""
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
    static = None
    if model.background is not None and "background" in stage.effects:
        static = _static(scene.box.scaled(1.05), stage, getattr(before, "background", None))
    return Ground(lattice, active, density_scale, scene.box, len(scene.times), scene.canonical_time, static)


def carried(method: nn.Module, before: nn.Module) -> None:
    """Copy the learned values that two methods on the same lattice share."""
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
    """Give all active voxels the opacity ``alpha`` over one voxel."""
    for grid in (method.radiance, method.background):
        if grid is None:
            continue
        raw = grid.activation.raw(alpha, grid.lattice.voxel_size)
        with torch.no_grad():
            if "density" in grid.names:
                grid.parameter("density").fill_(raw)
            else:
                grid.network[-1].bias[0] = raw


def _static(box: Box, stage: VoxelStage, before: VoxelGrid | None) -> tuple[Lattice, Tensor]:
    """Return lattice and active voxels of the static background: of the stage before, or all of ``box``."""
    voxels = stage.at("background_num_voxels", 0.0)
    if before is None:
        lattice = Lattice.of_count(box, voxels)
        return lattice, torch.ones(lattice.shape, dtype=torch.bool)
    resample(before, box, voxels, keep_alpha=stage.keep_alpha)
    return before.lattice, before.index >= 0


def _first(start: Start, lattice: Lattice, stage: VoxelStage) -> Tensor:
    """Return the voxels (X, Y, Z) bool that are active at first: the visual hull, or all."""
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
        count += 1  # all views of each time: some neighbouring cameras alone bound nothing
    frames, masks = frames[:count], []
    for i in frames:
        pixels = max(1, round(stage.hull_grow * scene.train[i].camera.width))
        masks.append(dilate(scene.train[i].load()[..., 3] > 127, pixels))
    points = lattice.to_world(lattice.all_voxels())
    hull = visual_hull(points, [scene.train[i].camera for i in frames], masks, stage.hull_misses)
    return hull.reshape(lattice.shape)
