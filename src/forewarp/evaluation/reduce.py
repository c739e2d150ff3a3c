"""Make rendered views smaller as the datasets make their pictures smaller."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.blocks import block_means, reduced_depth
from forewarp.scene.view import Rendering

_LEAST = 0.5 / 255  # alpha that 8 bits round to 0, where stored colours are 0 too


def reduced_rendering(
    rendering: Rendering, shape: tuple[int, int], by: int, background: Tensor, *, straight: bool
) -> Rendering:
    """Average each block of ``by`` x ``by`` pixels of a whole rendered picture.

    Pictures with alpha are stored straight and averaged before the alpha is applied, which darkens
    silhouettes; so is the rendering then, or it would be compared with another outline than it was fitted to.

    Args:
        rendering: of the whole picture, over ``background``.
        shape: its (height, width).
        by: side of a block; it divides both.
        background: colour (3,) behind the picture.
        straight: whether the scene's pictures have alpha.
    """
    rgb = rendering.rgb.clamp(0, 1).reshape(*shape, 3)
    opacity = rendering.opacity.clamp(0, 1).reshape(*shape, 1)
    alpha = block_means(opacity, by)
    if straight:
        color = (rgb - (1 - opacity) * background) / opacity.clamp(min=_LEAST)
        color = torch.where(opacity < _LEAST, 0.0, color).clamp(0, 1)
        rgb = block_means(color, by) * alpha + (1 - alpha) * background
    else:
        rgb = block_means(rgb, by)
    depth = reduced_depth(rendering.depth.reshape(shape), by)
    return Rendering(rgb.reshape(-1, 3), depth.flatten(), alpha.flatten())
