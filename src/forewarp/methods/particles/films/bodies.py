"""Bodies: what moves as a whole in a film has a pose at each image, until the curves of its nodes take over.

A step of a single node says little about where a thing goes that moves by half its width between two images,
and turns: its parts then slide over one another, and what it shows is repainted instead of turned. All of a
thing's particles together say it well.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from forewarp.methods.particles.nodes import Nodes

GROUPS = "deformation.nodes.groups"  # of nodes, in a stored state
_LOOSE = 1e-4  # how much curves are kept small where they take over
_LEAST = 1e-15
_TOUCHES = 0.05  # share of images in which a body touches the ground
_STEADY = 0.97  # of its distance that a body keeps, whatever is seen below it: masks are not exact


class Poses(NamedTuple):
    """Where B bodies are: ``turns`` (B, 3, 3) from how they rest, and their ``middles`` (B, 3)."""

    turns: Tensor
    middles: Tensor

    def farther(self, body: int, eye: Tensor, times: float) -> Poses:
        """Return these, with one body so many times as far from an eye (3,), along the same ray."""
        return self.but(body, Poses(self.turns, eye + times * (self.middles - eye)))

    def but(self, body: int, other: Poses) -> Poses:
        """Return these, with one body's of others."""
        made = Poses(self.turns.clone(), self.middles.clone())
        for own, its in zip(made, other):
            own[body] = its[body]
        return made


