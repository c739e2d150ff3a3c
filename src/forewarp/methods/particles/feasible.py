"""Without kernels a picture and its particles fill the memory: how large pictures may be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from forewarp.methods.particles.settings import Numbers
from forewarp.methods.particles.start import covered_pixels
from forewarp.ops.backend import has_kernels
from forewarp.ops.gaussians import FEASIBLE, smaller
from forewarp.scene.frame import Scene, spread

_PICTURES = 12  # that are looked at
_SLACK = 0.98  # of a side, as smaller pictures are not covered to the same share exactly


def check_feasible(
    method: type, scene: Scene, stage: str, numbers: Mapping[str, Any], device: torch.device
) -> None:
    """See ``Method``: where there are no kernels, refuse pictures too large for the particles they call for.

    These are as many as the root of the pixels that show anything, so that splats times pixels grow as
    the third power of a picture's side.

    Raises:
        ValueError: naming a size that is feasible.

    Cost: with kernels nothing, else a look at twelve pictures.
    """
    if has_kernels(device):
        return
    cameras = [frame.camera for frame in (*scene.train, *scene.held, *scene.val, *scene.test)]
    width, height = max(((c.width, c.height) for c in cameras), key=lambda size: size[0] * size[1])
    own, views = Numbers(name=stage, **numbers), len(scene.train)
    covered = covered_pixels(scene, spread(views, _PICTURES))
    count = own.most(covered, views) * max(own.first, own.full)
    share = (FEASIBLE / (count * width * height)) ** (1 / 3)
    if share >= 1:
        return
    wide, high = smaller(width, height, _SLACK * share)
    if device.type == "cpu":
        key, why = "model", "have no kernels without Numba"
        instead = "install forewarp[cpu] and leave FOREWARP_NUMBA unset"
    else:
        key, why, instead = "trainer", "have no kernels on a GPU", "use trainer=cpu"
    raise ValueError(
        f"{key}: expected pictures of at most {wide} x {high} pixels, as particles {why}, but got "
        f"{width} x {height} and {count:,.0f} particles; {instead}, or use smaller pictures"
    )
