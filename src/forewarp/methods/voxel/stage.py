"""The numbers of one stage of a voxel method: its schedules of lattices and bases, its start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from forewarp.methods.checks import steps_of

EFFECTS = ("motion", "view_dependence", "upsampler", "inpainter", "background")


@dataclass(frozen=True)
class VoxelStage:
    """The numbers of a stage. Fractions are fractions of the stage; opacities are over one voxel.

    Args:
        num_voxels: ``[[fraction, count], ...]``: about ``count`` voxels in the box from ``fraction`` on.
        background_num_voxels: as ``num_voxels``, for the static background's grid over the scene's box.
        effects: effects of the model to use in this stage, some of ``motion, view_dependence, upsampler,
            inpainter, background``.
        upsample: interpolate by this factor instead of the model's up-sampler; None: use the model's.
        carry: continue with the grids of the stage before, if it was a voxel method; False: use its box only.
        start: voxels that are active at first: ``box`` (all), ``hull`` (the visual hull; needs alpha), or
            ``auto`` (the hull if the images have alpha, else the box).
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
        patches: number of patches that the depth term renders.
        name: name of the stage, for errors.

    Raises:
        ValueError: naming the key that is out of range.
    """

    num_voxels: Sequence[Sequence[float]]
    background_num_voxels: Sequence[Sequence[float]] = ((0.0, 262144),)
    effects: Sequence[str] = EFFECTS
    upsample: float | None = None
    carry: bool = True
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
    patches: int = 16
    name: str = "fine"

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        for key in ("num_voxels", "background_num_voxels", "bases"):
            if key != "bases" or self.bases:
                steps_of(f"{where}.{key}", getattr(self, key))
        if not set(self.effects) <= set(EFFECTS):
            raise ValueError(
                f"{where}.effects: expected some of {', '.join(EFFECTS)}, but got {list(self.effects)}"
            )
        if self.start not in ("auto", "box", "hull"):
            raise ValueError(f"{where}.start: expected auto, box or hull, but got '{self.start}'")
        if not 0 <= self.confine <= 1:
            raise ValueError(f"{where}.confine: expected a fraction in [0, 1], but got {self.confine}")
        for key in ("box_alpha", "start_alpha"):
            if not 0 < getattr(self, key) < 1:
                raise ValueError(f"{where}.{key}: expected a number in (0, 1), but got {getattr(self, key)}")
        if not 0 < self.birth_alpha < self.keep_alpha < 1:
            raise ValueError(
                f"{where}: expected 0 < birth_alpha < keep_alpha < 1, or fog spreads, "
                f"but got {self.birth_alpha}, {self.keep_alpha}"
            )

    def at(self, key: str, fraction: float) -> float | None:
        """Return the value of the schedule ``key`` at a fraction; None if it is empty."""
        value = None
        for begin, number in getattr(self, key):
            if fraction >= begin or value is None:
                value = number
        return value
