"""Open images and films that anyone may have made: of known formats, of a bounded size, and nothing beside.

Pillow hands an EPS to another program, and ffmpeg opens what a playlist names, whatever the file is called.
"""

from __future__ import annotations

import io
import subprocess
import warnings
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import imageio_ffmpeg
import numpy as np

from forewarp.files import MOST_FILM, MOST_IMAGE, check_size, read_bytes

if TYPE_CHECKING:
    from PIL import Image, ImageCms

MOST_PIXELS = 80_000_000  # of an image and of a film's frame; Pillow warns a little above
MOST_DRAWN = 40_000_000  # pixels of an image that a run has drawn, which is read as float32
_SAME_COLORS, _PROFILES = 3, 16  # of 255, by which profiles that are sRGB may differ; kept conversions
FORMATS = ("PNG", "JPEG")
# ffmpeg's readers of films; others, such as those of playlists, open more than the file.
_CONTAINERS = (
    "mov,matroska,avi,mpegts,mpeg,mpegvideo,asf,flv,ogg,mxf,dv,gif,ivf,h264,hevc,m4v,obu,yuv4mpegpipe"
)


class TooManyPixels(ValueError):
    """An image has none, or more than ``MOST_PIXELS``."""


def open_image(stream: BinaryIO, most: int = MOST_PIXELS) -> Image.Image:
    """Open a PNG or JPEG, and decode nothing yet.

    Raises:
        TooManyPixels: for none or more than ``most``.
        PIL.UnidentifiedImageError: for another kind of file.
        OSError, SyntaxError, ValueError: for a harmed one, as Pillow raises them.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(stream, formats=FORMATS)
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise TooManyPixels("more") from error
    if not image.tile:
        raise UnidentifiedImageError
    if not 0 < image.width * image.height <= most:
        raise TooManyPixels(f"{image.width} x {image.height}")
    return image


def in_srgb(image: Image.Image, mode: str) -> Image.Image:
    """Convert an open image to one of Pillow's modes; RGB and RGBA to sRGB's colours, where its ICC profile,
    such as Display P3, has others. One that cannot be read, or is not of RGB, counts as sRGB.
    """
    from PIL import ImageCms

    converted, transform = image.convert(mode), None
    if mode in ("RGB", "RGBA") and (profile := image.info.get("icc_profile")):
        transform = _to_srgb(profile, mode)
    if transform is not None:
        ImageCms.applyTransform(converted, transform, inPlace=True)
    return converted


@lru_cache(_PROFILES)
def _to_srgb(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Make the conversion of colours of an ICC profile to sRGB; None where it changes next to nothing."""
    from PIL import Image, ImageCms

    colors = np.stack(np.meshgrid(*3 * [np.arange(0, 256, 17, dtype=np.uint8)]), -1).reshape(1, -1, 3)
    grid = Image.fromarray(colors).convert(mode)
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, mode, intent)
        changed = np.asarray(ImageCms.applyTransform(grid, transform))
    except Exception:  # PyCMSError, OSError and more, of a harmed profile
        return None
    apart = np.abs(changed[..., :3].astype(int) - colors).max()
    return transform if apart > _SAME_COLORS else None


def read_rgb(path: Path) -> np.ndarray:
    """Decode a PNG or JPEG: uint8 (H, W, 3), alpha dropped.

    Raises:
        OSError: where it cannot be read.
        ValueError: naming the file, for anything else than such an image of at most ``MOST_DRAWN`` pixels.
    """
    return _decoded(path, read_bytes(path, MOST_IMAGE))


def image_bytes(path: Path) -> bytes:
    """Read a PNG or JPEG as it is, to put it into a page.

    Raises:
        OSError, ValueError: as ``read_rgb``, and for a link, which may lead to any file.
    """
    if path.is_symlink():
        raise ValueError(f"{path}: expected an image, but got a link; put the image itself there")
    content = read_bytes(path, MOST_IMAGE)
    _decoded(path, content)
    return content


def _decoded(path: Path, content: bytes) -> np.ndarray:
    try:
        return np.array(open_image(io.BytesIO(content), MOST_DRAWN).convert("RGB"))
    except TooManyPixels as error:
        expected = f"an image of 1 to {MOST_DRAWN} pixels"
        raise ValueError(f"{path}: expected {expected}, but got {error}") from error
    except Exception as error:  # decoders raise OSError, SyntaxError, struct.error and more
        got = f"another file ({error})" if str(error) else "another file"
        raise ValueError(f"{path}: expected a PNG or JPEG image, but got {got}; make it anew") from error


def ffmpeg_reading(film: Path, *options: str) -> list[str]:
    """Return the words by which ffmpeg reads a film and no other file; options of the output follow.

    Args:
        film: that is read.
        options: of the input.

    Raises:
        OSError: where there is no file.
        ValueError: for a device, a pipe, and a file of more than ``MOST_FILM`` bytes.
    """
    check_size(film, MOST_FILM)
    guards = [
        "-protocol_whitelist",
        "file",
        "-format_whitelist",
        _CONTAINERS,
        "-max_pixels",
        str(MOST_PIXELS),
    ]
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin"]
    return [*call, *options, *guards, "-i", f"file:{film}"]


def film_bytes(path: Path) -> bytes:
    """Read an ``.mp4`` as it is, to put it into a page.

    Raises:
        OSError: where it cannot be read.
        ValueError: naming the file, for a link, and for what ffmpeg cannot decode as such.
    """
    if path.is_symlink():
        raise ValueError(f"{path}: expected a video, but got a link; put the video itself there")
    content = read_bytes(path, MOST_FILM)
    first = ["-map", "0:v:0", "-frames:v", "1", "-f", "null", "-"]
    done = subprocess.run([*ffmpeg_reading(path, "-v", "error"), *first], capture_output=True)
    if content[4:8] != b"ftyp" or done.returncode:
        raise ValueError(f"{path}: expected an MP4 video, but got another file; render it anew")
    return content
