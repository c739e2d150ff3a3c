"""Draw images (H, W, 3) in [0, 1], and write images and videos whole or not at all."""

from __future__ import annotations

import errno
import math
import os
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

from forewarp.files import disk_error, replace_file, written_whole
from forewarp.media import ffmpeg_reading, film_bytes, read_rgb

# Far to near, steadily lighter, so that it also works in grey.
_DEPTH = ((0.16, 0.11, 0.33), (0.17, 0.36, 0.55), (0.16, 0.61, 0.57), (0.55, 0.80, 0.36), (0.99, 0.91, 0.45))
_ERROR = ((0.0, 0.0, 0.0), (0.45, 0.05, 0.25), (0.90, 0.30, 0.10), (1.0, 0.78, 0.25), (1.0, 1.0, 0.9))
_STILL = 0.88  # grey of what does not move; white is empty
# Characters of numbers, 3 pixels wide and 5 high: the bits of a row as an octal digit.
_GLYPHS = {"0": "75557", "1": "26227", "2": "71747", "3": "71717", "4": "55711", "5": "74717", "6": "74757"}
_GLYPHS |= {"7": "71222", "8": "75757", "9": "75717", ".": "00002", "e": "74647", "-": "00700", "+": "02720"}
_BAR, _LINE = 46, 7  # pixels: a bar's length, a line's height


def ramp(values: Tensor, anchors: tuple[tuple[float, float, float], ...]) -> Tensor:
    """Map values (...) in [0, 1] to colours (..., 3), piecewise linear through ``anchors``.

    >>> ramp(torch.tensor(0.5), ((0.0, 0.0, 0.0), (1.0, 0.5, 0.0))).tolist()
    [0.5, 0.25, 0.0]
    """
    table = torch.tensor(anchors, device=values.device)
    at = values.clamp(0, 1) * (len(anchors) - 1)
    low = at.floor().long().clamp(max=len(anchors) - 2)
    return torch.lerp(table[low], table[low + 1], (at - low)[..., None])


def hues(turns: Tensor) -> Tensor:
    """Map fractions of a turn (...) around the colour wheel to hues (..., 3); 0 is red."""
    thirds = torch.arange(3, device=turns.device) / 3
    return 0.5 + 0.45 * torch.cos(2 * math.pi * (turns[..., None] - thirds))


