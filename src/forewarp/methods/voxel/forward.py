"""The paper's method: a canonical radiance grid, warped forward along trajectories to any time."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from forewarp.fields.grids import DirectRadiance
from forewarp.methods.method import HasTrajectories, Start, those_that_hold
from forewarp.methods.rows import renew_parameters
from forewarp.methods.voxel.effects import LearnedUpsampler, TrilinearUpsampler, UNet3d, inpaint, outline_of
from forewarp.methods.voxel.model import Factory, VoxelMethod, VoxelSnapshot, copy_shared
from forewarp.methods.voxel.structure import EFFECTS
from forewarp.ops.backend import check_value
from forewarp.scene.frame import spread
from forewarp.scene.view import Moment

_FITTED_TIMES = 48  # by which learned nodes begin with a known motion


class ForwardWarp(VoxelMethod):
    """Forward warping: canonical radiance -> flow -> warped -> up-sampled (-> inpainted) -> rendered.

    ``at`` is the whole pipeline. Every effect may be None, and is then absent.

    Args:
        start: scene, stage and numbers (see ``VoxelStage``).
        motion: makes the forward splat along trajectories; None: the scene is static.
        trajectory: makes the field of trajectories that motion follows.
        upsampler: makes what refines the warped grid; None: render at the resolution of the warp.
        inpainter: makes what fills holes; None: one rendering instead of two.
        shared: radiance, view_dependence, background and renderer: see ``VoxelMethod``.

    Raises:
        ValueError: for motion without trajectories, or an up-sampler whose scale is not a whole number beside
            an inpainter.
    """

    effects = EFFECTS

    def __init__(
        self,
        start: Start,
        *,
        motion: Factory | None = None,
        trajectory: Factory | None = None,
        upsampler: Factory | None = None,
        inpainter: Factory | None = None,
        **shared,
    ) -> None:
        super().__init__(start, **shared)
        scene, channels = start.scene, self.channels
        motion, inpainter = self.used("motion", motion), self.used("inpainter", inpainter)
        upsampler = self.used("upsampler", upsampler)
        if self.stage.upsample is not None:
            upsampler = partial(TrilinearUpsampler, scale=self.stage.upsample)
        made = getattr(upsampler, "func", upsampler)
        learned = isinstance(made, type) and issubclass(made, LearnedUpsampler)
        self.motion = self.upsampler = self.inpainter = None
        self.moves = motion is not None and len(scene.times) > 1
        if self.moves:
            other = "choose another model/motion or model"
            check_value("model.trajectory", trajectory, "a factory", callable, other)
            times = {"frames": len(scene.times), "canonical_time": scene.canonical_time}
            self.motion = motion(trajectory(scene.box, **times, voxels=self.radiance.lattice))
        inpainter = None if inpainter is None else inpainter(channels=channels, head=not learned)
        if upsampler is not None:
            asked = {"channels": channels, "features": getattr(inpainter, "width", 0)} if learned else {}
            self.upsampler = upsampler(**asked)
        self.inpainter = inpainter
        if inpainter is not None:
            scale, wanted = getattr(self.upsampler, "scale", 1), "a whole number beside an inpainter"
            other = "set it to 2, or choose model/inpainter=none"
            check_value("model.upsampler.scale", scale, wanted, lambda scale: scale == int(scale), other)
        self.begin(start)
        left, takes = start.handover, self.moves and self.stage.carry != "none"
        # Only voxels leave the length of their density; checkpoints need no note of it, as handovers stay.
        self.handed = (
            takes and left is not None and left.paths is not None and "density_scale" not in left.notes
        )
        if self.moves and not start.blank:
            self.begin_motion(start)

    def begin_motion(self, start: Start) -> None:
        """Begin with the motion of the stage before, where this stage carries it and has not copied it yet.

        Raises:
            ValueError: if F2 should take over the motion of something else.
        """
        before, learns = start.before, self.motion.trajectory.learned is not None
        self._follow(None)
        if self.stage.carry == "none" or not isinstance(before, HasTrajectories) or not before.moves:
            return
        alike = isinstance(before, ForwardWarp) and learns == (before.motion.trajectory.learned is not None)
        if alike and self.stage.carry == "all":
            return  # copied
        if learns:
            times = [start.scene.times[i] for i in spread(len(start.scene.times), _FITTED_TIMES)]
            self.motion.trajectory.fit(before.trajectories, times)
        elif self.stage.carry == "motion":
            wanted = "all or none, as the network F2 takes over the motion of an F2 alone"
            other = "set it so, or model.trajectory.kind=nodes"
            check_value(f"stage.{start.stage}.carry", "motion", wanted, lambda _: alike, other)
            copy_shared(before.motion, self.motion)

    def _follow(self, optimizer: torch.optim.Optimizer | None) -> None:
        """Let learned nodes be those around the active voxels."""
        changed = self.motion.trajectory.follow(self.radiance)
        if changed is not None and optimizer is not None:
            renew_parameters(optimizer, *changed)

    def outlines(self) -> dict[str, list[dict]]:
        """Describe the inpainter, with a learned up-sampler's layers."""
        drawn = isinstance(self.inpainter, UNet3d)
        return {"inpainter": outline_of(self.inpainter, self.upsampler)} if drawn else {}

    def at(self, moment: Moment) -> VoxelSnapshot:
        """Warp the canonical radiance to a moment; one field for each rendering, the best last."""
        canonical = self.radiance()  # V_R = F1
        warped, flow, coverage, dropped = canonical, None, None, 0  # V_R^t
        if self.motion is not None and moment.time != self.canonical_time:
            flow = self.motion.trajectory.flow(self.radiance, moment.time)  # V_flow
            warped, coverage, dropped = self.motion.warp(canonical, self.radiance.voxels, flow)
        first = "warped" if self.upsampler is None else "upsampled"
        if self.inpainter is None:
            upsampled, difference = warped if self.upsampler is None else self.upsampler(warped), None
            fields = {first: upsampled}  # V_RUp
        else:
            upsampled, inpainted, difference = inpaint(warped, coverage, self.inpainter, self.upsampler)
            fields = {first: upsampled, "inpainted": inpainted}  # V_RUp, V_RInp
        found = {"flow": flow, "coverage": coverage, "dropped": dropped, "inpaint_difference": difference}
        length = 2 / 3 * self.half_extent if self.moves else 1.0
        return self.snapshot(moment, fields, canonical, length=length, **found)

    def departures(self) -> list[str]:
        """See ``Method``; docs/method.md has the rest, which every preset shares."""
        direct = isinstance(self.radiance, DirectRadiance)
        as_in_dvgo = [n for n in self.literal if self.weights.get(n) and n not in self.printed]
        held = self.static_points is not None and self.weights.get("static_points", 0) > 0
        adds = self.inpainter is not None or isinstance(self.upsampler, LearnedUpsampler)
        notes = {
            "no up-sampling": self.upsampler is None,
            "no inpainter": self.inpainter is None,
            "colour without direction": self.view_dependence is None,
            "voxels hold density and colour, without the network F1": direct,
            "voxels without matter are left out (refresh_every)": self.stage.refresh_every > 0,
            "the inpainter and the up-layer add to the interpolated grid": adds,
            f"not normalised as printed: {', '.join(as_in_dvgo)} (literal)": as_in_dvgo,
            "points known to be static are held (static_points)": held,
            "learning rates end at lr_final_factor times the first (printed: constant)": True,
        }
        if self.motion is not None:
            learned = self.motion.trajectory.learned is not None
            notes |= {
                "motion (F2) at the nodes of a coarse lattice": self.motion.trajectory.at_nodes,
                "learned at these nodes, without the network F2": learned,
                "motion begins as that of another method (carry)": learned and self.handed,
                "cosines of a longer period (padding)": self.motion.trajectory.padding > 0,
                "matter fades where little of it is splatted (tau, fade)": True,
            }
        return those_that_hold(notes)

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Follow the schedules of the lattices and of the trajectory bases."""
        noted = super().advance(progress, step, optimizer)
        if self.motion is not None:
            self._follow(optimizer)
            noted["bases_in_play"] = self.motion.trajectory.play(self.stage.at("bases", progress))
        return noted

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Return the paths (N, T, 3) of canonical points (N, 3) at ``times`` (T,), in world units."""
        if self.motion is None:
            return points[:, None].expand(-1, len(times), -1)
        return self.motion.trajectory.trajectories(points, times)

    def moved(self, points: Tensor, rows: Tensor, time: float) -> Tensor:
        """Move the canonical voxels ``rows`` (N,) bool, at ``points`` (M, 3), to ``time`` (M, 3)."""
        return points + self.motion.trajectory.flow(self.radiance, time)[rows]
