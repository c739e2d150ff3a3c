"""Read, check, keep and write images; reduce them and lay them over a background."""

from __future__ import annotations

import io
import os
import warnings
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from forewarp.clock import left_out
from forewarp.data.files import SceneError, opened
from forewarp.files import MOST_IMAGE, written_whole
from forewarp.ops.grid import block_means, block_sums


class ImageCache:
    """Keep a tensor for each owner while the owner lives and all together take at most ``limit`` bytes.

    The least recently used goes first. What is larger than ``limit`` is never kept.

    >>> import torch
    >>> class Owner: pass
    >>> cache, a, b = ImageCache(4), Owner(), Owner()
    >>> for owner in (a, b):
    ...     _ = cache.get(owner, lambda: torch.zeros(3, dtype=torch.uint8))
    >>> cache.bytes
    3
    """

    def __init__(self, limit: int) -> None:
        self._kept: OrderedDict[int, tuple[weakref.ref, Tensor]] = OrderedDict()
        self.bytes, self.limit = 0, limit

    def get(self, owner: object, make: Callable[[], Tensor]) -> Tensor:
        """Give what is kept for ``owner``, or make and keep it; treat it as read-only."""
        key = id(owner)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][1]
        with left_out():  # reading pictures is no training
            made = make()
        if made.nbytes <= self.limit:
            # Freed as soon as the owner dies; until then no other object can have its id.
            self._kept[key] = (weakref.ref(owner, lambda _: self._drop(key)), made)
            self.bytes += made.nbytes
            self._shrink()
        return made

    def resize(self, limit: int) -> None:
        """Allow ``limit`` bytes from now on.

        Raises:
            SceneError: for anything but a number >= 0.
        """
        if isinstance(limit, bool) or not isinstance(limit, (int, float)) or not 0 <= limit < float("inf"):
            raise SceneError(f"data.cache_bytes: expected a number of bytes >= 0, but got {limit!r}")
        self.limit = int(limit)
        self._shrink()

    def _shrink(self) -> None:
        while self.bytes > self.limit:
            self._drop(next(iter(self._kept)))

    def _drop(self, key: int) -> None:
        _, gone = self._kept.pop(key)
        self.bytes -= gone.nbytes


CACHE = ImageCache(1_500_000_000)


_FORMATS = ("PNG", "JPEG")
_MOST_PIXELS = 80_000_000  # Pillow warns a little above
_JPEG_END, _JPEG_TAIL = b"\xff\xd9", 4096  # some cameras write a little behind the end
_FOREGROUND = 127  # a mask above it is foreground; masks are lossy, so never quite 0 or 255


@dataclass(frozen=True)
class Header:
    """What an image says of itself: ``size`` is (width, height) in pixels."""

    size: tuple[int, int]
    has_alpha: bool


def inspect_image(path: Path) -> Header:
    """Check that a PNG or JPEG is whole and of a kind that is read; decode nothing.

    Raises:
        SceneError: where the file is missing, empty, truncated, harmed, too large or of another kind.

    Cost: one read of a PNG, whose checksums are compared; two small reads of a JPEG, which has none.
    """
    with opened(path, MOST_IMAGE, "an image") as stream:
        return _inspect(stream, path)


def common_header(paths: Iterable[Path]) -> Header:
    """Check images that must have one size; alpha where all of them have it.

    Raises:
        SceneError: as ``inspect_image``, and where one differs in size from the first.
    """
    headers = {path: inspect_image(path) for path in paths}
    size = next(iter(headers.values())).size
    for path, header in headers.items():
        if header.size != size:
            raise SceneError(f"{path}: expected {_by(size)} pixels as the first, but got {_by(header.size)}")
    return Header(size, all(h.has_alpha for h in headers.values()))


def read_image(path: Path, *, upright: bool = False) -> Tensor:
    """Decode a PNG or JPEG: uint8 (H, W, 4), straight alpha; without an alpha channel it is 255.

    Args:
        path: of the image.
        upright: turn it as its EXIF orientation says; else it is as stored.

    Raises:
        SceneError: as ``inspect_image``, and where the pixels cannot be decoded.
    """
    return torch.from_numpy(_decode(path, "RGBA", upright))


