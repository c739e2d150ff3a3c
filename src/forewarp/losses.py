"""The loss terms, each a pure function of tensors; w1 to w7 are the paper's weights.

Each normalises as the works it comes from do, because the paper's weights are calibrated to that. The printed
equation is given by ``literal=True``, or by a function of its own, where it differs.
"""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.grid import patch_variation, total_variation


def mean_over_rays(values: Tensor, shares: Tensor | None) -> Tensor:
    """Mean of values (R,) of rays, each counted ``shares`` (R,) times; None: each once."""
    return values.mean() if shares is None else (values * shares).mean()


def photometric(rgb: Tensor, truth: Tensor, *, literal: bool = False, shares: Tensor | None = None) -> Tensor:
    """Squared error of the colours (R, 3), mean over rays and channels; literal: summed over channels."""
    error = (rgb - truth).square()
    return mean_over_rays(error.sum(-1) if literal else error.mean(-1), shares)


def point_color(
    weights: Tensor, colors: Tensor, ray_ids: Tensor, truth: Tensor, *, all_ray_ids: Tensor | None = None,
    shares: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """w1: ``sum_k w_k ||c_k - truth||^2`` over the samples of a ray, mean over rays.

    Args:
        weights: (S,) of the samples that have a colour; no gradient passes through them.
        colors: (S, 3).
        ray_ids: (S,) int64.
        truth: (R, 3).
        all_ray_ids: (P,) int64, the rays of all samples, including those too faint to have a colour: divide
            by a ray's number of samples, as printed. None: do not divide.
        shares: as of ``mean_over_rays``.
    """
    per_sample = weights.detach() * (colors - truth[ray_ids]).square().sum(-1)
    if all_ray_ids is not None:
        per_sample = per_sample / torch.bincount(all_ray_ids, minlength=len(truth))[ray_ids]
    if shares is not None:
        per_sample = per_sample * shares[ray_ids]
    return per_sample.sum() / max(len(truth), 1)


def background_entropy(transmittance: Tensor, shares: Tensor | None = None) -> Tensor:
    """w2: mean binary entropy of the rays' final transmittance (R,), clamped to have a finite slope."""
    t = transmittance.clamp(1e-6, 1 - 1e-6)
    return mean_over_rays(-(t * torch.log(t) + (1 - t) * torch.log1p(-t)), shares)


def sample_entropy(weights: Tensor) -> Tensor:
    """w2 as printed: mean binary entropy of the samples' weights (P,); 0 without samples."""
    return background_entropy(weights) if len(weights) else weights.sum()


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


def robust(image: Tensor, truth: Tensor, width: float) -> Tensor:
    """``sqrt(e^2 + width^2) - width`` of the errors of images (H, W, 3), summed over pixels and channels."""
    return ((image - truth).square() + width**2).sqrt().sub(width).sum()


def dssim(image: Tensor, truth: Tensor) -> Tensor:
    """Structural dissimilarity ``(1 - SSIM) / 2`` of images (H, W, 3), summed over pixels and channels.

    Windows are Gaussian, 11 pixels wide and of sigma 1.5; beyond the border images are 0.

    Source: Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity" (2004).
    """
    offsets = torch.arange(-5, 6).to(image)
    row = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = (row[:, None] * row / row.sum() ** 2)[None, None]
    a, b = (x.permute(2, 0, 1)[:, None] for x in (image, truth))
    blurred = (torch.nn.functional.conv2d(x, window, padding=5) for x in (a, b, a * a, b * b, a * b))
    mean_a, mean_b, square_a, square_b, product = blurred
    covariance = 2 * (product - mean_a * mean_b) + 0.03**2
    variances = square_a - mean_a**2 + square_b - mean_b**2 + 0.03**2
    means = (2 * mean_a * mean_b + 0.01**2) / (mean_a**2 + mean_b**2 + 0.01**2)
    return (1 - means * covariance / variances).sum() / 2


# Terms of methods that compare whole images, besides ``photo``: sums over an image's pixels and channels.
IMAGE_LOSSES = {"dssim": dssim}
