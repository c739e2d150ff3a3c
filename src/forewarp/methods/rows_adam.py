"""Adam by rows: what a step does not see keeps its moments and its own count of steps."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from forewarp.ops.adam import Learned, adam_rows


class RowsAdam(torch.optim.Optimizer):
    """See ``ops.adam``; a row is of a parameter's last axis. Its state follows ``methods.rows``.

    Raises:
        ValueError: for betas that are not in [0, 1).
    """

    def __init__(self, groups: list[dict], *, betas=(0.9, 0.99), eps: float = 1e-15) -> None:
        if not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"betas: expected numbers from 0 to below 1, but got {betas}")
        super().__init__(groups, {"lr": 1e-3, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure=None):
        """One step; see ``torch.optim.Optimizer``."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        alike: dict[tuple, list[Learned]] = {}
        for group in self.param_groups:
            alike.setdefault((*group["betas"], group["eps"]), []).extend(self._learned(group))
        for (first, second, eps), learned in alike.items():
            adam_rows(learned, (first, second), eps)
        return loss

    def _learned(self, group: dict) -> Iterator[Learned]:
        for p in group["params"]:
            if p.grad is None or not p.numel():
                continue
            state = self.state[p]
            if not state:
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(p), torch.zeros_like(p)
                state["steps"] = torch.zeros_like(p[..., 0])
            yield Learned(p, p.grad, state["exp_avg"], state["exp_avg_sq"], state["steps"], group["lr"])
