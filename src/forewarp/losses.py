"""The loss terms, each a pure function of tensors; w1 to w7 are the paper's weights.

Each normalises as the works it comes from do, because the paper's weights are calibrated to that. The printed
equation is given by ``literal=True``, or by a function of its own, where it differs.
"""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.grid import patch_variation, total_variation


def photometric(rgb: Tensor, truth: Tensor, *, literal: bool = False) -> Tensor:
    """Squared error of the colours (R, 3), mean over rays and channels; literal: summed over channels."""
    error = (rgb - truth).square()
    return error.sum(-1).mean() if literal else error.mean()


def point_color(
    weights: Tensor, colors: Tensor, ray_ids: Tensor, truth: Tensor, *, all_ray_ids: Tensor | None = None
) -> Tensor:
    """w1: ``sum_k w_k ||c_k - truth||^2`` over the samples of a ray, mean over rays.

    Args:
        weights: (S,) of the samples that have a colour; no gradient passes through them.
        colors: (S, 3).
        ray_ids: (S,) int64.
        truth: (R, 3).
        all_ray_ids: (P,) int64, the rays of all samples, including those too faint to have a colour: divide
            by a ray's number of samples, as printed. None: do not divide.
    """
    per_sample = weights.detach() * (colors - truth[ray_ids]).square().sum(-1)
    if all_ray_ids is not None:
        count = torch.bincount(all_ray_ids, minlength=len(truth))
        per_sample = per_sample / count[ray_ids]
    return per_sample.sum() / max(len(truth), 1)


def background_entropy(transmittance: Tensor) -> Tensor:
    """w2: mean binary entropy of the rays' final transmittance (R,), clamped to have a finite slope."""
    t = transmittance.clamp(1e-6, 1 - 1e-6)
    return -(t * torch.log(t) + (1 - t) * torch.log1p(-t)).mean()


def sample_entropy(weights: Tensor) -> Tensor:
    """w2 as printed: mean binary entropy of the samples' weights (P,); 0 without samples."""
    if not len(weights):
        return weights.sum()
    return background_entropy(weights)


def flow_l1(flow: Tensor) -> Tensor:
    """w3: mean absolute flow (N, 3)."""
    return flow.abs().mean() if flow.numel() else flow.sum()


def inpaint_diff(residual: Tensor) -> Tensor:
    """w4: mean absolute difference between the inpainted and the up-sampled grid."""
    return residual.abs().mean()


def tv_density(raw_density: Tensor, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """w5: total variation of the canonical raw density (N,) over pairs of neighbouring voxels."""
    return total_variation(raw_density[:, None], pairs)


def tv_flow(flow: Tensor, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """w6: total variation of the flow (N, 3) over pairs of neighbouring voxels."""
    return total_variation(flow, pairs)


def tv_depth(depth: Tensor, opacity: Tensor) -> Tensor:
    """w7: RegNeRF's depth smoothness on patches (B, S, S) from random views; depth in units of far - near."""
    return patch_variation(depth, opacity)


def moving_opacity(alpha: Tensor) -> Tensor:
    """Mean opacity (N,) of the moving grid's voxels: leave to the static background what it can explain."""
    return alpha.mean() if alpha.numel() else alpha.sum()


def static_points(displacement: Tensor) -> Tensor:
    """Squared displacement (N, 3) of points known to be static, mean over points (Nerfies)."""
    return displacement.square().sum(-1).mean()
