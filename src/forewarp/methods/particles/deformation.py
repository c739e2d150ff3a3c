"""How Gaussians move: each follows a few nodes, whose curves say where they go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from forewarp.methods.particles.gaussians import GaussianModel
from forewarp.methods.particles.nodes import Nodes, Skinning
from forewarp.ops.gaussians import Warp, moved
from forewarp.ops.nodes import pull_nodes

_TIMES = 16  # at which motion is looked at
_FOLLOWS = 1e-3  # weight of a node below which its motion shows nowhere


class NodeState(NamedTuple):
    """Nodes at the ``time`` of an image, which shows ``motion_time`` of the motion: the curve's ``basis``
    (K,), ``motion`` (M, 6 or 7) and ``maps`` (M, 12) as of ``ops.nodes``.
    """

    time: float
    motion_time: float
    basis: Tensor
    motion: Tensor
    maps: Tensor


class Deformation(nn.Module):
    """N Gaussians follow ``nodes`` by ``skinning``; those ``resting`` (N,) bool follow none (None: none may).

    Args:
        nodes: M of them.
        means: (N, 3), of the Gaussians.
        resting: (N,) bool, or None.
        fixed: (N,) bool, other Gaussians that never follow nodes; None: none.
    """

    ROWS = ("resting", *(f"skinning.{name}" for name in Skinning.ROWS))

    def __init__(
        self, nodes: Nodes, means: Tensor, resting: Tensor | None = None, fixed: Tensor | None = None
    ) -> None:
        super().__init__()
        self.register_buffer("resting", resting)
        self.nodes, self.skinning = nodes, Skinning(nodes, means)
        self._release(fixed)

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the parameters and buffers that have a row for each Gaussian."""
        return self.ROWS if self.resting is not None else self.ROWS[1:]

    def warp(self, time: float) -> Warp:
        """Return how all Gaussians move from the canonical state to a time."""
        return self.warp_by(self.nodes.maps(time))

    def warp_by(self, maps: Tensor) -> Warp:
        """Return how all Gaussians move with maps (M, 12) of nodes."""
        return Warp(maps, self.skinning.links, self.skinning.weights())

    def at(self, time: float) -> NodeState:
        """Move nodes to the time of a training image, which is seen from now on."""
        nodes = self.nodes
        motion_time = nodes.motion_time(time)
        nodes.extend(motion_time)
        basis = nodes.summed_basis((motion_time, 1.0))
        return NodeState(time, motion_time, basis, *nodes.motion_and_maps(basis))

    def gradients(
        self,
        now: NodeState,
        by_maps: Tensor,
        factors: Mapping[str, float],
        extent: float,
        more_by_motion: Tensor | None = None,
        learns: bool = True,
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Return the terms ``rigid`` and ``smooth``, and gradients by the nodes' parameters of both and of an
        image's loss, in one pass back from maps to curves.

        Args:
            now: nodes as the image shows them.
            by_maps: gradients (M, 12) of the image's loss by ``now.maps``.
            factors: weights of the terms.
            extent: of the scene, world units.
            more_by_motion: gradients by ``now.motion`` of other terms; None: there are none.
            learns: whether curves do; else their gradients are 0.
        """
        nodes, terms = self.nodes, {}
        edges, rigid = (nodes.edges, nodes.edge_weights), factors.get("rigid", 0.0)
        by_motion, terms["rigid"] = pull_nodes(now.motion, nodes.positions, by_maps, *edges, rigid)
        by_motion = by_motion if more_by_motion is None else by_motion + more_by_motion
        smooth = factors.get("smooth", 0.0)
        terms["smooth"], gradients = nodes.backward(
            now.time, now.motion_time, now.basis, by_motion, smooth, extent, learns
        )
        return terms, {f"nodes.{name}": gradient for name, gradient in gradients.items()}

    def static_mask(self, fixed: Tensor | None) -> Tensor | None:
        """Return which Gaussians (N,) follow no node: those ``fixed`` and those at rest; None: none can."""
        if fixed is None or self.resting is None:
            return self.resting if fixed is None else fixed
        return fixed | self.resting

    def _release(self, fixed: Tensor | None) -> None:
        if (static := self.static_mask(fixed)) is not None:
            self.skinning.release(static)

    def reskin(self, means: Tensor, optimizer: torch.optim.Optimizer, fixed: Tensor | None) -> None:
        """Look for the nodes beside Gaussians (N, 3) again, but for those that follow none."""
        self.skinning.relink(self.nodes, means, optimizer)
        self._release(fixed)

    @torch.no_grad()
    def freeze_static_nodes(
        self, gaussians: GaussianModel, span: Sequence[float], least: float, fixed: Tensor | None = None
    ) -> None:
        """Stop nodes that stay within ``least`` (world units) of their mean position in a span of time, with
        what their rotation moves beside them counted in; Gaussians that follow only stopped nodes stop, too.

        Such a Gaussian is put where it was on average, rotated as it was on average, and its shares of nodes
        become 0: it incurs no further cost of motion. A stopped node stays where it was on average, too, as
        others may be kept rigid with it.
        """
        times = torch.linspace(*span, _TIMES).tolist()
        self.nodes.stop(self.nodes.motion_range(times) < least, times)
        follows = self.skinning.weights() > _FOLLOWS
        static = self.static_mask(fixed)
        free = ~(follows & ~self.nodes.stopped[self.skinning.links.long()]).any(-1) & ~static
        if not bool(free.any()):
            return
        at_times = zip(*(moved(gaussians.means.data, self.warp(time)) for time in times))
        means, linear = (sum(parts) / len(times) for parts in at_times)
        gaussians.means[free] = means[free]
        left, _, right = torch.linalg.svd(linear[free])  # left @ right is the nearest rotation
        gaussians.quaternions[free] = _product(_quaternions(left @ right), gaussians.quaternions[free])
        self.resting[free] = True
        self.skinning.release(free)


def identity_warp(means: Tensor) -> Warp:
    """Return the warp of Gaussians (N, 3) that never move."""
    zero = means.new_zeros(len(means), 1)
    return Warp(means.new_zeros(1, 12), zero.int(), zero)


def _quaternions(matrices: Tensor) -> Tensor:
    """Return the quaternions (N, 4) of rotation matrices (N, 3, 3) by less than half a turn.

    >>> from forewarp.ops.gaussians import rotations
    >>> _quaternions(rotations(torch.tensor([[0.8, 0.0, 0.6, 0.0]])))
    tensor([[0.8000, 0.0000, 0.6000, 0.0000]])
    """
    w = 0.5 * (1 + matrices.diagonal(dim1=-2, dim2=-1).sum(-1)).clamp(min=1e-6).sqrt()
    skew = matrices - matrices.mT
    return torch.stack([w, *(skew[:, i, j] / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))], -1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Return the quaternions (N, 4) of first b's rotation, then a's."""
    w, v, x, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    scalar = w * x - (v * u).sum(-1, keepdim=True)
    return torch.cat([scalar, w * u + x * v + torch.linalg.cross(v, u)], -1)
