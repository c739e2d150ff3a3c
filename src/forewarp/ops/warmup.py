"""Compile the kernels before training, by a tiny call of each."""

from __future__ import annotations

import torch

from forewarp.ops.backend import use_numba
from forewarp.ops.grid import index_of, occupied_cells, trilinear
from forewarp.ops.march import march
from forewarp.ops.splat import average_splat
from forewarp.ops.trace import trace


def warm_up(device: torch.device | str = "cpu") -> None:
    """Run each operator forwards and backwards once, on two voxels per axis, without random numbers.

    Numba compiles a kernel, or reads it from its cache, at the first call, which takes seconds.
    """
    voxels = torch.cartesian_prod(*[torch.arange(2, device=device)] * 3)
    positions = voxels.float().requires_grad_()
    with torch.enable_grad():
        splat = average_splat(torch.ones_like(positions).requires_grad_(), positions, (2, 2, 2))
        read = trilinear(splat.values, splat.index, positions, positions.new_zeros(3))
        read.sum().backward()
    index = index_of(voxels, (2, 2, 2))
    cells = occupied_cells(index)
    start, along = positions.new_zeros(1, 3), positions.new_ones(1, 3)
    rays = (start.detach(), along, 0.0, 1.0, 0.5, cells, positions.new_zeros(1))
    march(*rays)
    if use_numba(positions):
        raw = positions.new_zeros(len(voxels))
        trace(*rays, raw=raw, index=index, fill=0.0, shift=0.0, scale=1.0)
