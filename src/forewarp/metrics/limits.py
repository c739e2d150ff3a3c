"""What keeps a picture from its truth: resolution, silhouettes, or what lies within them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forewarp.ops.grid import dilate

REGIONS = ("outside", "outline", "inside")


def low_passed(image: Tensor, pixels: float) -> Tensor:
    """The nearest picture that is linear between points ``pixels`` apart, as slices of a trilinear grid are.

    Not quite a bound: a grid's points lie elsewhere in every view, and its density makes edges of its own.

    Args:
        image: (H, W, 3) in [0, 1].
        pixels: from point to point; up to 1 the image itself.

    Returns:
        (H, W, 3): the least squares fit.
    """
    if pixels <= 1:
        return image
    rows, columns = (_projection(length, pixels) for length in image.shape[:2])
    return torch.einsum("ab,bcd,ec->aed", rows, image.double(), columns).to(image.dtype)


def _projection(length: int, pixels: float) -> Tensor:
    """Onto what is linear between points (length, length), float64."""
    places = (torch.arange(length).double() + 0.5) / pixels
    points = torch.arange(math.ceil(length / pixels) + 1).double()
    hats = (1 - (places[:, None] - points).abs()).clamp(min=0)
    return hats @ torch.linalg.pinv(hats)


def regions(foreground: Tensor, band: int = 2) -> dict[str, Tensor]:
    """Where the truth shows nothing, where its outline lies, and what is within: masks that share no pixel.

    Args:
        foreground: (H, W) bool.
        band: pixels on either side of the outline that belong to it.

    Returns:
        by the names of ``REGIONS``, (H, W) bool each.
    """

    outline = dilate(foreground, band) & dilate(~foreground, band)
    return {"outside": ~foreground & ~outline, "outline": outline, "inside": foreground & ~outline}


def error_shares(truth: Tensor, image: Tensor, foreground: Tensor) -> dict[str, Tensor]:
    """The squared error of each region, summed: their sum is the picture's.

    Args:
        truth, image: (H, W, 3).
        foreground: (H, W) bool, of the truth.
    """
    error = (truth - image).square().mean(-1)
    return {name: torch.where(mask, error, 0.0).sum() for name, mask in regions(foreground).items()}