def read_sized(path: Path, size: tuple[int, int]) -> Tensor:
    """``read_image`` of a file that must hold ``size`` (width, height); SceneError where it does not."""
    pixels = read_image(path)
    if (got := (pixels.shape[1], pixels.shape[0])) != size:
        raise SceneError(f"{path}: expected {_by(size)} pixels, but got {_by(got)}")
    return pixels


def read_gray16(path: Path) -> np.ndarray:
    """Decode a grey PNG of 16 bits a pixel: uint16 (H, W).

    Raises:
        SceneError: as ``read_image``, and for an image of another kind.
    """
    return _decode(path, "I;16").astype(np.uint16)


def write_png(path: Path, pixels: Tensor | np.ndarray) -> None:
    """Write uint8 (H, W, 4) or (H, W, 3) as a PNG with or without alpha, whole or not at all."""
    with written_whole(path) as beside:
        Image.fromarray(np.ascontiguousarray(pixels)).save(beside, "PNG")


def write_jpeg(path: Path, pixels: Tensor | np.ndarray, quality: int = 97) -> None:
    """Write uint8 (H, W, 3) or (H, W) as a JPEG of full colour resolution, whole or not at all."""
    pixels = np.ascontiguousarray(pixels)
    if pixels.dtype != np.uint8:
        raise ValueError(f"{path}: expected uint8 pixels, but got {pixels.dtype}")
    with written_whole(path) as beside:
        Image.fromarray(pixels).save(beside, "JPEG", quality=quality, subsampling=0)


def reduced(rgba: Tensor, by: int = 2) -> Tensor:
    """Average each block of ``by`` x ``by`` pixels of *straight* RGBA, uint8 (H, W, 4) -> (H/by, W/by, 4).

    Averaging before the alpha is applied darkens silhouettes a little; the published numbers do so. Rounded
    half to even: exactly what the released half-size copies hold.

    >>> reduced(torch.tensor([[[1], [2]], [[3], [5]]], dtype=torch.uint8)).item()
    3
    """
    return block_means(rgba, by).round().to(torch.uint8)


