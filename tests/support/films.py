"""Reads a video back."""

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
