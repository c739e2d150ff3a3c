"""Gaussians that nodes with curves carry through time: what a file holds of them, apart from training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.fields.curves import Curve
from forewarp.scene.camera import Camera

# Of the camera's near plane, and at least of its far plane: closer particles would fill the image.
_NEAR, _LEAST_NEAR = 0.1, 0.02
MARGIN = 0.125  # share of an image's longer side; what projects farther outside is left out


def nearest_shown(camera: Camera) -> float:
    """Return the depth, world units, that a Gaussian's centre needs more of to be drawn."""
    return max(_NEAR * camera.near, _LEAST_NEAR * camera.far)


@dataclass(frozen=True)
class NodeMotion:
    """M nodes at ``positions`` (M, 3), and how they and what follows them move.

    Attributes:
        positions: world units.
        translations: (M, K, 3), coefficients of the ``curve``, world units.
        rotations: (M, K, 3) likewise of Gibbs vectors; None where nodes do not rotate.
        curve: the curve of every node.
        links, weights: (N, L) of N particles: rows of nodes, int32, and their shares, which sum to 1, or are
            all 0 of a particle at rest.
        times, offsets: of images, ascending, and what is added to them for the time of the motion; linear in
            between and constant beyond. Empty: nothing is added.
    """

    positions: Tensor
    translations: Tensor
    rotations: Tensor | None
    curve: Curve
    links: Tensor
    weights: Tensor
    times: Sequence[float] = ()
    offsets: Sequence[float] = ()


@dataclass(frozen=True)
class MovingGaussians:
    """N Gaussians of a canonical state, and what time makes of them.

    Attributes:
        means: (N, 3), world units.
        log_scales: (N, 3), of standard deviations along the axes, world units.
        quaternions: (N, 4), how the axes are turned: w, x, y, z of any length.
        opacity: (N,), logits at the canonical time.
        harmonics: (N, B, 3), B one of 1, 4, 9, 16; see ``scene.cloud.Ellipsoids``.
        color_over_time: (N, K, 3); with ``f_k(t) = cos(pi k t) - cos(pi k t_c)`` the colour has
            ``sum_k f_k c_k`` more. None: nothing.
        opacity_over_time: (N, F), of the opacity's logit likewise.
        canonical_time: ``t_c``, in [0, 1].
        blur: square pixels added to the variance of every splat.
        motion: None: nothing moves.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity: Tensor
    harmonics: Tensor
    color_over_time: Tensor | None
    opacity_over_time: Tensor | None
    canonical_time: float
    blur: float
    motion: NodeMotion | None

    def cosines(self, times: Tensor, count: int) -> Tensor:
        """Return ``f_k`` (..., count) at times (...,), for k = 1 .. count."""
        k = math.pi * torch.arange(1, count + 1).to(times)
        return torch.cos(k * times[..., None]) - torch.cos(k * self.canonical_time)
