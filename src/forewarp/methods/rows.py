"""Rows of parameters that come, go and learn one by one, with the optimiser's moments."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from forewarp.methods.method import part_of
from forewarp.ops.adam import AdamState, adam_rows


def keep_rows(method: nn.Module, rows: Tensor) -> tuple[list[Parameter], list[Parameter]]:
    """Replace every parameter and buffer in ``method.grows`` by its ``rows`` (N',) int64, each in [0, N).

    Returns:
        the parameters before and after, pairwise.

    Raises:
        ValueError: for rows out of range.

    Cost: one copy of each.
    """
    before, after = [], []
    count = len(part_of(method, method.grows[0]))
    if rows.dtype != torch.int64 or (len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < count):
        got = f"{rows.dtype}: {rows[:5].tolist()} ..."
        raise ValueError(f"rows: expected int64 in [0, {count}), but got {got}")
    for name in method.grows:
        place, _, last = name.rpartition(".")
        owner, value = method.get_submodule(place), part_of(method, name)
        taken = value.data[rows.to(value.device)]
        if isinstance(value, Parameter):
            # A new Parameter: autograd remembers an old one's shape for as long as any graph lives.
            before.append(value)
            after.append(Parameter(taken, requires_grad=value.requires_grad))
            setattr(owner, last, after[-1])
        else:
            setattr(owner, last, taken)
    return before, after


@torch.no_grad()
def take_rows(
    method: nn.Module, optimizer: torch.optim.Optimizer, rows: Tensor, fresh: Tensor | None = None
) -> None:
    """Replace every parameter and buffer in ``method.grows`` by its ``rows``, and the moments likewise.

    A row that is named twice is copied; a row that is not named is removed.

    Args:
        method: the method whose parameters change.
        optimizer: the optimizer whose moments follow.
        rows: (N',) int64, each in [0, N).
        fresh: (N',) bool, rows whose moments start at 0; None: every row keeps the moments of its source.

    Raises:
        ValueError: for rows out of range.

    Cost: one copy of each parameter and of its moments.
    """
    before, after = keep_rows(method, rows)
    renew_parameters(optimizer, before, after, rows if fresh is None else rows.masked_fill(fresh, -1))


def renew_parameters(
    optimizer: torch.optim.Optimizer, before: list[Parameter], after: list[Parameter], rows: Tensor | None
) -> None:
    """Replace parameters in an optimiser, and carry their moments over row by row.

    Args:
        optimizer: the optimizer whose groups and moments change.
        before, after: parameters (N, ...) and (N', ...), pairwise.
        rows: (N',) int64, the old row of each new row, -1 for none; None: all moments start at 0.
    """
    renewed = dict(zip(map(id, before), after))
    for group in optimizer.param_groups:
        group["params"] = [renewed.get(id(p), p) for p in group["params"]]
    for old, new in zip(before, after):
        if (state := optimizer.state.pop(old, None)) is None:
            continue
        for key, value in state.items():
            if not torch.is_tensor(value) or value.dim() == 0:  # the number of steps
                continue
            if rows is None or not len(value):
                state[key] = torch.zeros_like(new)
            else:
                at = rows.to(value.device)
                known = (at >= 0).reshape(-1, *[1] * (value.dim() - 1))
                state[key] = torch.where(known, value[at.clamp(min=0)], 0.0)
        optimizer.state[new] = state


class RowsAdam(torch.optim.Optimizer):
    """See ``ops.adam``; a row is of a parameter's last axis. Its state follows ``methods.rows``."""

    def __init__(self, groups: list[dict], *, betas=(0.9, 0.99), eps: float = 1e-15) -> None:
        super().__init__(groups, {"lr": 1e-3, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure=None):
        """One step; see ``torch.optim.Optimizer``."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        alike: dict[tuple, list[AdamState]] = {}
        for group in self.param_groups:
            alike.setdefault((*group["betas"], group["eps"]), []).extend(self._learned(group))
        for (first, second, eps), learned in alike.items():
            adam_rows(learned, (first, second), eps)
        return loss

    def _learned(self, group: dict) -> Iterator[AdamState]:
        for p in group["params"]:
            if p.grad is None or not p.numel():
                continue
            state = self.state[p]
            if not state:
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(p), torch.zeros_like(p)
                state["steps"] = torch.zeros_like(p[..., 0])
            yield AdamState(p, p.grad, state["exp_avg"], state["exp_avg_sq"], state["steps"], group["lr"])
