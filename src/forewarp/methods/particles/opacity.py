"""Opacity: how large it becomes over time, where it ends, and how it decays."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forewarp.methods.method import Method

_TIMES = 16  # at which opacity over time is looked at
_MOST = 6.0  # logit: at 17 float32 has no slope left, and what is opaque there can never fade


def most_opaque(method: Method) -> Tensor:
    """The logit of each particle's opacity (N,) when it is largest; see ``Particles.most_opaque``."""
    base = method.opacity.data[:, 0]
    if method.fade is None:
        return base
    fades = base.new_tensor([method.fades(i / _TIMES) for i in range(_TIMES + 1)])  # (T, F)
    return base + (fades @ method.fade.data.T).amax(0)


@torch.no_grad()
def bound(method: Method) -> None:
    """Keep the logit of opacity at an end, at all times: where time adds to it, by taking from its base.

    Cost: nothing to speak of; with opacity over time about 20 operations a particle and cosine.
    """
    base = method.opacity.data
    if method.fade is not None:
        base[:, 0] -= (most_opaque(method) - _MOST).clamp(min=0)
    base.clamp_(max=_MOST)


@torch.no_grad()
def decay(method: Method, shown: Tensor, share: float) -> None:
    """Take a share in [0, 1) of the opacity of particles (N,) bool; where time adds to it, of that without.

    Few pictures leave open what stands where; what none of those that show it asks for fades, and goes.

    Cost: some six operations a particle; none where the share is 0.

    Source: as in "Binocular-Guided 3D Gaussian Splatting with View Consistency for Sparse View Synthesis"
    (NeurIPS 2024), there of all particles and throughout.
    """
    if share > 0:
        base = method.opacity.data
        taken = torch.log1p(share * base.exp()) - math.log1p(-share)  # of the logit
        base.sub_(torch.where(shown[:, None], taken, 0.0))


def fade(method: Method) -> None:
    """Take of opacity what the pictures of a step take (``decay``); nothing, if the step was dropped.

    Args:
        method: has ``opacity``, whose gradient a dropped step lacks, the share ``decay``, and in ``fading``
            what each picture showed, which is forgotten.
    """
    if method.opacity.grad is not None:
        for shown in method.fading:
            decay(method, shown, method.decay)
    method.fading.clear()
