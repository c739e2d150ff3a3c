"""How particles move: nodes with smooth curves, which of them a particle follows, and the images' times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from forewarp.fields.curves import Curve
from forewarp.fields.moving import around
from forewarp.ops.nodes import carry_nodes, skin_weights, spread_nodes
from forewarp.scene.cloud import far_apart, nearest

LINKS = 6  # nodes that a particle follows
_LEAST = 1e-20  # squared distance; what is nearer together coincides, and cannot be strained
_DAMP = 0.5  # of a curve's last step, where it is continued to times not yet seen
_HALF_STEP = 1e-3  # of all time: for central differences by time
_FULL = 0.05  # share of a spline's basis at a time, from which on its knot counts as seen
_FARTHEST = 0.2  # of all time: no image's time is off by more
_BEYOND = _FARTHEST + 2 * _HALF_STEP  # of all time, by which a curve must reach beyond [0, 1]
_REST_TIMES = 16  # over which a node's mean place is taken
_FEWEST = 20  # nodes of a group
_PULL = 0.1  # of the learning rate: by how much a step draws an offset towards 0


class TimeOffsets(nn.Module):
    """Learned corrections of the times that are written beside images: from these to times of the motion.

    T training times are each off by ``values`` (T, 1), in units of their mean distance; times in between are
    interpolated linearly. Published sequences hold their first image twice, leave one out before the last,
    or round their times. A smooth motion cannot fit such times; the error then shows as a wrong depth, which
    one image cannot tell.

    Args:
        times: distinct, two or more.
        most: bound of ``values``; of few times less, so that none is off by more than a fifth of all time.
    """

    def __init__(self, times: Sequence[float], most: float) -> None:
        super().__init__()
        self.times = sorted(times)
        self.step = (self.times[-1] - self.times[0]) / (len(times) - 1)
        self.most = min(most, _FARTHEST / self.step)
        self.learns = True
        self.values = nn.Parameter(torch.zeros(len(times), 1))

    def __call__(self, time: float) -> float:
        """Return the time of the motion, up to ``most`` steps beyond [0, 1]."""
        off = sum(w * self.values.detach()[row].item() for row, w in around(self.times, time).items())
        return time + self.step * min(max(off, -self.most), self.most)

    def gradients(self, time: float, by_motion_time: float) -> Tensor:
        """Return the gradients by ``values``, given the one by the time of the motion."""
        gradients = torch.zeros_like(self.values)
        for row, weight in around(self.times, time).items():
            gradients[row] = weight * self.step * by_motion_time
        return gradients

    @torch.no_grad()
    def settle(self, rate: float) -> None:
        """Draw offsets that no image holds towards 0, and keep all to the bound.

        A time's images count once in about T steps, so that a step draws by a T-th of a share of the rate.
        """
        size = (self.values.abs() - _PULL * rate / len(self.times)).clamp(0.0, self.most)
        self.values.copy_(size * self.values.sign())


class Nodes(nn.Module):
    """M nodes at rest ``positions`` (M, 3), each with a curve of translations and of rotations over time.

    Parameters are the curves' coefficients (M, K, 3): ``translations`` in world units, and ``rotations`` as
    Gibbs vectors, None where nodes do not rotate; with ``groups`` as quaternions (M, K, 4), see
    ``ops.nodes.node_maps``.

    Args:
        points: (N, 3) canonical points that are to move; None: a checkpoint will say.
        count: number of nodes.
        curve: the curve of every node.
        time_offsets: learned corrections of the images' times; None: times are used as they are given.
        rotates: whether nodes rotate.
        rests: whether nodes may ``stop``; ``stopped`` (M,) bool says which have.
        edges: neighbours that a node is kept rigid with.
        group_of: (N,) int64, the group that each of ``points`` is of, as the body of it, -1: of none; None:
            there are no ``groups`` (M,). Nodes, links and edges are of one group each, or of none.
    """

    loose = ("edges", "edge_weights")  # few nodes have few neighbours

    def __init__(
        self,
        points: Tensor | None,
        count: int,
        curve: Curve,
        time_offsets: TimeOffsets | None = None,
        *,
        rotates: bool = True,
        rests: bool = False,
        edges: int = 6,
        group_of: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.curve, self.time_offsets = curve, time_offsets
        rows, positions = None, torch.zeros(1, 3)
        if points is not None:
            rows = far_apart(points, count) if group_of is None else _of_each(group_of, points, count)
            positions = points[rows].clone()
        count, groups = len(positions), None
        if group_of is not None:
            groups = torch.full((1,), -1) if rows is None else _large(group_of, rows)[rows]
        squared, neighbours = nearest(positions, positions, edges + 1)
        squared, neighbours = squared[:, 1:], neighbours[:, 1:]  # the nearest is the node itself
        unit = squared.mean() if squared.numel() else torch.tensor(1.0)
        padded = squared + 1e-3 * unit
        stiffness = (padded > _LEAST) / padded.clamp(min=_LEAST)
        if groups is not None:
            stiffness = stiffness * (groups[neighbours] == groups[:, None])
        spacing = squared[:, :3].sqrt().mean(-1) if squared.shape[1] else torch.ones(count)
        self.translations = nn.Parameter(torch.zeros(count, curve.count, 3))
        numbers = 3 if groups is None else 4
        self.rotations = nn.Parameter(torch.zeros(count, curve.count, numbers)) if rotates else None
        self.register_buffer("positions", positions)
        self.register_buffer("groups", groups)
        self.register_buffer("edges", neighbours.contiguous())
        self.register_buffer("edge_weights", stiffness / max(neighbours.numel(), 1))
        self.register_buffer("spacing", spacing.clamp(min=1e-6 * max(float(unit), _LEAST) ** 0.5))
        self._averaged: tuple[list[float], Tensor] | None = None  # see _mean_basis
        self.register_buffer("stopped", torch.zeros(count, dtype=torch.bool) if rests else None)
        self.register_buffer("seen_times", torch.tensor([curve.canonical_time] * 2))  # from, to
        names = ("positions", "groups", "edges", "edge_weights", "spacing", "stopped")
        names += ("translations", "rotations")
        self.grows = tuple(name for name in names if getattr(self, name) is not None)

    def links(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nodes that points (N, 3) follow: rows (N, L) int32, and their shares (N, L).

        ``exp(-(d^2 - d_min^2) / (2 s^2))``, normalised, s the mean distance of a node to its nearest three.
        """
        squared, rows = nearest(points, self.positions, LINKS)
        shares = torch.exp(-(squared - squared[:, :1]) / (2 * self.spacing[rows] ** 2))
        if self.groups is not None:
            of = self.groups[rows]
            shares = shares * (of == of[:, :1])
        return rows.int(), (shares / shares.sum(-1, keepdim=True)).contiguous()

    def motion_time(self, time: float) -> float:
        """Return the time of the motion that an image of a given time shows."""
        return time if self.time_offsets is None else self.time_offsets(time)

    def basis(self, time: float) -> Tensor:
        """Return the curve's basis (K,) at a given time."""
        return self.summed_basis((self.motion_time(time), 1.0))

    def summed_basis(self, *parts: tuple[float, float]) -> Tensor:
        """Return the sum of the curve's bases (K,) at times of the motion, each with its factor."""
        return self.curve.summed(parts, 0.0 if self.time_offsets is None else _BEYOND).to(self.positions)

    def motion_and_maps(self, basis: Tensor) -> tuple[Tensor, Tensor]:
        """Return the motion (M, 6 or 7) for a curve's basis (K,), and the nodes' maps (M, 12)."""
        return carry_nodes(self.translations, self.rotations, basis, self.positions)

    def maps(self, time: float) -> Tensor:
        """Return the nodes' maps (M, 12) at a given time; see ``ops.nodes.node_maps``."""
        return self.motion_and_maps(self.basis(time))[1]

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return what is learned, by the name of its learning rate."""
        groups = {"node_translations": [self.translations], "node_rotations": self._coefficients()[1:]}
        groups["time_offsets"] = [] if self.time_offsets is None else [self.time_offsets.values]
        return {name: group for name, group in groups.items() if group}

    def _coefficients(self) -> list[nn.Parameter]:
        return [self.translations] if self.rotations is None else [self.translations, self.rotations]

    @torch.no_grad()
    def extend(self, motion_time: float) -> None:
        """Note that a time of the motion is seen, and continue curves beyond those seen so far: a knot beyond
        them starts as a damped continuation of the two before it.
        """
        motion_time, (first, last) = min(max(motion_time, 0.0), 1.0), self.seen_times.tolist()
        if first <= motion_time <= last:
            return
        reach = self.curve.reach()
        if reach is None:
            return
        self.seen_times[0], self.seen_times[1] = min(motion_time, first), max(motion_time, last)
        slack = _FULL * float(reach[0, 1] - reach[0, 0])
        after = (reach[:, 0] > float(self.seen_times[1]) - slack).nonzero()[:, 0].tolist()
        before = (reach[:, 1] < float(self.seen_times[0]) + slack).nonzero()[:, 0].tolist()
        for value in self._coefficients():
            for knots, step in ((after, -1), (before[::-1], 1)):
                for j in knots:
                    near, far = j + step, j + 2 * step
                    if 0 <= far < len(reach):
                        value[:, j] = value[:, near] + _DAMP * (value[:, near] - value[:, far])

    @torch.no_grad()
    def motion_range(self, times: list[float]) -> Tensor:
        """Return how far each node takes what is beside it (M,) from its mean place, world units."""
        bases = torch.stack([self.basis(time) for time in times])
        distance = torch.zeros_like(self.spacing)
        for value, arm in zip(self._coefficients(), self.arms()):
            went = torch.einsum("mkc,tk->tmc", value, bases)
            distance += arm * (went - went.mean(0)).norm(dim=-1).amax(0)
        return distance

    def arms(self) -> list[Tensor]:
        """Return the factors (M,) by which translations, and rotations if there are any, become distances.

        A Gibbs vector, and the first three numbers of a quaternion, is half a small angle; what rotates lies
        about ``spacing`` from the node.
        """
        arms = [torch.ones_like(self.spacing), 2 * self.spacing]
        return arms[: len(self._coefficients())]

    @torch.no_grad()
    def stop(self, which: Tensor, times: list[float]) -> None:
        """Let nodes (M,) bool stay where they were, and as they were rotated, on average over some times.

        Cosines are 0 at the canonical time, so that with these nodes stay where they are then.
        """
        which = which & ~self.stopped
        self.stopped |= which
        mean = torch.stack([self.basis(time) for time in times]).mean(0)
        for value in self._coefficients():
            stays = torch.einsum("mkc,k->mc", value[which], mean)
            value[which] = stays[:, None] if self.curve.kind == "spline" else 0.0

    def misfit(self, state: Mapping[str, Tensor], prefix: str) -> str | None:
        """Name the edges of a stored state if there is not one row of them for each node, or one points at a
        node that there is not; None where all is well.
        """
        nodes, edges, weights = (state[prefix + name] for name in ("positions", *self.loose))
        fits = len(edges) == len(nodes) and edges.shape == weights.shape and are_rows(edges, len(nodes))
        return None if fits else f"{prefix}edges"

    def backward(
        self, time: float, motion_time: float, basis: Tensor, by_motion: Tensor, factor: float, unit: float,
        learns: bool = True,
    ) -> tuple[float, dict[str, Tensor]]:  # fmt: skip
        """Carry gradients by the motion at a time to the coefficients and time offsets; keep curves smooth.

        Added to the loss is ``factor mean |x(t + h) - 2 x(t) + x(t - h)|^2 / unit^2``, h the distance of
        two knots: only where and as often as a curve is seen.

        Args:
            time, motion_time: given time of an image, and the time of the motion that it shows.
            basis: the curve's (K,) at ``motion_time``.
            by_motion: gradients (M, 6 or 7) by the motion of nodes.
            factor: weight of the second differences.
            unit: a length, world units.
            learns: whether curves do; else their gradients are 0.

        Returns:
            the mean of the squared second differences, and gradients by the parameters' names.
        """
        bend = self._second_difference(motion_time) if factor else torch.zeros_like(basis)
        coefficients = self.translations, self.rotations
        *gradients, bent = spread_nodes(*coefficients, by_motion, basis, bend, factor, unit)
        if not learns:
            for gradient in gradients:
                gradient.zero_()
        if self.stopped is not None and bool(self.stopped.any()):
            for gradient in gradients:
                if gradient is not None:
                    gradient[self.stopped] = 0.0  # rounding errors would be steps, as Adam takes them
        if self.time_offsets is not None and self.time_offsets.learns:
            late, early = motion_time + _HALF_STEP, motion_time - _HALF_STEP
            velocity = self.summed_basis((late, 0.5 / _HALF_STEP), (early, -0.5 / _HALF_STEP))
            by_time = (self.motion_and_maps(velocity)[0].detach() * by_motion).sum().item()
            gradients.append(self.time_offsets.gradients(time, by_time))
        names = ("translations", "rotations", "time_offsets.values")
        return bent, {name: value for name, value in zip(names, gradients) if value is not None}

    @torch.no_grad()
    def mean_motion(self) -> Tensor:
        """Return the motion (M, 6 or 7), averaged over the times seen."""
        return self.motion_and_maps(self._mean_basis())[0]

    def _mean_basis(self) -> Tensor:
        """Return the curve's basis (K,), averaged over the times of the motion that were seen."""
        span = [0.0, 1.0] if self.curve.reach() is None else self.seen_times.tolist()
        if self._averaged is None or self._averaged[0] != span:  # they grow as times come in
            times = torch.linspace(*span, _REST_TIMES).tolist()
            self._averaged = span, self.summed_basis(*((time, 1 / _REST_TIMES) for time in times))
        return self._averaged[1].to(self.positions)

    def _second_difference(self, motion_time: float) -> Tensor:
        """Return the second difference (K,) of the basis around a time of the motion, within those seen."""
        step, (low, high) = 1 / max(self.curve.pieces, 2), self.seen_times.tolist()
        low, high = low + step, high - step
        if low > high:
            return self.positions.new_zeros(self.curve.count)
        middle = min(max(motion_time, low), high)
        before, after = max(middle - step, 0.0), min(middle + step, 1.0)
        return self.summed_basis((after, 1.0), (middle, -2.0), (before, 1.0))


