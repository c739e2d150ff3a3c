"""Forward warping: average splatting with a trilinear kernel."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from forewarp.ops.backend import arrays, check_shapes, match_threads, use_numba
from forewarp.ops.grid import _CORNERS


class Splat(NamedTuple):
    """The sparse result of a splat.

    Attributes:
        values: (M, C), averages.
        coverage: (M,), summed weights.
        index: (X, Y, Z) int32, row of each voxel or -1.
        dropped: number of source voxels that left the box or had no finite position.
    """

    values: Tensor
    coverage: Tensor
    index: Tensor
    dropped: int


def average_splat(source: Tensor, positions: Tensor, shape: tuple[int, int, int], tau: float = 1e-2) -> Splat:
    """Average splatting (the paper's three warping equations), with sums divided by ``max(coverage, tau)``.

    ``target[p] = sum_q b(u) source[q] / sum_q b(u)``, ``b(u) = prod max(0, 1 - |u_i|)``,
    ``u = positions[q] - p``. Voxels that nothing reaches are absent from the sparse result.

    Args:
        source: (N, C), values to move.
        positions: (N, 3), where they land, lattice coordinates.
        shape: (X, Y, Z) of the target.
        tau: lower bound of the divisor. It bounds the gradient with respect to positions by about 1/tau.

    Returns:
        a ``Splat``; values and coverage are differentiable in ``source`` and ``positions``. A voxel without
        finite position contributes nothing, one outside the box only where its kernel reaches inside.

    Cost: 8 voxels of C + 1 channels per source voxel; memory M (C + 1) for M touched voxels.
    """
    check_shapes("source (N, C), positions (N, 3)", source, positions)
    last = torch.tensor(shape, device=positions.device) - 1
    detached = positions.detach()
    reaches = ((detached > -1) & (detached < last + 1)).all(-1)  # False for NaN
    usable = torch.where(reaches[:, None], positions, torch.full_like(positions, float("nan")))
    scatter = _numba_scatter if use_numba(source) else scatter_reference
    sums, index = scatter(source, usable, tuple(shape))
    coverage = sums[:, -1]
    values = sums[:, :-1] / coverage.clamp(min=tau)[:, None]
    inside = ((detached >= 0) & (detached <= last)).all(-1)
    return Splat(values, coverage, index, int(len(source) - int(inside.sum())))


def with_copies(splat: Splat, source: Tensor, cells: Tensor, tau: float = 1e-2) -> Splat:
    """Add static voxels to a splat, each to its own voxel with weight 1.

    Equal to splatting them onto themselves, for an eighth of the work.

    Args:
        splat: the splat of all moving voxels, with the same ``tau``.
        source: (N, C), values of the static voxels.
        cells: (N, 3) int64, their distinct positions.

    Cost: one voxel of C + 1 channels per static voxel.

    >>> nothing = average_splat(torch.zeros(0, 1), torch.zeros(0, 3), (2, 2, 2))
    >>> with_copies(nothing, torch.tensor([[7.0]]), torch.tensor([[0, 1, 1]])).values
    tensor([[7.]])
    """
    check_shapes("source (N, C), cells (N, 3)", source, cells)
    index, rows = splat.index.clone(), splat.index[cells.unbind(-1)].long()
    absent = (rows < 0).nonzero()[:, 0]
    fresh = torch.arange(len(absent), device=rows.device) + len(splat.coverage)
    rows = rows.index_copy(0, absent, fresh)
    index[cells[absent].unbind(-1)] = fresh.int()
    coverage = torch.cat([splat.coverage, splat.coverage.new_zeros(len(absent))])
    sums = torch.cat([splat.values, splat.values.new_zeros(len(absent), splat.values.shape[1])])
    sums = (sums * coverage.clamp(min=tau)[:, None]).index_add(0, rows, source)
    coverage = coverage.index_add(0, rows, torch.ones_like(source[:, 0]))
    return Splat(sums / coverage.clamp(min=tau)[:, None], coverage, index, splat.dropped)


def scatter_reference(
    source: Tensor, positions: Tensor, shape: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """Return sums (M, C + 1), coverage last, and the index of the touched voxels, in plain PyTorch.

    Voxels whose ``positions`` are NaN contribute nothing.
    """
    keep = (~positions.detach().isnan().any(-1)).nonzero()[:, 0]
    source, positions = source[keep], positions[keep]
    base = positions.detach().floor().long()
    fraction = positions - base
    offsets = torch.tensor(_CORNERS, device=source.device)
    weights = torch.where(offsets.bool(), fraction[:, None], 1 - fraction[:, None]).prod(-1)  # (N, 8)
    cells = base[:, None] + offsets
    x, y, z = shape
    inside = ((cells >= 0) & (cells < torch.tensor(shape, device=cells.device))).all(-1)
    flat = (cells[..., 0] * y + cells[..., 1]) * z + cells[..., 2]
    flat = torch.where(inside, flat, x * y * z)
    touched = torch.zeros(x * y * z + 1, dtype=torch.bool, device=source.device)
    touched[flat.reshape(-1)] = True
    rows = touched[:-1].cumsum(0, dtype=torch.int32) - 1
    index = torch.where(touched[:-1], rows, -1)
    row_of = torch.cat([index, index.new_tensor([-1])])[flat].long()  # (N, 8)
    payload = torch.cat([source, torch.ones_like(source[:, :1])], -1)
    sums = source.new_zeros(int(touched[:-1].sum()) + 1, payload.shape[1])
    row_of = torch.where(row_of < 0, len(sums) - 1, row_of)
    for corner in range(8):
        sums = sums.index_add(0, row_of[:, corner], weights[:, corner, None] * payload)
    return sums[:-1], index.reshape(shape).int()


def _numba_scatter(source: Tensor, positions: Tensor, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    from forewarp.ops.kernels import voxels as kernels

    index = torch.full(shape, -1, dtype=torch.int32)
    rows = kernels.number_touched(*arrays(positions, index))
    return _NumbaScatter.apply(source, positions, index, rows), index


class _NumbaScatter(torch.autograd.Function):
    @staticmethod
    def forward(ctx, source, positions, index, rows):
        from forewarp.ops.kernels import voxels as kernels

        chunks = min(4, match_threads())
        ctx.save_for_backward(source, positions, index)
        sums = source.new_zeros(chunks, rows, source.shape[1] + 1)
        kernels.scatter(*arrays(source, positions, index, sums))
        return sums.sum(0) if chunks > 1 else sums[0]

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        from forewarp.ops.kernels import voxels as kernels

        match_threads()
        source, positions, index = ctx.saved_tensors
        grad_source, grad_positions = source.new_zeros(source.shape), positions.new_zeros(positions.shape)
        kernels.scatter_backward(*arrays(source, positions, index, grad, grad_source, grad_positions))
        return grad_source, grad_positions, None, None
