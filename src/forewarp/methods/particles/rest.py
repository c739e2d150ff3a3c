"""Bring to rest what does not move: nodes that stand still, and particles that follow none but these."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forewarp.methods.method import Method
from forewarp.ops.gaussians import moved

_FOLLOWS = 1e-3  # weight of a node below which its motion shows nowhere
_TIMES = 16  # at which motion is looked at


def pixel_width(covered: float) -> float:
    """Return the width of a pixel as a share of the scene's extent, from the number of covered pixels.

    Roughly: as of a disc that fills the covered pixels, whose extent (the median distance from its middle) is
    its radius over the root of 2. Of pictures that show a part of the scene each it is too large.

    >>> round(pixel_width(20_000.0), 4)
    0.0177
    """
    return math.sqrt(2 * math.pi / max(covered, 1.0))


@torch.no_grad()
def come_to_rest(method: Method, least: float) -> None:
    """Stop each node that stays within ``least`` (world units) of its mean place, with what its turning moves
    beside it counted in; particles that follow only stopped nodes stop, too.

    Such a particle is put where it was on average, turned as it was on average, and its shares of nodes
    become 0: it costs no motion any more. A stopped node stays where it was on average, too, as others may
    be kept rigid with it.

    Args:
        method: has ``ends`` (the first and the last time), ``nodes``, ``means``, ``turns``, ``skin``
            and ``resting`` (N,) bool.
        least: the distance.
    """
    nodes = method.nodes
    times = torch.linspace(*method.ends, _TIMES).tolist()
    nodes.stop(nodes.reach_of(times) < least, times)
    follows = method.skin.weights() > _FOLLOWS
    free = ~(follows & ~nodes.still[method.skin.links.long()]).any(-1) & ~method.resting
    if not bool(free.any()):
        return
    places, linear = (sum(parts) / len(times) for parts in zip(*(_moved(method, t) for t in times)))
    method.means[free] = places[free]
    left, _, right = torch.linalg.svd(linear[free])
    method.turns[free] = _product(_quaternions(left @ right), method.turns[free])
    method.resting[free] = True
    method.skin.let_go(free)


def _moved(method: Method, time: float) -> tuple[Tensor, Tensor]:
    return moved(method.means.data, method.warp(time))


def _quaternions(matrices: Tensor) -> Tensor:
    """Quaternions (N, 4) of rotation matrices (N, 3, 3) by less than half a turn.

    >>> from forewarp.ops.gaussians import rotations
    >>> _quaternions(rotations(torch.tensor([[0.8, 0.0, 0.6, 0.0]])))
    tensor([[0.8000, 0.0000, 0.6000, 0.0000]])
    """
    w = 0.5 * (1 + matrices.diagonal(dim1=-2, dim2=-1).sum(-1)).clamp(min=1e-6).sqrt()
    skew = matrices - matrices.mT
    return torch.stack([w, *(skew[:, i, j] / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))], -1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """The quaternions (N, 4) of first b's rotation, then a's."""
    w, v, x, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    scalar = w * x - (v * u).sum(-1, keepdim=True)
    return torch.cat([scalar, w * u + x * v + torch.linalg.cross(v, u)], -1)