def _large(group_of: Tensor, rows: Tensor) -> Tensor:
    """Let only those be groups, numbered anew, that have as many nodes as say where they are."""
    made, count = torch.full_like(group_of, -1), 0
    for group in group_of.unique().tolist():
        if group >= 0 and int((group_of[rows] == group).sum()) >= _FEWEST:
            made[group_of == group], count = count, count + 1
    return made


def _of_each(group_of: Tensor, points: Tensor, count: int) -> Tensor:
    """Choose about ``count`` rows of points (N, 3) that are far apart: of each group by its share of them."""
    rows = []
    for group in group_of.unique().tolist():
        own = (group_of == group).nonzero()[:, 0]
        rows.append(own[far_apart(points[own], max(4, round(count * len(own) / len(points))))])
    return torch.cat(rows)


def are_rows(indices: Tensor, count: int) -> bool:
    """Return whether all indices are of ``count`` rows: kernels do not check them."""
    return not indices.numel() or 0 <= int(indices.min()) <= int(indices.max()) < count


class Skinning(nn.Module):
    """N particles follow up to L nodes each: ``links`` (N, L) int32, by ``weights`` that sum to 1.

    A weight is that of the distance, ``shares`` (N, L), times ``exp(logits)``: what lies beside two parts
    that move apart learns which of them it belongs to. A particle at rest has the shares 0, and follows none.
    """

    ROWS = ("links", "shares", "logits")

    def __init__(self, nodes: Nodes, points: Tensor) -> None:
        super().__init__()
        links, shares = nodes.links(points)
        self.logits = nn.Parameter(torch.zeros_like(shares))
        self.register_buffer("links", links)
        self.register_buffer("shares", shares)

    def weights(self) -> Tensor:
        """Return the weights (N, L), differentiable in ``logits``."""
        return skin_weights(self.shares, self.logits)

    @torch.no_grad()
    def relink(self, nodes: Nodes, points: Tensor, optimizer: torch.optim.Optimizer) -> None:
        """Look for the nodes beside points (N, 3) again.

        What was learned of those that stay is kept, with its moments: as factors of the shares, so that one
        that comes anew begins with its share.
        """
        level = (self.logits + self.shares.log()).logsumexp(-1, keepdim=True).nan_to_num(neginf=0.0)
        old_links, old_logits = self.links, self.logits - level
        self.links, self.shares = nodes.links(points)
        stays = self.links[:, :, None] == old_links[:, None]
        self.logits.copy_((stays * old_logits[:, None]).sum(-1))
        moments = optimizer.state.get(self.logits, {})
        for name in {"exp_avg", "exp_avg_sq"} & moments.keys():
            moments[name] = (stays * moments[name][:, None]).sum(-1)

    def release(self, which: Tensor) -> None:
        """Let particles (N,) bool follow no node."""
        self.shares[which] = 0.0
