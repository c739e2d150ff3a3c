"""The numbers of one stage, checked once."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

EFFECTS = ("motion", "view", "upsampler", "inpainter", "background")


@dataclass(frozen=True)
class StageSettings:
    """One stage of a run. Fractions are of the stage.

    Args:
        name: also the name of its folder.
        voxels: ``[[fraction, count], ...]``: from that fraction on, about so many voxels in the box.
        rates: kind of parameter -> learning rate (see ``methods.spec.parameter_kinds``).
        iterations: steps; null where minutes bound it.
        minutes: training minutes; null where iterations bound it. With both, what comes first.
        background_voxels: as ``voxels``, for the static background's grid over the whole scene's box.
        effects: those of the model's that this stage uses, of ``motion, view, upsampler, inpainter,
            background``.
        upsample: plain interpolation by this factor in place of the model's up-sampler; null: the model's.
        carry: start from the stage before; otherwise only its box is used.
        start: what is active at the beginning, ``box`` or ``hull`` (needs alpha); ``auto`` is the hull where
            the images have alpha, else the box.
        hull_frames: the hull is that of so many frames nearest to the canonical time, and of all that share a
            time with them; few, or what moves fast is carved away. hull_grow: share of the image's width by
            which silhouettes are grown, since the scene moves. hull_misses: views that may disagree.
        hold: fraction up to which rates are constant; after it they fall exponentially to ``final_rate``.
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
        curriculum: arguments of ``Curriculum``.
        patches: patches a draw for the depth term.
        max_gradient: norm that gradients are clipped to; 0: not at all.
    """

    name: str
    voxels: Sequence[Sequence[float]]
    rates: Mapping[str, float]
    iterations: int | None = None
    minutes: float | None = None
    background_voxels: Sequence[Sequence[float]] = ((0.0, 262144),)
    effects: Sequence[str] = EFFECTS
    upsample: float | None = None
    carry: bool = True
    start: str = "box"
    hull_grow: float = 0.01
    hull_misses: int = 0
    hull_frames: int = 5
    hold: float = 0.0
    final_rate: float = 0.1
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
    curriculum: Mapping[str, float] = field(default_factory=dict)
    patches: int = 16
    max_gradient: float = 0.0

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        if not isinstance(self.name, str) or not re.fullmatch(r"\w[\w-]*", self.name):
            raise ValueError(
                "stage: expected names of letters, digits, _ and -, as they name folders, "
                f"but got {self.name!r}"
            )
        if self.iterations is None and self.minutes is None:
            raise ValueError(
                f"{where}: expected iterations or minutes, but got neither; set budget.minutes=10"
            )
        for key in ("iterations", "minutes"):
            value = getattr(self, key)
            if value is not None and not value > 0:
                raise ValueError(f"{where}.{key}: expected a number > 0, but got {value}")
        for key in ("voxels", "background_voxels", "bases"):
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

    def rate_factor(self, fraction: float) -> float:
        """What learning rates are multiplied by at a fraction."""
        if fraction <= self.hold:
            return 1.0
        return self.final_rate ** ((min(1.0, fraction) - self.hold) / (1 - self.hold))

    def fraction(self, steps: int, seconds: float) -> float:
        """How much of the stage is done: the larger of the shares of its iterations and its minutes."""
        done = 0.0
        if self.iterations is not None:
            done = steps / self.iterations
        if self.minutes is not None:
            done = max(done, seconds / (60 * self.minutes))
        return min(1.0, done)
