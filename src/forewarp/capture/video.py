"""Read a video through ffmpeg: the stamp and the sharpness of every frame, and the pixels of some.

Frames come turned upright, as the file's rotation flag says, none dropped and none repeated.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from forewarp.capture.sharpness import edge_width, sharpness

_SIDE = 640  # pixels of the longer side at which sharpness is measured
_STAMP = re.compile(r"Parsed_showinfo.* n: *\d+ .* pts_time:(\S+)")
_DURATION = re.compile(r"Duration: (\d+):(\d+):([\d.]+)")
_WHOLE = 0.9  # share of its duration after which a video counts as whole
_DAMAGE = re.compile("partial file|ended prematurely|corrupt")

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Footage:
    """All frames of a video: ``stamps`` (N,) seconds from the first, ascending; ``sharp`` (N,) and ``widths``
    (N,) as ``sharpness.sharpness`` and ``sharpness.edge_width``.
    """

    stamps: np.ndarray
    sharp: np.ndarray
    widths: np.ndarray


def measure(video: Path, progress: Progress, threads: int | None = None) -> Footage:
    """Decode a video once and measure its frames.

    Args:
        video: any that ffmpeg reads.
        progress: called with tenths of seconds done and all.
        threads: None: as many as ffmpeg likes.

    Raises:
        ValueError: where the file is no video, ends too early, or has a single frame.

    **Cost** one decoding, and about 10 ms a frame.
    """
    sharp, widths = [], []
    small = f"scale=w='min(iw,if(gt(iw,ih),{_SIDE},-1))':h='min(ih,if(gt(iw,ih),-1,{_SIDE}))',format=gray"
    with _Said() as said:
        for picture in _frames(video, f"showinfo=checksum=0,{small}", "pgm", said, threads):
            sharp.append(sharpness(picture))
            widths.append(edge_width(picture))
            if len(sharp) % 10 == 1 and said.read_on().duration and said.stamps:
                seconds = min(said.stamps[-1] - said.stamps[0], said.duration)
                progress(round(10 * seconds), math.ceil(10 * said.duration))
        _refuse(video, said.read_on(), len(sharp))
    progress(len(sharp), len(sharp))
    order = np.array(said.stamps[: len(sharp)])
    return Footage(order - order[0], np.array(sharp), np.array(widths))


def extracted(
    video: Path, chosen: Sequence[int], size: int | None, threads: int | None = None
) -> Iterator[np.ndarray]:
    """Yield the frames ``chosen``, ascending indices: uint8 (H, W, 3), square pixels, upright.

    Args:
        video: which ``measure`` has accepted.
        chosen: from 0.
        size: most pixels of the longer side; None: as filmed.
        threads: None: as many as ffmpeg likes.
    """
    shape = f"select='{_any_of(list(chosen))}',scale=w='iw*sar':h=ih"
    if size is not None:
        fit = f"w='if(gt(iw,ih),min(iw,{size}),-1)':h='if(gt(iw,ih),-1,min(ih,{size}))'"
        shape += f",scale={fit}:flags=area"
    with _Said() as said:
        yield from _frames(video, f"{shape},format=rgb24", "ppm", said, threads)


def _any_of(chosen: list[int]) -> str:
    """Write ``n == a or n == b ...`` for ffmpeg, as a balanced tree: its parser allows a depth of 100."""
    if len(chosen) == 1:
        return rf"eq(n\,{chosen[0]})"
    half = len(chosen) // 2
    return f"({_any_of(chosen[:half])}+{_any_of(chosen[half:])})"


class _Said:
    """What ffmpeg says, while it runs: a file, read on without moving the place that ffmpeg writes at.

    ``duration`` in seconds, 0 where unknown; ``stamps`` of the frames so far; ``rest`` all other lines.
    """

    def __init__(self) -> None:
        self.duration, self.stamps, self.rest, self._begun = 0.0, [], [], 0

    def __enter__(self) -> _Said:
        self.file = tempfile.TemporaryFile()
        return self

    def __exit__(self, *error) -> None:
        self.file.close()

    def read_on(self) -> _Said:
        """Read the lines that are new."""
        raw = b""
        while more := os.pread(self.file.fileno(), 1 << 20, self._begun + len(raw)):
            raw += more
        raw = raw[: raw.rfind(b"\n") + 1]
        self._begun += len(raw)
        for line in raw.decode(errors="replace").splitlines():
            if found := _STAMP.search(line):
                self.stamps += [float(found[1])] if found[1] != "NOPTS" else []
            elif found := _DURATION.search(line):
                self.duration = sum(float(part) * unit for part, unit in zip(found.groups(), (3600, 60, 1)))
            else:
                self.rest.append(line)
        return self


def _frames(video: Path, filters: str, codec: str, said: _Said, threads: int | None) -> Iterator[np.ndarray]:
    """Decode the first video stream; write what ffmpeg says to ``said``."""
    import imageio_ffmpeg

    some = ["-threads", str(threads or 0)]  # of decoder and encoder
    begin = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", "-nostats"]
    shape = ["-map", "0:v:0", "-vf", filters, "-filter_threads", some[1], "-fps_mode", "passthrough"]
    call = [*begin, *some, "-i", str(video), *shape, *some, "-f", "image2pipe", "-c:v", codec, "-"]
    with subprocess.Popen(call, stdout=subprocess.PIPE, stderr=said.file) as process:
        try:
            while (picture := _read_netpbm(process.stdout)) is not None:
                yield picture
        except BaseException:  # also where no more are asked for
            process.kill()
            raise


def _read_netpbm(stream) -> np.ndarray | None:
    """Read one binary PGM (H, W) or PPM (H, W, 3); None at the end."""
    kind = stream.readline().strip()
    if kind not in (b"P5", b"P6"):
        return None
    width, height = map(int, stream.readline().split())
    stream.readline()
    channels = 3 if kind == b"P6" else 1
    raw = stream.read(width * height * channels)
    if len(raw) < width * height * channels:
        return None
    return np.frombuffer(raw, np.uint8).reshape((height, width, 3) if channels == 3 else (height, width))


def _refuse(video: Path, said: _Said, count: int) -> None:
    """Refuse what gives no frames, one frame, or fewer than the file promises."""
    stamps, duration, text = said.stamps, said.duration, "\n".join(said.rest)
    if not count:
        with video.open("rb") as stream:
            missing = "moov atom not found" in text and stream.read(8).endswith(b"ftyp")
        got = "one that was cut off; copy it again" if missing else "another file; choose a video, or images="
        got = "sound alone; choose a video" if "matches no streams" in text else got
        raise ValueError(f"{video}: expected a video, but got {got}")
    if count == 1:
        raise ValueError(f"{video}: expected a video of many frames, but got one frame")
    if len(stamps) < count or not np.all(np.diff(stamps[:count]) > 0):
        raise ValueError(
            f"{video}: expected a time stamp for each frame, each later than the one before, but got "
            f"{len(stamps)} for {count} frames; save it anew with a video editor"
        )
    end = stamps[count - 1] - stamps[0]
    step = end / (count - 1)
    # The header's duration is of all streams: sound that goes on is no damage.
    cut = _DAMAGE.search(text) or ": Audio:" not in text
    if cut and end + step < _WHOLE * duration:
        raise ValueError(
            f"{video}: expected {duration:.1f} seconds, as its header says, but got {end + step:.1f}; copy "
            "it again, or save the part that plays with a video editor"
        )
