"""Volume rendering: from densities along rays to weights, from weights to sums."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.checks import check_shape


def render_weights(optical: Tensor, ray_ids: Tensor, rays: int) -> tuple[Tensor, Tensor]:
    """``w_k = T_k (1 - exp(-x_k))``, ``T_k = exp(-sum_{j<k} x_j)`` (the paper's rendering equations).

    One cumulative sum in float64 runs over all rays and each ray's start is subtracted, so that rays do not
    affect each other. In log space the gradient is exact even for opaque samples.

    Args:
        optical: x = sigma * delta (P,) >= 0, the samples of a ray adjacent and in order.
        ray_ids: (P,) int64, ascending.
        rays: R, number of rays.

    Returns:
        weights (P,) and the final transmittance (R,), 1 for a ray without samples. Differentiable in
        ``optical``.

    Cost: one pass over P.

    >>> w, t = render_weights(torch.tensor([0.0, 1e30]), torch.tensor([0, 0]), 2)
    >>> w.tolist(), t.round(decimals=6).tolist()
    ([0.0, 1.0], [0.0, 1.0])
    """
    check_shape("optical", optical, ("P",))
    check_shape("ray_ids", ray_ids, (len(optical),))
    # An optical depth of 80 is opaque in float32; the cap keeps the global sum exact.
    x = optical.double().clamp(max=80.0)
    through = x.cumsum(0) - x
    counts = torch.zeros(rays, dtype=torch.int64, device=x.device).index_add_(
        0, ray_ids, torch.ones_like(ray_ids)
    )
    starts = counts.cumsum(0) - counts
    offset = torch.cat([through, through.new_zeros(1)])[
        starts
    ]  # a last ray without samples starts at the end
    before = (through - offset[ray_ids]).clamp(min=0)
    weights = torch.exp(-before) * -torch.expm1(-x)
    total = torch.zeros(rays, dtype=x.dtype, device=x.device).index_add(0, ray_ids, x)
    return weights.to(optical.dtype), torch.exp(-total).to(optical.dtype)


def accumulate(weights: Tensor, values: Tensor, ray_ids: Tensor, rays: int) -> Tensor:
    """Sum ``w_k v_k`` over the samples of each ray.

    Args:
        weights: (P,).
        values: (P, C).
        ray_ids: (P,) int64.
        rays: R, number of rays.

    Returns:
        (R, C), 0 for a ray without samples. Differentiable in both.
    """
    check_shape("values", values, (len(weights), "C"))
    return values.new_zeros(rays, values.shape[1]).index_add(0, ray_ids, weights[:, None] * values)


def dense_weights(optical: Tensor) -> tuple[Tensor, Tensor]:
    """``render_weights`` for rays with equal numbers of samples.

    Args:
        optical: x = sigma * delta (R, S) >= 0, in order along each ray; may be infinite.

    Returns:
        weights (R, S) and the final transmittance (R,). Differentiable in ``optical``.

    Cost: one pass over R S, in the dtype of ``optical``.

    >>> w, t = dense_weights(torch.tensor([[0.0, 1e30, 1.0]]))
    >>> w.round(decimals=6).tolist(), t.round(decimals=6).tolist()
    ([[0.0, 1.0, 0.0]], [0.0])
    """
    check_shape("optical", optical, ("R", "S"))
    x = optical.clamp(max=80.0)
    # Shift instead of subtracting, which would lose digits behind an opaque sample.
    before = torch.cat([torch.zeros_like(x[:, :1]), x.cumsum(1)], 1)
    through = torch.exp(-before)
    return through[:, :-1] * -torch.expm1(-x), through[:, -1]
