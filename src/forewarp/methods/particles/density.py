"""Density control: split, remove, let opacity decay, and bring to rest what does not move."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forewarp.fields.moving import cosines
from forewarp.methods.particles.shared import left_alone
from forewarp.methods.rows import take_rows
from forewarp.ops.gaussians import moved, rotations

if TYPE_CHECKING:
    from forewarp.methods.particles.model import Particles

_FADED = -4.0  # logit of the opacity below which a particle goes
_UNSEEN = 5  # rounds without being seen after which it goes
_MOST_A_ROUND = 0.1  # share of the particles that are split at once
_HALF, _APART = 0.6, 0.6  # of the longest axis: a half's length, and how far each is moved along it
_LARGE = 0.45  # of the scene's extent: what has a longer axis goes
_NEAREST, _NEARER = 0.02, 0.6  # share of an image's particles; of the farthest of them, what is too near
_TIMES = 16  # at which opacity over time and motion are looked at
_MOST_OPAQUE = 6.0  # logit: at 17 float32 has no gradient left, and what is opaque there can never fade
_FOLLOWS = 1e-3  # weight of a node below which its motion shows nowhere


def too_near(order: Tensor, distances: Tensor) -> Tensor:
    """Find particles much nearer to a camera than nearly all others before it: return their rows.

    So near, a few of them mend an image where they stand in no other's way, and hide things from views that
    lie between images. A thing that comes near is more than a few; of fewer than fifty none is too near.

    Args:
        order, distances: (V,) and (N,), as of ``ops.gaussians.ImageLoss``.

    >>> too_near(torch.arange(50), torch.tensor([0.1] + [2.0] * 49))
    tensor([0])
    """
    if not len(order):
        return order
    nearest = distances[order[: int(_NEAREST * len(order)) + 1]]
    return order[: int(torch.searchsorted(nearest, _NEARER * nearest[-1]))]


@torch.no_grad()
def control(particles: Particles, progress: float, optimizer: torch.optim.Optimizer) -> None:
    """Run a round of density control; every few rounds, link particles to nodes anew, and let nodes rest.

    Args:
        particles: with the counters of the rounds so far.
        progress: fraction of the stage that is done.
        optimizer: whose moments follow.
    """
    stage = particles.stage
    renew(particles, round(float(particles.final_count) * stage.share_at(progress)), optimizer)
    if particles.nodes is not None and int(particles.round) % stage.relink == 0:
        particles.skinning.relink(particles.nodes, particles.means.data, optimizer)
        if (still := left_alone(particles.shared, particles.resting)) is not None:
            particles.skinning.release(still)
        rests = particles.least_motion is not None and progress >= stage.rest_from
        if rests and not particles.nodes.led:  # curves say where nodes go
            least = max(particles.least_motion, pixel_width(float(particles.covered_pixels)))
            come_to_rest(particles, least * float(particles.extent))


@torch.no_grad()
def renew(particles: Particles, target: int, optimizer: torch.optim.Optimizer) -> None:
    """Remove particles that are not needed, and split those with the largest gradients.

    A particle goes whose opacity has faded, that is longer than a good part of the scene, that stood too near
    to a camera (``unseen_rounds`` is infinite), or, once all times are in play, that no image has shown for
    some rounds. The rest is split along its longest axis, in the order of its mean gradient over the images
    that showed it, until there are ``target``. Those that are shared with other windows neither go, nor are
    they split or counted.
    """
    shared = torch.zeros_like(particles.unseen_rounds, dtype=torch.bool)
    if particles.shared is not None:
        shared = particles.shared >= 0
    gone = particles.unseen_rounds.isinf()
    particles.unseen_rounds.copy_(torch.where(particles.image_count > 0, 0.0, particles.unseen_rounds + 1))
    gone |= most_opaque(particles) < _FADED
    large = particles.scales.amax(-1).exp() > _LARGE * float(particles.extent)
    gone |= large & ~particles.beyond(particles.means.data)
    if particles.nodes is not None:
        first, last = particles.nodes.seen_times.tolist()
        if first <= particles.ends[0] + 0.02 and last >= particles.ends[1] - 0.02:
            gone |= particles.unseen_rounds >= _UNSEEN
    gone &= ~shared
    kept = (~gone).nonzero()[:, 0]
    if not len(kept):  # all that there is must not vanish
        kept = torch.arange(len(gone), device=gone.device)
    own = len(kept) - int(shared.sum())
    room = min(target - own, int(_MOST_A_ROUND * own) + 1)
    gradient = (particles.gradient_sum / particles.image_count.clamp(min=1))[kept]
    split = kept[gradient.topk(max(0, min(room, int((gradient > 0).sum())))).indices]
    fresh = torch.arange(len(kept) + len(split), device=kept.device) >= len(kept)
    if len(split) or len(kept) < len(gone):
        sources = torch.searchsorted(kept, split)  # rows among those that stay
        take_rows(particles, optimizer, torch.cat([kept, split]), fresh)
        _halve(particles, sources, fresh.nonzero()[:, 0])
    particles.gradient_sum.zero_()
    particles.image_count.zero_()


def _halve(particles: Particles, first: Tensor, second: Tensor) -> None:
    """Make two shorter halves of particles that lie in the rows ``first`` and, copied, ``second``."""
    longest = particles.scales[first].argmax(-1)
    length = particles.scales[first].gather(-1, longest[:, None]).exp()
    axes = rotations(particles.quaternions[first])
    axis = axes.gather(-1, longest[:, None, None].expand(-1, 3, 1))[..., 0]
    step = _APART * length * axis
    particles.means[first] -= step
    particles.means[second] += step
    shorter = torch.log(torch.tensor(_HALF))
    for rows in (first, second):
        particles.scales[rows, longest] += shorter


def most_opaque(particles: Particles) -> Tensor:
    """Return the logit of each particle's opacity (N,) when it is largest."""
    base = particles.opacity.data[:, 0]
    if particles.opacity_over_time is None:
        return base
    count, canonical = particles.opacity_over_time.shape[1], particles.canonical_time
    bases = base.new_tensor([cosines(count, i / _TIMES, canonical) for i in range(_TIMES + 1)])  # (T, F)
    return base + (bases @ particles.opacity_over_time.data.T).amax(0)


