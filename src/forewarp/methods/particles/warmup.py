"""Compiling ahead of time: a step, a picture and an optimiser's step of a single particle.

``python -m forewarp.methods.particles.warmup`` compiles the way back alone, which is about half of the work.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from tempfile import TemporaryFile

import torch
from torch import Tensor

from forewarp.ops.adam import Learned, adam_rows
from forewarp.ops.backend import cores, use_numba
from forewarp.ops.gaussians import Gaussians, Pinhole, Warp, compare, compile_way_back, project, rasterize
from forewarp.ops.nodes import carry_nodes, pull_nodes, skin_weights, spread_nodes

_PATIENCE_S = 120.0  # that the other process is waited for


@torch.no_grad()
def compile_kernels(method: torch.nn.Module) -> None:
    """Run each operator once; nothing is drawn at random, nothing of the method is touched.

    What was never compiled on a machine is compiled by two processes, where it has two cores. A method that
    uses none of the kernels, as on a GPU, has nothing to compile.
    """
    if not use_numba(method.means):
        return
    from forewarp.ops.kernels import nodes as kernels

    zero, one, first = torch.zeros(1, 3), torch.ones(1, 1), torch.ones(1)
    missed = kernels.carry.stats.cache_misses.total()
    carry_nodes(zero[:, None], zero[:, None], first, zero)
    with _way_back_beside(kernels.carry.stats.cache_misses.total() > missed):
        given = _single()
        rasterize(project(*given), 9, 8)
        two = torch.zeros(2, 1, 3)  # of a single node, half of its gradients would pass for contiguous
        spread_nodes(two, two, torch.zeros(2, 6), first, first, 1.0, 1.0)
        edges = torch.zeros(1, 1, dtype=torch.int64)
        pull_nodes(torch.zeros(1, 6), zero, torch.zeros(1, 12), edges, one, 1.0)
        skin_weights(one, one)
        moments = zero.clone(), zero.clone(), first.clone()
        adam_rows([Learned(torch.zeros(1, 3), torch.ones(1, 3), *moments, 1e-3)], (0.9, 0.99), 1e-15)
    compare(*given, torch.zeros(72, 4, dtype=torch.uint8), torch.ones(3))


def _single() -> tuple[Gaussians, Warp, Pinhole, Tensor, Tensor]:
    """A particle, its warp and a camera."""
    zero, one = torch.zeros(1, 3), torch.ones(1, 1)
    particles = Gaussians(zero, zero, torch.ones(1, 4), one, torch.zeros(1, 1, 3))
    warp = Warp(torch.zeros(1, 12), torch.zeros(1, 1, dtype=torch.int32), one)
    eye = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    pinhole = Pinhole(eye, (0.0, 0.0, -2.0), (8.0, 8.0), (4.0, 4.0), (9, 8), 0.1)
    return particles, warp, pinhole, torch.zeros(0), torch.ones(1)


@contextmanager
def _way_back_beside(new: bool) -> Iterator[None]:
    """Let another process compile the way back meanwhile, if kernels are ``new`` and there is a core for it.

    It leaves them in the cache on disk, where this process finds them; what it does not get done is
    compiled here, and why is told. It is never killed, as half a file in the cache would be worse than none.
    """
    if not new or cores() < 2:
        yield
        return
    with TemporaryFile() as errors:
        process, command = None, [sys.executable, "-m", "forewarp.methods.particles.warmup"]
        with suppress(OSError):
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
        yield
        if process is None:
            return
        with suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
        if process.returncode:
            errors.seek(0)
            said = errors.read().decode(errors="replace").strip().splitlines()
            why = said[-1] if said else f"status {process.returncode}"
            print(f"kernels are compiled by one process, as a second one failed: {why}")


if __name__ == "__main__":
    compile_way_back(*_single())
