"""Learned perceptual image patch similarity (LPIPS, version 0.1), on three backbones.

Distances of different backbones are not comparable, so every name contains the net; papers report
``lpips_vgg``. Backbone weights are files in torchvision's format and never downloaded; the small
linear heads come with torchmetrics. (torchmetrics' own LPIPS needs torchvision.)
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from importlib import resources
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from forewarp.archives import read_archive
from forewarp.metrics.image import image_pair
from forewarp.metrics.limits import LPIPS_LEAST_SIDE, NETS

WEIGHTS_VARIABLE = "FOREWARP_LPIPS_WEIGHTS"
_FILE_PATTERNS = {
    "squeeze": ("squeezenet1_1*.pth", "squeeze.backbone.pth"),
    "vgg": ("vgg16-*.pth", "vgg16.pth", "vgg.backbone.pth"),
    "alex": ("alexnet*.pth", "alex.backbone.pth"),
}
# The layers whose outputs are compared, as indices into torchvision's ``features``.
_TAPS = {"squeeze": (1, 4, 7, 9, 10, 11, 12), "vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}
_EPSILON = 1e-10


class Fire(nn.Module):
    """SqueezeNet's block: a 1x1 squeeze, then 1x1 and 3x3 filters side by side."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, 2 * expanded, H, W)."""
        x = self.squeeze(x).relu_()
        return torch.cat([self.expand1x1(x), self.expand3x3(x)], 1).relu_()


def convolution(inputs: int, outputs: int, side: int = 3, **more: int) -> list[nn.Module]:
    """Make a convolution and its ReLU."""
    return [nn.Conv2d(inputs, outputs, side, **more), nn.ReLU(inplace=True)]


def squeezenet_features() -> nn.Sequential:
    """The convolutional part of SqueezeNet 1.1, parameter names as in torchvision."""
    pool = nn.MaxPool2d(3, 2, ceil_mode=True)
    layers = [*convolution(3, 64, stride=2), pool, Fire(64, 16, 64), Fire(128, 16, 64), pool]
    layers += [Fire(128, 32, 128), Fire(256, 32, 128), pool]
    layers += [Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)]
    return nn.Sequential(*layers)


def vgg16_features() -> nn.Sequential:
    """The convolutional part of VGG16 up to its last ReLU, parameter names as in torchvision."""
    layers, inputs = [], 3
    for width, repeats in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for _ in range(repeats):
            layers += convolution(inputs, width, padding=1)
            inputs = width
        layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers[:-1])


def alexnet_features() -> nn.Sequential:
    """The convolutional part of AlexNet up to its last ReLU, parameter names as in torchvision."""
    pool = nn.MaxPool2d(3, 2)
    layers = [*convolution(3, 64, 11, stride=4, padding=2), pool, *convolution(64, 192, 5, padding=2), pool]
    for inputs, outputs in ((192, 384), (384, 256), (256, 256)):
        layers += convolution(inputs, outputs, padding=1)
    return nn.Sequential(*layers)


_BACKBONES = {"squeeze": squeezenet_features, "vgg": vgg16_features, "alex": alexnet_features}