def halved_cutout(rgba: Tensor) -> Tensor:
    """Average each 2 x 2 block, uint8 (H, W, 4) -> (H // 2, W // 2, 4); the colour is the foreground's.

    What lies behind a cut-out is another place; averaged in, it would rim every silhouette.

    Args:
        rgba: colour is 0 wherever alpha is 0; all other pixels count alike.

    >>> halved_cutout(torch.tensor([[[9, 9, 9, 255], [0] * 4], [[0] * 4, [3, 3, 3, 255]]], dtype=torch.uint8))
    tensor([[[  6,   6,   6, 128]]], dtype=torch.uint8)
    """
    height, width = (n // 2 * 2 for n in rgba.shape[:2])
    rgba = rgba[:height, :width]
    sums = block_sums(rgba[..., :3])
    count = block_sums(rgba[..., 3] > 0)[..., None].clamp(min=1)
    color = torch.div(sums + count // 2, count, rounding_mode="floor").to(torch.uint8)
    return torch.cat([color, reduced(rgba[..., 3:])], -1)


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
        """Give the pixels; SceneError where the file cannot be decoded or has another size."""
        return CACHE.get(self, self._decode)

    def _decode(self) -> Tensor:
        pixels = read_sized(self.path, self.size)
        return reduced(pixels) if self.halve else pixels


class MaskedImage:
    """An image cut out by a mask in another file, decoded when asked for: uint8 (H, W, 4), 0 where alpha is.

    Where the image has an alpha of its own, it counts inside the mask. Only the smallest rectangle that holds
    the foreground is kept, a fraction of most images.

    Args:
        image, mask: files of one size; a mask's first channel counts, above 127 is foreground.
        size: (width, height), what both must hold.
        halve: average 2 x 2 pixels; an odd last row or column is cut off.
    """

    def __init__(self, image: Path, mask: Path, size: tuple[int, int], halve: bool = False) -> None:
        self.image, self.mask, self.size, self.halve = image, mask, size, halve
        self._corner = (0, 0)

    def __call__(self) -> Tensor:
        """Give the pixels; SceneError where a file cannot be decoded or has another size."""
        part = CACHE.get(self, self._decode)
        (row, column), (rows, columns) = self._corner, part.shape[:2]
        width, height = (n // 2 if self.halve else n for n in self.size)
        whole = torch.zeros(height, width, 4, dtype=torch.uint8)
        whole[row : row + rows, column : column + columns] = part
        return whole

    def _decode(self) -> Tensor:
        """Cut out the foreground's rectangle and note where it lies."""
        rgba = read_sized(self.image, self.size)
        on = (read_sized(self.mask, self.size)[..., 0] > _FOREGROUND) & (rgba[..., 3] > 0)
        rgba *= on[..., None]
        if self.halve:
            rgba = halved_cutout(rgba)
        foreground = rgba[..., 3] > 0
        if not bool(foreground.any()):
            return rgba[:0, :0].clone()
        rows, columns = (foreground.any(axis).nonzero()[:, 0] for axis in (1, 0))
        self._corner = (int(rows[0]), int(columns[0]))
        part = rgba[self._corner[0] : int(rows[-1]) + 1, self._corner[1] : int(columns[-1]) + 1]
        return part.clone()


def _decode(path: Path, mode: str, upright: bool = False) -> np.ndarray:
    """Decode the first picture of a file in one of Pillow's modes, turned upright if wanted."""
    with opened(path, MOST_IMAGE, "an image") as stream:
        content = io.BytesIO(stream.read())
    _inspect(content, path, mode)
    content.seek(0)
    try:
        # In one expression: while a name keeps the image alive, its memory is not used again.
        turn = ImageOps.exif_transpose if upright else (lambda image: image)
        return np.array(turn(Image.open(content, formats=_FORMATS)).convert(mode))
    except Exception as error:  # decoders raise OSError, SyntaxError, struct.error and more
        raise SceneError(
            f"{path}: expected an image, but got data that cannot be decoded ({error})"
        ) from error


def _inspect(stream: BinaryIO, path: Path, mode: str = "RGBA") -> Header:
    """Check an open image, which is to be read in one of Pillow's modes."""
    image = _identified(stream, path)
    if not 0 < image.width * image.height <= _MOST_PIXELS:
        raise SceneError(
            f"{path}: expected an image of 1 to {_MOST_PIXELS} pixels, but got {_by(image.size)}"
        )
    has_16_bits = ";16" in str(image.tile[0][3])  # the mode alone hides it
    if mode == "I;16" and not (has_16_bits and image.mode.startswith("I")):
        raise SceneError(f"{path}: expected a grey PNG of 16 bits a pixel, but got mode {image.mode}")
    if mode == "RGBA" and (has_16_bits or image.mode == "CMYK"):
        got = "16 bits" if has_16_bits else "CMYK"
        raise SceneError(f"{path}: expected 8 bits a channel, grey or RGB, but got {got}; convert the image")
    header = Header(image.size, image.has_transparency_data)
    try:
        whole = image.verify() is None if image.format == "PNG" else _has_jpeg_end(stream)
    except Exception:  # OSError, SyntaxError and more
        whole = False
    if not whole:
        raise SceneError(
            f"{path}: expected a whole image, but got a truncated or harmed one; copy the file again"
        )
    return header


def _identified(stream: BinaryIO, path: Path) -> Image.Image:
    """Read an image's header."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(stream, formats=_FORMATS)
        if not image.tile:
            raise UnidentifiedImageError
        return image
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise SceneError(f"{path}: expected an image of 1 to {_MOST_PIXELS} pixels, but got more") from error
    except Exception as error:  # OSError, ValueError and more
        got = str(error)
        if isinstance(error, UnidentifiedImageError):
            empty = not stream.seek(0, os.SEEK_END)
            got = "an empty file" if empty else "another kind of file or a harmed header"
        raise SceneError(f"{path}: expected a PNG or JPEG image, but got {got}") from error


def _has_jpeg_end(stream: BinaryIO) -> bool:
    """Tell whether the end's marker follows, which cannot occur among the pixels; Pillow does not look."""
    here, size = stream.tell(), stream.seek(0, os.SEEK_END)
    for begin in (max(here, size - _JPEG_TAIL), here):
        stream.seek(begin)
        if _JPEG_END in stream.read():
            return True
    return False


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
