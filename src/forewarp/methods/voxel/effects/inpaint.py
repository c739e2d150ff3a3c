"""The inpainting effect: a 3D U-Net that fills what the forward warp left open."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class ConvBlock(nn.Module):
    """Instance norm, convolution, ReLU: the paper's convolution layer.

    A volume of one voxel has no statistics, so the norm is left out there. Under autocast one of two voxels'
    depth stays in float32: oneDNN's bfloat16 gradient of the weights reads memory there that nobody wrote.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm3d(inputs, affine=True)
        self.conv = nn.Conv3d(inputs, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(1, I, x, y, z) -> (1, O, x, y, z)."""
        if x[0, 0].numel() > 1:
            # Of one volume the same as instance norm, which would put the channels first again.
            x = functional.batch_norm(x, None, None, self.norm.weight, self.norm.bias, training=True)
        if x.shape[2] > 2:
            return functional.relu(self.conv(x), inplace=True)
        with torch.autocast(x.device.type, enabled=False):
            return functional.relu(self.conv(x.to(self.conv.weight.dtype)), inplace=True)


class Pointwise(nn.Conv3d):
    """A convolution of one voxel: a product of matrices where the channels lie last."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(1, I, x, y, z) -> (1, O, x, y, z), channels last."""
        return functional.linear(x.movedim(1, -1), self.weight.flatten(1), self.bias).movedim(-1, 1)


def zero_head(inputs: int, outputs: int) -> Pointwise:
    """A layer that says 0 until it has learned."""
    head = Pointwise(inputs, outputs)
    nn.init.zeros_(head.weight)
    nn.init.zeros_(head.bias)
    return head


class UNet3d(nn.Module):
    """The inpainter: 4 encode levels and 3 decode levels, on the occupied box only.

    It sees the warped grid alone, no time, so that it cannot learn to move things. Its output is features for
    a learned up-sampler, or, without one, a residual whose layer starts at zero: at first it is the identity.

    Args:
        channels: 1 + C of the radiance grid.
        width: channels of the first level, doubled at each deeper one; a multiple of 16.
        levels: encode levels.
        margin: voxels around the occupied box.
        coverage_channel: also feed the splat's coverage.
        head: with the layer that makes the residual; a learned up-sampler has its own.
    """

    def __init__(
        self,
        *,
        channels: int,
        width: int = 16,
        levels: int = 4,
        margin: int = 4,
        coverage_channel: bool = False,
        head: bool = True,
    ) -> None:
        super().__init__()
        if width % 16 or levels < 2:
            raise ValueError(
                "model.inpainter: expected a width that is a multiple of 16 and levels >= 2, "
                f"but got {width=}, {levels=}"
            )
        self.channels, self.width, self.margin = channels, width, margin
        self.coverage_channel = coverage_channel
        widths = [width * 2**level for level in range(levels)]
        inputs = [channels + coverage_channel, *widths[:-1]]
        self.encode = nn.ModuleList(
            nn.Sequential(ConvBlock(i, max(o // 2, i)), ConvBlock(max(o // 2, i), o))
            for i, o in zip(inputs, widths)
        )
        self.decode = nn.ModuleList(
            nn.Sequential(ConvBlock(deep + skip, skip), ConvBlock(skip, skip))
            for deep, skip in zip(widths[:0:-1], widths[-2::-1])
        )
        self.head = zero_head(width, channels) if head else None

    def features(self, dense: Tensor) -> Tensor:
        """(1, I, x, y, z) -> (1, width, x, y, z); any size of at least one voxel."""
        skips = []
        x = dense
        for level, block in enumerate(self.encode):
            if level:
                x = functional.max_pool3d(x, 2, ceil_mode=True)
            x = block(x)
            skips.append(x)
        for block, skip in zip(self.decode, skips[-2::-1]):
            # To the skip's size, not by a factor of 2: odd sizes are common.
            x = functional.interpolate(x, size=skip.shape[2:], mode="nearest")
            x = block(torch.cat([x, skip], 1))
        return x

    def residual(self, features: Tensor) -> Tensor:
        """Features (1, width, x, y, z) -> what to add to the warped grid (1, 1 + C, x, y, z)."""
        return self.head(features).to(self.head.weight.dtype)  # half precision ends with the convolutions
