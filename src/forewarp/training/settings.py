"""The numbers of one stage that the platform sees to, checked once."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class StageSettings:
    """One stage of a run. Fractions are of the stage.

    Args:
        name: also the name of its folder.
        lr: learning rate by the names of the method's ``param_groups``.
        iterations: steps; null where minutes bound it.
        minutes: training minutes; null where iterations bound it. With both, what comes first.
        lr_hold: fraction up to which learning rates are constant. After it they fall exponentially, to
            ``lr_final_factor`` of what they were.
        curriculum: arguments of ``Curriculum``.
        max_gradient: norm that gradients are clipped to; 0: not at all.
        numbers: all other keys of the stage, which are the method's own.
    """

    name: str
    lr: Mapping[str, float]
    iterations: int | None = None
    minutes: float | None = None
    lr_hold: float = 0.0
    lr_final_factor: float = 0.1
    curriculum: Mapping[str, float] = field(default_factory=dict)
    max_gradient: float = 0.0
    numbers: Mapping[str, Any] = field(default_factory=dict)

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

    @classmethod
    def of(cls, name: str, **keys: Any) -> StageSettings:
        """Sort a stage's keys into the platform's and the method's own."""
        own = {key: keys.pop(key) for key in list(keys) if key in cls.__dataclass_fields__}
        return cls(name, **own, numbers=keys)

    def lr_factor(self, fraction: float) -> float:
        """What learning rates are multiplied by at a fraction."""
        if fraction <= self.lr_hold:
            return 1.0
        return self.lr_final_factor ** ((min(1.0, fraction) - self.lr_hold) / (1 - self.lr_hold))

    def fraction(self, steps: int, seconds: float) -> float:
        """How much of the stage is done: the larger of the shares of its iterations and its minutes."""
        done = 0.0
        if self.iterations is not None:
            done = steps / self.iterations
        if self.minutes is not None:
            done = max(done, seconds / (60 * self.minutes))
        return min(1.0, done)
