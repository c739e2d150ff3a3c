"""Regularisers of particles: functions of tensors with autograd, each with a line in ``REGULARIZERS``.

Two more terms, ``rigid`` and ``smooth``, are in ``Deformation.gradients``: the kernels that carry an image's
gradients back to the nodes add theirs, without a graph (``ops.nodes.pull_nodes``, ``spread_nodes``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from forewarp.methods.particles.deformation import Deformation
from forewarp.methods.particles.gaussians import GaussianModel

_REST = 3e-3  # share of the scene's extent below which nodes are pulled to rest with less than full force


class RegularizerInput(NamedTuple):
    """What a regulariser may look at; gradients go to all parameters in it, and to ``motion``.

    Attributes:
        gaussians: the canonical Gaussians.
        deformation: how they move; None: they do not.
        motion: (M, 6 or 7) of the nodes at the image's time, as of ``ops.nodes``; None likewise.
        extent: of the scene, world units.
    """

    gaussians: GaussianModel
    deformation: Deformation | None
    motion: Tensor | None
    extent: float


Regularizer = Callable[[RegularizerInput], Tensor | None]  # returns (), or None where what it measures is off


def static(seen: RegularizerInput) -> Tensor | None:
    """Measure how far nodes are from where they are on average over the times seen; its force does not grow
    with their distance: it holds what images say little about, and gives way where they say more.

    Once for translations and once for rotations, the mean over nodes of ``sqrt(d^2 + e^2) - e``: e = 0.003, d
    how far a node is from its mean place, or how far its rotation from the mean takes what is beside it, in
    shares of the extent. The mean counts as constant.
    """
    if seen.motion is None:
        return None
    nodes, value = seen.deformation.nodes, 0.0
    away = (seen.motion - nodes.mean_motion()) / seen.extent
    for arm, part in zip(nodes.arms(), (away[:, :3], away[:, 3:])):
        d = arm[:, None] * part
        value = value + (d.square().sum(-1) + _REST**2).sqrt().mean() - _REST
    return value


REGULARIZERS: Mapping[str, Regularizer] = {"static": static}


def regularize(
    regularizers: Mapping[str, Regularizer],
    factors: Mapping[str, float],
    seen: RegularizerInput,
    parameters: Iterable[tuple[str, nn.Parameter]],
) -> tuple[dict[str, float | None], Tensor | None, dict[str, Tensor]]:
    """Compute regularisers, and the gradients of their weighted sum.

    Args:
        regularizers: those that have a weight, by name.
        factors: weights by name.
        seen: what they look at.
        parameters: of the method, by name.

    Returns:
        their values; gradients by ``seen.motion``, None where no regulariser looks at it; and by parameters.

    Cost: that of autograd; none without a regulariser.
    """
    if not regularizers:
        return {}, None, {}
    with torch.enable_grad():
        motion = None if seen.motion is None else seen.motion.detach().requires_grad_()
        values = {name: function(seen._replace(motion=motion)) for name, function in regularizers.items()}
        total = sum(factors[name] * value for name, value in values.items() if value is not None)
        learns = torch.is_tensor(total) and total.requires_grad
        leaves = {name: parameter for name, parameter in parameters if parameter.requires_grad}
        leaves |= {} if motion is None else {"": motion}
        found = torch.autograd.grad(total, list(leaves.values()), allow_unused=True) if learns else ()
    gradients = {name: found for name, found in zip(leaves, found) if found is not None}
    values = {name: None if value is None else float(value.detach()) for name, value in values.items()}
    return values, gradients.pop("", None), gradients
