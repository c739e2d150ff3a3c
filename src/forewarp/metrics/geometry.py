"""Accuracy of geometry: depth maps, shapes and point trajectories."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.metrics.limits import THRESHOLDS
from forewarp.ops.backend import check_shapes

MOVING_FRACTION = 0.02


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
    check_shapes("truth (H, W), depth (H, W)", truth, prediction)
    if foreground is not None:
        check_shapes("truth (H, W), foreground (H, W)", truth, foreground)
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
    check_shapes("truth (N, T, 3), predicted (N, T, 3)", truth, predicted)
    if len(truth) < 1 or truth.shape[1] < 2:
        raise ValueError(f"truth: expected N >= 1 and T >= 2, but got shape {tuple(truth.shape)}")
    for name, points in (("predicted", predicted), ("truth", truth)):
        if bad := int((~torch.isfinite(points)).sum()):
            raise ValueError(
                f"{name}: expected finite places, but got {bad} of {points.numel()} NaN or infinite"
            )
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


def chamfer(predicted: Tensor, truth: Tensor) -> dict[str, float] | None:
    r"""Compare two surfaces given as points, in world units.

    .. math:: \mathrm{chamfer} = \tfrac12 \Big( \underbrace{\tfrac1{|P|} \sum_{p \in P} \min_{q \in Q}
        |p - q|}_{\text{accuracy}} + \underbrace{\tfrac1{|Q|} \sum_{q \in Q} \min_{p \in P}
        |p - q|}_{\text{completeness}} \Big)

    Args:
        predicted: points P (N, 3).
        truth: points Q (M, 3).

    Returns:
        ``chamfer``, ``accuracy``, ``completeness``; None if a surface has no points.

    >>> chamfer(torch.zeros(1, 3), torch.tensor([[0.0, 0, 0], [0, 0, 3]]))
    {'chamfer': 0.75, 'accuracy': 0.0, 'completeness': 1.5}
    """
    from scipy.spatial import cKDTree  # late, as its import takes time

    points = [given.detach().cpu().double().numpy() for given in (predicted, truth)]
    if not all(map(len, points)):
        return None
    trees = [cKDTree(given) for given in points]
    accuracy, completeness = (float(trees[1 - i].query(points[i])[0].mean()) for i in (0, 1))
    return {"chamfer": (accuracy + completeness) / 2, "accuracy": accuracy, "completeness": completeness}


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if values.numel() else None
