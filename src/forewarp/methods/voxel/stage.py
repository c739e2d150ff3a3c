"""The numbers of one stage of a voxel method, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

EFFECTS = ("motion", "view_dependence", "upsampler", "inpainter", "background")


@dataclass(frozen=True)
class VoxelStage:
    """What a stage does with its lattices. Fractions are of the stage.

    Args:
        num_voxels: ``[[fraction, count], ...]``: from that fraction on, about so many voxels in the box.
        background_num_voxels: as ``num_voxels``, for the static background's grid over the scene's box.
        effects: the model's effects that this stage uses: some of ``motion, view_dependence, upsampler,
            inpainter, background``.
        upsample: plain interpolation by this factor in place of the model's up-sampler; null: the model's.
        carry: start from the stage before, where that is of voxels too; otherwise only its box is used.
        start: what is active at the beginning, ``box`` or ``hull`` (needs alpha); ``auto`` is the hull where
            the images have alpha, else the box.
        hull_frames: the hull is that of so many frames nearest to the canonical time, and of all that share a
            time with them; few, or what moves fast is carved away. hull_grow: share of the image's width by
            which silhouettes are grown, since the scene moves. hull_misses: views that may disagree.
        refresh_every: steps between updates of the active voxels; 0: never. refresh_from: fraction.
        keep_alpha, birth_alpha: opacity over a voxel that is kept, and that new voxels start with.
        confine: fraction up to which voxels are born only where some were active at the start, so that new
            matter cannot stand in for motion; 0: anywhere.
        see_steps: once a lattice has stood for so many steps, a refresh, or the next lattice, also forgets
            voxels that no view has seen since it changed, or since they were born; 0: never.
        box_alpha: opacity over a voxel of what the next stage's box must hold.
        start_alpha: opacity over a voxel of the first active voxels.
        color_threshold: the renderer's in this stage; null: as elsewhere.
        bases: ``[[fraction, K], ...]``: how many bases play from that fraction on; empty: all.
        patches: patches a draw for the depth term.
        name: of the stage, for errors.
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
            steps = [tuple(s) for s in getattr(self, key)]
            if (key != "bases" and not steps) or any(
                len(s) != 2 or not 0 <= s[0] <= 1 or s[1] < 1 for s in steps
            ):
                raise ValueError(
                    f"{where}.{key}: expected [[fraction, count], ...], but got {getattr(self, key)}"
                )
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
        """The value of the schedule ``key`` at a fraction; None where it is empty."""
        value = None
        for begin, number in getattr(self, key):
            if fraction >= begin or value is None:
                value = number
        return value
