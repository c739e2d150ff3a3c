"""Networks that several methods learn: perceptrons, NeRF's trunk and template, codes, screws."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence, Set

import torch
from torch import Tensor, nn

from forewarp.ops.encode import encoded_size, positional_encoding
from forewarp.ops.nodes import geman_mcclure, move_by_screw, stretch


class Network(nn.Sequential):
    """Layers that stay in float32 under autocast: bfloat16 would blur a trajectory by a voxel."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., I) -> (..., O), in full precision."""
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float() if x.dtype in (torch.float16, torch.bfloat16) else x)


def mlp(
    inputs: int, outputs: int, *, width: int, layers: int, zero_last: bool = False, leaky: bool = False
) -> Network:
    """``layers`` linear layers, ReLU between them.

    Args:
        inputs, outputs: numbers of channels.
        width: channels of the hidden layers.
        layers: number of linear layers, at least 1.
        zero_last: start from zero outputs.
        leaky: use LeakyReLU with slope 0.01. Otherwise, at the learning rates of motion, one step may
            kill every ReLU of the last hidden layer, and all points then move alike.

    Raises:
        ValueError: for ``layers`` or ``width`` below 1.

    >>> len([m for m in mlp(33, 4, width=128, layers=3) if isinstance(m, nn.Linear)])
    3
    """
    if layers < 1 or width < 1:
        raise ValueError(f"mlp: expected layers >= 1 and width >= 1, but got {layers=}, {width=}")
    sizes = [inputs, *[width] * (layers - 1), outputs]
    parts: list[nn.Module] = []
    for a, b in zip(sizes[:-1], sizes[1:]):
        parts += [nn.Linear(a, b), nn.LeakyReLU(0.01) if leaky else nn.ReLU(inplace=True)]
    parts.pop()
    if zero_last:
        nn.init.zeros_(parts[-1].weight)
        nn.init.zeros_(parts[-1].bias)
    return Network(*parts)


class Trunk(nn.Module):
    """``layers`` linear layers with ReLU; layer ``skip`` reads the input again.

    Args:
        inputs: channels read by the first layer.
        width: channels of every layer.
        layers: number of layers, at least 1.
        skip: number of the layer, from 1, that also reads the input: 6 in PyTorch versions of NeRF, 5 in JAX
            versions; None: no layer.
        besides: channels that only the first layer reads, not the skip.
        glorot: start from Glorot's uniform weights and biases of 0, as JAX versions do; False: PyTorch's.

    >>> sum(p.numel() for p in Trunk(72, width=256, layers=8, skip=6).parameters())
    497664
    """

    def __init__(
        self, inputs: int, *, width: int, layers: int, skip: int | None, besides: int = 0, glorot=False
    ) -> None:
        super().__init__()
        if min(inputs, width, layers) < 1 or not (skip is None or 2 <= skip <= layers):
            wanted = "inputs, width and layers >= 1 and a skip in [2, layers] or null"
            raise ValueError(f"trunk: expected {wanted}, but got {inputs=}, {width=}, {layers=}, {skip=}")
        self.skip = skip
        sizes = [inputs + besides, *[width] * (layers - 1)]
        self.layers = nn.ModuleList(
            nn.Linear(size + (inputs if number == skip else 0), width) for number, size in enumerate(sizes, 1)
        )
        if glorot:
            self.apply(start_as_glorot)

    def forward(self, x: Tensor, beside: Tensor | None = None) -> Tensor:
        """(..., I), and what the first layer reads beside it (..., B) -> (..., width)."""
        hidden = x if beside is None else torch.cat([x, beside], -1)
        for number, layer in enumerate(self.layers, 1):
            if number == self.skip:
                hidden = torch.cat([x, hidden], -1)
            hidden = torch.relu(layer(hidden))
        return hidden


