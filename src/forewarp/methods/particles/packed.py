"""Between the parameters of particles and what the operators read: together on the way there, apart again."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from forewarp.methods.method import Method
from forewarp.ops.project import Gaussians


def packed(method: Method) -> Gaussians:
    """The particles as the operators read them."""
    solid = method.opacity if method.fade is None else torch.cat([method.opacity, method.fade], -1)
    colors = [part for part in (method.color, method.shade, method.tint) if part is not None]
    colors = colors[0] if len(colors) == 1 else torch.cat(colors, 1)
    return Gaussians(method.means, method.log_scales, method.turns, solid, colors)


def by_name(method: Method, gradients: Gaussians) -> dict[str, Tensor]:
    """Gradients by what ``packed`` gives, as gradients by the name of each parameter."""
    found = {"means": gradients.means, "log_scales": gradients.log_scales, "turns": gradients.quaternions}
    found["opacity"] = gradients.opacity[:, :1]
    if method.fade is not None:
        found["fade"] = gradients.opacity[:, 1:]
    at = 0
    for name in ("color", "shade", "tint"):
        part = getattr(method, name)
        if part is not None:
            found[name] = gradients.colors[:, at : at + part.shape[1]]
            at += part.shape[1]
    return found


def add(total: dict[str, Tensor], found: Mapping[str, Tensor]) -> None:
    """Add gradients to those of the same names in ``total``."""
    for name, value in found.items():
        total[name] = value if name not in total else total[name] + value
