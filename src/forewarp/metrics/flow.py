"""Accuracy of point trajectories."""

from __future__ import annotations

import torch
from torch import Tensor

MOVING_FRACTION = 0.02


def end_point_error(
    predicted: Tensor, truth: Tensor, moving_threshold: float | None = None
) -> dict[str, float | int | None]:
    r"""Mean distance of tracked points from their true positions, separately for moving and static points.

    .. math:: \mathrm{EPE} = \frac{1}{|P| (T - 1)} \sum_{p \in P} \sum_{t \ge 1} |x_{pt} - x^*_{pt}|

    The first time is left out: it is canonical, where a method is exact by construction.

    Args:
        predicted: positions (N, T, 3), world units.
        truth: true positions (N, T, 3) at the same times, the first canonical.
        moving_threshold: world units; a point moves if its true displacement from its canonical position ever
            exceeds this. None: 0.02 of the diagonal of the points' canonical bounding box.

    Returns:
        ``epe_moving``, ``epe_still`` (of static points) and ``motion_mean`` (the mean true displacement of
        moving points, which a static prediction scores), in world units, None if there are no such points;
        ``count_moving``, ``count_still``; ``moving_threshold`` as used.

    Raises:
        ValueError: for shapes other than (N, T, 3) with T >= 2, shapes that differ, or values not finite.

    >>> truth = torch.tensor([[[0.0, 0, 0], [1, 0, 0]], [[0, 0, 1], [0, 0, 1]]])
    >>> scores = end_point_error(truth[:, :1].expand(2, 2, 3), truth, moving_threshold=0.1)
    >>> scores["epe_moving"], scores["epe_still"], scores["motion_mean"]
    (1.0, 0.0, 1.0)
    """
    _check_points(predicted, truth)
    predicted, truth = predicted.detach().cpu().double(), truth.cpu().double()
    if moving_threshold is None:
        canonical = truth[:, 0]
        moving_threshold = MOVING_FRACTION * float((canonical.amax(0) - canonical.amin(0)).norm())
    error = (predicted - truth)[:, 1:].norm(dim=-1)
    motion = (truth[:, 1:] - truth[:, :1]).norm(dim=-1)
    moving = motion.amax(1) > moving_threshold
    return {
        "epe_moving": _mean(error[moving]),
        "epe_still": _mean(error[~moving]),
        "motion_mean": _mean(motion[moving]),
        "count_moving": int(moving.sum()),
        "count_still": int((~moving).sum()),
        "moving_threshold": float(moving_threshold),
    }


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if values.numel() else None


def _check_points(predicted: Tensor, truth: Tensor) -> None:
    if truth.ndim != 3 or truth.shape[-1] != 3 or truth.shape[0] < 1 or truth.shape[1] < 2:
        raise ValueError(
            f"true points: expected (N, T, 3) with N >= 1 and T >= 2, but got shape {tuple(truth.shape)}"
        )
    if predicted.shape != truth.shape:
        raise ValueError(
            f"predicted points: expected shape {tuple(truth.shape)}, but got {tuple(predicted.shape)}"
        )
    for name, points in (("predicted points", predicted), ("true points", truth)):
        bad = int((~torch.isfinite(points)).sum())
        if bad:
            raise ValueError(
                f"{name}: expected finite places, but got {bad} of {points.numel()} NaN or infinite"
            )
