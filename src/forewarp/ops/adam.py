"""Adam that passes over rows without a gradient: what a picture does not show does not learn from it."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.backend import match_threads, use_numba
from forewarp.ops.checks import check_shape


def adam_rows(
    value: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, steps: Tensor, rate: float,
    betas: tuple[float, float], eps: float,
) -> None:  # fmt: skip
    """One step of Adam, in place, of the rows whose gradient is not 0 throughout.

    ``m = b1 m + (1 - b1) g``, ``v = b2 v + (1 - b2) g^2``, and with n the steps that the row itself has
    made ``value -= rate m / (1 - b1^n) / (sqrt(v / (1 - b2^n)) + eps)``.

    Args:
        value, gradient, mean, square: (..., C); a row is of the last axis. The kernel takes contiguous ones.
        steps: (...,) float32, how many steps each row has made.
        rate, betas, eps: as of Adam.

    Raises:
        ValueError: for shapes that do not go together, as an altered checkpoint may have.

    Cost: one look at the gradients; five numbers moved for each of sixteen rows of which one has a gradient.
    """
    for name, part in (("gradient", gradient), ("exp_avg", mean), ("exp_avg_sq", square)):
        check_shape(name, part, tuple(value.shape))
    check_shape("steps", steps, tuple(value.shape[:-1]))
    fast = use_numba(value) and value.dtype == torch.float32
    if fast and all(t.is_contiguous() for t in (value, mean, square, steps)):
        from forewarp.ops import kernels_adam

        match_threads()
        betas = tuple(map(float, betas))
        table = kernels_adam.biases(*betas)
        parts = (value.detach(), gradient.contiguous(), mean, square, steps)
        flat = (t.numpy().reshape(-1) for t in parts)  # a view, quicker than PyTorch's
        kernels_adam.adam(*flat, float(rate), *betas, float(eps), table)
        return
    seen = (gradient != 0).any(-1)
    counted = steps[seen] + 1
    g = gradient[seen]
    m = betas[0] * mean[seen] + (1 - betas[0]) * g
    v = betas[1] * square[seen] + (1 - betas[1]) * g * g
    steps[seen], mean[seen], square[seen] = counted, m, v
    first, second = (1 - torch.pow(b, counted)[..., None] for b in betas)
    value[seen] -= rate * (m / first) / ((v / second).sqrt() + eps)
