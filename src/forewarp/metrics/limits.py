"""Find where errors come from: resolution, outlines, or the inside of objects."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forewarp.ops.grid import dilate

REGIONS = ("outside", "outline", "inside")


def low_passed(image: Tensor, pixels: float) -> Tensor:
    """Fit an image that is linear between points ``pixels`` apart, like a slice of a trilinear grid.

    Not a strict bound for a grid: grid points lie elsewhere in every view, and density makes edges.

    Args:
        image: (H, W, 3) in [0, 1].
        pixels: distance of the points; at most 1 returns the image itself.

    Returns:
        (H, W, 3), the least-squares fit.
    """
    if pixels <= 1:
        return image
    rows, columns = (_projection(length, pixels) for length in image.shape[:2])
    return torch.einsum("ab,bcd,ec->aed", rows, image.double(), columns).to(image.dtype)


def _projection(length: int, pixels: float) -> Tensor:
    """Return the projection (length, length) onto functions linear between the points, float64."""
    places = (torch.arange(length).double() + 0.5) / pixels
    points = torch.arange(math.ceil(length / pixels) + 1).double()
    hats = (1 - (places[:, None] - points).abs()).clamp(min=0)
    return hats @ torch.linalg.pinv(hats)


def regions(foreground: Tensor, band: int = 2) -> dict[str, Tensor]:
    """Divide an image into the outside, the outline and the inside of its foreground.

    Args:
        foreground: (H, W) bool.
        band: half the width of the outline, in pixels.

    Returns:
        disjoint masks (H, W) bool by the names in ``REGIONS``.
    """
    outline = dilate(foreground, band) & dilate(~foreground, band)
    return {"outside": ~foreground & ~outline, "outline": outline, "inside": foreground & ~outline}


def error_shares(truth: Tensor, image: Tensor, foreground: Tensor) -> dict[str, Tensor]:
    """Sum the squared error in each region; the sums add up to the error of the image.

    Args:
        truth, image: (H, W, 3).
        foreground: (H, W) bool, the true foreground.
    """
    error = (truth - image).square().mean(-1)
    return {name: torch.where(mask, error, 0.0).sum() for name, mask in regions(foreground).items()}
