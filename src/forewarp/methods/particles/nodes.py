"""How particles move: nodes with smooth curves of place and turn, and who follows which of them."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from forewarp.fields.curves import Curve
from forewarp.methods.particles.time_offsets import FARTHEST, TimeOffsets
from forewarp.ops.nodes import carry_nodes, spread_nodes
from forewarp.scene.cloud import far_apart

LINKS = 6  # nodes that a particle follows
_LEAST = 1e-20  # squared distance; what is nearer together coincides, and cannot be strained
_DAMP = 0.5  # of a curve's last stride, where it is continued to times not yet seen
_NEAR = 1e-3  # half of the time over which a slope by time is taken
_BEYOND = FARTHEST + 2 * _NEAR  # of all time, by which more of a curve is asked for
_FULL = 0.05  # share of a spline's basis at a time, from which on its knot counts as seen


def nearest(points: Tensor, places: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Squared distances and rows (N, count) of the places (M, 3) nearest to points (N, 3); less, where there
    are fewer.

    Raises:
        ValueError: for points or places that are not finite.

    Cost: a tree of the places, on the CPU, and a walk down it for each point.
    """
    from scipy.spatial import KDTree  # late, as its import takes time

    known = range(1, min(count, len(places)) + 1)
    if not len(points):
        return points.new_zeros(0, len(known)), torch.zeros(
            0, len(known), dtype=torch.int64, device=points.device
        )
    tree = KDTree(places.detach().double().cpu().numpy())
    away, rows = tree.query(points.detach().double().cpu().numpy(), list(known))
    return torch.from_numpy(away).square().to(points), torch.from_numpy(rows).to(points.device)


