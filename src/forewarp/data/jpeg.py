"""JPEG images: their headers read without decoding, and written."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import imageio.v3 as iio
import numpy as np
from torch import Tensor

from forewarp.files import replace_file
from forewarp.scene.errors import SceneError

SIGNATURE = b"\xff\xd8"
_END = b"\xff\xd9"
_TAIL = 4096  # bytes: where the end is looked for first; some cameras write a little behind it
_FRAMES = {0xC0, 0xC1, 0xC2}  # baseline, extended and progressive: what decoders read
_OTHER_FRAMES = {*range(0xC3, 0xD0)} - {0xC4, 0xC8, 0xCC}
_SCAN = 0xDA


def inspect_jpeg(path: Path) -> tuple[int, int]:
    """Size (width, height) in pixels of a JPEG that is there from its first marker to its last.

    Raises:
        SceneError: where the file is missing, empty, truncated, no JPEG, or of a kind that is not decoded.

    Cost: a few small reads, whatever the file's size: about 30 microseconds.
    """
    try:
        with open(path, "rb", opener=_at_once) as stream:
            return jpeg_size(stream, path)
    except OSError as error:
        raise SceneError(f"{path}: expected an image, but got {error.strerror or error}") from error


def _at_once(path: str, flags: int) -> int:
    """Open without waiting for whoever fills a pipe."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def jpeg_size(stream: BinaryIO, path: Path) -> tuple[int, int]:
    """As ``inspect_jpeg``, of an open file or of bytes; ``path`` names it in errors."""
    start = stream.read(2)
    if not start:
        raise SceneError(f"{path}: expected an image, but got an empty file")
    if start != SIGNATURE:
        raise SceneError(f"{path}: expected a JPEG image, but got a file of another kind")
    header, kind = b"", 0
    while kind != _SCAN:
        kind, length = _next_segment(stream, path)
        if kind in _OTHER_FRAMES:
            raise SceneError(
                f"{path}: expected a baseline or progressive JPEG image, but got another kind; convert it"
            )
        if kind not in _FRAMES:
            stream.seek(length - 2, os.SEEK_CUR)
        elif header:  # of two sizes the decoder takes the last
            raise SceneError(f"{path}: expected a JPEG image with one header, but got two")
        else:
            header = stream.read(length - 2) or b"-"
    if not header:
        raise SceneError(f"{path}: expected a JPEG image, but got one without a header")
    if len(header) < 6 or not _has_end(stream):
        raise SceneError(f"{path}: expected a whole JPEG image, but got a truncated one; copy the file again")
    bits, channels = header[0], header[5]
    if bits != 8 or channels not in (1, 3):
        raise SceneError(
            f"{path}: expected 1 or 3 channels of 8 bits, but got {channels} of {bits}; convert the image"
        )
    return int.from_bytes(header[3:5], "big"), int.from_bytes(header[1:3], "big")


def write_jpeg(path: Path, pixels: Tensor | np.ndarray, quality: int = 97) -> None:
    """Write uint8 (H, W, 3) or (H, W) as a JPEG of full colour resolution, whole or not at all."""
    pixels = np.asarray(pixels)
    if pixels.dtype != np.uint8:
        raise ValueError(f"{path}: expected uint8 pixels, but got {pixels.dtype}")
    options = {"extension": ".jpg", "plugin": "pillow", "quality": quality, "subsampling": 0}
    replace_file(path, iio.imwrite("<bytes>", pixels, **options))


def _next_segment(stream: BinaryIO, path: Path) -> tuple[int, int]:
    """A segment's kind and its length, which counts itself."""
    marker = stream.read(2)
    while marker == b"\xff\xff":  # padding
        marker = marker[1:] + stream.read(1)
    length = int.from_bytes(stream.read(2), "big")
    if len(marker) < 2:
        raise SceneError(f"{path}: expected a whole JPEG image, but got a truncated one; copy the file again")
    if marker[0] != 0xFF or length < 2:
        raise SceneError(f"{path}: expected an unharmed JPEG image, but got a broken header")
    return marker[1], length


def _has_end(stream: BinaryIO) -> bool:
    """Whether the end's marker follows; in the pixels' data it cannot occur."""
    here, size = stream.tell(), stream.seek(0, os.SEEK_END)
    for begin in (max(here, size - _TAIL), here):
        stream.seek(begin)
        if _END in stream.read():
            return True
    return False
