"""Images on disk and in memory: checked, decoded once, halved, laid over a background."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

from forewarp.data import jpeg
from forewarp.data.cache import CACHE
from forewarp.data.files import read_bytes
from forewarp.files import replace_file
from forewarp.scene.errors import SceneError

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MOST_PIXELS = 80_000_000  # of a larger image the decoder warns
_MOST_BYTES = 1 << 29


@dataclass(frozen=True)
class PngHeader:
    """What a PNG says of itself: ``size`` is (width, height) in pixels."""

    size: tuple[int, int]
    has_alpha: bool


def inspect_png(path: Path) -> PngHeader:
    """Size and kind of a PNG whose bytes are all there and unharmed; nothing is decoded.

    Raises:
        SceneError: where the file is missing, empty, truncated, harmed or not a PNG of 8 bits a channel.

    Cost: one read of the file.
    """
    return _inspect(_bytes(path), path)


def common_header(paths: Iterable[Path]) -> PngHeader:
    """The one size of all these PNGs; alpha where all of them have it.

    Raises:
        SceneError: where one is no good (see ``inspect_png``) or differs in size from the first.
    """
    headers = {path: inspect_png(path) for path in paths}
    size = next(iter(headers.values())).size
    for path, header in headers.items():
        if header.size != size:
            got = f"{header.size[0]} x {header.size[1]}"
            raise SceneError(f"{path}: expected {size[0]} x {size[1]} pixels as the first, but got {got}")
    return PngHeader(size, all(h.has_alpha for h in headers.values()))


def read_image(path: Path) -> Tensor:
    """A decoded image, uint8 (H, W, 4), straight alpha; without an alpha channel it is 255.

    Raises:
        SceneError: where the file is missing or its pixels cannot be decoded.
    """
    content = _bytes(path)
    if path.suffix.lower() == ".png":
        _inspect(content, path)  # the decoder does not look at the checksums of pixel data
    elif content.startswith(jpeg.SIGNATURE):
        check_size(jpeg.jpeg_size(io.BytesIO(content), path), path)
    else:  # of another kind the size is known only to its decoder
        raise SceneError(f"{path}: expected a PNG or JPEG image, but got a file of another kind")
    try:
        pixels = iio.imread(content, index=0, plugin="pillow", mode="RGBA")  # of a film the first
    except Exception as error:  # decoders raise OSError, SyntaxError, struct.error and more
        raise SceneError(
            f"{path}: expected an image, but got data that cannot be decoded ({error})"
        ) from error
    return torch.from_numpy(np.array(pixels))


def read_sized(path: Path, size: tuple[int, int]) -> Tensor:
    """``read_image`` of a file that must hold ``size`` (width, height); SceneError where it does not."""
    pixels = read_image(path)
    if (pixels.shape[1], pixels.shape[0]) != size:
        got = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise SceneError(f"{path}: expected {size[0]} x {size[1]} pixels, but got {got}")
    return pixels


def check_size(size: tuple[int, int], path: Path) -> None:
    """Refuse an image without pixels or with absurdly many, before it is decoded."""
    if not 0 < size[0] * size[1] <= _MOST_PIXELS:
        got = f"{size[0]} x {size[1]}"
        raise SceneError(f"{path}: expected an image of 1 to {_MOST_PIXELS} pixels, but got {got}")


def read_gray16(path: Path) -> np.ndarray:
    """A decoded grey PNG of 16 bits a pixel, uint16 (H, W).

    Raises:
        SceneError: where the file is missing, harmed or of another kind.
    """
    content = _bytes(path)
    _inspect(content, path, gray16=True)
    try:
        return np.asarray(iio.imread(content, index=0, plugin="pillow"), np.uint16)
    except Exception as error:  # as in read_image
        raise SceneError(
            f"{path}: expected an image, but got data that cannot be decoded ({error})"
        ) from error


def write_png(path: Path, pixels: Tensor | np.ndarray) -> None:
    """Write uint8 (H, W, 4) or (H, W, 3) as a PNG with or without alpha, whole or not at all."""
    mode = "RGBA" if pixels.shape[-1] == 4 else "RGB"
    replace_file(
        path, iio.imwrite("<bytes>", np.asarray(pixels), extension=".png", plugin="pillow", mode=mode)
    )


def halved(rgba: Tensor) -> Tensor:
    """The mean of each 2 x 2 block of *straight* RGBA, uint8 (H, W, 4) -> (H/2, W/2, 4), rounded.

    Averaging before the alpha is applied darkens silhouettes a little; the published numbers do so.

    >>> halved(torch.tensor([[[1], [2]], [[3], [5]]], dtype=torch.uint8)).item()
    3
    """
    blocks = rgba.to(torch.int16)
    total = blocks[0::2, 0::2] + blocks[0::2, 1::2] + blocks[1::2, 0::2] + blocks[1::2, 1::2]
    # total / 4 rounded half to even, in integers: exactly what the released half-size copies hold
    return ((total + 1 + ((total >> 2) & 1)) >> 2).to(torch.uint8)


def halved_depth(depth: Tensor) -> Tensor:
    """The mean of the foreground (> 0) of each 2 x 2 block, (H, W) -> (H/2, W/2); 0 where there is none."""
    h, w = depth.shape
    blocks = depth.reshape(h // 2, 2, w // 2, 2)
    return blocks.sum((1, 3)) / (blocks > 0).sum((1, 3)).clamp(min=1)


def composited(rgba: Tensor, background: Tensor) -> Tensor:
    """``rgb * a + (1 - a) * background``: uint8 (..., 4) over (3,) or (..., 3) gives float32 (..., 3)."""
    straight = rgba.float() / 255.0
    return torch.lerp(background.expand_as(straight[..., :3]), straight[..., :3], straight[..., 3:])


class CachedImage:
    """An image decoded at its first use and kept while there is room, uint8 (H, W, 4); it is read-only.

    ``size`` (width, height) is what the file must hold; with ``halve`` half of that is given.
    """

    def __init__(self, path: Path, size: tuple[int, int], halve: bool = False) -> None:
        self.path, self.size, self.halve = path, size, halve

    def __call__(self) -> Tensor:
        """The pixels; raises SceneError where the file cannot be decoded or has another size."""
        return CACHE.get(self, self._decode)

    def _decode(self) -> Tensor:
        pixels = read_sized(self.path, self.size)
        return halved(pixels) if self.halve else pixels


def _bytes(path: Path) -> bytes:
    content = read_bytes(path, _MOST_BYTES, "an image")
    if not content:
        raise SceneError(f"{path}: expected an image, but got an empty file")
    return content


def _inspect(content: bytes, path: Path, gray16: bool = False) -> PngHeader:
    if content[:8] != _SIGNATURE:
        raise SceneError(f"{path}: expected a PNG image, but got a file of another kind")
    at, kind, header, transparent = 8, b"", b"", False
    while kind != b"IEND":  # each chunk: length, kind, body, checksum of kind and body
        length = int.from_bytes(content[at : at + 4], "big")
        kind, end = content[at + 4 : at + 8], at + 8 + length
        if end + 4 > len(content):
            raise SceneError(
                f"{path}: expected a whole PNG image, but got a truncated one; copy the file again"
            )
        if zlib.crc32(memoryview(content)[at + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            raise SceneError(
                f"{path}: expected an unharmed PNG image, but got a wrong checksum; copy the file again"
            )
        # Of two headers the decoder takes the first and looks at it wherever it stands.
        if (kind == b"IHDR") != (at == 8):
            raise SceneError(f"{path}: expected a PNG that begins with its only header, but got another")
        header = content[at + 8 : end] if at == 8 else header
        transparent |= kind == b"tRNS"
        at = end + 4
    if len(header) != 13:
        raise SceneError(f"{path}: expected a PNG image, but got one without a header")
    width, height, bits, color = struct.unpack(">IIBB", header[:10])
    check_size((width, height), path)
    if gray16 and (bits, color) != (16, 0):
        raise SceneError(f"{path}: expected a grey PNG of 16 bits a pixel, but got {bits} bits a channel")
    if bits > 8 and not gray16:
        raise SceneError(f"{path}: expected 8 bits a channel, but got {bits}; convert the image")
    return PngHeader((width, height), transparent or color in (4, 6))
