"""Adam that passes over rows without a gradient: what an image does not show does not learn from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from forewarp.ops.backend import check_shapes, match_threads, use_numba


class AdamState(NamedTuple):
    """What a step changes of one parameter, and by what.

    Attributes:
        value, gradient, mean, square: (..., C); a row is of the last axis.
        steps: (...,) float32, how many steps each row has made.
        lr: as of Adam.
    """

    value: Tensor
    gradient: Tensor
    mean: Tensor
    square: Tensor
    steps: Tensor
    lr: float


_SHAPES = "value (..., C), gradient (..., C), exp_avg (..., C), exp_avg_sq (..., C), steps (...)"


def adam_rows(states: Sequence[AdamState], betas: tuple[float, float], eps: float) -> None:
    """Make one step of Adam, in place, of the rows whose gradient is not 0 throughout.

    ``m = b1 m + (1 - b1) g``, ``v = b2 v + (1 - b2) g^2``, and with n the steps that the row itself has
    made ``value -= lr m / (1 - b1^n) / (sqrt(v / (1 - b2^n)) + eps)``.

    Args:
        states: of parameters. The kernel takes all that are contiguous, float32 and on the CPU, at one go.
        betas, eps: as of Adam.

    Raises:
        ValueError: for shapes that do not go together, as an altered checkpoint may have.

    Cost: one look at the gradients; five numbers moved for each of the rows side by side, up to sixteen, of
    which one has a gradient.
    """
    fast = []
    for state in states:
        shape = state.value.shape
        if any(t.shape != shape for t in state[1:4]) or state.steps.shape != shape[:-1]:
            check_shapes(_SHAPES, *state[:5])  # says which
        if _fits_kernel(state):
            fast.append(state)
        else:
            _adam_reference(state, betas, eps)
    if fast:
        _adam_numba(fast, betas, eps)


def _fits_kernel(state: AdamState) -> bool:
    """Return whether the kernel takes it: it reads and writes float32 at addresses."""
    tensors, value = state[:5], state.value
    fits = all(t.dtype == torch.float32 and t.device == value.device for t in tensors)
    kept = all(t.is_contiguous() for t in (value, *tensors[2:]))  # a gradient may be copied
    return fits and kept and use_numba(value) and value.numel() > 0


def _adam_numba(states: list[AdamState], betas: tuple[float, float], eps: float) -> None:
    from forewarp.ops.kernels import adam as kernels

    match_threads()
    table, alive = [], []  # gradients must outlive the call
    for value, gradient, mean, square, steps, _ in states:
        alive.append(gradient.contiguous())
        width, tensors = value.shape[-1], (value, alive[-1], mean, square, steps)
        table.append([*(t.data_ptr() for t in tensors), value.numel() // width, width])
    rates = np.array([state.lr for state in states], np.float32)
    betas = tuple(map(float, betas))
    kernels.adam(np.array(table, np.int64), rates, *betas, float(eps), kernels.biases(*betas))


def _adam_reference(state: AdamState, betas: tuple[float, float], eps: float) -> None:
    """``adam_rows`` of one parameter in plain PyTorch. Picking rows by index would let a GPU's host wait."""
    value, gradient, mean, square, steps, lr = state
    seen = (gradient != 0).any(-1)
    steps += seen
    n, seen = steps[..., None], seen[..., None]
    m = betas[0] * mean + (1 - betas[0]) * gradient
    v = betas[1] * square + (1 - betas[1]) * gradient * gradient
    first, second = (1 - torch.pow(b, n) for b in betas)  # 0 in rows that have not been seen yet
    value -= torch.where(seen, lr * (m / first) / ((v / second).sqrt() + eps), 0)
    mean.copy_(torch.where(seen, m, mean))
    square.copy_(torch.where(seen, v, square))
