"""The paper's seven terms, each a pure function of tensors.

Each normalises as its ancestors do, because the printed weights are calibrated to that; ``literal=True``
gives the printed form where the two differ.
"""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.variation import patch_variation, total_variation


def photometric(rgb: Tensor, truth: Tensor, *, literal: bool = False) -> Tensor:
    """Squared error of the rendered colour, (R, 3) both: mean over rays and channels.

    Literal: sums the channels.
    """
    error = (rgb - truth).square()
    return error.sum(-1).mean() if literal else error.mean()


def point_color(
    weights: Tensor, colors: Tensor, ray_ids: Tensor, truth: Tensor, *, all_ray_ids: Tensor | None = None
) -> Tensor:
    """w1: ``sum_k w_k ||c_k - truth||^2`` over the samples of a ray, mean over rays; w without gradient.

    Args:
        weights: (S,). colors: (S, 3). ray_ids: (S,) int64. truth: (R, 3).
        all_ray_ids: (P,) int64, the rays of all samples, those included that are too faint for a colour:
            gives the printed 1/K, K the number of a ray's samples; None: without it.
    """
    per_sample = weights.detach() * (colors - truth[ray_ids]).square().sum(-1)
    if all_ray_ids is not None:
        count = torch.bincount(all_ray_ids, minlength=len(truth))
        per_sample = per_sample / count[ray_ids]
    return per_sample.sum() / max(len(truth), 1)


def background_entropy(transmittance: Tensor) -> Tensor:
    """w2: binary entropy of a ray's final transmittance (R,), kept 1e-6 off 0 and 1 for a finite slope."""
    t = transmittance.clamp(1e-6, 1 - 1e-6)
    return -(t * torch.log(t) + (1 - t) * torch.log1p(-t)).mean()


def sample_entropy(weights: Tensor) -> Tensor:
    """w2 as printed: binary entropy of every sample's weight (P,), mean; 0 where there is no sample."""
    if not len(weights):
        return weights.sum()
    return background_entropy(weights)


def flow_l1(flow: Tensor) -> Tensor:
    """w3: mean absolute flow (N, 3)."""
    return flow.abs().mean() if flow.numel() else flow.sum()


def inpaint_diff(residual: Tensor) -> Tensor:
    """w4: mean absolute difference of the inpainted and the up-sampled grid."""
    return residual.abs().mean()


def tv_density(raw_density: Tensor, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """w5: total variation of the canonical raw density (N,) over neighbouring voxels."""
    return total_variation(raw_density[:, None], pairs)


def tv_flow(flow: Tensor, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """w6: total variation of the flow (N, 3) over neighbouring voxels."""
    return total_variation(flow, pairs)


def tv_depth(depth: Tensor, opacity: Tensor) -> Tensor:
    """w7: RegNeRF's smoothness of depth (B, S, S), in fractions of far - near, on patches of random views."""
    return patch_variation(depth, opacity)


def moving_opacity(alpha: Tensor) -> Tensor:
    """Mean opacity (N,) over a voxel of the grid that moves: what a static background explains, it should."""
    return alpha.mean() if alpha.numel() else alpha.sum()


def still_points(displacement: Tensor) -> Tensor:
    """Squared displacement (N, 3) of points that are known to stand still, mean over points (Nerfies)."""
    return displacement.square().sum(-1).mean()
