"""Volume rendering of packed samples."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.checks import check_shape


def render_weights(optical: Tensor, ray_ids: Tensor, rays: int) -> tuple[Tensor, Tensor]:
    """``w_k = T_k (1 - exp(-x_k))``, ``T_k = exp(-sum_{j<k} x_j)`` (the paper's rendering equations).

    The sum runs over all rays at once in float64 and each ray's start is subtracted, so that a ray's weights
    do not depend on its neighbours; in log space the gradient is exact also where a sample is opaque.

    Args:
        optical: x = sigma * delta (P,) >= 0, samples of a ray adjacent and in order.
        ray_ids: (P,) int64, ascending.
        rays: R.

    Returns:
        weights (P,) and the final transmittance (R,), 1 where a ray has no sample. Differentiable in
        ``optical``.

    Cost: one pass over P.

    >>> w, t = render_weights(torch.tensor([0.0, 1e30]), torch.tensor([0, 0]), 2)
    >>> w.tolist(), t.round(decimals=6).tolist()
    ([0.0, 1.0], [0.0, 1.0])
    """
    check_shape("optical", optical, ("P",))
    check_shape("ray_ids", ray_ids, (len(optical),))
    # An optical depth of 80 is opaque to the last bit of a float32; the cap keeps the global sum exact.
    x = optical.double().clamp(max=80.0)
    through = x.cumsum(0) - x
    counts = torch.zeros(rays, dtype=torch.int64, device=x.device).index_add_(
        0, ray_ids, torch.ones_like(ray_ids)
    )
    starts = counts.cumsum(0) - counts
    offset = torch.cat([through, through.new_zeros(1)])[starts]  # a ray without samples may start at the end
    before = (through - offset[ray_ids]).clamp(min=0)
    weights = torch.exp(-before) * -torch.expm1(-x)
    total = torch.zeros(rays, dtype=x.dtype, device=x.device).index_add(0, ray_ids, x)
    return weights.to(optical.dtype), torch.exp(-total).to(optical.dtype)


def accumulate(weights: Tensor, values: Tensor, ray_ids: Tensor, rays: int) -> Tensor:
    """``sum_k w_k v_k`` per ray.

    Args:
        weights: (P,).
        values: (P, C).
        ray_ids: (P,) int64.
        rays: R.

    Returns:
        (R, C), 0 where a ray has no sample. Differentiable in both.
    """
    check_shape("values", values, (len(weights), "C"))
    return values.new_zeros(rays, values.shape[1]).index_add(0, ray_ids, weights[:, None] * values)


def dense_weights(optical: Tensor) -> tuple[Tensor, Tensor]:
    """``render_weights`` where every ray has the same number of samples.

    Args:
        optical: x = sigma * delta (R, S) >= 0, in order along each ray; it may be infinite.

    Returns:
        weights (R, S) and the final transmittance (R,). Differentiable in ``optical``.

    Cost: one pass over R S, no wider than its dtype.

    >>> w, t = dense_weights(torch.tensor([[0.0, 1e30, 1.0]]))
    >>> w.round(decimals=6).tolist(), t.round(decimals=6).tolist()
    ([[0.0, 1.0, 0.0]], [0.0])
    """
    check_shape("optical", optical, ("R", "S"))
    x = optical.clamp(max=80.0)
    # Shifted, not subtracted: beside an opaque sample a difference would keep few digits.
    before = torch.cat([torch.zeros_like(x[:, :1]), x.cumsum(1)], 1)
    through = torch.exp(-before)
    return through[:, :-1] * -torch.expm1(-x), through[:, -1]
