"""The optional parts of particles: which there are, and which of them a stage uses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from forewarp.fields.curves import KINDS
from forewarp.ops.backend import is_number


@dataclass(frozen=True)
class Effects:
    """The choice of each effect; None: off.

    Args:
        motion: ``spline`` or ``cosines``: the curves of the nodes.
        rotation: True: nodes turn, and do not only shift.
        view_dependence: degree 1 to 3 of the harmonics by which colour depends on direction.
        color_over_time, opacity_over_time: cosines over time of each particle's colour, and of its opacity.
        background: share of the scene's extent. Nodes that move (and, by turning, move what is beside them)
            no farther than that from their mean place, or than a pixel, come to rest; particles that follow
            no others need no nodes any more.

    Raises:
        ValueError: naming the key of a choice that there is not.
    """

    motion: str | None = None
    rotation: bool | None = None
    view_dependence: int | None = None
    color_over_time: int | None = None
    opacity_over_time: int | None = None
    background: float | None = None

    def __post_init__(self) -> None:
        for name, known, good in (
            ("motion", " or ".join(KINDS), lambda choice: choice in KINDS),
            ("rotation", "true", lambda choice: choice is True),
            ("view_dependence", "a degree of 1 to 3", lambda choice: _is_whole(choice) and choice <= 3),
            ("color_over_time", "a number of cosines >= 1", _is_whole),
            ("opacity_over_time", "a number of cosines >= 1", _is_whole),
            ("background", "a number > 0", lambda choice: is_number(choice) and choice > 0),
        ):
            choice = getattr(self, name)
            if choice is not None and not good(choice):
                raise ValueError(
                    f"model.{name}: expected {known}, or null, but got {choice!r}; "
                    f"choose model/{name}=none to switch it off"
                )

    def only(self, names: Sequence[str], times: int) -> Effects:
        """Switch off all effects but those named, and, in a scene of one time, those that need several."""
        kept = {name for name in names if times > 1 or name == "view_dependence"}
        kept -= set() if self.motion is not None and "motion" in kept else {"rotation", "background"}
        return replace(self, **{name: None for name in NAMES if name not in kept})


NAMES = tuple(field.name for field in fields(Effects))


def _is_whole(choice) -> bool:
    return isinstance(choice, int) and not isinstance(choice, bool) and choice >= 1


def cosines(count: int, time: float, canonical_time: float) -> list[float]:
    """``cos(pi k t) - cos(pi k t_c)`` for k = 1 .. count: 0 at the canonical time.

    >>> cosines(2, 1.0, 0.0)
    [-2.0, 0.0]
    """
    return [
        math.cos(math.pi * k * time) - math.cos(math.pi * k * canonical_time) for k in range(1, count + 1)
    ]
