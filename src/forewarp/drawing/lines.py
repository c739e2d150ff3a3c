"""Draw antialiased lines and discs over a picture, hidden where the scene occludes them."""

from __future__ import annotations

import torch
from torch import Tensor

_SPACING = 0.5  # pixels between the discs that make a line
_MOST = 2048  # discs per segment; longer ones leave any picture


def draw_discs(picture: Tensor, at: Tensor, colors: Tensor, alpha: Tensor, radius: float) -> Tensor:
    """Draw discs over a picture. Where they overlap, average the colours and take the largest opacity.

    Args:
        picture: (H, W, 3).
        at: centres (M, 2) in pixels from the top-left corner.
        colors: (M, 3).
        alpha: (M,).
        radius: in pixels.

    Cost: linear in M and in the square of ``radius``.
    """
    height, width = picture.shape[:2]
    reach = torch.arange(-int(radius + 1.5), int(radius + 1.5) + 1, device=at.device)
    pixel = at.floor().long()[:, None] + torch.cartesian_prod(reach, reach)  # (M, K, 2)
    gap = (pixel + 0.5 - at[:, None]).norm(dim=-1)
    cover = (radius + 0.5 - gap).clamp(0, 1) * alpha[:, None]
    x, y = pixel.unbind(-1)
    kept = (cover > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    flat, cover = (y * width + x)[kept], cover[kept]
    colors = colors[:, None].expand(-1, pixel.shape[1], -1)[kept]
    ink = picture.new_zeros(height * width, 3).index_add_(0, flat, colors * cover[:, None])
    total = picture.new_zeros(height * width).index_add_(0, flat, cover)
    most = picture.new_zeros(height * width).scatter_reduce_(0, flat, cover, "amax")
    mixed = torch.lerp(picture.reshape(-1, 3), ink / total.clamp(min=1e-8)[:, None], most[:, None])
    return mixed.reshape(picture.shape)


def sample_lines(vertices: Tensor) -> tuple[Tensor, Tensor]:
    """Sample points along polylines, half a pixel apart.

    Args:
        vertices: (N, T, C); the first two channels are pixels, all are interpolated.

    Returns:
        points (M, C) and the line of each (M,).
    """
    begin, end = vertices[:, :-1].flatten(0, 1), vertices[:, 1:].flatten(0, 1)
    count = ((end - begin)[:, :2].norm(dim=-1) / _SPACING).ceil().long().clamp(1, _MOST)
    segment = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    place = torch.arange(len(segment), device=count.device) - (count.cumsum(0) - count)[segment]
    share = (place / count[segment])[:, None]
    return torch.lerp(begin[segment], end[segment], share), segment // (vertices.shape[1] - 1)


def hidden(at: Tensor, distance: Tensor, depth: Tensor, slack: float) -> Tensor:
    """Tell which points lie more than ``slack`` behind the surface: (M,) bool.

    Args:
        at: (M, 2) pixels.
        distance: (M,) along the ray.
        depth: (H, W) of the surface, infinite where there is none.
        slack: in the unit of ``distance``.
    """
    height, width = depth.shape
    x, y = at.floor().long().unbind(-1)
    return distance > depth[y.clamp(0, height - 1), x.clamp(0, width - 1)] + slack
