"""Compiling ahead of time: a step, a picture and an optimiser's step of a single particle."""

from __future__ import annotations

import torch

from forewarp.ops.adam import adam_rows
from forewarp.ops.backend import use_numba
from forewarp.ops.compare import compare
from forewarp.ops.nodes import carry_nodes, pull_nodes, spread_nodes
from forewarp.ops.project import Gaussians, Pinhole, Warp, project
from forewarp.ops.rasterize import rasterize


@torch.no_grad()
def compile_kernels(method: torch.nn.Module) -> None:
    """Run each operator once; nothing is drawn at random, nothing of the method is touched.

    A method that uses none of the kernels, as on a GPU, has nothing to compile.
    """
    if not use_numba(method.means):
        return
    zero, one = torch.zeros(1, 3), torch.ones(1, 1)
    particles = Gaussians(zero, zero, torch.ones(1, 4), one, torch.zeros(1, 1, 3))
    warp = Warp(torch.zeros(1, 12), torch.zeros(1, 1, dtype=torch.int32), one)
    eye = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    pinhole = Pinhole(eye, (0.0, 0.0, -2.0), (8.0, 8.0), (4.0, 4.0), (9, 8), 0.1)
    none, first = torch.zeros(0), torch.ones(1)
    compare(particles, warp, pinhole, none, first, torch.zeros(72, 4, dtype=torch.uint8), torch.ones(3))
    rasterize(project(particles, warp, pinhole, none, first), 9, 8)
    edges = torch.zeros(1, 1, dtype=torch.int64)
    carry_nodes(zero[:, None], zero[:, None], first, zero)
    two = torch.zeros(2, 1, 3)  # of a single node, half of its gradients would pass for contiguous
    spread_nodes(two, two, torch.zeros(2, 6), first, first, 1.0, 1.0)
    pull_nodes(torch.zeros(1, 6), zero, torch.zeros(1, 12), edges, one, 1.0)
    adam_rows(
        torch.zeros(1, 3),
        torch.ones(1, 3),
        zero.clone(),
        zero.clone(),
        first.clone(),
        1e-3,
        (0.9, 0.99),
        1e-15,
    )
