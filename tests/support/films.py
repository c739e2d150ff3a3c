"""Writes small videos of any stamps and rotation, and reads videos back."""

import subprocess

import imageio_ffmpeg
import numpy as np


def read_film(path, height, width):
    """All frames (N, height, width, 3) uint8 of an mp4, which must be of that size."""
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), *raw]
    done = subprocess.run(call, capture_output=True, check=True)
    assert f" {width}x{height}" in done.stderr.decode()
    return np.frombuffer(done.stdout, dtype=np.uint8).reshape(-1, height, width, 3)


def write_film(path, frames, *, stamps="N*40", rotation=0, options=(), inputs=()):
    """Write frames (N, H, W, 3) uint8; ``stamps`` is ffmpeg's expression of the frame N, milliseconds, and
    ``inputs`` are words for another input, of sound.
    """
    count, height, width, _ = frames.shape
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error"]
    shape = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-i", "-", *inputs]
    times = ["-vf", f"settb=1/1000,setpts='{stamps}'", "-fps_mode", "passthrough", "-enc_time_base", "1:1000"]
    flat = path.with_name(f"flat_{path.name}") if rotation else path
    coded = ["-c:v", "libx264", "-qp", "4", "-pix_fmt", "yuv420p", "-video_track_timescale", "1000", *options]
    subprocess.run([*ffmpeg, *shape, *times, *coded, str(flat)], input=frames.tobytes(), check=True)
    if rotation:
        turned = ["-display_rotation", str(rotation), "-i", str(flat), "-c", "copy", str(path)]
        subprocess.run([*ffmpeg, *turned], check=True)
        flat.unlink()
    return path


def numbered(count, size=(48, 64), step=8):
    """Frames (N, H, W, 3) whose grey tells their number, the upper left quarter bright."""
    grey = step * np.arange(count, dtype=np.uint8)[:, None, None, None]
    frames = np.zeros((count, *size, 3), np.uint8) + grey
    frames[:, : size[0] // 2, : size[1] // 2] = 250
    return frames


def write_planes(path, planes, kind, *words, count=3):
    """Write ``count`` times an image of planes (3, H, W) of a pixel format of ffmpeg's; ``words`` are of the
    output.
    """
    _, height, width = planes.shape
    raw = ["-f", "rawvideo", "-pix_fmt", kind, "-s", f"{width}x{height}", "-i", "-"]
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *raw, *words, str(path)]
    subprocess.run(call, input=count * planes.tobytes(), check=True)
    return path
