"""Image similarity: PSNR, SSIM and MS-SSIM of 8-bit images.

Every function takes a prediction and a target (H, W, 3), floats in [0, 1], and rounds both to 8 bits first,
so that a number can be reproduced from the saved PNG files. SSIM is computed in float64: in float32 the
variance of a flat region cancels, and two equal white images score 0.9985 instead of 1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from forewarp.metrics.limits import MS_SSIM_LEAST_SIDE, SSIM_LEAST_SIDE
from forewarp.ops.backend import check_shapes

PSNR_CAP = 100.0
_REACH = 5  # pixels of a window on either side of its middle
_C1, _C2 = 0.01**2, 0.03**2
_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def quantise(image: Tensor) -> Tensor:
    """Clip an image (...,) to [0, 1] and round it to steps of 1/255, as an 8-bit file does; float64.

    >>> (quantise(torch.tensor([-0.1, 0.5, 1.0])) * 255).tolist()
    [0.0, 128.0, 255.0]
    """
    return (image.detach().to("cpu", torch.float64).clamp(0, 1) * 255).round() / 255


def image_pair(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Check both images and round them to 8 bits, (H, W, 3) float64 on the CPU.

    A prediction outside [0, 1] by less than 1 is clipped, as saving does.

    Raises:
        ValueError: for another shape, dtype or range, or values that are not finite.
    """
    check_shapes("target (H, W, 3), prediction (H, W, 3)", target, prediction)
    for name, image, slack in (("prediction", prediction, 1.0), ("target", target, 1e-3)):
        if not image.numel():
            raise ValueError(f"{name}: expected pixels, but got shape {tuple(image.shape)}")
        if not image.is_floating_point():
            raise ValueError(f"{name}: expected floats in [0, 1], but got {image.dtype}; divide by 255")
        if bad := int((~torch.isfinite(image)).sum()):
            got = f"{bad} of {image.numel()} NaN or infinite"
            raise ValueError(f"{name}: expected finite values, but got {got}")
        low, high = float(image.min()), float(image.max())
        if low < -slack or high > 1 + slack:
            raise ValueError(f"{name}: expected values in [0, 1], but got [{low:.4g}, {high:.4g}]")
    return quantise(prediction), quantise(target)


def psnr(prediction: Tensor, target: Tensor) -> float:
    r"""Peak signal-to-noise ratio of one image in dB, :math:`-10 \log_{10} \mathrm{MSE}`, at most 100.

    Report the mean over images. Pooling the MSE of all images first, as torchmetrics' class does by default,
    gives a smaller number. The cap keeps the mean finite for equal images.

    >>> round(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.2)), 6)
    13.9794
    """
    a, b = image_pair(prediction, target)
    error = float((a - b).square().mean())
    return PSNR_CAP if error == 0 else min(PSNR_CAP, -10 * math.log10(error))


def ssim(prediction: Tensor, target: Tensor) -> float | None:
    """Structural similarity: Gaussian window of 11 pixels and sigma 1.5, data range 1, mean over all pixels.

    Borders are reflected. Equal to torchmetrics' function in float64, which takes about four times the time
    and three times the memory for 800 x 800 pixels.

    Returns:
        None for an image with a side below 11 pixels, as the window does not fit.

    Cost: 22 multiply-adds per pixel and channel, for each of five blurred images.
    """
    a, b = image_pair(prediction, target)
    if min(a.shape[:2]) < SSIM_LEAST_SIDE:
        return None
    a, b = (F.pad(x.permute(2, 0, 1), (5, 5, 5, 5), mode="reflect") for x in (a, b))
    return float(_similarity(a, b)[0].mean())


