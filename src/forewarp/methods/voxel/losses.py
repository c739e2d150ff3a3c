"""The loss terms of the voxel methods: which function of ``losses`` is applied to what."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from forewarp import losses
from forewarp.fields.grids import RadianceGrid
from forewarp.renderer import Marched

if TYPE_CHECKING:
    from forewarp.methods.voxel.model import VoxelSnapshot

Pairs = list[tuple[Tensor, Tensor]]
LITERAL = ("photo", "point_color", "background_entropy")  # terms whose printed form differs


@dataclass(frozen=True)
class Seen:
    """What the terms are computed from.

    Attributes:
        rgb: the true colours (R, 3).
        state: the method at the batch's time.
        renderings: renderings of the batch's rays, by name.
        render_patches: renders depth and opacity (B, S, S) of patches from random views at this time.
        stray: returns the displacement (N, 3) of points known to be static; None if none are known.
        neighbours: returns the pairs of neighbouring voxels of an index.
    """

    rgb: Tensor
    state: VoxelSnapshot
    renderings: dict[str, Marched]
    render_patches: Callable[[], tuple[Tensor, Tensor]]
    stray: Callable[[], Tensor | None]
    neighbours: Callable[[Tensor], Pairs]

    @property
    def pairs(self) -> Pairs:
        """Pairs of neighbouring canonical voxels."""
        return self.neighbours(self.state.canonical.index)

    @property
    def grids(self) -> list[RadianceGrid]:
        """The canonical grid, and the static background's if there is one."""
        return [g for g in (self.state.canonical, self.state.background) if g is not None]

    def tensors(self) -> Iterable[tuple[str, Tensor | None]]:
        """Yield everything that was computed, from the grids to the renderings, by name."""
        state = self.state
        for name in ("flow", "coverage", "inpaint_difference"):
            yield f"state.{name}", getattr(state, name)
        grids = {"canonical": state.canonical, "background": state.background, **state.fields}
        yield from ((f"state.{name}.values", getattr(grid, "values", None)) for name, grid in grids.items())
        for name, drawn in self.renderings.items():
            yield from ((f"{name}.{part}", getattr(drawn, part)) for part in ("rgb", "depth", "opacity"))


Term = Callable[[Seen], Tensor | None]


def _over_renderings(term: Callable[[Seen, Marched], Tensor]) -> Term:
    return lambda seen: sum(term(seen, rendering) for rendering in seen.renderings.values())


def _flow(term: Callable[[Seen, Tensor], Tensor]) -> Term:
    return lambda seen: None if seen.state.flow is None else term(seen, seen.state.flow / seen.state.length)


def _static_points(seen: Seen) -> Tensor | None:
    stray = seen.stray()
    return None if stray is None else losses.static_points(stray)


def _moving_opacity(seen: Seen) -> Tensor | None:
    if seen.state.background is None:
        return None
    grid = seen.state.canonical
    return losses.moving_opacity(grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size))


def _inpaint(seen: Seen) -> Tensor | None:
    residual = seen.state.inpaint_difference
    return None if residual is None else losses.inpaint_diff(residual)


def voxel_terms(literal: Iterable[str] = ()) -> dict[str, Term]:
    """Return all terms by name; those in ``literal`` in the form printed in the paper (see ``losses``).

    Raises:
        ValueError: for a literal term that has no printed form of its own.
    """
    literal = frozenset(literal)
    if not literal <= set(LITERAL):
        raise ValueError(
            f"objective.literal: expected some of {', '.join(LITERAL)}, but got {sorted(literal)}"
        )

    def entropy(seen: Seen, r: Marched) -> Tensor:
        if "background_entropy" in literal:
            return losses.sample_entropy(r.all_weights)
        return losses.background_entropy(r.transmittance)

    def point_color(seen: Seen, r: Marched) -> Tensor:
        every = r.all_ray_ids if "point_color" in literal else None
        return losses.point_color(r.weights, r.colors, r.ray_ids, seen.rgb, all_ray_ids=every)

    return {
        "photo": _over_renderings(
            lambda seen, r: losses.photometric(r.rgb, seen.rgb, literal="photo" in literal)
        ),
        "point_color": _over_renderings(point_color),
        "background_entropy": _over_renderings(entropy),
        "flow_l1": _flow(lambda seen, flow: losses.flow_l1(flow)),
        "inpaint_diff": _inpaint,
        "tv_density": lambda seen: sum(
            losses.tv_density(g.raw_density, seen.neighbours(g.index)) for g in seen.grids
        ),
        "tv_flow": _flow(lambda seen, flow: losses.tv_flow(flow, seen.pairs)),
        "tv_depth": lambda seen: losses.tv_depth(*seen.render_patches()),
        "static_points": _static_points,
        "moving_opacity": _moving_opacity,
    }


TERMS = tuple(voxel_terms())
