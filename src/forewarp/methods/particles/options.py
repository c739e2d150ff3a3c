"""The options of particles: effects, and the numbers of a stage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from forewarp.fields.curves import KINDS
from forewarp.methods.effect import Effect, Evidence
from forewarp.methods.method import check_effects, check_number, steps_of
from forewarp.ops.backend import check_value, is_number

SMALLEST = 96  # pixels of an image's longer side, below which none is made smaller
OF_COSINES = ("color_over_time", "opacity_over_time", "exposure")  # effects that are a number of these
_VIEWS = 100  # training images from which on more of them call for no more particles


@dataclass(frozen=True)
class Effects:
    """The choice of each effect; None: off. Defaults are those of cut-out images.

    Args:
        motion: the curves of the nodes, ``spline`` or ``cosines``.
        rotation: True: nodes also rotate what is beside them.
        view_dependence: degree 1 to 3 of the spherical harmonics by which colour depends on direction.
        color_over_time, opacity_over_time: number of cosines over time of each particle's colour and opacity.
        exposure: number of cosines over time of the gain and the bias of all colours, as of a film whose
            exposure or white balance drifts; at most one for four times, none where several cameras film.
        background: share of the scene's extent. Nodes that move (and, by rotating, move what is beside them)
            no farther than that from their mean position, or than a pixel, come to rest; particles that
            follow no others need no nodes any more.

    Raises:
        ValueError: naming the key of a choice that there is not.
    """

    motion: str | None = "spline"
    rotation: bool | None = True
    view_dependence: int | None = 1
    color_over_time: int | None = 2
    opacity_over_time: int | None = None
    exposure: int | None = None
    background: float | None = 0.03

    def __post_init__(self) -> None:
        for name, expected, valid in (
            ("motion", " or ".join(KINDS), lambda choice: choice in KINDS),
            ("rotation", "true", lambda choice: choice is True),
            ("view_dependence", "a degree of 1 to 3", lambda choice: _is_count(choice) and choice <= 3),
            *((name, "a number of cosines >= 1", _is_count) for name in OF_COSINES),
            ("background", "a number > 0", lambda choice: is_number(choice) and choice > 0),
        ):
            if (choice := getattr(self, name)) is not None:
                off = f"choose model/{name}=none to switch it off"
                check_value(f"model.{name}", choice, f"{expected}, or null", valid, off)

    def only(self, names: Sequence[str], times: int) -> Effects:
        """Switch off all effects but those named, and, in a scene of one time, those that need several."""
        kept = {name for name in names if times > 1 or name == "view_dependence"}
        if self.motion is None or "motion" not in kept:
            kept -= {"rotation", "background"}
        return replace(self, **{name: None for name in NAMES if name not in kept})


NAMES = tuple(field.name for field in fields(Effects))


def _is_count(choice: object) -> bool:
    return type(choice) is int and choice >= 1


def view_share(views: int) -> float:
    """Return how much so many training images tell of details, as a share in [0, 1] of a hundred's."""
    return min(1.0, views / _VIEWS)


