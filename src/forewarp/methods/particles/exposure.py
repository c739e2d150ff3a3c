"""Exposure and white balance that drift over time, as those of a phone do: gain and bias of all colours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from forewarp.methods.effect import DRIFT_TIMES
from forewarp.ops.gaussians import FLAT
from forewarp.scene.frame import Scene


def count_of(asked: int, scene: Scene) -> int:
    """Return how many cosines there are, of those asked for: at most one for ``DRIFT_TIMES`` times, and none
    where several cameras film, each of which has an exposure of its own.
    """
    return min(asked, len(scene.instants) // DRIFT_TIMES) if scene.has_one_camera else 0


def basis_at(count: int, time: float, is_window: bool) -> list[float]:
    """Return ``cos(pi k t)`` for k = 1, 2, ..: 0 on average, so that matter has its average colours.

    A window of a film shares matter with the others, and begins with k = 0.
    """
    return [math.cos(math.pi * k * time) for k in range(0 if is_window else 1, count + (not is_window))]


def gain_and_bias(coefficients: Tensor, basis: Sequence[float]) -> Tensor:
    """Return what each colour channel is multiplied by, and what is added to it: (2, 3).

    Args:
        coefficients: (K, 2, 3), of gain and bias.
        basis: (K,), the cosines at a time.
    """
    light = torch.einsum("k,kic->ic", coefficients.new_tensor(basis), coefficients)
    return light + light.new_tensor([[1.0], [0.0]])


def lit(colors: Tensor, light: Tensor) -> Tensor:
    """Return coefficients (N, B, 3) of ``gain c + bias`` from those of colours ``c``, ``light`` as above.

    A colour is 0.5 and the sum of its coefficients, the first of which is times ``FLAT``.
    """
    gain, bias = light
    colors = colors * gain
    colors[:, 0] += (0.5 * (gain - 1) + bias) / FLAT
    return colors


def to_unlit(
    colors: Sequence[Tensor], gradients: Sequence[Tensor], light: Tensor, basis: Sequence[float]
) -> tuple[list[Tensor], Tensor]:
    """Lead gradients by what ``lit`` returned back to what it was given, and to the coefficients of exposure.

    Args:
        colors: by kind (N, k, 3), the constant harmonic first.
        gradients: by lit colours, likewise.
        light, basis: as above.

    Returns:
        gradients by the colours, and by the coefficients (K, 2, 3).
    """
    by_bias = gradients[0].sum((0, 1)) / FLAT
    by_gain = 0.5 * by_bias + sum((c * g).sum((0, 1)) for c, g in zip(colors, gradients, strict=True))
    by_light = torch.stack([by_gain, by_bias])
    return [g * light[0] for g in gradients], by_light.new_tensor(basis)[:, None, None] * by_light
