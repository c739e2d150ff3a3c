"""How a method is put together once a scene and a lattice are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from forewarp.effects.background import StaticBackground
from forewarp.effects.motion import Motion
from forewarp.effects.upsample import LearnedUpsampler, TrilinearUpsampler
from forewarp.fields.trajectory import TrajectoryField
from forewarp.methods.backward_warp import BackwardWarp, Deformation
from forewarp.methods.forward_warp import ForwardWarp
from forewarp.scene.box import Box, Lattice


@dataclass(frozen=True)
class MethodSpec:
    """The choices of ``model/``, each a factory that waits for what only the scene knows, or None for off.

    ``warp`` is ``forward`` or ``backward``; the backward method takes ``deformation`` and ignores the effects
    that need a forward warp (motion with its trajectory, upsampler, inpainter).
    """

    radiance: Callable[..., nn.Module]
    warp: str = "forward"
    motion: Callable[..., Motion] | None = None
    trajectory: Callable[..., TrajectoryField] | None = None
    upsampler: Callable[..., nn.Module] | None = None
    inpainter: Callable[..., nn.Module] | None = None
    view: Callable[..., nn.Module] | None = None
    deformation: Callable[..., Deformation] | None = None
    background: Callable[..., StaticBackground] | None = None

    def __post_init__(self) -> None:
        if self.warp not in ("forward", "backward"):
            raise ValueError(f"model.warp: expected forward or backward, but got '{self.warp}'")
        for name in ("motion", "trajectory", "upsampler", "inpainter", "view", "deformation", "background"):
            choice = getattr(self, name)
            if choice is not None and not callable(choice):
                raise ValueError(
                    f"model.{name}: expected a factory or null, but got {choice!r}; "
                    f"choose model/{name}=none to switch it off"
                )
        needed = {"deformation": self.warp == "backward", "trajectory": self.motion is not None}
        for name, need in needed.items():
            if need and getattr(self, name) is None:
                raise ValueError(
                    f"model.{name}: expected a factory, but got null; choose another model/motion or model"
                )

    def build(
        self,
        lattice: Lattice,
        active: Tensor,
        *,
        unit: float,
        scene_box: Box,
        frames: int,
        canonical_time: float,
        effects: Sequence[str],
        upsample: float | None = None,
        still: tuple[Lattice, Tensor] | None = None,
    ) -> ForwardWarp | BackwardWarp:
        """The method on a lattice.

        Args:
            lattice: the canonical lattice.
            active: (X, Y, Z) bool.
            unit: length that density is measured in.
            scene_box: normalises positions, the same in all stages.
            frames: distinct training times; with one there is no motion.
            canonical_time: in [0, 1].
            effects: those that this stage uses, where the model has them.
            upsample: plain interpolation by this factor in place of the model's up-sampler; forward only.
            still: lattice and active voxels of the static background; needed where the model has one.
        """
        view = self.view() if self.view is not None and "view" in effects else None
        features = view.features if view is not None else 3
        radiance = self.radiance(lattice, active, features=features, unit=unit, box=scene_box)
        background = None
        if self.background is not None and "background" in effects:
            background = self.background(*still, unit=unit)
        common = {"canonical_time": canonical_time, "view": view, "background": background}
        if self.warp == "backward":
            moves = frames > 1
            deformation = self.deformation(scene_box, canonical_time=canonical_time) if moves else None
            return BackwardWarp(radiance, deformation=deformation, **common)
        motion = None
        if self.motion is not None and frames > 1 and "motion" in effects:
            motion = self.motion(self.trajectory(scene_box, frames=frames, canonical_time=canonical_time))
        inpainter = None
        if self.inpainter is not None and "inpainter" in effects:
            learned = upsample is None and "upsampler" in effects and self._learns_to_upsample
            inpainter = self.inpainter(channels=1 + features, head=not learned)
        upsampler = self._upsampler(features, inpainter, effects, upsample)
        return ForwardWarp(radiance, motion=motion, upsampler=upsampler, inpainter=inpainter, **common)

    @property
    def _learns_to_upsample(self) -> bool:
        made = getattr(self.upsampler, "func", self.upsampler)
        return isinstance(made, type) and issubclass(made, LearnedUpsampler)

    def _upsampler(self, features, inpainter, effects, upsample) -> nn.Module | None:
        if upsample is not None:
            return TrilinearUpsampler(scale=upsample)
        if self.upsampler is None or "upsampler" not in effects:
            return None
        if self._learns_to_upsample:
            return self.upsampler(channels=1 + features, features=0 if inpainter is None else inpainter.width)
        return self.upsampler()


def parameter_kinds(method: nn.Module) -> dict[str, list[nn.Parameter]]:
    """Every parameter under the kind that its learning rate is given by.

    Kinds: ``density``, ``color``, ``shading`` and ``grid`` (rows of voxel grids), ``flow`` (the trajectory or
    deformation network), ``network`` (all other networks).
    """
    kinds: dict[str, list[nn.Parameter]] = {}
    for name, parameter in method.named_parameters():
        head, last = name.split(".")[0], name.split(".")[-1]
        if last in ("density", "color", "shading"):
            kind = last
        elif last in ("features", "grid"):
            kind = "grid"
        elif head in ("motion", "deformation"):
            kind = "flow"
        else:
            kind = "network"
        kinds.setdefault(kind, []).append(parameter)
    return kinds


def parameter_count(method: nn.Module) -> int:
    """Learned numbers."""
    return sum(p.numel() for p in method.parameters())
