"""The inpainting effect: a 3D U-Net that fills the holes of the forward warp."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


def convolve(layer: nn.Conv3d, x: Tensor) -> Tensor:
    """Apply a convolution to a volume (1, I, x, y, z), on one CPU thread by oneDNN as on several.

    With one thread PyTorch itself takes oneDNN only for volumes above some size, and is about seven times
    slower below it.
    """
    own = x.device.type != "cpu" or x.dtype != torch.float32 or torch.is_autocast_enabled("cpu")
    if own or torch.get_num_threads() > 1 or not torch.backends.mkldnn.is_available():
        return layer(x)
    return functional.conv3d(x.to_mkldnn(), layer.weight, layer.bias, padding=layer.padding).to_dense()


class ConvBlock(nn.Module):
    """Instance norm, convolution, ReLU: the paper's convolution layer.

    A single voxel is not normalised, as it has no statistics. Volumes at most 2 voxels deep stay in float32
    under autocast, as oneDNN's bfloat16 gradient of the weights reads uninitialised memory there.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm3d(inputs, affine=True)
        self.conv = nn.Conv3d(inputs, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(1, I, x, y, z) -> (1, O, x, y, z)."""
        if x[0, 0].numel() > 1:
            # Equal to instance norm for one volume, and keeps the channels last.
            x = functional.batch_norm(x, None, None, self.norm.weight, self.norm.bias, training=True)
        if x.shape[2] > 2:
            return functional.relu(convolve(self.conv, x), inplace=True)
        with torch.autocast(x.device.type, enabled=False):
            return functional.relu(self.conv(x.to(self.conv.weight.dtype)), inplace=True)


class Pointwise(nn.Conv3d):
    """A 1 x 1 x 1 convolution, as a matrix product over the last channels."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(1, I, x, y, z) -> (1, O, x, y, z), channels last."""
        return functional.linear(x.movedim(1, -1), self.weight.flatten(1), self.bias).movedim(-1, 1)


def zero_head(inputs: int, outputs: int) -> Pointwise:
    """Make a pointwise layer that starts as 0."""
    head = Pointwise(inputs, outputs)
    nn.init.zeros_(head.weight)
    nn.init.zeros_(head.bias)
    return head


class UNet3d(nn.Module):
    """The inpainter: a U-Net with 4 encoder and 3 decoder levels, on the occupied box only.

    It sees the warped grid but not the time, so that it cannot learn motion. It outputs features for a
    learned up-sampler, or, without one, a residual that starts as 0.

    Args:
        channels: 1 + C of the radiance grid.
        width: channels of the first level, doubled at each further level; a multiple of 16.
        levels: encoder levels.
        margin: voxels around the occupied box.
        coverage_channel: also feed in the splat's coverage.
        head: own the layer that makes the residual; False for a learned up-sampler, which has one.
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
            # To the size of the skip, as odd sizes do not double.
            x = functional.interpolate(x, size=skip.shape[2:], mode="nearest")
            x = block(torch.cat([x, skip], 1))
        return x

    def residual(self, features: Tensor) -> Tensor:
        """Features (1, width, x, y, z) -> residual of the warped grid (1, 1 + C, x, y, z)."""
        return self.head(features).to(self.head.weight.dtype)  # half precision ends with the convolutions