class Bodies(nn.Module):
    """B bodies, each with a pose at each of T times. While they ``lead``, nodes go with them.

    ``twists`` (B, T, 6) is what a step of the optimiser turns and shifts them by: a rotation vector times
    ``sizes`` (B,), how far nodes are from the middle (root mean square), and a shift, all world units. Poses
    take them over at once (``settle``), so that they are 0 before each step.

    Args:
        nodes: M of them, each of a body, or of none: their ``groups``.
        times: of training images, distinct; near the canonical one bodies are at first as they rest.
    """

    grows, loose = ("twists", "sizes", "rest", "turns", "middles", "farthest"), ()

    def __init__(self, nodes: Nodes, times: Sequence[float]) -> None:
        super().__init__()
        self._nodes = (nodes,)  # in a tuple, as they are a part of the deformation
        of_node, positions = nodes.groups, nodes.positions
        count, self.times = int(of_node.max()) + 1, sorted(times)
        self.twists = nn.Parameter(torch.zeros(count, len(times), 6))
        own = [positions[of_node == body] for body in range(count)]
        sizes = torch.tensor([float((p - p.mean(0)).square().sum(-1).mean().sqrt()) for p in own])
        self.register_buffer("sizes", sizes.clamp(min=1e-6 * float(sizes.amax()) + _LEAST if own else 1.0))
        self.register_buffer("rest", torch.stack([p.mean(0) for p in own]) if own else torch.zeros(0, 3))
        self.register_buffer("turns", torch.eye(3).repeat(count, len(times), 1, 1))
        self.register_buffer("middles", self.rest[:, None].repeat(1, len(times), 1))
        self.register_buffer("seen", torch.zeros(len(times), dtype=torch.bool))
        self.register_buffer("eyes", torch.zeros(len(times), 3))  # from where they were seen, and how far
        self.register_buffer("farthest", torch.full((count, len(times)), torch.inf))  # from there they may be
        self.register_buffer(
            "rounds", torch.zeros(len(times), dtype=torch.int64)
        )  # of fits that images were in
        self.register_buffer("lead", torch.tensor(count > 0))
        self.seen[self.row(nodes.curve.canonical_time)] = True

    def __len__(self) -> int:
        return len(self.sizes)

    @property
    def of_node(self) -> Tensor:
        """The body (M,) int64 that a node is of; -1: of none."""
        return self.nodes.groups

    @property
    def nodes(self) -> Nodes:
        """What they move."""
        return self._nodes[0]

    def misfit(self, state: dict[str, Tensor], prefix: str) -> str | None:
        """Name the stored groups of nodes if one is of a body that there is not; None: all is well."""
        of_node, count = state[GROUPS], len(state[prefix + "sizes"])
        fits = not len(of_node) or -1 <= int(of_node.min()) <= int(of_node.max()) < count
        return None if fits else GROUPS

    def row(self, time: float) -> int:
        """Return the row of the training time nearest to a time."""
        after = min(bisect_left(self.times, time), len(self.times) - 1)
        return min((max(after - 1, 0), after), key=lambda row: abs(self.times[row] - time))

    def at(self, time: float) -> Poses:
        """Return the poses at a time: between those of the nearest times seen, or the nearest."""
        rows = self.seen.nonzero()[:, 0].tolist()
        after = bisect_left(rows, time, key=lambda row: self.times[row])
        first, last = rows[max(after - 1, 0)], rows[min(after, len(rows) - 1)]
        span = self.times[last] - self.times[first]
        return self.between(first, last, (time - self.times[first]) / span if span else 0.0)

    def between(self, first: int, last: int, share: float) -> Poses:
        """Return the poses at a share of the way from one row's to another's, or beyond."""
        start, end = self.turns[:, first], self.turns[:, last]
        middles = torch.lerp(self.middles[:, first], self.middles[:, last], share)
        return Poses(_matrices(share * _vectors(end @ start.mT)) @ start, middles)

    def carry(self, poses: Poses, positions: Tensor, motion: Tensor, maps: Tensor) -> None:
        """Let bodies take nodes along, in ``motion`` (M, 7) and ``maps`` (M, 12); see ``ops.nodes``."""
        own = self.of_node >= 0
        of = self.of_node[own]
        shift = poses.middles - (poses.turns @ self.rest[..., None])[..., 0]
        linear = poses.turns - torch.eye(3).to(poses.turns)
        maps[own] = torch.cat([linear.reshape(-1, 9), shift], -1)[of]
        motion[own, :3] = (linear[of] @ positions[own][..., None])[..., 0] + shift[of]
        quaternions = Rotation.from_matrix(poses.turns.cpu().double().numpy()).as_quat()
        motion[own, 3:] = torch.from_numpy(quaternions).to(motion)[of]
        motion[own, 6] -= 1.0

    def by_twists(self, poses: Poses, by_maps: Tensor) -> Tensor:
        """Return the gradients (B, 6) by turns about the middles, and by shifts, of a loss with ``by_maps``
        (M, 12).
        """
        own = self.of_node >= 0
        summed = by_maps.new_zeros(len(self), 12).index_add_(0, self.of_node[own], by_maps[own])
        by_linear, by_shift = summed[:, :9].reshape(-1, 3, 3), summed[:, 9:]
        arm = -(poses.turns @ self.rest[..., None])[..., 0]  # a map's shift, seen from the middle
        outer = by_linear @ poses.turns.mT + by_shift[:, :, None] * arm[:, None]
        turn = torch.stack([outer[:, i, j] - outer[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
        return torch.cat([turn / self.sizes[:, None], by_shift], -1)

    def gradients(self, time: float, by_maps: Tensor) -> Tensor:
        """Return the gradients by ``twists`` of a loss with ``by_maps`` (M, 12), at a time."""
        found, row = torch.zeros_like(self.twists), self.row(time)
        found[:, row] = self.by_twists(Poses(self.turns[:, row], self.middles[:, row]), by_maps)
        return found

    def moved(self, poses: Poses, twists: Tensor) -> Poses:
        """Turn and shift poses by twists (B, 6)."""
        turns = _matrices(twists[:, :3] / self.sizes[:, None])
        return Poses(turns @ poses.turns, poses.middles + twists[:, 3:])

    def apart(self, poses: Poses, others: Poses) -> Tensor:
        """Return the twists (B, 6) that bring others to these."""
        turns = _vectors(poses.turns @ others.turns.mT)
        return torch.cat([turns * self.sizes[:, None], poses.middles - others.middles], -1)

    @torch.no_grad()
    def settle(self) -> None:
        """Take ``twists`` over into the poses."""
        for row in self.twists.abs().sum((0, 2)).nonzero()[:, 0].tolist():
            if not bool(self.twists[:, row].isfinite().all()):
                continue  # training tells of broken numbers
            now = Poses(self.turns[:, row], self.middles[:, row])
            self._put(row, self.moved(now, self.twists[:, row]))
        self.twists.zero_()

    def put(self, time: float, poses: Poses, eye: Tensor) -> None:
        """Note where bodies are at the time of a training image, and from where (3,) they are seen."""
        row = self.row(time)
        self.seen[row], self.eyes[row] = True, eye
        self._put(row, poses)

    def bring_before(self, time: float, farthest: Tensor) -> None:
        """Keep bodies, from now on, before what rests behind them: at most so far (B,) from the eye."""
        row = self.row(time)
        now = Poses(self.turns[:, row], self.middles[:, row])
        least = _STEADY * (now.middles - self.eyes[row]).norm(dim=-1)
        self.farthest[:, row] = farthest.maximum(least)
        self._put(row, now)

    @torch.no_grad()
    def fit_curves(self, nodes: Nodes) -> None:
        """Fit the curves of nodes to the poses, by least squares."""
        own, motion = self.of_node >= 0, []
        for time in self.times:
            now = nodes.positions.new_zeros(len(own), 7)
            self.carry(self.at(time), nodes.positions, now, nodes.positions.new_zeros(len(own), 12))
            now[:, 6] += 1.0
            if motion:  # q and -q turn alike; curves must not change sides
                now[(now[:, 3:] * motion[-1][:, 3:]).sum(-1) < 0, 3:] *= -1
            motion.append(now)
        motion = torch.stack(motion, 1)[own].double()
        motion[motion[:, self.row(nodes.curve.canonical_time), 6] < 0, :, 3:] *= -1  # at rest it is 1
        motion[..., 6] -= 1.0
        bases = torch.stack([nodes.basis(time) for time in self.times]).double()
        normal = bases.T @ bases + _LOOSE * torch.eye(bases.shape[1]).to(bases)
        curves = torch.linalg.solve(normal, bases.T @ motion).float()
        nodes.translations.data[own], nodes.rotations.data[own] = curves[..., :3], curves[..., 3:]
        nodes.seen_times.copy_(nodes.seen_times.new_tensor([0.0, 1.0]))

    def _put(self, row: int, poses: Poses) -> None:
        away = poses.middles - self.eyes[row]
        share = (self.farthest[:, row] / away.norm(dim=-1)).clamp(max=1.0)
        self.turns[:, row], self.middles[:, row] = poses.turns, self.eyes[row] + share[:, None] * away

    @torch.no_grad()
    def nearest_to_ground(self) -> Tensor:
        """Return how many times as far away bodies may be (B,), at least 1, until they touch what rests below
        them in the few images in which they are nearest to it.
        """
        away = (self.middles - self.eyes).norm(dim=-1)
        known = self.seen & self.farthest.isfinite()
        times = [(self.farthest[b] / away[b])[known[b]] for b in range(len(self))]
        found = [float(t.quantile(_TOUCHES)) if len(t) else 1.0 for t in times]
        return self.sizes.new_tensor(found).clamp(min=1.0)

    @torch.no_grad()
    def enlarge(self, times: Tensor, eye: Tensor) -> None:
        """Make bodies so many times (B,) as large and as far away, at rest from an eye (3,); what images show
        stays as it is.
        """
        self.rest.copy_(eye + times[:, None] * (self.rest - eye))
        self.sizes.mul_(times)
        gone = self.eyes + times[:, None, None] * (self.middles - self.eyes)
        self.middles.copy_(torch.where(self.seen[:, None], gone, self.rest[:, None]))


def _vectors(turns: Tensor) -> Tensor:
    """Return rotation vectors (B, 3) of rotations (B, 3, 3)."""
    return torch.from_numpy(Rotation.from_matrix(turns.cpu().double().numpy()).as_rotvec()).to(turns)


def _matrices(vectors: Tensor) -> Tensor:
    """Return rotations (B, 3, 3) of rotation vectors (B, 3)."""
    return torch.from_numpy(Rotation.from_rotvec(vectors.cpu().double().numpy()).as_matrix()).to(vectors)
