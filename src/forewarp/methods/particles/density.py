"""Where particles are missing, and which are not needed."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.methods.method import Method
from forewarp.methods.rows import take_rows

_FADED = -4.0  # logit of the opacity below which a particle goes
_IDLE = 5  # rounds without being seen after which it goes
_MOST_A_ROUND = 0.1  # share of the particles that are split at once
_HALF, _APART = 0.6, 0.6  # of the longest axis: a half's length, and how far each is moved along it
_LARGE = 0.45  # of the scene's extent: a longer axis goes
_NEAREST, _NEARER = 0.02, 0.6  # share of a picture's particles; of the farthest of them, what is too near


def too_near(order: Tensor, distances: Tensor) -> Tensor:
    """Which particles stand much nearer to a camera than nearly all others before it: their rows.

    So near, a few of them mend a picture where they stand in no other's way, and hide things from views that
    lie between pictures. A thing that comes near is more than a few; of fewer than fifty none is too near.

    Args:
        order, distances: (V,) and (N,), as of ``ops.compare.Compared``.

    >>> too_near(torch.arange(50), torch.tensor([0.1] + [2.0] * 49))
    tensor([0])
    """
    if not len(order):
        return order
    nearest = distances[order[: int(_NEAREST * len(order)) + 1]]
    return order[: int(torch.searchsorted(nearest, _NEARER * nearest[-1]))]


@torch.no_grad()
def renew(
    method: Method, optimizer: torch.optim.Optimizer, target: int, *, unseen: bool, extent: float
) -> None:
    """Remove what is not needed, and split what the pictures pull at most.

    A particle goes whose opacity has faded, that is longer than a good part of the scene, that stood too near
    to a camera, or that, where ``unseen``, no picture has shown for some rounds. The rest is split along its
    longest axis, in the order of its mean pull over the pictures that showed it, until there are ``target``.

    Args:
        method: has ``means``, ``log_scales``, ``turns``, ``most_opaque``, and the counters ``pulled``,
            ``shown`` and ``idle``, (N,) each; what is infinitely ``idle`` goes.
        optimizer: whose moments follow.
        target: how many there should be.
        unseen: whether all frames are in play.
        extent: of the scene, world units.
    """
    gone = method.idle.isinf()
    method.idle.copy_(torch.where(method.shown > 0, 0.0, method.idle + 1))
    gone |= method.most_opaque() < _FADED
    gone |= method.log_scales.amax(-1).exp() > _LARGE * extent
    if unseen:
        gone |= method.idle >= _IDLE
    kept = (~gone).nonzero()[:, 0]
    if not len(kept):  # all that there is must not vanish
        kept = torch.arange(len(gone), device=gone.device)
    room = min(target - len(kept), int(_MOST_A_ROUND * len(kept)) + 1)
    pull = (method.pulled / method.shown.clamp(min=1))[kept]
    torn = kept[pull.topk(max(0, min(room, int((pull > 0).sum())))).indices]
    fresh = torch.zeros(len(kept) + len(torn), dtype=torch.bool, device=kept.device)
    fresh[len(kept) :] = True
    if len(torn) or len(kept) < len(gone):
        first = torch.searchsorted(kept, torn)  # where the sources are among those that stay
        take_rows(method, optimizer, torch.cat([kept, torn]), fresh)
        _split(method, first, torch.arange(len(kept), len(kept) + len(torn), device=kept.device))
    method.pulled.zero_()
    method.shown.zero_()


def _split(method: Method, first: Tensor, second: Tensor) -> None:
    """Make two shorter halves of particles that lie in the rows ``first`` and, copied, ``second``."""
    longest = method.log_scales[first].argmax(-1)
    length = method.log_scales[first].gather(-1, longest[:, None]).exp()
    axis = _axes(method.turns[first], longest)
    step = _APART * length * axis
    method.means[first] -= step
    method.means[second] += step
    shorter = torch.log(torch.tensor(_HALF))
    for rows in (first, second):
        method.log_scales[rows, longest] += shorter


def _axes(quaternions: Tensor, which: Tensor) -> Tensor:
    """The direction (N, 3) of each particle's axis ``which`` (N,)."""
    from forewarp.ops.gaussians import rotations

    turned = rotations(quaternions)
    return turned.gather(-1, which[:, None, None].expand(-1, 3, 1))[..., 0]