@torch.no_grad()
def bound_opacity(particles: Particles) -> None:
    """Keep the logit of opacity bounded at all times: where time adds to it, by taking from its base.

    Cost: nothing to speak of; with opacity over time about 20 operations a particle and cosine.
    """
    base = particles.opacity.data
    if particles.opacity_over_time is not None:
        base[:, 0] -= (most_opaque(particles) - _MOST_OPAQUE).clamp(min=0)
    base.clamp_(max=_MOST_OPAQUE)


@torch.no_grad()
def decay_opacity(particles: Particles) -> None:
    """Take a share of the opacity of particles: ``decay`` of those that a step's images showed,
    ``hidden_decay`` of the others, both in [0, 1).

    Few images leave open what stands where; what none of those that show it asks for fades, and goes. What
    most images do not show, as it lies behind other things, may move there as it likes, and is wrong
    where a view shows it after all: unless images ask for it again and again, it fades, too. Where time adds
    to opacity, it is taken of that without. A step that was dropped has no gradient, and takes nothing.

    Cost: some six operations a particle and image; none where the shares are 0.

    Source: as in "Binocular-Guided 3D Gaussian Splatting with View Consistency for Sparse View Synthesis"
    (NeurIPS 2024), there one share for all particles and throughout.
    """
    base, shown_share, hidden_share = particles.opacity.data, particles.decay, particles.hidden_decay
    if (shown_share > 0 or hidden_share > 0) and particles.opacity.grad is not None:
        for shown in particles.shown_now:
            share = torch.where(shown, base.new_tensor(shown_share), base.new_tensor(hidden_share))
            if particles.shared is not None:
                share[particles.shared >= 0] = 0.0
            base[:, 0] -= torch.log1p(share * base[:, 0].exp()) - torch.log1p(-share)  # of the logit
    particles.shown_now.clear()


def pixel_width(covered: float) -> float:
    """Return the width of a pixel as a share of the scene's extent, from the number of covered pixels.

    Roughly: as of a disc that fills the covered pixels, whose extent (the median distance from its middle) is
    its radius over the root of 2. Of images that show a part of the scene each it is too large.

    >>> round(pixel_width(20_000.0), 4)
    0.0177
    """
    return math.sqrt(2 * math.pi / max(covered, 1.0))


@torch.no_grad()
def come_to_rest(particles: Particles, least: float) -> None:
    """Stop nodes that stay within ``least`` (world units) of their mean position, with what their turning
    moves beside them counted in; particles that follow only stopped nodes stop, too.

    Such a particle is put where it was on average, turned as it was on average, and its shares of nodes
    become 0: it costs no motion any more. A stopped node stays where it was on average, too, as others may
    be kept rigid with it.
    """
    nodes = particles.nodes
    times = torch.linspace(*particles.ends, _TIMES).tolist()
    nodes.stop(nodes.motion_range(times) < least, times)
    follows = particles.skinning.weights() > _FOLLOWS
    still = left_alone(particles.shared, particles.resting)
    free = ~(follows & ~nodes.stopped[particles.skinning.links.long()]).any(-1) & ~still
    if not bool(free.any()):
        return
    at_times = zip(*(moved(particles.means.data, particles.warp(time)) for time in times))
    means, linear = (sum(parts) / len(times) for parts in at_times)
    particles.means[free] = means[free]
    left, _, right = torch.linalg.svd(linear[free])  # left @ right is the nearest rotation
    particles.quaternions[free] = _product(_quaternions(left @ right), particles.quaternions[free])
    particles.resting[free] = True
    particles.skinning.release(free)


def _quaternions(matrices: Tensor) -> Tensor:
    """Return the quaternions (N, 4) of rotation matrices (N, 3, 3) by less than half a turn.

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
