"""An image and its foreground mask in two files, as one image with alpha."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from forewarp.data.cache import CACHE
from forewarp.data.images import halved, read_sized

_FOREGROUND = 127  # a mask above it is foreground; masks are lossy, so never quite 0 or 255


class MaskedImage:
    """An image cut out by a mask, decoded when asked for: uint8 (H, W, 4), 0 where alpha is.

    Where the image has an alpha of its own, it counts inside the mask. Only the smallest rectangle that holds
    the foreground is kept, a fraction of most images.

    Args:
        image, mask: files of one size; a mask's first channel counts, above 127 is foreground.
        size: (width, height), what both must hold.
        halve: average 2 x 2 pixels; an odd last row or column is cut off.
    """

    def __init__(self, image: Path, mask: Path, size: tuple[int, int], halve: bool = False) -> None:
        self.image, self.mask, self.size, self.halve = image, mask, size, halve
        self._corner = (0, 0)

    def __call__(self) -> Tensor:
        """The pixels; raises SceneError where a file cannot be decoded or has another size."""
        part = CACHE.get(self, self._decode)
        (row, column), (rows, columns) = self._corner, part.shape[:2]
        width, height = (n // 2 if self.halve else n for n in self.size)
        whole = torch.zeros(height, width, 4, dtype=torch.uint8)
        whole[row : row + rows, column : column + columns] = part
        return whole

    def _decode(self) -> Tensor:
        """The foreground's rectangle; notes where it lies."""
        rgba = read_sized(self.image, self.size)
        on = (read_sized(self.mask, self.size)[..., 0] > _FOREGROUND) & (rgba[..., 3] > 0)
        rgba *= on[..., None]
        if self.halve:
            rgba = halved_cutout(rgba)
        foreground = rgba[..., 3] > 0
        if not bool(foreground.any()):
            return rgba[:0, :0].clone()
        rows, columns = (foreground.any(axis).nonzero()[:, 0] for axis in (1, 0))
        self._corner = (int(rows[0]), int(columns[0]))
        part = rgba[self._corner[0] : int(rows[-1]) + 1, self._corner[1] : int(columns[-1]) + 1]
        return part.clone()


def halved_cutout(rgba: Tensor) -> Tensor:
    """The mean of each 2 x 2 block, uint8 (H, W, 4) -> (H // 2, W // 2, 4), the colour its foreground's.

    What lies behind a cut-out is another place; averaged in, it would rim every silhouette.

    Args:
        rgba: colour 0 wherever alpha is 0; where it is not, pixels count alike.

    >>> halved_cutout(torch.tensor([[[9, 9, 9, 255], [0] * 4], [[0] * 4, [3, 3, 3, 255]]], dtype=torch.uint8))
    tensor([[[  6,   6,   6, 128]]], dtype=torch.uint8)
    """
    height, width = (n // 2 * 2 for n in rgba.shape[:2])
    rgba = rgba[:height, :width]
    blocks = rgba[..., :3].reshape(height // 2, 2, width // 2, 2, 3).int().sum((1, 3))
    count = (rgba[..., 3] > 0).reshape(height // 2, 2, width // 2, 2).sum((1, 3))[..., None].clamp(min=1)
    color = torch.div(blocks + count // 2, count, rounding_mode="floor").to(torch.uint8)
    return torch.cat([color, halved(rgba[..., 3:])], -1)
