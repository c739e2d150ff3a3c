"""What keeps a picture from its truth: resolution, silhouettes, or what lies within them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

REGIONS = ("outside", "outline", "inside")


def low_passed(image: Tensor, pixels: float) -> Tensor:
    """What a lattice whose voxels are ``pixels`` wide in the picture could show at best.

    Args:
        image: (H, W, 3) in [0, 1].
        pixels: a voxel's width; up to 1 the image itself.

    Returns:
        (H, W, 3): averaged over a voxel and linear between voxels, as a trilinear grid is.
    """
    if pixels <= 1:
        return image
    height, width = image.shape[:2]
    coarse = (max(round(height / pixels), 1), max(round(width / pixels), 1))
    planes = image.movedim(-1, 0)[None]
    sampled = functional.interpolate(planes, size=coarse, mode="area")
    return functional.interpolate(sampled, size=(height, width), mode="bilinear")[0].movedim(0, -1)


def regions(foreground: Tensor, band: int = 2) -> dict[str, Tensor]:
    """Where the truth shows nothing, where its outline lies, and what is within: masks that share no pixel.

    Args:
        foreground: (H, W) bool.
        band: pixels on either side of the outline that belong to it.

    Returns:
        by the names of ``REGIONS``, (H, W) bool each.
    """

    def grown(mask: Tensor) -> Tensor:
        side = 2 * band + 1
        return functional.max_pool2d(mask[None, None].float(), side, stride=1, padding=band)[0, 0] > 0

    outline = grown(foreground) & grown(~foreground)
    return {"outside": ~foreground & ~outline, "outline": outline, "inside": foreground & ~outline}


def error_shares(truth: Tensor, image: Tensor, foreground: Tensor) -> dict[str, Tensor]:
    """The squared error of each region, summed: their sum is the picture's.

    Args:
        truth, image: (H, W, 3).
        foreground: (H, W) bool, of the truth.
    """
    error = (truth - image).square().mean(-1)
    return {name: torch.where(mask, error, 0.0).sum() for name, mask in regions(foreground).items()}