def masked_ssim(prediction: Tensor, target: Tensor, mask: Tensor) -> float | None:
    """Structural similarity of the pixels of a mask (H, W) bool, as dycheck's mSSIM.

    Every mean over a window is over its pixels in the mask alone, first along rows, then along columns, as in
    a partial convolution; windows stay inside the image. A window without any such pixel counts as 1, which
    their code gives as well: a number over few pixels is higher than over many.

    Returns:
        None for an image with a side below 11 pixels, as the window does not fit, and for an empty mask.

    Source: Gao et al., "Monocular Dynamic View Synthesis: A Reality Check" (2022).
    """
    a, b = (x.permute(2, 0, 1) for x in image_pair(prediction, target))
    if min(a.shape[1:]) < SSIM_LEAST_SIDE or not bool(mask.any()):
        return None
    means, inside = torch.stack([a, b, a * a, b * b, a * b]), mask.to(a)
    for axis in (-1, -2):
        length = means.shape[axis] - 2 * _REACH
        inner = means * inside
        blurred = sum(w * inner.narrow(axis, k, length) for k, w in enumerate(_window()))
        count = sum(inside.narrow(axis, k, length) for k in range(2 * _REACH + 1))
        means = torch.where(count > 0, blurred * (2 * _REACH + 1) / count.clamp(min=1), 0.0)
        inside = (count > 0).to(a)
    mean_a, mean_b, square_a, square_b, product = means
    variance_a, variance_b = ((s - m**2).clamp(min=0) for s, m in ((square_a, mean_a), (square_b, mean_b)))
    most = (variance_a * variance_b).sqrt()
    covariance = (product - mean_a * mean_b).clamp(-most, most)
    similarity = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    return float((similarity / ((mean_a**2 + mean_b**2 + _C1) * (variance_a + variance_b + _C2))).mean())


def ms_ssim(prediction: Tensor, target: Tensor) -> float | None:
    """Structural similarity over five scales, mean over channels, as ``tf.image.ssim_multiscale``.

    Windows stay inside the image; halving an odd side keeps its last row or column. (torchmetrics treats
    borders and odd sides differently.)

    Returns:
        None for an image with a side below 161 pixels, as the window does not fit the coarsest scale.
    """
    a, b = (x.permute(2, 0, 1) for x in image_pair(prediction, target))
    return _multi_scale(a, b, lambda x: F.avg_pool2d(x, 2, ceil_mode=True))


def ms_ssim_legacy(prediction: Tensor, target: Tensor) -> float | None:
    """MS-SSIM as TiNeuVox and NDVG compute it, only for comparison with their published numbers.

    Their code reshapes (H, W, 3) to (3, H, W) without a permute, so a "channel" is a third of the image with
    interleaved colours. That raises the score of a blurred or shifted image by up to 0.07; for an object on
    white it may lower the score.

    Returns:
        None for an image with a side below 161 pixels.
    """
    a, b = (x.reshape(3, *x.shape[:2]) for x in image_pair(prediction, target))
    # Their library pads odd sides with zeros on both ends.
    return _multi_scale(a, b, lambda x: F.avg_pool2d(x, 2, padding=[s % 2 for s in x.shape[-2:]]))


def _multi_scale(a: Tensor, b: Tensor, halve) -> float | None:
    """The product over scales of contrast (all but the last) and similarity (the last), images (C, H, W)."""
    if min(a.shape[-2:]) < MS_SSIM_LEAST_SIDE:
        return None
    value = torch.ones(len(a), dtype=a.dtype)
    for scale, weight in enumerate(_SCALE_WEIGHTS):
        similarity, contrast = _similarity(a, b)
        last = scale == len(_SCALE_WEIGHTS) - 1
        # A negative base has no real power; both libraries clamp it at 0.
        value = value * (similarity if last else contrast).mean((-2, -1)).relu() ** weight
        if not last:
            a, b = halve(a), halve(b)
    return float(value.mean())


def _similarity(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Similarity and contrast in every full window of two images (C, H, W) -> (C, H-10, W-10).

    One channel after the other, as float64 of all takes most of a gigabyte at 1352 x 1014 pixels.
    """
    channels = [_similarity_of_channel(*pair) for pair in zip(a, b)]
    similarity, contrast = (torch.stack(values) for values in zip(*channels))
    return similarity, contrast


def _similarity_of_channel(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    mean_a, mean_b, square_a, square_b, product = _blur(torch.stack([a, b, a * a, b * b, a * b]))
    variances = (square_a - mean_a**2).clamp_min(0) + (square_b - mean_b**2).clamp_min(0)
    contrast = (2 * (product - mean_a * mean_b) + _C2) / (variances + _C2)
    return contrast * (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1), contrast


def _blur(images: Tensor) -> Tensor:
    """The Gaussian mean over 11 x 11 pixels, (..., H, W) -> (..., H-10, W-10), one axis after the other."""
    for axis in (-2, -1):
        length = images.shape[axis] - 2 * _REACH
        # Sums of shifted images: PyTorch's float64 convolution takes several times as long.
        images = sum(w * images.narrow(axis, k, length) for k, w in enumerate(_window()))
    return images


def _window() -> list[float]:
    """Return the weights of a Gaussian window of 11 pixels."""
    weights = torch.exp(-(torch.arange(-_REACH, _REACH + 1, dtype=torch.float64) ** 2) / (2 * 1.5**2))
    return (weights / weights.sum()).tolist()
