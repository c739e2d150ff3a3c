"""Adam that passes over rows without a gradient: what a picture does not show does not learn from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from forewarp.ops.backend import check_shape, match_threads, use_numba


class Learned(NamedTuple):
    """What a step changes of one parameter, and by what.

    Attributes:
        value, gradient, mean, square: (..., C); a row is of the last axis.
        steps: (...,) float32, how many steps each row has made.
        rate: as of Adam.
    """

    value: Tensor
    gradient: Tensor
    mean: Tensor
    square: Tensor
    steps: Tensor
    rate: float


def adam_rows(learned: Sequence[Learned], betas: tuple[float, float], eps: float) -> None:
    """One step of Adam, in place, of the rows whose gradient is not 0 throughout.

    ``m = b1 m + (1 - b1) g``, ``v = b2 v + (1 - b2) g^2``, and with n the steps that the row itself has
    made ``value -= rate m / (1 - b1^n) / (sqrt(v / (1 - b2^n)) + eps)``.

    Args:
        learned: parameters. The kernel takes all that are contiguous, float32 and on the CPU, at one go.
        betas, eps: as of Adam.

    Raises:
        ValueError: for shapes that do not go together, as an altered checkpoint may have.

    Cost: one look at the gradients; five numbers moved for each of the rows side by side, up to sixteen, of
    which one has a gradient.
    """
    for one in learned:
        shape = one.value.shape
        for name, part in (("gradient", one.gradient), ("exp_avg", one.mean), ("exp_avg_sq", one.square)):
            if part.shape != shape:
                check_shape(name, part, tuple(shape))
        check_shape("steps", one.steps, tuple(shape[:-1]))
    quick = [_quick(one) for one in learned]
    if any(quick):
        _by_kernel([one for one, fast in zip(learned, quick) if fast], betas, eps)
    for one, fast in zip(learned, quick):
        if not fast:
            _adam_reference(one, betas, eps)


def _quick(one: Learned) -> bool:
    """Whether the kernel takes it: it reads and writes float32 at addresses."""
    parts = one[:5]
    fits = all(t.dtype == torch.float32 and t.device == one.value.device for t in parts)
    kept = all(t.is_contiguous() for t in (one.value, *parts[2:]))  # a gradient may be copied
    return fits and kept and use_numba(one.value) and one.value.numel() > 0


def _by_kernel(learned: list[Learned], betas: tuple[float, float], eps: float) -> None:
    from forewarp.ops.kernels import adam as kernels

    match_threads()
    table, alive = [], []  # gradients must outlive the call
    for value, gradient, mean, square, steps, _ in learned:
        alive.append(gradient.contiguous())
        width, parts = value.shape[-1], (value, alive[-1], mean, square, steps)
        table.append([*(t.data_ptr() for t in parts), value.numel() // width, width])
    rates = np.array([one.rate for one in learned], np.float32)
    first, second = map(float, betas)
    bias = kernels.biases(first, second)
    kernels.adam(np.array(table, np.int64), rates, first, second, float(eps), bias)


def _adam_reference(learned: Learned, betas: tuple[float, float], eps: float) -> None:
    """``adam_rows`` of one parameter in plain PyTorch."""
    value, gradient, mean, square, steps, rate = learned
    seen = (gradient != 0).any(-1)
    counted = steps[seen] + 1
    g = gradient[seen]
    m = betas[0] * mean[seen] + (1 - betas[0]) * g
    v = betas[1] * square[seen] + (1 - betas[1]) * g * g
    steps[seen], mean[seen], square[seen] = counted, m, v
    first, second = (1 - torch.pow(b, counted)[..., None] for b in betas)
    value[seen] -= rate * (m / first) / ((v / second).sqrt() + eps)
