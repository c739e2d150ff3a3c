"""Accuracy of depth maps."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.metrics.registry import THRESHOLDS


def depth_delta(
    prediction: Tensor,
    truth: Tensor,
    foreground: Tensor | None = None,
    thresholds: tuple[float, ...] = THRESHOLDS,
) -> tuple[float, ...] | None:
    r"""Return the fraction of foreground pixels with :math:`\max(d / d^*, d^* / d)` below each threshold.

    Args:
        prediction: ray depth (H, W), world units; values that are not finite and positive count as wrong.
        truth: exact ray depth (H, W), same units, 0 on the background.
        foreground: (H, W) bool; None: all pixels. Pixels without a true depth never count.
        thresholds: each above 1.

    Returns:
        one fraction in [0, 1] per threshold, or None if there is no foreground.

    Raises:
        ValueError: for shapes that differ, or a threshold <= 1, which nothing can meet.

    >>> depth_delta(torch.tensor([[1.0, 1.2, 9.0]]), torch.tensor([[1.0, 1.0, 0.0]]), thresholds=(1.1, 1.25))
    (0.5, 1.0)
    """
    for name, other in (("depth", prediction), ("foreground", foreground)):
        if other is not None and other.shape != truth.shape:
            raise ValueError(
                f"{name}: expected the true depth's shape {tuple(truth.shape)}, but got {tuple(other.shape)}"
            )
    if min(thresholds, default=0) <= 1:
        raise ValueError(f"thresholds: expected ratios above 1, but got {thresholds}")
    prediction, truth = prediction.detach().cpu().double(), truth.cpu().double()
    inside = (truth > 0) & torch.isfinite(truth)
    if foreground is not None:
        inside &= foreground.cpu().bool()
    if not inside.any():
        return None
    d, exact = prediction[inside], truth[inside]
    usable = torch.isfinite(d) & (d > 0)
    safe = torch.where(usable, d, exact)
    ratio = torch.where(usable, torch.maximum(safe / exact, exact / safe), torch.inf)
    return tuple(float((ratio < t).double().mean()) for t in thresholds)
