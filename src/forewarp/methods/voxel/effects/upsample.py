"""The up-sampling effect: warp on a coarse lattice, render on a finer one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from forewarp.fields.radiance_grid import RadianceGrid
from forewarp.methods.voxel.effects.dense import Crop, densify, occupied_crop, sparsify
from forewarp.methods.voxel.effects.inpaint import ConvBlock, Pointwise, zero_head
from forewarp.ops.grid import index_of, occupied_cells, trilinear
from forewarp.scene.box import Lattice


def refined(lattice: Lattice, scale: float) -> Lattice:
    """Return the lattice of the same box with the spacing divided by ``scale``."""
    return Lattice(lattice.box, tuple(max(2, round((n - 1) * scale) + 1) for n in lattice.shape))


class TrilinearUpsampler(nn.Module):
    """Interpolate to a lattice ``scale`` times finer, in occupied cells only.

    Args:
        scale: above 1, not necessarily whole.
    """

    def __init__(self, *, scale: float = 2.0) -> None:
        super().__init__()
        if not scale > 1:
            raise ValueError(
                f"model.upsampler.scale: expected a number > 1, but got {scale}; or model/upsampler=none"
            )
        self.scale = scale

    def forward(self, grid: RadianceGrid) -> RadianceGrid:
        """Return the grid on the finer lattice; differentiable in its values.

        Cost: one trilinear read per fine voxel in occupied cells.
        """
        fine = refined(grid.lattice, self.scale)
        cells = occupied_cells(grid.index)
        axes = [
            (torch.arange(n, device=cells.device) * ((m - 1) / (n - 1))).long().clamp(max=m - 2)
            for n, m in zip(fine.shape, grid.lattice.shape)
        ]
        voxels = cells[axes[0]][:, axes[1]][:, :, axes[2]].nonzero()
        points = grid.lattice.to_lattice(fine.to_world(voxels))
        values = trilinear(grid.values, grid.index, points, grid.fill)
        return replace(grid, lattice=fine, index=index_of(voxels, fine.shape), values=values)


class LearnedUpsampler(TrilinearUpsampler):
    """Interpolate, then add detail by two convolutions at the fine resolution: the paper's up-layer.

    Its last layer starts as 0, so that training starts from plain interpolation.

    Args:
        scale: a whole number > 1.
        channels: 1 + C of the radiance grid.
        width: channels at the fine resolution.
        margin: voxels around the occupied box.
        features: channels of the inpainter's features; 0: read the warped grid.
        recompute: save memory: keep one fine volume for the backward pass instead of five, for a third more
            of the convolutions' time.
    """

    def __init__(
        self,
        *,
        scale: int = 2,
        channels: int,
        width: int = 16,
        margin: int = 2,
        features: int = 0,
        recompute: bool = True,
    ) -> None:
        super().__init__(scale=scale)
        if int(scale) != scale:
            raise ValueError(
                f"model.upsampler.scale: the learned layer expects a whole number, but got {scale}"
            )
        self.scale, self.margin, self.recompute = int(scale), margin, recompute
        self.project = Pointwise(features or channels, width)
        self.layers = nn.Sequential(ConvBlock(width, width), ConvBlock(width, width))
        self.head = zero_head(width, channels)

    def residual(self, features: Tensor, crop: Crop) -> Tensor:
        """Coarse features (1, F, x, y, z) of ``crop`` -> detail (1, 1 + C, x', y', z') of the fine crop."""
        first, second = self.layers

        def refine(coarse: Tensor) -> Tensor:
            return first(interpolate_dense(coarse, crop, self.scale))

        def finish(fine: Tensor) -> Tensor:
            return self.head(second(fine))

        # Project to few channels first, as all the cost is at the fine resolution.
        detail = self._held(finish, self._held(refine, self.project(features)))
        return detail.to(self.head.weight.dtype)  # half precision ends with the convolutions

    def _held(self, part: Callable[[Tensor], Tensor], volume: Tensor) -> Tensor:
        if not self.recompute:
            return part(volume)
        return checkpoint(part, volume, use_reentrant=False, preserve_rng_state=False)

    def alone(self, grid: RadianceGrid) -> RadianceGrid:
        """Up-sample a warped grid without an inpainter: interpolation plus learned detail."""
        crop = occupied_crop(grid.index, self.margin)
        dense = densify(grid, crop)
        fine = interpolate_dense(dense, crop, self.scale) + self.residual(dense, crop)
        return sparsify(grid, refined(grid.lattice, self.scale), crop.scaled(self.scale), fine)


def interpolate_dense(dense: Tensor, crop: Crop, scale: int) -> Tensor:
    """Interpolate (1, C, x, y, z) of ``crop`` to the lattice ``scale`` times finer."""
    return functional.interpolate(dense, size=crop.scaled(scale).shape, mode="trilinear", align_corners=True)
