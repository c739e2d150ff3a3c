"""The weighted sum of the paper's terms. The only place where a weight is compared with 0."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from forewarp import losses
from forewarp.ops.grid import neighbour_pairs
from forewarp.scene.batch import Batch
from forewarp.scene.state import RadianceGrid, Rendering, State


@dataclass
class Step:
    """What the terms may look at: the batch, what the method answered, what was rendered of it, and
    ``render_patches``, which renders depth and opacity (B, S, S) of patches from random views at this time,
    and ``stray``, which gives how far points that stand still are displaced (N, 3), None where none is known.
    """

    batch: Batch
    state: State
    renderings: dict[str, Rendering]
    render_patches: Callable[[], tuple[Tensor, Tensor]]
    stray: Callable[[], Tensor | None] = lambda: None
    neighbours: Callable[[Tensor], list[tuple[Tensor, Tensor]]] = neighbour_pairs

    @cached_property
    def pairs(self) -> list[tuple[Tensor, Tensor]]:
        """Neighbouring canonical voxels."""
        return self.neighbours(self.state.canonical.index)

    @property
    def grids(self) -> list[RadianceGrid]:
        """The canonical grid, and the static background's where there is one."""
        return [g for g in (self.state.canonical, self.state.background) if g is not None]


def _over_renderings(term: Callable[[Step, Rendering], Tensor]) -> Callable[[Step], Tensor]:
    return lambda step: sum(term(step, rendering) for rendering in step.renderings.values())


def _flow(term: Callable[[Step, Tensor], Tensor]) -> Callable[[Step], Tensor | None]:
    return lambda step: None if step.state.flow is None else term(step, step.state.flow / step.state.length)


def _still_points(step: Step) -> Tensor | None:
    stray = step.stray()
    return None if stray is None else losses.still_points(stray)


def _moving_opacity(step: Step) -> Tensor | None:
    if step.state.background is None:
        return None
    grid = step.state.canonical
    return losses.moving_opacity(grid.activation.alpha(grid.raw_density, grid.lattice.pitch))


def _inpaint(step: Step) -> Tensor | None:
    residual = step.state.inpaint_difference
    return None if residual is None else losses.inpaint_diff(residual)


LITERAL = ("photo", "point_color", "background_entropy")  # terms with a printed form of their own


def _terms(literal: frozenset[str]) -> dict[str, Callable[[Step], Tensor | None]]:
    def entropy(step: Step, r: Rendering) -> Tensor:
        if "background_entropy" in literal:
            return losses.sample_entropy(r.all_weights)
        return losses.background_entropy(r.transmittance)

    return {
        "photo": _over_renderings(
            lambda s, r: losses.photometric(r.rgb, s.batch.rgb, literal="photo" in literal)
        ),
        "point_color": _over_renderings(
            lambda s, r: losses.point_color(
                r.weights,
                r.colors,
                r.ray_ids,
                s.batch.rgb,
                all_ray_ids=r.all_ray_ids if "point_color" in literal else None,
            )
        ),
        "background_entropy": _over_renderings(entropy),
        "flow_l1": _flow(lambda s, flow: losses.flow_l1(flow)),
        "inpaint_diff": _inpaint,
        "tv_density": lambda s: sum(losses.tv_density(g.raw_density, s.neighbours(g.index)) for g in s.grids),
        "tv_flow": _flow(lambda s, flow: losses.tv_flow(flow, s.pairs)),
        "tv_depth": lambda s: losses.tv_depth(*s.render_patches()),
        "still_points": _still_points,
        "moving_opacity": _moving_opacity,
    }


class Objective:
    """``loss = sum_i w_i term_i``; a term of weight 0 is never called.

    Args:
        weights: term -> weight; terms not named have weight 0.
        every: term -> n: evaluated each n-th step with n times the weight.
        literal: terms in the printed form where that differs (see ``losses``).
        photo_on: renderings that the per-ray terms look at; null: all.
    """

    def __init__(
        self,
        weights: Mapping[str, float],
        *,
        every: Mapping[str, int] | None = None,
        literal: list[str] | tuple[str, ...] = (),
        photo_on: list[str] | None = None,
    ) -> None:
        if not set(literal) <= set(LITERAL):
            raise ValueError(
                f"objective.literal: expected some of {', '.join(LITERAL)}, but got {list(literal)}"
            )
        known = _terms(frozenset(literal))
        self.every = dict(every or {})
        for name in (*weights, *self.every):
            if name not in known:
                raise ValueError(f"objective: expected a term of {', '.join(known)}, but got '{name}'")
        if any(not (n >= 1 and n == int(n)) for n in self.every.values()):
            raise ValueError(f"objective.every: expected whole numbers of steps >= 1, but got {self.every}")
        self.weights = {name: float(w) for name, w in weights.items()}
        self.terms = known
        self.photo_on = tuple(photo_on) if photo_on is not None else None
        self.needs_all_weights = bool({"point_color", "background_entropy"} & set(literal))
        self._pairs: list[tuple[Tensor, list[tuple[Tensor, Tensor]]]] = []

    def wanted(self, names: Iterable[str]) -> list[str]:
        """Of the possible renderings, those that the per-ray terms look at; all where none is listed."""
        names = list(names)
        return [n for n in names if self.photo_on is None or n in self.photo_on] or names

    def __call__(self, step: Step, number: int) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of step ``number`` and every term evaluated, raw, by name."""
        loss, raw = torch.zeros(()), {}
        for name, (value, factor) in self.parts(step, number).items():
            raw[name] = value.detach()
            loss = loss.to(value) + factor * value
        return loss, raw

    def parts(self, step: Step, number: int) -> dict[str, tuple[Tensor, float]]:
        """Every term of step ``number`` that is evaluated, with its factor, by name."""
        step.neighbours = self._neighbours
        found = {}
        for name, weight in self.weights.items():
            every = self.every.get(name, 1)
            if weight == 0 or number % every:
                continue
            value = self.terms[name](step)
            if value is not None:  # else the effect that it measures is off
                found[name] = value, weight * every
        return found

    def _neighbours(self, index: Tensor) -> list[tuple[Tensor, Tensor]]:
        for known, pairs in self._pairs:
            if known is index:
                return pairs
        pairs = neighbour_pairs(index)
        self._pairs = [*self._pairs[-1:], (index, pairs)]  # two grids at most; what changed is forgotten
        return pairs
