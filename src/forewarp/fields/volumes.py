"""Networks between pictures, a code, and volumes: an encoder, a decoder, and an inverse warp of affine maps.

Volumes fill the cube [-1, 1]^3, lattice points on its corners; ``grid_sample`` keeps x as their last axis.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from forewarp.ops.gaussians import rotations

DEVIATION_SCALE = 0.01  # of the layer that gives the logarithm of the deviation
_SLOPE = 0.2  # of leaky ReLUs
_LEAST = 1e-3  # least total weight of the maps at a point


class PictureEncoder(nn.Module):
    """Pictures of an instant (K, 3, H, W) -> mean and logarithm of the deviation of a code, (C,) each.

    Args:
        pictures: K, each with convolutions of its own.
        size: H and W, multiples of ``2**len(tower)``.
        tower: channels of the convolutions (4 x 4, stride 2).
        width: channels of the layer that joins the pictures.
        code: C.
    """

    def __init__(
        self,
        pictures: int,
        size: tuple[int, int],
        *,
        tower: Sequence[int] = (64, 64, 128, 128, 256, 256, 256),
        width: int = 512,
        code: int = 256,
    ) -> None:
        super().__init__()
        by = 2 ** len(tower)
        if len(size) != 2 or min(size) < by or any(side % by for side in size):
            raise ValueError(
                f"model.picture_size: expected height and width in multiples of {by}, as the tower halves "
                f"{len(tower)} times, but got {list(size)}"
            )
        steps = list(zip((3, *tower[:-1]), tower))
        self.towers = nn.ModuleList(
            nn.Sequential(
                *(part for i, o in steps for part in (nn.Conv2d(i, o, 4, 2, 1), nn.LeakyReLU(_SLOPE)))
            )
            for _ in range(pictures)
        )
        self.joined = nn.Linear(pictures * tower[-1] * (size[0] // by) * (size[1] // by), width)
        self.mean, self.deviation = nn.Linear(width, code), nn.Linear(width, code)

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        seen = [tower(one[None]).flatten() for tower, one in zip(self.towers, pictures, strict=True)]
        hidden = functional.leaky_relu(self.joined(torch.cat(seen)), _SLOPE)
        return 0.1 * self.mean(hidden), DEVIATION_SCALE * self.deviation(hidden)


class VolumeDecoder(nn.Module):
    """A code (C,) -> raw values (4, S, S, S), S = ``2**len(channels)``: three of colour, then opacity."""

    def __init__(
        self, code: int, channels: Sequence[int] = (1024, 512, 512, 256, 256, 128, 128), out: int = 4
    ) -> None:
        super().__init__()
        self.first = nn.Linear(code, channels[0])
        self.grow = nn.ModuleList(
            nn.ConvTranspose3d(i, o, 4, 2, 1) for i, o in zip(channels, (*channels[1:], out))
        )

    def forward(self, code: Tensor) -> Tensor:
        """See the class."""
        volume = self.first(code).reshape(1, -1, 1, 1, 1)
        for layer in self.grow:
            volume = layer(functional.leaky_relu(volume, _SLOPE))
        return volume[0]


class AffineMixture(nn.Module):
    """An inverse warp: ``W(x) = sum_i g_i(A_i x) A_i x / max(sum_i g_i(A_i x), 0.001)`` with affine maps
    ``A_i x = s_i * R_i (x - t_i)`` and decoded weights ``g_i``, on a lattice.

    Args:
        code: C.
        maps: their number.
        side: lattice points along an axis of the weights and of W.
        width, weight_width: hidden channels of the maps and of the weights.
        from_identity: start from ``s = 1`` and ``R = I``, and go on beyond the cube with the weights at its
            border. As released, scales are small and rotations any at first, so that W draws all points to
            the middle, and weights are 0 beyond the cube, near which gradients have peaks.
    """

    def __init__(
        self,
        code: int,
        *,
        maps: int = 16,
        side: int = 32,
        width: int = 128,
        weight_width: int = 64,
        from_identity: bool = False,
    ) -> None:
        super().__init__()
        self.maps, self.side, self.from_identity = maps, side, from_identity

        def head(hidden: int, out: int) -> nn.Sequential:
            return nn.Sequential(nn.Linear(code, hidden), nn.LeakyReLU(_SLOPE), nn.Linear(hidden, out))

        self.scale, self.turn, self.shift = (head(width, maps * size) for size in (3, 4, 3))
        self.weight = head(weight_width, maps * side**3)
        axis = torch.linspace(-1, 1, side)
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        self.register_buffer("lattice", torch.stack([x, y, z], -1), persistent=False)

    def moved(self, code: Tensor, points: Tensor) -> Tensor:
        """Apply each map to points (..., 3): (M, ..., 3)."""
        scale = self.scale(code).reshape(self.maps, 3)
        turn = self.turn(code).reshape(self.maps, 4)
        shift = 0.1 * self.shift(code).reshape(self.maps, 3)
        if self.from_identity:
            scale = 1 + scale
            turn = turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0])
        flat = points.reshape(-1, 3) - shift[:, None]
        found = scale[:, None] * (flat @ rotations(turn).mT)
        return found.reshape(self.maps, *points.shape)

    def forward(self, code: Tensor) -> Tensor:
        """Code (C,) -> W at the lattice's points (3, S, S, S)."""
        places = self.moved(code, self.lattice)
        weights = self.weight(code).exp().reshape(self.maps, 1, *[self.side] * 3)
        beyond = "border" if self.from_identity else "zeros"
        weights = functional.grid_sample(weights, places, padding_mode=beyond, align_corners=True)
        weights = weights[:, 0, ..., None]
        whole = (weights * places).sum(0) / weights.sum(0).clamp(min=_LEAST)
        return whole.permute(3, 0, 1, 2)


def read(volume: Tensor, points: Tensor, padding: str = "zeros") -> Tensor:
    """Read a volume (C, S, S, S) at points (N, 3) of the cube, trilinearly: (N, C).

    Beyond the cube lies 0, or with padding ``border`` what is nearest.
    """
    at = points.reshape(1, 1, 1, -1, 3)
    return functional.grid_sample(volume[None], at, padding_mode=padding, align_corners=True)[0, :, 0, 0].T
