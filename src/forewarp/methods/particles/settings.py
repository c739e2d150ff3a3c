"""A stage's numbers, checked once, and what follows from the pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from forewarp.methods.particles.effects import NAMES
from forewarp.ops.backend import is_number

_VIEWS = 100  # pictures from which on more of them call for no more particles


def told_by(views: int) -> float:
    """How much so many pictures tell of who follows whom and of details: all of it in [0, 1], or a share."""
    return min(1.0, views / _VIEWS)


@dataclass(frozen=True)
class Numbers:
    """The numbers of a stage that are the method's own. Shares are of the stage.

    Args:
        effects: those of the model's effects that the stage uses; one that only shapes particles uses none.
        density: particles there are in the end, times the square root of the pixels that show anything; of
            less than a hundred pictures, of their share of these pixels.
        first: share of them to begin with.
        full: share of them that this stage ends with.
        nodes: how many there are, times the square root of the particles at the beginning.
        knots: coefficients of each node's curve, times the square root of the times.
        straight: whether the curves, if splines, end without acceleration: two coefficients follow from the
            others. Runs that do not say have free ends.
        edges: neighbours that a node is kept rigid with.
        every: share between two rounds of density control, up to ``settled``.
        relink: rounds after which particles look again for the nodes beside them.
        rest: share from which nodes that do not move come to rest, where the model has a background.
        jitter, calm: spread of the random shift of a picture's time, which falls to 0 at the share ``calm``.
        time_offsets: largest learned correction of a picture's time, times the mean distance of two training
            times; learned from ``calm`` on, of splines alone; 0: times are used as they are given.
        opacity_decay: share of their opacity that a picture takes from the particles that it shows, while the
            rate of opacity is its first; as that falls, so does the share.
        crowd_decay: share of their opacity that a picture takes besides, times ``1 - covered pixels /
            particles``, with as many particles as there are in the end; 0 where these are fewer than pixels.
        loose: what is left of the weight of ``rigid`` at the end.
        name: name of the stage.

    Raises:
        ValueError: naming the stage's wrong key.
    """

    effects: Sequence[str] = NAMES
    density: float = 90.0
    first: float = 0.5
    full: float = 1.0
    nodes: float = 2.5
    knots: float = 2.2
    straight: bool = False
    edges: int = 6
    every: float = 0.01
    settled: float = 0.6
    relink: int = 5
    rest: float = 0.45
    jitter: float = 0.01
    calm: float = 0.4
    time_offsets: float = 0.0
    opacity_decay: float = 0.0
    crowd_decay: float = 0.0
    loose: float = 0.17
    name: str = "fine"

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        if not set(self.effects) <= set(NAMES):
            raise ValueError(
                f"{where}.effects: expected some of {', '.join(NAMES)}, but got {list(self.effects)}"
            )
        if not isinstance(self.straight, bool):
            raise ValueError(f"{where}.straight: expected true or false, but got {self.straight!r}")
        for keys, what, good in (
            (("first", "every", "loose", "full"), "a number in (0, 1]", lambda value: 0 < value <= 1),
            (("density", "nodes", "knots", "calm"), "a number > 0", lambda value: value > 0),
            (("edges", "relink"), "a whole number >= 1", lambda value: value >= 1 and value == int(value)),
            (("opacity_decay", "crowd_decay"), "a number in [0, 1)", lambda value: 0 <= value < 1),
            (("jitter", "settled", "rest", "time_offsets"), "a number >= 0", lambda value: value >= 0),
        ):
            for key in keys:
                value = getattr(self, key)
                if not (is_number(value) and good(value)):
                    raise ValueError(f"{where}.{key}: expected {what}, but got {value!r}")

    def most(self, covered: float, views: int) -> int:
        """How many particles there are in the end, by the pixels that show anything and the pictures.

        >>> Numbers().most(20_000.0, 100), Numbers().most(20_000.0, 25)
        (12728, 6364)
        """
        return max(32, round(self.density * math.sqrt(covered * told_by(views))))

    def decay(self, most: float, covered: float) -> float:
        """Return the share of their opacity that a picture takes from particles, by how crowded pixels are.

        >>> numbers = Numbers(crowd_decay=2.5e-3)
        >>> numbers.decay(10_000.0, 20_000.0), numbers.decay(10_000.0, 2000.0)
        (0.0, 0.002)
        """
        crowd = max(0.0, 1 - covered / most)
        return self.opacity_decay + self.crowd_decay * crowd * (1 - self.opacity_decay)

    def share_at(self, progress: float) -> float:
        """The share of them that there should be: on a line from ``first``; soon before ``settled``, all."""
        done = min(1.0, progress / max(0.8 * self.settled, 1e-6))
        return self.full * (self.first + (1 - self.first) * done)

    def motion(self, particles: int, times: int) -> tuple[int, int]:
        """How many nodes, and how many coefficients each has.

        >>> Numbers().motion(6364, 100)
        (199, 22)
        """
        knots = min(times + 2, round(self.knots * math.sqrt(times)))
        return max(4, round(self.nodes * math.sqrt(particles))), max(4, knots)