class Nodes(nn.Module):
    """M nodes: rest ``places`` (M, 3), and coefficients (M, K, 3) of ``shift`` (world units) and of ``turn``
    (Gibbs vectors), None where nodes do not turn.

    Args:
        points: (N, 3) canonical points that are to move; None: a checkpoint will say.
        count: of nodes.
        curve: of every node.
        offsets: learned corrections of the pictures' times; None: times are used as they are given.
        turns: whether nodes turn.
        rests: whether nodes may ``stop``; ``still`` (M,) bool says which have.
        edges: neighbours that a node is kept rigid with.
    """

    ROWS = ("places", "edges", "edge_weights", "spread", "still", "shift", "turn")

    def __init__(
        self,
        points: Tensor | None,
        count: int,
        curve: Curve,
        offsets: TimeOffsets | None = None,
        *,
        turns: bool = True,
        rests: bool = False,
        edges: int = 6,
    ) -> None:
        super().__init__()
        self.curve, self.offsets = curve, offsets
        places = torch.zeros(1, 3) if points is None else points[far_apart(points, count)].clone()
        self.register_buffer("places", places)
        away, beside = nearest(places, places, edges + 1)
        away, beside = away[:, 1:], beside[:, 1:]  # the nearest is the node itself
        unit = away.mean() if away.numel() else torch.tensor(1.0)
        apart = away + 1e-3 * unit
        tight = (apart > _LEAST) / apart.clamp(min=_LEAST)
        self.register_buffer("edges", beside.contiguous())
        self.register_buffer("edge_weights", tight / max(beside.numel(), 1))
        near = away[:, :3].sqrt().mean(-1) if away.shape[1] else torch.ones(len(places))
        self.register_buffer("spread", near.clamp(min=1e-6 * max(float(unit), _LEAST) ** 0.5))
        self.shift = nn.Parameter(torch.zeros(len(places), curve.count, 3))
        self.turn = nn.Parameter(torch.zeros(len(places), curve.count, 3)) if turns else None
        self.register_buffer("seen", torch.tensor([curve.canonical_time] * 2))
        self.register_buffer("still", torch.zeros(len(places), dtype=torch.bool) if rests else None)

    def __len__(self) -> int:
        return len(self.places)

    def links(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Who points (N, 3) follow: rows (N, L) int32 of nodes, and their shares (N, L).

        ``exp(-(d^2 - d_min^2) / (2 s^2))``, normalised, s the mean distance of a node to its nearest three.
        """
        away, rows = nearest(points, self.places, LINKS)
        shares = torch.exp(-(away - away[:, :1]) / (2 * self.spread[rows] ** 2))
        return rows.int(), (shares / shares.sum(-1, keepdim=True)).contiguous()

    def basis(self, time: float) -> Tensor:
        """The curve's basis (K,) at a given time, as the coefficients are."""
        return self.basis_of_motion((self.taken(time), 1.0))

    def taken(self, time: float) -> float:
        """The time of the motion in a picture of a given time."""
        return time if self.offsets is None else self.offsets(time)

    def basis_of_motion(self, *parts: tuple[float, float]) -> Tensor:
        """The sum of the curve's bases (K,) at times of the motion, each with its factor."""
        return self.curve.summed(parts, 0.0 if self.offsets is None else _BEYOND).to(self.places)

    def carried(self, basis: Tensor) -> tuple[Tensor, Tensor]:
        """Where nodes went and how they turned (M, 6), by a curve's basis (K,), and their maps (M, 12)."""
        return carry_nodes(self.shift, self.turn, basis, self.places)

    def maps(self, time: float) -> Tensor:
        """``ops.nodes.node_maps`` (M, 12) at a time."""
        return self.carried(self.basis(time))[1]

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """What is learned, by the name of its rate."""
        off = None if self.offsets is None else self.offsets.off
        parts = {"shifts": self.shift, "node_turns": self.turn, "time_offsets": off}
        return {name: [part] for name, part in parts.items() if part is not None}

    @torch.no_grad()
    def look_ahead(self, taken: float) -> None:
        """Note that a time of the motion is seen, and continue curves beyond those seen so far: a knot beyond
        them starts as a damped continuation of the two before it.
        """
        taken, (first, last) = min(max(taken, 0.0), 1.0), self.seen.tolist()
        if first <= taken <= last:
            return
        reach = self.curve.reach()
        if reach is None:
            return
        self.seen[0], self.seen[1] = min(taken, first), max(taken, last)
        middle = reach.mean(-1)
        slack = _FULL * float(reach[0, 1] - reach[0, 0])
        after = (reach[:, 0] > float(self.seen[1]) - slack).nonzero()[:, 0].tolist()
        before = (reach[:, 1] < float(self.seen[0]) + slack).nonzero()[:, 0].tolist()
        for value in (self.shift, self.turn):
            if value is None:
                continue
            for knots, step in ((after, -1), (before[::-1], 1)):
                for j in knots:
                    near, far = j + step, j + 2 * step
                    if 0 <= far < len(middle):
                        value[:, j] = value[:, near] + _DAMP * (value[:, near] - value[:, far])

    @torch.no_grad()
    def reach_of(self, times: list[float]) -> Tensor:
        """How far each node takes what is beside it (M,) from its mean place over some times, world units."""
        far = torch.zeros(len(self.places)).to(self.places)
        for value, arm in ((self.shift, 1.0), (self.turn, 2 * self.spread)):  # |r| is half the angle
            if value is not None:
                went = torch.einsum("mkc,tk->tmc", value, self._bases(times))
                far += arm * (went - went.mean(0)).norm(dim=-1).amax(0)
        return far

    @torch.no_grad()
    def stop(self, which: Tensor, times: list[float]) -> None:
        """Let nodes (M,) bool stay where they were, and as they were turned, on average over some times.

        Cosines are 0 at the canonical time, so that with these nodes stay where they are then.
        """
        which = which & ~self.still
        self.still |= which
        mean = self._bases(times).mean(0)
        for value in (self.shift, self.turn):
            if value is not None:
                stays = torch.einsum("mkc,k->mc", value[which], mean)
                value[which] = stays[:, None] if self.curve.kind == "spline" else 0.0

    def _bases(self, times: list[float]) -> Tensor:
        return torch.stack([self.basis(time) for time in times])

    def rows(self) -> list[str]:
        """What has a row a node."""
        return [name for name in self.ROWS if getattr(self, name) is not None]

    def misfit(self, state: Mapping[str, Tensor], prefix: str, links: Tensor) -> str | None:
        """Name an entry of a stored state that contradicts the others; None where all is well.

        All have as many rows as there are places, and nothing points at a node that there is not.
        """
        many = len(state[prefix + "places"])
        for name in self.rows():
            own, theirs = getattr(self, name), state[prefix + name]
            free = 2 if name in ("edges", "edge_weights") else 1  # few nodes have few neighbours
            fits = theirs.dtype == own.dtype and theirs.dim() == own.dim() and len(theirs) == many
            if not fits or theirs.shape[free:] != own.shape[free:]:
                return prefix + name
        if state[prefix + "edges"].shape != state[prefix + "edge_weights"].shape:
            return prefix + "edges"
        for name, rows in ((prefix + "edges", state[prefix + "edges"]), ("skin.links", links)):
            if rows.numel() and not 0 <= int(rows.min()) <= int(rows.max()) < many:
                return name
        return None

    def _load_from_state_dict(self, state, prefix, *args, **kwargs) -> None:
        for name in self.ROWS:  # a checkpoint says how many nodes there are
            own = getattr(self, name)
            if own is not None and prefix + name in state:
                own.data = own.data.new_empty(state[prefix + name].shape)
        super()._load_from_state_dict(state, prefix, *args, **kwargs)

    def spread_over_time(
        self, time: float, taken: float, basis: Tensor, slope: Tensor, factor: float, unit: float
    ) -> tuple[float, dict[str, Tensor]]:
        """From slopes (M, 6) by ``motion`` to those by coefficients, and by the offset of a picture's given
        ``time`` from that of the motion, ``taken``; by name. Curves are kept smooth.

        What is kept small is ``mean |x(t + h) - 2 x(t) + x(t - h)|^2 / unit^2``, h a knot's distance to the
        next: only where and as often as a curve is seen. Its value comes first.
        """
        bend = self._bend(taken) if factor else torch.zeros_like(basis)
        *found, bent = spread_nodes(self.shift, self.turn, slope, basis, bend, factor, unit)
        if self.still is not None and bool(self.still.any()):
            for part in found:
                if part is not None:
                    part[self.still] = 0.0  # rounding errors would be steps, as Adam takes them
        if self.offsets is not None and self.offsets.learns:
            found.append(self.offsets.slopes(time, self._by_time(taken, slope)))
        names = ("nodes.shift", "nodes.turn", "nodes.offsets.off")
        return bent, {name: part for name, part in zip(names, found) if part is not None}

    def _by_time(self, taken: float, slope: Tensor) -> float:
        """From slopes (M, 6) by ``motion`` to the one by its time."""
        along = self.basis_of_motion((taken + _NEAR, 0.5 / _NEAR), (taken - _NEAR, -0.5 / _NEAR))
        return (self.carried(along)[0].detach() * slope).sum().item()

    def _bend(self, taken: float) -> Tensor:
        """The second difference (K,) of the basis around a time of the motion, within those seen."""
        step, (low, high) = 1 / max(self.curve.pieces, 2), self.seen.tolist()
        low, high = low + step, high - step
        if low > high:
            return self.places.new_zeros(self.curve.count)
        middle = min(max(taken, low), high)
        before, after = max(middle - step, 0.0), min(middle + step, 1.0)
        return self.basis_of_motion((after, 1.0), (middle, -2.0), (before, 1.0))