def depth_colors(depth: Tensor, opacity: Tensor, ends: tuple[float, float] | None = None) -> Tensor:
    """Draw depth (H, W) over white, near bright, with its scale in the lower right corner, in world units.

    The scale spans the image's own ends. A small image has none, nor one whose ``ends`` are given.
    """
    bare, ends = ends is not None, ends or depth_ends(depth, opacity)
    if ends is None:
        return depth.new_ones(*depth.shape, 3)
    near, far = ends
    colors = ramp((far - depth) / max(far - near, 1e-6 * far, torch.finfo(depth.dtype).tiny), _DEPTH)
    colors = torch.lerp(torch.ones_like(colors), colors, opacity[..., None].clamp(0, 1))
    scale = at_least(depth_scale(near, far), _LINE * max(2, min(depth.shape) // 100)).to(colors)
    height, width = scale.shape[:2]
    if not bare and height < depth.shape[0] and width < depth.shape[1]:
        colors[-height:, -width:] = scale
    return colors


def depth_ends(depth: Tensor, opacity: Tensor) -> tuple[float, float] | None:
    """Return the nearest and the farthest depth of opaque pixels, but for 1 % at either end; None if there
    are none.
    """
    solid = depth[opacity > 0.5]
    if not len(solid):
        return None
    ends = torch.quantile(solid[:: max(1, len(solid) // 100_000)], depth.new_tensor([0.01, 0.99]))
    return tuple(ends.tolist())


def depth_scale(near: float, far: float) -> Tensor:
    """Draw the bar of depth colours (14, 48, 3) over white, its ends as numbers of three digits above it."""
    drawn = torch.ones(2 * _LINE, _BAR + 2, 3)
    drawn[_LINE:-1, 1:-1] = ramp(torch.linspace(1, 0, _BAR), _DEPTH)
    ends = [_written(f"{value:.3g}") for value in (near, far)]
    for ink, left in zip(ends, (1, 1 + _BAR - ends[1].shape[1])):
        drawn[1:6, left : left + ink.shape[1]][ink] = 0.0
    return drawn


def _written(number: str) -> Tensor:
    """Return which pixels (5, 4 N - 1) of a line the N characters of a number fill."""
    rows = [[int(_GLYPHS[c][row]) << 1 >> 3 - x & 1 for c in number for x in range(4)] for row in range(5)]
    return torch.tensor(rows, dtype=torch.bool)[:, :-1]


def error_colors(a: Tensor, b: Tensor, full: float = 0.25) -> Tensor:
    """Draw the mean absolute difference of two images (H, W, 3): black is 0, white ``full`` or more."""
    return ramp((a - b).abs().mean(-1) / full, _ERROR)


def flow_colors(flow: Tensor, opacity: Tensor, full: float | None = None) -> Tensor:
    """Draw flow (H, W, 2) in pixels over white: hue is the direction, saturation the length.

    Args:
        flow: right and down.
        opacity: (H, W).
        full: length of full saturation; None: the 98 % quantile, at least a pixel.
    """
    length = flow.norm(dim=-1)
    if full is None:
        solid = length[opacity > 0.5][:: max(1, length.numel() // 100_000)]
        full = max(1.0, float(torch.quantile(solid, 0.98))) if len(solid) else 1.0
    turns = torch.atan2(flow[..., 1], flow[..., 0]) / (2 * math.pi)
    still = torch.full_like(flow[..., :1], _STILL).expand(*length.shape, 3)
    colors = torch.lerp(still, hues(turns), (length / full).clamp(max=1)[..., None])
    return torch.lerp(torch.ones_like(colors), colors, opacity[..., None].clamp(0, 1))


def with_wheel(image: Tensor, share: float = 0.16) -> Tensor:
    """Draw the wheel of flow colours into the lower right corner of an image (H, W, 3)."""
    height, width = image.shape[:2]
    size = max(8, int(share * min(height, width)))
    if size + 4 > min(height, width):
        return image
    axis = (torch.arange(size, device=image.device) + 0.5) / size * 2 - 1
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    inside = ((1 - torch.hypot(x, y)) * size / 2).clamp(0, 1)
    rows, columns = slice(height - size - 2, height - 2), slice(width - size - 2, width - 2)
    wheel, image = flow_colors(torch.stack([x, y], -1), torch.ones_like(x), 1.0), image.clone()
    image[rows, columns] = torch.lerp(image[rows, columns], wheel, inside[..., None])
    return image


def in_a_row(images: list[Tensor], gap: int = 4) -> Tensor:
    """Put images (H, W_i, 3) of one height side by side, with white gaps."""
    white = images[0].new_ones(images[0].shape[0], gap, 3)
    return torch.cat([part for image in images for part in (white, image)][1:], 1)


def at_least(image: Tensor, side: int) -> Tensor:
    """Repeat every pixel of an image (H, W, 3) so often that its shorter side has ``side`` or more.

    >>> at_least(torch.zeros(100, 120, 3), 300).shape
    torch.Size([300, 360, 3])
    """
    times = max(1, math.ceil(side / min(image.shape[:2])))
    return image.repeat_interleave(times, 0).repeat_interleave(times, 1)


def at_most(image: Tensor, side: int) -> Tensor:
    """Shrink an image (H, W, 3) whose longer side has more than ``side`` pixels; each becomes a mean.

    >>> at_most(torch.zeros(100, 120, 3), 60).shape
    torch.Size([50, 60, 3])
    """
    height, width = image.shape[:2]
    scale = min(1, side / max(height, width))
    return area_means(image, (max(1, round(height * scale)), max(1, round(width * scale))))


def area_means(image: Tensor, shape: tuple[int, int]) -> Tensor:
    """Resize an image (H, W, 3) to a smaller shape; each pixel is the mean of those that it covers."""
    channels_first = image.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(channels_first, shape, mode="area")[0].permute(1, 2, 0)


_SPACING = 0.5  # pixels between the discs that make a line
_MOST = 2048  # discs per segment; longer ones leave any image


def draw_discs(image: Tensor, at: Tensor, colors: Tensor, alpha: Tensor, radius: float) -> Tensor:
    """Draw discs over an image. Where they overlap, average the colours and take the largest opacity.

    Args:
        image: (H, W, 3).
        at: centres (M, 2) in pixels from the top-left corner.
        colors: (M, 3).
        alpha: (M,).
        radius: in pixels.

    Cost: linear in M and in the square of ``radius``.
    """
    height, width = image.shape[:2]
    reach = torch.arange(-int(radius + 1.5), int(radius + 1.5) + 1, device=at.device)
    pixel = at.floor().long()[:, None] + torch.cartesian_prod(reach, reach)  # (M, K, 2)
    gap = (pixel + 0.5 - at[:, None]).norm(dim=-1)
    cover = (radius + 0.5 - gap).clamp(0, 1) * alpha[:, None]
    x, y = pixel.unbind(-1)
    kept = (cover > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    flat, cover = (y * width + x)[kept], cover[kept]
    colors = colors[:, None].expand(-1, pixel.shape[1], -1)[kept]
    ink = image.new_zeros(height * width, 3).index_add_(0, flat, colors * cover[:, None])
    total = image.new_zeros(height * width).index_add_(0, flat, cover)
    most = image.new_zeros(height * width).scatter_reduce_(0, flat, cover, "amax")
    mixed = torch.lerp(image.reshape(-1, 3), ink / total.clamp(min=1e-8)[:, None], most[:, None])
    return mixed.reshape(image.shape)


def sample_lines(vertices: Tensor) -> tuple[Tensor, Tensor]:
    """Sample points along polylines, half a pixel apart.

    Args:
        vertices: (N, T, C); the first two channels are pixels, all are interpolated.

    Returns:
        points (M, C) and the line of each (M,).
    """
    begin, end = vertices[:, :-1].flatten(0, 1), vertices[:, 1:].flatten(0, 1)
    count = ((end - begin)[:, :2].norm(dim=-1) / _SPACING).ceil().long().clamp(1, _MOST)
    segment = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    place = torch.arange(len(segment), device=count.device) - (count.cumsum(0) - count)[segment]
    share = (place / count[segment])[:, None]
    return torch.lerp(begin[segment], end[segment], share), segment // (vertices.shape[1] - 1)


def hidden(at: Tensor, distance: Tensor, depth: Tensor, slack: float) -> Tensor:
    """Tell which points lie more than ``slack`` behind the surface: (M,) bool.

    Args:
        at: (M, 2) pixels.
        distance: (M,) along the ray.
        depth: (H, W) of the surface, infinite where there is none.
        slack: in the unit of ``distance``.
    """
    height, width = depth.shape
    x, y = at.floor().long().unbind(-1)
    return distance > depth[y.clamp(0, height - 1), x.clamp(0, width - 1)] + slack


FORMATS = ("mp4", "gif", "png")
_CRF = "10"  # loss of films, as ffmpeg's crf
_SMALLER = ((1, 20), (1, 26), (1, 32), (2, 26), (2, 32), (4, 32))  # size to divide by, loss (ffmpeg's crf)


def to_bytes(image: Tensor) -> np.ndarray:
    """Round (H, W, 3) in [0, 1] to uint8 (H, W, 3)."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def write_png(path: Path, image: Tensor) -> Path:
    """Write (H, W, 3) in [0, 1]; make the folder."""
    replace_file(path, png_bytes(image))
    return path


def png_bytes(image: Tensor) -> bytes:
    """Encode (H, W, 3) in [0, 1], rounded as metrics round it."""
    return iio.imwrite("<bytes>", to_bytes(image.double()), extension=".png")


def jpeg_bytes(image: Tensor, quality: int) -> bytes:
    """Encode (H, W, 3) in [0, 1] with loss; ``quality`` in [1, 95]."""
    return iio.imwrite("<bytes>", to_bytes(image), extension=".jpg", quality=quality, subsampling=0)


def image_size(path: Path) -> tuple[int, int]:
    """Read the width and height of an image, or of the first one of a film, in pixels."""
    return tuple(iio.improps(path, index=0).shape[1::-1])


def read_image(path: Path) -> Tensor:
    """Read a PNG or JPEG as (H, W, 3) in [0, 1]; alpha is dropped. Raises as ``media.read_rgb``."""
    return torch.from_numpy(read_rgb(path)).float().div_(255)


def video_within(path: Path, most: int) -> tuple[bytes, str]:
    """Read an ``.mp4``; encode it with more loss, and at last smaller, until it has at most ``most`` bytes.

    Returns:
        the file's bytes, and in words what was changed; no bytes if nothing fits.

    Raises:
        OSError: naming ``path``, if ffmpeg cannot read it.
        ValueError: as ``media.film_bytes``.
    """
    if len(content := film_bytes(path)) <= most:
        return content, ""
    for shrink, loss in _SMALLER:
        with tempfile.TemporaryFile() as file:  # without a name, so that a killed process leaves none
            even = f"scale=trunc(iw/{2 * shrink})*2:trunc(ih/{2 * shrink})*2:flags=area"
            options = f"-vf {even} -crf {loss} -pix_fmt yuv420p -movflags +faststart -an".split()
            call = [*ffmpeg_reading(path, "-y", "-v", "error"), *options]
            call += ["-f", "mp4", f"/dev/fd/{file.fileno()}"]
            if subprocess.run(call, capture_output=True, pass_fds=[file.fileno()]).returncode:
                raise OSError(errno.EIO, "ffmpeg could not read it", str(path))
            if file.seek(0, os.SEEK_END) <= most:
                file.seek(0)
                size = f", at 1/{shrink} of its width and height" if shrink > 1 else ""
                return file.read(), f"encoded again with more loss{size}"
    return b"", "left out"


def write_video(path: Path, images: Iterable[Tensor], *, fps: float, sound: Path | None = None) -> Path:
    """Write images (H, W, 3) in [0, 1], taken one by one, in the format that the suffix names.

    ``.mp4`` and ``.gif`` are files; ``.png`` makes a folder of images, named like the file without suffix.
    ``sound`` is a WAV file, of which an ``.mp4`` gets an AAC track.

    Returns:
        the file or the folder.

    Raises:
        OSError: naming ``path``, where it cannot be written whole; what was there then stays.
    """
    if path.suffix == ".png":
        folder, count = path.with_suffix(""), 0
        for count, image in enumerate(images, 1):
            write_png(folder / f"{count - 1:04d}.png", image)
        keep_first(folder, count)
        return folder
    frames = map(to_bytes, images)
    if path.suffix == ".gif":
        options = {"extension": ".gif", "duration": 1000 / fps, "loop": 0}
        replace_file(path, iio.imwrite("<bytes>", list(frames), **options))
        return path
    with written_whole(path) as beside:
        _write_mp4(beside, frames, fps, sound)
    return path


def keep_first(folder: Path, count: int) -> None:
    """Delete what an earlier, longer series left: ``0000.png`` ... from ``count`` on."""
    for path in folder.glob("[0-9][0-9][0-9][0-9].png"):
        if int(path.stem) >= count:
            path.unlink()


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float, sound: Path | None) -> None:
    # The codec takes even sides only.
    frames = (np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), mode="edge") for f in frames)
    first = next(frames)
    height, width, _ = first.shape
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    call += ["-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    call += ["-an"] if sound is None else ["-i", str(sound), "-map", "0:v:0", "-map", "1:a:0", "-c:a", "aac"]
    call += ["-c:v", "libx264", "-crf", _CRF, "-pix_fmt", "yuv420p"]
    call += ["-colorspace", "smpte170m", f"file:{path}"]  # as ffmpeg converts; else HD shows as BT.709
    with tempfile.TemporaryFile() as said:  # no pipe, which would fill up
        with subprocess.Popen(call, stdin=subprocess.PIPE, stderr=said) as process:
            try:
                for frame in chain([first], frames):
                    if frame.shape != first.shape:  # ffmpeg would take it, and shear all that follow
                        expected = f"images of {first.shape}, as the first"
                        raise ValueError(f"video: expected {expected}, but got {frame.shape}")
                    process.stdin.write(np.ascontiguousarray(frame))
                process.stdin.close()
            except BrokenPipeError:  # it has ended, and says why
                process.stdin.raw.close()
            except BaseException:
                process.kill()
                raise
        if process.returncode:
            said.seek(0)
            raise disk_error(said.read().decode(errors="replace"), path)
