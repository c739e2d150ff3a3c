"""Between the parameters of particles and what the operators read: together on the way there, apart again."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from forewarp.methods.method import Method
from forewarp.ops.gaussians import Gaussians

_KINDS = ("color", "shade", "tint")  # of colour: plain, by direction, by time


def packed(method: Method) -> Gaussians:
    """The particles as the operators read them."""
    solid = method.opacity if method.fade is None else torch.cat([method.opacity, method.fade], -1)
    colors = [getattr(method, name) for name in _kinds(method)]
    colors = colors[0] if len(colors) == 1 else torch.cat(colors, 1)
    return Gaussians(method.means, method.log_scales, method.turns, solid, colors)


def kinds_of(method: Method) -> list[int]:
    """How many coefficients each kind of colour has, as ``ops.compare`` asks."""
    return [getattr(method, name).shape[1] for name in _kinds(method)]


def _kinds(method: Method) -> list[str]:
    return [name for name in _KINDS if getattr(method, name) is not None]


def by_name(method: Method, gradients: Gaussians) -> dict[str, Tensor]:
    """Gradients by what ``packed`` gives, colours by kinds, as gradients by the name of each parameter."""
    found = {"means": gradients.means, "log_scales": gradients.log_scales, "turns": gradients.quaternions}
    found["opacity"] = gradients.opacity[:, :1]
    if method.fade is not None:
        found["fade"] = gradients.opacity[:, 1:]
    return found | dict(zip(_kinds(method), gradients.colors, strict=True))


def add(total: dict[str, Tensor], found: Mapping[str, Tensor]) -> None:
    """Add gradients to those of the same names in ``total``."""
    for name, value in found.items():
        total[name] = value if name not in total else total[name] + value