@dataclass(frozen=True)
class Numbers:
    """The numbers of a stage that are the method's own. Shares are of the stage.

    Args:
        effects: those of the model's effects that the stage uses; one that only shapes particles uses none.
        density: number of particles in the end, divided by the square root of the covered pixels (those that
            show anything); of less than a hundred images, by that of their share of these pixels.
        initial_share, final_share: shares of that number that the stage begins and ends with.
        nodes: number of nodes, divided by the square root of the number of particles at the beginning.
        knots: coefficients of each node's curve, divided by the square root of the number of times; at most
            half as many as times and four more, or what lies between two of them would be left open.
        natural_splines: whether splines end without acceleration: two coefficients follow from the others.
        edges: neighbours that a node is kept rigid with.
        density_interval: share between two rounds of density control, up to ``density_until``.
        relink: rounds after which particles look again for the nodes beside them.
        rest_from: share from which nodes that do not move come to rest, where the model has a background.
        jitter: deviation of the random shift of an image's time, which falls to 0 at ``jitter_until``.
        time_offsets: largest learned correction of an image's time, times the mean distance of two training
            times; learned from ``jitter_until`` on, of splines alone; 0: times are used as they are given.
        opacity_decay: share of their opacity that a step takes from the particles that its image shows, while
            the learning rate of opacity is its first; as that falls, so does the share.
        crowd_decay: extra opacity decay per step, scaled by ``max(0, 1 - covered_pixels / final_count)``.
        hidden_decay: as ``opacity_decay``, of the particles that the image does not show.
        rigid_final_factor: factor that the weight of ``rigid`` falls to by the end.
        image_scale: ``[[fraction, times], ...]``: from a fraction on, images are so many times smaller, not
            below 96 pixels of the longer side: motion over many pixels is found in cheap steps.
        rest_by_masks: whether particles follow no node that masks of a film's images, if it has any, do not
            show to move.
        bodies: share of the stage up to which what one camera sees on the ground (by ``rest_by_masks``) moves
            as rigid bodies, and nothing else moves; nodes must rotate. 0: nothing does.
        shell: far planes of the cameras at which particles stand behind all that images show; what is outside
            the box is at rest; at least 1. 0: particles begin in the box, and all may move. Images with alpha
            have none.
        name: name of the stage.

    Raises:
        ValueError: naming the stage's wrong key.
    """

    effects: Sequence[str] = NAMES
    density: float = 90.0
    initial_share: float = 0.5
    final_share: float = 1.0
    nodes: float = 2.5
    knots: float = 2.2
    natural_splines: bool = True
    edges: int = 6
    density_interval: float = 0.01
    density_until: float = 0.6
    relink: int = 5
    rest_from: float = 0.45
    jitter: float = 0.01
    jitter_until: float = 0.4
    time_offsets: float = 1.5
    opacity_decay: float = 0.0
    crowd_decay: float = 2.5e-3
    hidden_decay: float = 0.0
    rigid_final_factor: float = 0.17
    image_scale: Sequence[Sequence[float]] = ((0.0, 1),)
    rest_by_masks: bool = False
    bodies: float = 0.0
    shell: float = 0.0
    name: str = "fine"

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        check_effects(f"{where}.effects", self.effects, NAMES)
        steps_of(f"{where}.image_scale", self.image_scale, from_start=True)
        for key in ("natural_splines", "rest_by_masks"):
            check_value(f"{where}.{key}", getattr(self, key), "true or false", lambda v: isinstance(v, bool))
        shares = "initial_share", "final_share", "density_interval", "rigid_final_factor"
        decays = "opacity_decay", "crowd_decay", "hidden_decay", "bodies"
        others = "density_until", "rest_from", "jitter", "time_offsets"
        for keys, wanted, good in (
            (shares, "a number in (0, 1]", lambda value: 0 < value <= 1),
            (decays, "a number in [0, 1)", lambda value: 0 <= value < 1),
            (("density", "nodes", "knots", "jitter_until"), "a number > 0", lambda value: value > 0),
            (("edges", "relink"), "a whole number >= 1", lambda value: value >= 1 and value == int(value)),
            (others, "a number >= 0", lambda value: value >= 0),
            (("shell",), "0 or a number >= 1", lambda value: value == 0 or value >= 1),
        ):
            for key in keys:
                check_number(f"{where}.{key}", getattr(self, key), wanted, good)

    def final_count(self, covered_pixels: float, views: int) -> int:
        """Return how many particles there are in the end.

        >>> Numbers().final_count(20_000.0, 100), Numbers().final_count(20_000.0, 25)
        (12728, 6364)
        """
        return max(32, round(self.density * math.sqrt(covered_pixels * view_share(views))))

    def decay(self, final_count: float, covered_pixels: float) -> float:
        """Return the share of their opacity that a step takes from particles, by how crowded pixels are.

        >>> Numbers().decay(10_000.0, 20_000.0), Numbers().decay(10_000.0, 2000.0)
        (0.0, 0.002)
        """
        crowd = max(0.0, 1 - covered_pixels / final_count)
        return self.opacity_decay + self.crowd_decay * crowd * (1 - self.opacity_decay)

    def share_at(self, progress: float) -> float:
        """Return the share of ``final_count`` at a progress: it is reached a little before control ends."""
        done = min(1.0, progress / max(0.8 * self.density_until, 1e-6))
        return self.final_share * (self.initial_share + (1 - self.initial_share) * done)

    def motion(self, particles: int, times: int) -> tuple[int, int]:
        """Return how many nodes there are, and how many coefficients each has.

        >>> Numbers().motion(6364, 100)
        (199, 22)
        """
        knots = min(times // 2 + 4, round(self.knots * math.sqrt(times)))
        return max(4, round(self.nodes * math.sqrt(particles))), max(4, knots)


EFFECTS = (
    Effect("motion", attribute="deformation", of=Evidence.of_time),
    Effect("rotation", attribute="deformation.nodes.rotations", needs="motion"),
    Effect("background", attribute="deformation.nodes.stopped", needs="motion"),
    Effect("opacity_over_time", attribute="gaussians.opacity_over_time", of=Evidence.of_time),
    Effect("color_over_time", attribute="gaussians.color_over_time", of=Evidence.of_time),
    Effect("exposure", of=Evidence.of_exposure),
    Effect("view_dependence", attribute="gaussians.sh", of=Evidence.of_direction),
)
