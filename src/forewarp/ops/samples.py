"""Sample distances along rays: evenly, or by importance."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.checks import check_shape


def stratified(near: Tensor, far: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Stratified sampling (NeRF): one distance in each of ``count`` bins between ``near`` and ``far``.

    The bins meet midway between the points of ``linspace(near, far, count)``, so the first and the last are
    half as wide as the others.

    Args:
        near, far: (R,) of each ray.
        count: S >= 2.
        generator: draws each distance uniformly in its bin; None: return the linspace.

    Returns:
        (R, S), ascending.

    >>> stratified(torch.tensor([2.0]), torch.tensor([6.0]), 3)
    tensor([[2., 4., 6.]])
    """
    check_shape("near", near, ("R",))
    check_shape("far", far, tuple(near.shape))
    if count < 2:
        raise ValueError(f"stratified: expected count >= 2, but got {count}")
    steps = torch.linspace(0, 1, count, dtype=near.dtype, device=near.device)
    even = near[:, None] + (far - near)[:, None] * steps
    if generator is None:
        return even
    middle = midpoints(even)
    low, high = torch.cat([even[:, :1], middle], 1), torch.cat([middle, even[:, -1:]], 1)
    return low + (high - low) * _uniform(even, generator)


def midpoints(depths: Tensor) -> Tensor:
    """Return the midpoints (R, S - 1) of neighbouring distances (R, S)."""
    return 0.5 * (depths[:, 1:] + depths[:, :-1])


@torch.no_grad()
def by_importance(
    edges: Tensor,
    weights: Tensor,
    count: int,
    generator: torch.Generator | None = None,
    floor: float = 1e-5,
) -> Tensor:
    """Importance sampling (NeRF): draw ``count`` distances from a piecewise constant density.

    Evaluate the inverse of its distribution function, linear within a bin, at uniform numbers. No gradient
    passes.

    Args:
        edges: (R, B + 1) of the bins, ascending.
        weights: (R, B) >= 0 of the bins, not normalised.
        count: S >= 1.
        generator: draws the uniform numbers; None: take them evenly from 0 to 1.
        floor: above 0, added to every weight, so that every bin can be drawn.

    Returns:
        (R, S), ascending without a generator.

    Cost: R (B + S log B).

    >>> by_importance(torch.tensor([[0.0, 1.0, 3.0]]), torch.tensor([[0.5, 0.5]]), 5)
    tensor([[0.0000, 0.5000, 1.0000, 2.0000, 3.0000]])
    """
    check_shape("edges", edges, ("R", "E"))
    check_shape("weights", weights, (len(edges), edges.shape[1] - 1))
    if weights.shape[1] < 1 or count < 1 or not floor > 0:
        raise ValueError(
            f"by_importance: expected a bin, count >= 1 and floor > 0, but got {weights.shape[1]} bins, "
            f"{count=}, {floor=}"
        )
    ends = (weights + floor).cumsum(1)
    ends = torch.cat([torch.zeros_like(ends[:, :1]), ends / ends[:, -1:]], 1)
    if generator is None:
        at = torch.linspace(0, 1, count, dtype=ends.dtype, device=ends.device).repeat(len(ends), 1)
    else:
        at = _uniform(ends.new_empty(len(ends), count), generator)
    right = torch.searchsorted(ends, at, right=True).clamp(1, weights.shape[1])
    (begin, end), (low, high) = ([t.gather(1, right - 1), t.gather(1, right)] for t in (ends, edges))
    return low + (high - low) * ((at - begin) / (end - begin)).clamp(0, 1)


def union(*depths: Tensor) -> Tensor:
    """Merge sets of distances (R, S_i) of the same rays into one, ascending (R, sum of S_i)."""
    return torch.cat(depths, 1).sort(1).values


def clip_to_box(
    origins: Tensor, directions: Tensor, near: float, far: float, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    """Clip the interval ``[near, far]`` of each ray to an axis-aligned box.

    Args:
        origins, directions: (R, 3).
        near, far: range of all rays, in multiples of a direction's length.
        low, high: (3,) corners of the box.

    Returns:
        near (R,) and far (R,); far <= near for a ray that misses the box.
    """
    check_shape("origins", origins, ("R", 3))
    check_shape("directions", directions, tuple(origins.shape))
    to_low, to_high = low - origins, high - origins
    inside = (to_low <= 0) & (to_high >= 0)
    level = directions == 0
    safe = torch.where(level, torch.ones_like(directions), directions)
    never = torch.where(inside, -torch.inf, torch.inf).to(origins)  # for rays parallel to a face
    enter = torch.where(level, never, torch.minimum(to_low / safe, to_high / safe))
    leave = torch.where(level, -never, torch.maximum(to_low / safe, to_high / safe))
    return enter.amax(1).clamp(near, far), leave.amin(1).clamp(near, far)


def _uniform(like: Tensor, generator: torch.Generator) -> Tensor:
    """Draw numbers in [0, 1) on the generator's device, with shape, dtype and device of a tensor."""
    return torch.rand(like.shape, generator=generator, device=generator.device, dtype=like.dtype).to(like)
