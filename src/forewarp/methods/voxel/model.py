"""The choices of ``model=forward`` and ``model=backward``, and how a method is made of them for a stage."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from torch import nn

from forewarp.fields.trajectory import TrajectoryField
from forewarp.methods.method import Start
from forewarp.methods.voxel.backward_warp import BackwardWarp, Deformation
from forewarp.methods.voxel.effects.background import StaticBackground
from forewarp.methods.voxel.effects.motion import Motion
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler, TrilinearUpsampler
from forewarp.methods.voxel.forward_warp import ForwardWarp
from forewarp.methods.voxel.method import VoxelMethod
from forewarp.methods.voxel.planning import VoxelPlanning
from forewarp.methods.voxel.stage import VoxelStage
from forewarp.methods.voxel.start import Ground, carried, ground_of, is_carried, set_start_density
from forewarp.renderer import Renderer


@dataclass(frozen=True)
class VoxelModel:
    """What both voxel methods choose: factories that wait for what only the scene knows, or None for off.

    Calling it with a ``Start`` makes the method.
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
        """Make the method of a stage: continued from the stage before, or seeing its first pictures."""
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
        """Refuse what a stage says and no voxel method knows, before anything is read."""
        VoxelStage(name=stage, **numbers)
        VoxelMethod.check(stage, (), terms, literal)

    def build(self, ground: Ground, stage: VoxelStage) -> VoxelMethod:
        """Make the method on lattices."""
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
            background = self.background(*ground.still, density_scale=ground.density_scale)
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
    """The paper: a canonical grid warped forward, with its optional parts."""

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
    """The opponent: the same grid, and a deformation network on the samples."""

    deformation: Callable[..., Deformation] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.deformation is None:
            raise ValueError("model.deformation: expected a factory, but got null; choose another model")

    def _warp(self, radiance, ground: Ground, stage: VoxelStage, features: int, common: dict) -> BackwardWarp:
        time = ground.canonical_time
        deformation = self.deformation(ground.box, canonical_time=time) if ground.frames > 1 else None
        return BackwardWarp(radiance, deformation=deformation, **common)