class Template(nn.Module):
    """Density and colour at a point.

    Density is linear in the trunk's output and ignores the condition (a direction, a code). Colour passes a
    linear bottleneck, one layer of half the width that also reads the condition, and a sigmoid.

    Args:
        inputs: channels of the encoded point.
        condition: channels that only colour depends on.
        width, glorot: see ``Trunk``, of all layers.
        trunk: layers and skip, see ``Trunk``.

    >>> sum(p.numel() for p in Template(63, 27, width=256, layers=8, skip=6).parameters())
    595844
    """

    def __init__(self, inputs: int, condition: int, *, width: int, glorot: bool = False, **trunk) -> None:
        super().__init__()
        if condition < 1 or width < 2:
            wanted = "condition >= 1 and width >= 2"
            raise ValueError(f"template: expected {wanted}, but got {condition=}, {width=}")
        self.trunk = Trunk(inputs, width=width, **trunk)
        self.density_head = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.shading = nn.Linear(width + condition, width // 2)
        self.color_head = nn.Linear(width // 2, 3)
        if glorot:
            self.apply(start_as_glorot)

    def density(self, x: Tensor) -> Tensor:
        """Encoded points (..., I) -> raw density (...,)."""
        return self.density_head(self.trunk(x))[..., 0]

    def forward(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Encoded points (..., I), condition (..., D) -> raw density (...,), colour (..., 3) in [0, 1]."""
        hidden = self.trunk(x)
        return self.density_head(hidden)[..., 0], self.color(hidden, condition)

    def color(self, hidden: Tensor, condition: Tensor) -> Tensor:
        """What the trunk gave (..., width), condition (..., D) -> colour (..., 3) in [0, 1]."""
        shaded = torch.relu(self.shading(torch.cat([self.bottleneck(hidden), condition], -1)))
        return torch.sigmoid(self.color_head(shaded))


def start_as_glorot(layer: nn.Module, gain: float = 1.0) -> None:
    """Give a linear layer or a convolution Glorot's uniform weights and a bias of 0; leave others alone.

    A transposed convolution counts the weights that one of its outputs reads, and starts equal within blocks
    of its stride, so that its outputs show no pattern (Neural Volumes).
    """
    if not isinstance(layer, (nn.Linear, nn.Conv2d, nn.ConvTranspose3d)):
        return
    spreads = isinstance(layer, nn.ConvTranspose3d)
    nn.init.xavier_uniform_(layer.weight, gain * math.prod(layer.stride) ** 0.5 if spreads else gain)
    nn.init.zeros_(layer.bias)
    for axis, stride in enumerate(layer.stride if spreads else (), 2):
        first = torch.arange(0, layer.weight.shape[axis], stride)
        blocks = layer.weight.detach().index_select(axis, first).repeat_interleave(stride, axis)
        layer.weight.data.copy_(blocks)


class TimeCodes(nn.Module):
    """A code (D,) for each training time; between two of them, the codes beside it in proportion (linear).

    Args:
        times: the distinct training times, ascending.
        size: D.
        spread: the first values are uniform in [0, spread).
    """

    def __init__(self, times: Sequence[float], size: int, spread: float = 0.05) -> None:
        super().__init__()
        self.times = tuple(times)
        self.table = nn.Parameter(spread * torch.rand(len(self.times), size))

    def forward(self, time: float) -> Tensor:
        """Return the code (D,) of a time; before the first and after the last it stays the same."""
        before, after, share = beside(self.times, time)
        return self.table[before] if before == after else self.table[before].lerp(self.table[after], share)


def beside(times: Sequence[float], time: float) -> tuple[int, int, float]:
    """Return the numbers of the ascending times before and after a time, and how far it is on the way.

    Both are the same at one of the times, before the first and after the last.

    >>> beside((0.0, 0.5, 1.0), 0.625), beside((0.0, 0.5), 0.5)
    ((1, 2, 0.25), (1, 1, 0.0))
    """
    after = bisect.bisect_left(times, time)
    if after == len(times) or after == 0 or times[after] == time:
        after = min(after, len(times) - 1)
        return after, after, 0.0
    return after - 1, after, (time - times[after - 1]) / (times[after] - times[after - 1])


class CameraCodes(nn.Module):
    """A code (D,) for each camera that took training pictures; others see by the mean of them.

    Args:
        cameras: their ids; None: pictures whose camera is not known.
        size: D.
        spread: the first values are uniform in [0, spread).
    """

    def __init__(self, cameras: Set[int | None], size: int, spread: float = 0.05) -> None:
        super().__init__()
        ordered = sorted(cameras, key=lambda camera: (camera is None, camera))
        self.rows = {camera: row for row, camera in enumerate(ordered)}
        self.table = nn.Parameter(spread * torch.rand(len(self.rows), size))

    def forward(self, camera: int | None) -> Tensor:
        """Return the code (D,) of a camera's id."""
        return self.table[self.rows[camera]] if camera in self.rows else self.table.mean(0)


_ELASTIC, _STILL = 0.03, 1e-3  # scales of the two robust terms: of log stretches, and in world units
_JITTER = 1e-3  # world units
_FIRST = 1e-4  # first weights of the heads are uniform in [0, this)


class ScrewWarp(nn.Module):
    """Move observed points to the template: ``x' = exp(w, v) x`` with ``(w, v) = W(PE(x), code)``.

    Args:
        code_size: channels of a code.
        frequencies: octaves of the points' encoding.
        width, trunk: width, layers and skip, see ``Trunk``.

    >>> sum(p.numel() for p in ScrewWarp(8, frequencies=6, width=128, layers=6, skip=5).parameters())
    95494
    """

    def __init__(self, code_size: int, *, frequencies: int, width: int, **trunk) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.trunk = Trunk(encoded_size(3, frequencies) + code_size, width=width, **trunk, glorot=True)
        self.turn, self.shift = nn.Linear(width, 3), nn.Linear(width, 3)
        for head in (self.turn, self.shift):
            nn.init.uniform_(head.weight, 0, _FIRST)
            nn.init.zeros_(head.bias)

    def forward(self, points: Tensor, code: Tensor, window: float) -> Tensor:
        """World points (..., 3) by a code (D,), or one each (..., D) -> template points (..., 3).

        ``window``: how many octaves of the encoding count (see ``positional_encoding``).
        """
        encoded = positional_encoding(points, self.frequencies, window=window)
        hidden = self.trunk(torch.cat([encoded, code.expand(*points.shape[:-1], -1)], -1))
        return move_by_screw(points, self.turn(hidden), self.shift(hidden))

    def octaves(self, progress: float, warp_in: float) -> float:
        """How many octaves of the encoding count at ``progress`` of a stage: all from ``warp_in`` on."""
        return self.frequencies * min(1.0, progress / max(warp_in, 1e-6))

    def elastic(self, points: Tensor, code: Tensor, window: float) -> Tensor:
        """How far the warp at points (P, 3) is from rigid (P,), in [0, 0.06]: robust squared logarithms of
        the singular values of its Jacobian.

        Cost: the warp, and three times its gradient, through which gradients pass too.
        """
        points = points.detach().requires_grad_()
        moved = self(points, code, window)
        rows = [torch.autograd.grad(moved[:, i].sum(), points, create_graph=True)[0] for i in range(3)]
        jacobian = torch.stack(rows, 1)
        return geman_mcclure(stretch(jacobian), _ELASTIC)

    def stray(
        self, still: Tensor | None, table: Tensor, window: float, most: int | None, generator: torch.Generator
    ) -> Tensor | None:
        """How far the warp moves points that should stay (P, 3): mean in [0, 0.002]; None without any.

        ``most`` of them are drawn (None: all), and for each one of the codes in ``table`` (T, D).
        """
        if still is None or not len(still):
            return None
        points = drawn(still.to(table), most, generator)
        codes = table[torch.randint(len(table), (len(points),), generator=generator).to(table.device)]
        noise = torch.randn(points.shape, generator=generator).to(points)
        near = points + _JITTER * noise
        return geman_mcclure((self(near, codes, window) - near).square().sum(-1), _STILL).mean()


def drawn(rows: Tensor, count: int | None, generator: torch.Generator) -> Tensor:
    """Draw ``count`` different rows of a tensor (N, ...) at random, or take all where there are no more."""
    if count is None or len(rows) <= count:
        return rows
    return rows[torch.randperm(len(rows), generator=generator)[:count].to(rows.device)]