class LPIPS(nn.Module):
    """Perceptual distance of one backbone, frozen.

    Args:
        net: ``squeeze``, ``vgg`` or ``alex``.
        backbone: weight file in torchvision's format, of the whole model or of its ``features``.

    Raises:
        ValueError: for an unknown net, or a file without the net's weights.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, net: str, backbone: str | Path) -> None:
        super().__init__()
        _check_net(net)
        self.net = net
        self.features = _BACKBONES[net]()
        _load_backbone(self.features, Path(backbone), net)
        for k, weight in enumerate(heads_of(net)):
            self.register_buffer(f"head{k}", weight)
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[:, None, None])
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None])
        self.requires_grad_(False)

    @torch.no_grad()
    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """Distances (B,) of image pairs (B, 3, H, W) in [-1, 1]; no gradient.

        Cost: one pass of the backbone over both images, holding two layers at a time.
        """
        return sum(part.mean((1, 2, 3)) for part in self._maps(first, second))

    def _maps(self, first: Tensor, second: Tensor) -> Iterator[Tensor]:
        """Yield the distances (B, 1, h, w) of each layer that is compared, at its places."""
        x = (torch.cat([first, second]) - self.shift) / self.scale
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in _TAPS[self.net]:
                head = getattr(self, f"head{_TAPS[self.net].index(index)}")
                normalised = x / (torch.linalg.vector_norm(x, dim=1, keepdim=True) + _EPSILON)
                a, b = normalised.chunk(2)
                yield F.conv2d((a - b).square(), head)

    @torch.no_grad()
    def forward(self, prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
        """Distance of two images (H, W, 3) in [0, 1], rounded to 8 bits; None for a side below 32 pixels.

        With a mask (H, W) bool, as dycheck's mLPIPS: both images are black outside it, and the layers' maps,
        enlarged to the image, are averaged inside; None where that is nowhere.
        """
        pair = image_pair(prediction, target)
        if min(prediction.shape[:2]) < LPIPS_LEAST_SIDE or (mask is not None and not bool(mask.any())):
            return None
        shown = 1.0 if mask is None else mask.to(pair[0])[..., None]
        a, b = ((2 * (x * shown).permute(2, 0, 1)[None] - 1).to(self.shift) for x in pair)
        if mask is None:
            return float(self.distance(a, b))
        size = tuple(mask.shape)
        whole = sum(F.interpolate(part, size, mode="bilinear") for part in self._maps(a, b))
        return float(whole[0, 0][mask.to(whole.device)].mean())


def find_lpips_weights(net: str, extra: Iterable[str | Path] | str | Path | None = ()) -> Path | None:
    """Find the weight file of a net's backbone by file name, or return None.

    Search the given files and folders, then ``FOREWARP_LPIPS_WEIGHTS``, then torch hub's cache,
    where torchvision stores its downloads.

    Raises:
        ValueError: for an unknown net, a given place that does not exist, or a given file named after no net.
    """
    _check_net(net)
    extra = [extra] if isinstance(extra, str | Path) else extra or ()
    named = [("lpips_weights", Path(place).expanduser()) for place in extra if place]
    if os.environ.get(WEIGHTS_VARIABLE):
        named.append((WEIGHTS_VARIABLE, Path(os.environ[WEIGHTS_VARIABLE]).expanduser()))
    for key, place in named:
        if not place.exists():
            raise ValueError(f"{key}: expected an existing weight file or folder, but got {place}")
        if place.is_file() and not any(_is_named_after(place, other) for other in NETS):
            names = ", ".join(pattern for patterns in _FILE_PATTERNS.values() for pattern in patterns)
            raise ValueError(f"{key}: expected a file named like {names}, but got {place}; rename it")
    for place in [*(place for _, place in named), Path(torch.hub.get_dir()) / "checkpoints"]:
        for file in [place] if place.is_file() else sorted(place.glob("*.pth")):
            if _is_named_after(file, net):
                return file
    return None


def _is_named_after(file: Path, net: str) -> bool:
    return any(file.match(pattern) for pattern in _FILE_PATTERNS[net])


def find_lpips(
    nets: Iterable[str] = NETS, extra: Iterable[str | Path] | str | Path | None = ()
) -> dict[str, LPIPS | None]:
    """Return ``{"lpips_<net>": LPIPS}`` for the nets asked for, with None for nets without weights."""
    files = {net: find_lpips_weights(net, extra) for net in nets}
    return {f"lpips_{net}": LPIPS(net, file) if file else None for net, file in files.items()}


def _check_net(net: str) -> None:
    if net not in NETS:
        raise ValueError(f"lpips: expected a net of {', '.join(NETS)}, but got {net!r}")


def _load_backbone(features: nn.Sequential, file: Path, net: str) -> None:
    """Load a state dict; unpickle tensors only."""
    what = f"weights of {net}'s features"
    try:
        stored = read_archive(file, legacy=True)
    except (OSError, ValueError) as error:
        raise ValueError(f"{file}: expected {what}, but got {error} on reading") from error
    if not all(isinstance(value, Tensor) for value in stored.values()):
        raise ValueError(f"{file}: expected {what}, but got other things")
    state = {str(key).removeprefix("features."): value for key, value in stored.items()}
    try:
        features.load_state_dict({key: state[key] for key in features.state_dict() if key in state})
    except RuntimeError as error:  # PyTorch names what is missing or of another shape
        got = " ".join(str(error).split())
        raise ValueError(f"{file}: expected {what}, but got others: {got}") from error


def heads_of(net: str) -> list[Tensor]:
    """Read torchmetrics' linear heads (1, C, 1, 1), one per tap."""
    file = resources.files("torchmetrics") / "functional" / "image" / "lpips_models" / f"{net}.pth"
    state = torch.load(Path(str(file)), map_location="cpu", weights_only=True)
    return [state[f"lin{k}.model.1.weight"] for k in range(len(_TAPS[net]))]
