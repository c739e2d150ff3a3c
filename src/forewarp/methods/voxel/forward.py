"""The paper's method: a canonical radiance grid, warped forward along trajectories to any time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import DirectRadiance, FeatureRadiance, RadianceGrid
from forewarp.methods.voxel.effects import (
    LearnedUpsampler,
    Motion,
    StaticBackground,
    Together,
    TrilinearUpsampler,
    UNet3d,
    densify,
    interpolate_dense,
    occupied_crop,
    refined,
    sparsify,
)
from forewarp.methods.voxel.model import Ground, VoxelMethod, VoxelModel, VoxelSnapshot
from forewarp.methods.voxel.planning import EFFECTS, VoxelPlanning
from forewarp.methods.voxel.structure import VoxelStage
from forewarp.renderer import Renderer
from forewarp.scene.view import Moment


class ForwardWarp(VoxelMethod):
    """Forward warping: canonical radiance -> flow -> warped -> up-sampled (-> inpainted) -> rendered.

    ``at`` is the whole pipeline. Every effect may be None, and is then absent.

    Args:
        radiance: the canonical radiance field.
        canonical_time: time of the canonical field, at which nothing is warped.
        motion: trajectories and the forward splat; None: the scene is static.
        upsampler: refines the warped grid; None: render at the resolution of the warp.
        inpainter: fills holes; None: one rendering instead of two.
        view_dependence: turns features and directions into colour; None: the features are the colour.
        background: everything static, on a grid of its own; None: a constant background colour.
        renderer: marches the rays.

    Raises:
        ValueError: for an up-sampler whose scale is not a whole number beside an inpainter.
    """

    effects = EFFECTS

    def __init__(
        self,
        radiance: DirectRadiance | FeatureRadiance,
        *,
        canonical_time: float,
        motion: Motion | None = None,
        upsampler: TrilinearUpsampler | None = None,
        inpainter: UNet3d | None = None,
        view_dependence: nn.Module | None = None,
        background: StaticBackground | None = None,
        renderer: Renderer | None = None,
    ) -> None:
        super().__init__(
            radiance,
            canonical_time=canonical_time,
            renderer=renderer,
            view_dependence=view_dependence,
            background=background,
        )
        self.motion, self.upsampler, self.inpainter = motion, upsampler, inpainter
        scale = getattr(upsampler, "scale", 1)
        if inpainter is not None and scale != int(scale):
            raise ValueError(
                f"model.upsampler.scale: expected a whole number beside an inpainter, but got {scale}; "
                "set it to 2, or choose model/inpainter=none"
            )

    def at(self, moment: Moment) -> VoxelSnapshot:
        """Warp the canonical radiance to a moment; one field for each rendering, the best last."""
        canonical = self.radiance()  # V_R = F1
        warped, flow, coverage, dropped = canonical, None, None, 0  # V_R^t
        if self.motion is not None and moment.time != self.canonical_time:
            flow = self.motion.flow(self.radiance, moment.time)  # V_flow
            warped, coverage, dropped = self.motion.warp(canonical, self.radiance.voxels, flow)
        if self.inpainter is None:
            fields, difference = {self.first_rendering: self._upsample(warped)}, None  # V_RUp
        else:
            fields, difference = self._inpaint(warped, coverage)  # V_RUp, V_RInp
        static = None
        if self.background is not None:
            static = self.background()
            fields = {name: Together(field, static) for name, field in fields.items()}
        return VoxelSnapshot(
            moment,
            fields,
            canonical,
            self.renderer,
            self.view_dependence,
            flow,
            coverage,
            dropped,
            difference,
            static,
            length=2 / 3 * self.half_extent if self.moves else 1.0,
        )

    def departures(self) -> list[str]:
        """See ``Method``; docs/method.md has the rest, which every preset shares."""
        parts = {"no up-sampling": self.upsampler, "no inpainter": self.inpainter}
        parts["colour without direction"] = self.view_dependence
        notes = [about for about, part in parts.items() if part is None]
        if isinstance(self.radiance, DirectRadiance):
            notes.append("voxels hold density and colour, without the network F1")
        if self.motion is not None and self.motion.trajectory.at_nodes:
            notes.append("motion (F2) at the nodes of a coarse lattice")
        return notes

    @property
    def first_rendering(self) -> str:
        """Name of the rendering without inpainting: ``upsampled``, or ``warped`` without an up-sampler."""
        return "warped" if self.upsampler is None else "upsampled"

    def _upsample(self, warped: RadianceGrid) -> RadianceGrid:
        if self.upsampler is None:
            return warped
        learned = isinstance(self.upsampler, LearnedUpsampler)
        return self.upsampler.alone(warped) if learned else self.upsampler(warped)

    def _inpaint(
        self, warped: RadianceGrid, coverage: Tensor | None
    ) -> tuple[dict[str, RadianceGrid], Tensor]:
        """Return the grid before and after inpainting, and their difference, on the occupied box."""
        crop = occupied_crop(warped.index, self.inpainter.margin)
        dense = densify(warped, crop)
        inputs = dense
        if self.inpainter.coverage_channel:
            cover = warped.values.new_ones(len(warped.values)) if coverage is None else coverage.clamp(max=1)
            inputs = torch.cat(
                [dense, densify(warped.with_values(cover[:, None] * 1.0), crop).clamp(min=0)], 1
            )
        features = self.inpainter.features(inputs)
        lattice, region = warped.lattice, crop
        if isinstance(self.upsampler, LearnedUpsampler):
            residual = self.upsampler.residual(features, crop)
        else:
            residual = self.inpainter.residual(features)
        if self.upsampler is not None:
            scale = int(self.upsampler.scale)
            lattice, region = refined(lattice, scale), crop.scaled(scale)
            dense = interpolate_dense(dense, crop, scale)
            if residual.shape[2:] != dense.shape[2:]:
                residual = interpolate_dense(residual, crop, scale)
        upsampled = sparsify(warped, lattice, region, dense)
        inpainted = sparsify(warped, lattice, region, dense + residual)
        return {self.first_rendering: upsampled, "inpainted": inpainted}, residual

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Follow the schedules of the lattices and of the trajectory bases."""
        noted = super().advance(progress, step, optimizer)
        if self.motion is None:
            return noted
        return noted | {"bases_in_play": self.motion.trajectory.play(self.stage.at("bases", progress))}

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Return the paths (N, T, 3) of canonical points (N, 3) at ``times`` (T,), in world units."""
        if self.motion is None:
            return points[:, None].expand(-1, len(times), -1)
        return self.motion.trajectory.trajectories(points, times)

    def moved(self, points: Tensor, rows: Tensor, time: float) -> Tensor:
        """Move the canonical voxels ``rows`` (N,) bool, at ``points`` (M, 3), to ``time`` (M, 3)."""
        return points + self.motion.flow(self.radiance, time)[rows]

    @property
    def moves(self) -> bool:
        """False if the scene is static."""
        return self.motion is not None

    def displacement(self, points: Tensor, time: float) -> Tensor:
        """Return the displacement (N, 3) of canonical points at ``time``, in world units; differentiable."""
        return self.trajectories(points, points.new_tensor([time]))[:, 0] - points

    @property
    def half_extent(self) -> float:
        """Half the scene's longest side, in world units."""
        return self.motion.trajectory.scale


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
