"""Who follows whom: the nodes beside each particle, and how much of each one's motion it takes."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from forewarp.methods.particles.nodes import Nodes
from forewarp.ops.nodes import skin_weights


class Skin(nn.Module):
    """N particles follow up to L nodes each: ``links`` (N, L) int32, by ``weights`` that sum to 1.

    A weight is that of the distance, ``shares`` (N, L), times ``exp(learned)``: what lies beside two parts
    that move apart learns which of them it belongs to. A particle at rest has the shares 0, and follows none.
    """

    ROWS = ("links", "shares", "learned")

    def __init__(self, nodes: Nodes, points: Tensor) -> None:
        super().__init__()
        links, shares = nodes.links(points)
        self.register_buffer("links", links)
        self.register_buffer("shares", shares)
        self.learned = nn.Parameter(torch.zeros_like(shares))

    def weights(self) -> Tensor:
        """The weights (N, L), differentiable in ``learned``."""
        return skin_weights(self.shares, self.learned)

    @torch.no_grad()
    def relink(self, nodes: Nodes, points: Tensor, optimizer: torch.optim.Optimizer) -> None:
        """Look for the nodes beside points (N, 3) again.

        What was learned of those that stay is kept, with its moments: as factors of the shares, so that one
        that comes anew begins with its share.
        """
        level = (self.learned + self.shares.log()).logsumexp(-1, keepdim=True).nan_to_num(neginf=0.0)
        before, known = self.links, self.learned - level
        self.links, self.shares = nodes.links(points)
        stays = self.links[:, :, None] == before[:, None]
        self.learned.copy_((stays * known[:, None]).sum(-1))
        moments = optimizer.state.get(self.learned, {})
        for name in {"exp_avg", "exp_avg_sq"} & moments.keys():
            moments[name] = (stays * moments[name][:, None]).sum(-1)

    def let_go(self, which: Tensor) -> None:
        """Let particles (N,) bool follow no node."""
        self.shares[which] = 0.0
