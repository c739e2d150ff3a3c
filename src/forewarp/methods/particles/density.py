"""Density control: when and where Gaussians are split, removed, and lose opacity."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from forewarp.methods.particles.gaussians import GaussianModel
from forewarp.methods.particles.options import Numbers

_FADED = -4.0  # logit of the opacity below which a Gaussian goes
_UNSEEN = 5  # rounds without being seen after which it goes
_MOST_A_ROUND = 0.1  # share of the Gaussians that are split at once
_LARGE = 0.45  # of the scene's extent: what has a longer axis goes
_NEAREST, _NEARER = 0.02, 0.6  # share of an image's Gaussians; of the farthest of them, what is too near


class DensityControl(nn.Module):
    """Statistics of what images show of N Gaussians, and what follows from them.

    Attributes:
        gradient_sum, image_count: (N,), since the last round: sums of the gradients by the pixel, and how
            many images showed a Gaussian.
        unseen_rounds: (N,), rounds in which no image did; infinite: to be removed.
        round: (), the number of the last round.
        decay, hidden_decay: shares of opacity that a step takes, see ``decay_opacity``.

    Args:
        count: N.
        stage: when rounds are, and how many Gaussians there are by then.
    """

    ROWS = ("gradient_sum", "image_count", "unseen_rounds")

    def __init__(self, count: int, stage: Numbers) -> None:
        super().__init__()
        self.stage = stage
        self.register_buffer("gradient_sum", torch.zeros(count))
        self.register_buffer("image_count", torch.zeros(count))
        self.register_buffer("unseen_rounds", torch.zeros(count))
        self.register_buffer("round", torch.zeros((), dtype=torch.int64))
        self.decay = self.hidden_decay = 0.0
        self.shown_now: list[Tensor] = []  # which Gaussians each image of this step showed

    def count(self, pixel_gradient: Tensor) -> None:
        """Count an image, by the lengths (N,) of the gradients by the pixel; 0: it does not show that one."""
        shown = pixel_gradient > 0
        self.gradient_sum.add_(pixel_gradient)
        self.image_count.add_(shown)
        self.shown_now.append(shown)

    def mark_too_near(self, progress: float, order: Tensor, distances: Tensor) -> None:
        """Remove with the next round what stands too near to an image's camera; see ``too_near``."""
        if progress < self.stage.density_until:
            self.unseen_rounds[too_near(order, distances)] = math.inf

    def is_due(self, progress: float) -> bool:
        """Return whether a round is due, and note it."""
        number = int(progress / self.stage.density_interval)
        due = number > int(self.round) and progress < self.stage.density_until
        if due:
            self.round.fill_(number)
        return due

    @torch.no_grad()
    def densify_and_prune(
        self,
        gaussians: GaussianModel,
        target: int,
        take_rows: Callable[[Tensor, Tensor], None],
        *,
        extent: float,
        far: Tensor,
        fixed: Tensor | None = None,
        all_times: bool = False,
    ) -> None:
        """Remove Gaussians that are not needed, and split those with the largest gradients.

        One goes whose opacity has faded, that is longer than a good part of the scene, that stood too near
        to a camera, or, once all times are in play, that no image has shown for some rounds. The rest is
        split along its longest axis, in the order of its mean gradient over the images that showed it, until
        there are ``target``.

        Args:
            gaussians: N of them.
            target: how many there should be, those that are ``fixed`` not counted.
            take_rows: replaces everything that has a row for each Gaussian by its rows (N',), of which those
                in a mask (N',) begin without moments; see ``methods.rows.take_rows``.
            extent: of the scene, world units.
            far: (N,) bool, which may be large.
            fixed: (N,) bool, which neither go, nor are split or counted; None: none.
            all_times: whether all times are in play.
        """
        fixed = torch.zeros_like(self.unseen_rounds, dtype=torch.bool) if fixed is None else fixed
        gone = self.unseen_rounds.isinf()
        self.unseen_rounds.copy_(torch.where(self.image_count > 0, 0.0, self.unseen_rounds + 1))
        gone |= gaussians.most_opaque() < _FADED
        gone |= (gaussians.scales.amax(-1).exp() > _LARGE * extent) & ~far
        if all_times:
            gone |= self.unseen_rounds >= _UNSEEN
        gone &= ~fixed
        kept = (~gone).nonzero()[:, 0]
        if not len(kept):  # all that there is must not vanish
            kept = torch.arange(len(gone), device=gone.device)
        own = len(kept) - int(fixed.sum())
        room = min(target - own, int(_MOST_A_ROUND * own) + 1)
        gradient = (self.gradient_sum / self.image_count.clamp(min=1))[kept]
        split = kept[gradient.topk(max(0, min(room, int((gradient > 0).sum())))).indices]
        fresh = torch.arange(len(kept) + len(split), device=kept.device) >= len(kept)
        if len(split) or len(kept) < len(gone):
            sources = torch.searchsorted(kept, split)  # rows among those that stay
            take_rows(torch.cat([kept, split]), fresh)
            gaussians.halve(sources, fresh.nonzero()[:, 0])
        self.gradient_sum.zero_()
        self.image_count.zero_()

    @torch.no_grad()
    def decay_opacity(self, opacity: Tensor, fixed: Tensor | None = None) -> None:
        """Take a share of the opacity of Gaussians: ``decay`` of those that a step's images showed,
        ``hidden_decay`` of the others, both in [0, 1).

        Few images leave open what stands where; what none of those that show it asks for fades, and goes.
        What most images do not show, as it lies behind other things, is unconstrained where it is occluded:
        unless images ask for it again and again, it fades, too. Where time adds to opacity, it is taken of
        that without. A step that was dropped has no gradient, and takes nothing.

        Args:
            opacity: (N, 1) logits, with the step's gradient.
            fixed: (N,) bool, which keep theirs.

        Cost: some six operations a Gaussian and image; none where the shares are 0.

        Source: as in "Binocular-Guided 3D Gaussian Splatting with View Consistency for Sparse View Synthesis"
        (NeurIPS 2024), there one share for all and throughout.
        """
        base, shown_share, hidden_share = opacity.data, self.decay, self.hidden_decay
        if (shown_share > 0 or hidden_share > 0) and opacity.grad is not None:
            for shown in self.shown_now:
                share = torch.where(shown, base.new_tensor(shown_share), base.new_tensor(hidden_share))
                if fixed is not None:
                    share[fixed] = 0.0
                base[:, 0] -= torch.log1p(share * base[:, 0].exp()) - torch.log1p(-share)  # of the logit
        self.shown_now.clear()


def too_near(order: Tensor, distances: Tensor) -> Tensor:
    """Find Gaussians much nearer to a camera than nearly all others before it: return their rows.

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
