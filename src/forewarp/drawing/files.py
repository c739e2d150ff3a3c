"""Write images and videos, whole or not at all."""

from __future__ import annotations

import errno
import subprocess
import tempfile
from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import torch
from torch import Tensor

from forewarp.files import written_whole

FORMATS = ("mp4", "gif", "png")
_SMALLER = ((1, 20), (1, 26), (1, 32), (2, 26), (2, 32), (4, 32))  # size to divide by, loss (ffmpeg's crf)


def to_bytes(image: Tensor) -> np.ndarray:
    """Round (H, W, 3) in [0, 1] to uint8 (H, W, 3)."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def write_png(path: Path, image: Tensor) -> Path:
    """Write (H, W, 3) in [0, 1]; make the folder."""
    with written_whole(path) as beside:
        iio.imwrite(beside, to_bytes(image), extension=".png")
    return path


def png_bytes(image: Tensor) -> bytes:
    """Encode (H, W, 3) in [0, 1]."""
    return iio.imwrite("<bytes>", to_bytes(image), extension=".png")


def jpeg_bytes(image: Tensor, quality: int) -> bytes:
    """Encode (H, W, 3) in [0, 1] with loss; ``quality`` in [1, 95]."""
    return iio.imwrite("<bytes>", to_bytes(image), extension=".jpg", quality=quality, subsampling=0)


def read_image(path: Path) -> Tensor:
    """Read an image as (H, W, 3) in [0, 1]; alpha is dropped."""
    return torch.from_numpy(iio.imread(path)[..., :3].copy()).float() / 255


def smaller_video(path: Path, most: int) -> tuple[bytes, str]:
    """Encode an ``.mp4`` with more loss, and at last smaller, until it has at most ``most`` bytes.

    Returns:
        the file's bytes, and in words what was changed; no bytes if nothing fits.

    Raises:
        OSError: naming ``path``, if ffmpeg cannot read it.
    """
    with tempfile.TemporaryDirectory(prefix="forewarp-") as folder:
        file = Path(folder) / "video.mp4"
        for shrink, loss in _SMALLER:
            even = f"scale=trunc(iw/{2 * shrink})*2:trunc(ih/{2 * shrink})*2:flags=area"
            options = f"-vf {even} -crf {loss} -pix_fmt yuv420p -movflags +faststart -an".split()
            call = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-i", str(path)]
            if subprocess.run([*call, *options, str(file)], capture_output=True).returncode:
                raise OSError(errno.EIO, "ffmpeg could not read it", str(path))
            if file.stat().st_size <= most:
                size = f", at 1/{shrink} of its width and height" if shrink > 1 else ""
                return file.read_bytes(), f"encoded again with more loss{size}"
    return b"", "left out"


def write_video(path: Path, images: Iterable[Tensor], *, fps: float) -> Path:
    """Write images (H, W, 3) in [0, 1], taken one by one, in the format that the suffix names.

    ``.mp4`` and ``.gif`` are files; ``.png`` makes a folder of images, named like the file without suffix.

    Returns:
        the file or the folder.
    """
    if path.suffix == ".png":
        folder = path.with_suffix("")
        for number, image in enumerate(images):
            write_png(folder / f"{number:04d}.png", image)
        return folder
    frames = map(to_bytes, images)
    with written_whole(path) as beside:
        if path.suffix == ".gif":
            iio.imwrite(beside, list(frames), extension=".gif", duration=1000 / fps, loop=0)
        else:
            _write_mp4(beside, frames, fps)
    return path


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    # The codec takes even sides only.
    frames = (np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), mode="edge") for f in frames)
    first = next(frames)
    # The default block of 16 would stretch the image; 2 is the smallest that the codec allows.
    options = {"fps": fps, "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    writer = imageio_ffmpeg.write_frames(str(path), first.shape[1::-1], **options)
    writer.send(None)
    try:
        for frame in chain([first], frames):
            if frame.shape != first.shape:  # ffmpeg would take it, and shear all that follow
                expected = f"images of {first.shape}, as the first"
                raise ValueError(f"video: expected {expected}, but got {frame.shape}")
            writer.send(np.ascontiguousarray(frame))
    except OSError as error:  # its message has many lines and does not name the file
        raise OSError(errno.EIO, "ffmpeg could not go on (is the disk full?)", str(path)) from error
    finally:
        writer.close()
