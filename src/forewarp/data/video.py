"""Decode videos with ffmpeg: frames upright, of square pixels, in SDR and whole, none dropped or repeated."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import islice
from pathlib import Path
from threading import Thread

import numpy as np

from forewarp.data.files import mismatch
from forewarp.media import MOST_PIXELS, ffmpeg_reading

VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")  # suffixes of a rig's films, in small letters
_STAMP = re.compile(r"Parsed_showinfo.* n: *\d+ .* pts_time:(\S+)")
_DURATION = re.compile(r"Duration: (\d+):(\d+):([\d.]+)")
HDR = {"arib-std-b67": "HLG", "smpte2084": "PQ"}
_WIDE = {"bt2020": "BT.2020", "smpte431": "DCI-P3", "smpte432": "Display P3"}
_PRIMARIES = re.compile(r"Video: .*\((?:[^)]*, ?)?[\w-]+/(" + "|".join(_WIDE) + r")/([\w-]+)")
_CURVES = ("bt709", "smpte170m", "iec61966-2-1", "bt2020-10", "bt2020-12")  # of SDR that zscale knows
_ALPHA = re.compile(
    r"Video: (?!gif)[^,]*, (?:yuva|gbrap|rgba|bgra|argb|abgr|ya8|ya16|ayuv|vuya)|(?i:alpha_mode) *: 1"
)
# Two pictures in a frame, and directions all around.
_STEREO = re.compile(r"(?i)stereo ?3d: (side by side|top and bottom)")
_SPHERICAL = re.compile(r"(?i)spherical[^:\n]*: ((?:half )?equirectangular|cubemap|fisheye)")
# What ffmpeg's v360 calls these.
_V360 = {
    "equirectangular": "e:flat",
    "half equirectangular": "he:flat",
    "cubemap": "c3x2:flat",
    "fisheye": "fisheye:flat:ih_fov=180:iv_fov=180",
}
_CHANGED = re.compile(r"because video parameters changed to (.*), (\d+)x(\d+)")
_TRANSFER = re.compile(r"Video: .*\b(" + "|".join(HDR) + r")\b")
# Of more than 8 bits, with matrix/primaries/transfer of which one of the first is BT.2020's, the last none.
_UNSAID = re.compile(
    r"Video: .*p0?1[0-6](?:le|be)?\((?:[^)]*, ?)?(?:bt2020\w*/[\w-]+|[\w-]+/bt2020)/(?:unknown|reserved)\b"
)
# The tags of a stream, and its size; a matrix of colours stands first in its tag.
_TAGS = re.compile(r"Video: [^,]*, \w+(?:\(([^)]*)\))?, (\d+)x(\d+)")
_MATRIX = re.compile(r"\b(?<!/)(bt|smpte|fcc|gbr|ycg|ictcp)")
_SIDES = re.compile(r"Video: .*[ ,]\d+x\d+[ ,\n]")
_NO_TIME = ("-9223372036854775808", "NOPTS")  # for a frame without a time stamp
_TOO_LARGE = re.compile(r"Picture size (\d+x\d+) is invalid")
_STREAM, _SIZE = re.compile(r"^ *Stream #.*: Video:"), re.compile(r", (\d+)x(\d+)")
_INTERLACED = re.compile(r"Video: .*\b(top|bottom) (coded )?first\b")
_MOST_TOLD = 2000  # frames that ffmpeg is told to choose; a system takes 128 KiB in a word of a command
_SD = 1024, 576  # pixels of the longer and the shorter side, at most
# 203 cd/m2 are the white of SDR (BT.2408); below 0.8 of it colours stay, above they are compressed.
_TO_SDR = (
    "zscale=tin={0}:pin=bt2020:min=bt2020nc:t=linear:npl=203:agamma=false,format=gbrpf32le,zscale=p=bt709,"
    "tonemap=mobius:param=0.8:peak=4.9:desat=0,zscale=t=bt709:m=bt709:r=pc"
)
_TO_BT709 = "format=gbrp16le,zscale=tin={1}:pin={0}:min=gbr:rin=pc:t={1}:p=bt709:m=gbr:r=pc"
_UNTOLD = (
    "10 bits or more of BT.2020 without a transfer are taken for SDR; if colours look faded, tag it as HLG "
    "(ffmpeg -i IN -c copy -color_trc arib-std-b67 OUT.mp4) or PQ (smpte2084)"
)
_HIDDEN = "its alpha is not read, so what it hides is shown; to cut out, give images= of its frames as PNG"


def extracted(
    video: Path,
    chosen: Sequence[int] | None,
    size: int | None,
    threads: int | None = None,
    bars: tuple[float, float] = (0.0, 0.0),
    start: float | None = None,
) -> Iterator[np.ndarray]:
    """Yield the frames ``chosen``, ascending indices: uint8 (H, W, 3), square pixels, upright.

    Args:
        video: any that ffmpeg reads.
        chosen: from 0; None: all.
        size: most pixels of the longer side; None: as filmed.
        threads: None: as many as ffmpeg likes.
        bars: to cut off, shares of the width at the left and at the right each, and of the height.
        start: seconds; count from the first frame that is not before it. Of those before only such are
            decoded as others depend on.
    """

    def any_of(indices: Sequence[int]) -> str:
        """Write ``n == a or n == b ...`` as a tree in which ffmpeg searches for each frame's number."""
        if len(indices) == 1:
            return rf"eq(n\,{indices[0]})"
        half = len(indices) // 2
        return rf"if(lt(n\,{indices[half]})\,{any_of(indices[:half])}\,{any_of(indices[half:])})"

    is_told = chosen is not None and len(chosen) <= _MOST_TOLD
    select = f"select='{any_of(chosen)}'," if is_told else ""
    filters = f"{deinterlacing(video)}{select}scale=w='iw*sar':h=ih"
    if max(bars) > 0:
        filters += f",crop=w=iw*{1 - 2 * bars[0]}:h=ih*{1 - 2 * bars[1]}"
    if size is not None:
        fit = f"w='if(gt(iw,ih),min(iw,{size}),-1)':h='if(gt(iw,ih),-1,min(ih,{size}))'"
        filters += f",scale={fit}:flags=area"
    transfer = hdr_of(video)
    filters = "setparams=colorspace=bt709," + filters if _is_untagged_hd(video) else filters
    filters += f",{_TO_SDR.format(transfer)}" if transfer else ""
    filters += f",{_TO_BT709.format(*wide)}" if (wide := _wide_of(video)) else ""
    frames = decode(video, f"{filters},format=rgb24", "ppm", Log(), threads, start)
    if chosen is None or is_told:
        yield from frames
    else:
        wanted = {*chosen}
        yield from (frame for n, frame in enumerate(islice(frames, chosen[-1] + 1)) if n in wanted)


def hdr_of(video: Path) -> str | None:
    """Return ffmpeg's name of the transfer of an HDR video, HLG or PQ; None: it is SDR."""
    match = _TRANSFER.search(header_of(video))
    return match and match[1]


def converted(video: Path) -> list[str]:
    """Say what is converted: HDR to SDR, the primaries of wide colours to BT.709's, half frames to whole."""
    transfer, wide = hdr_of(video), _wide_of(video)
    lines = [f"{HDR[transfer]}, tone-mapped to SDR"] if transfer else []
    lines += [f"{_WIDE[wide[0]]}, converted to BT.709"] if wide else []
    return lines + (["interlaced, made whole"] if deinterlacing(video) else [])


def doubts_of(video: Path) -> list[str]:
    """Say what of a video is not read, or may be meant otherwise: its alpha; that it may be HDR, by 10 bits
    and BT.2020, but does not say its transfer.
    """
    told = header_of(video)
    return [line for line, said in ((_UNTOLD, _UNSAID), (_HIDDEN, _ALPHA)) if said.search(told)]


def _wide_of(video: Path) -> tuple[str, str] | None:
    """Return ffmpeg's names of the primaries of an SDR video, where wider than BT.709's, and its transfer."""
    match = None if hdr_of(video) else _PRIMARIES.search(header_of(video))
    return match and (match[1], match[2] if match[2] in _CURVES else "bt709")


def deinterlacing(video: Path) -> str:
    """Return the filter that makes whole frames of an interlaced video, with its comma; else nothing."""
    return "bwdif=mode=send_frame:deint=interlaced," if _INTERLACED.search(header_of(video)) else ""


def _is_untagged_hd(video: Path) -> bool:
    """Tell whether a video does not say its matrix of colours and is larger than SD: players take it for
    BT.709, ffmpeg for BT.601, which is right for SD.
    """
    match = _TAGS.search(header_of(video))
    if match is None or _MATRIX.search(match[1] or ""):
        return False
    return any(side > most for side, most in zip(sorted(map(int, match.groups()[1:]), reverse=True), _SD))


def header_of(video: Path) -> str:
    """Return what ffmpeg says of a video, without covers and previews; kept until the file changes.

    Raises:
        OSError: where there is none.
        ValueError: for a pipe or a device, for frames of more than ``MOST_PIXELS``, of two pictures side by
            side, and of 360 degrees.
    """
    return _header_and_stream(video)[0]


def _header_and_stream(video: Path) -> tuple[str, str]:
    about = video.stat()
    return _header(video, about.st_size, about.st_mtime_ns)


@lru_cache(64)
def _header(video: Path, size: int, changed: int) -> tuple[str, str]:
    """Return what ffmpeg says, and its name of the stream that has the most frames and pixels, the film's."""
    told = subprocess.run(ffmpeg_reading(video), capture_output=True).stderr.decode(errors="replace")
    if (large := _TOO_LARGE.search(told)) and not _SIDES.search(told):  # else its frames have another size
        raise mismatch(video, f"frames of at most {MOST_PIXELS} pixels", large[1])
    lines = told.splitlines(keepends=True)
    streams = [line for line in lines if _STREAM.search(line)]
    names = [f"0:v:{number}" for number in range(len(streams))] or ["0:v:0"]
    best = names[0]
    if streams[1:]:
        sides = [_SIZE.search(line) for line in streams]
        pixels = [int(match[1]) * int(match[2]) if match else 0 for match in sides]
        shown = {name: n * len(_ticks(video, name)[0]) for name, n in zip(names, pixels)}
        best = max(names, key=shown.get)
        others = {line for name, line in zip(names, streams) if name != best}
        told = "".join(line for line in lines if line not in others)
    if both := _STEREO.search(told):
        part = "iw/2:ih" if both[1][0] in "sS" else "iw:ih/2"
        advice = f"type ffmpeg -i {video.name} -vf crop={part}:0:0 one.mp4"
        raise mismatch(video, "a film by one lens", f"two pictures in each frame, {both[1]}", advice)
    if all_around := _SPHERICAL.search(told):
        kind = all_around[1].lower()
        advice = (
            f"type ffmpeg -i {video.name} -vf v360={_V360[kind]}:h_fov=90:v_fov=60:w=1280:h=740 front.mp4"
        )
        advice += ", with the lens's degrees as ih_fov and iv_fov" if kind == "fisheye" else ""
        raise mismatch(video, "a film in perspective", f"one that is {kind}", advice)
    return told, best


def stamps_of(video: Path) -> np.ndarray:
    """Read the times of a video's frames, seconds, ascending, decoding none; empty where it is no video.

    Those before 0 were cut off without coding the rest anew, as phones do, and are not shown.

    Raises:
        SceneError: for a video that does not store the time of each frame, as AVI with B-frames.
    """
    ticks, unit = _ticks(video, _header_and_stream(video)[1])
    if without := sum(tick in _NO_TIME for tick in ticks):
        got = f"{without} of {len(ticks)} without one"
        raise mismatch(video, "a time stamp of each frame", got, f"type ffmpeg -i {video.name} new.mp4")
    return np.sort([float(int(tick) * unit) for tick in ticks if tick.isdecimal()])


def _ticks(video: Path, stream: str) -> tuple[list[str], Fraction | int]:
    """Return the time stamp of each frame in a stream, in units of so many seconds."""
    call = [*ffmpeg_reading(video, "-v", "quiet"), "-map", stream, "-c", "copy", "-f", "framecrc", "-"]
    done = subprocess.run(call, capture_output=True)
    lines = done.stdout.decode(errors="replace").splitlines()
    unit = next((Fraction(line.split(":")[1].strip()) for line in lines if line.startswith("#tb 0:")), 1)
    return [line.split(",")[2].strip() for line in lines if not line.startswith("#")], unit


def start_of(stamps: np.ndarray, row: int) -> float | None:
    """Return from when on ``extracted`` begins with a frame: midway from the one before it, as rates vary and
    times are rounded; None for the first.
    """
    return None if row == 0 else float(stamps[row - 1] + stamps[row]) / 2


def sound_of(video: Path, rate: int, most: float) -> np.ndarray:
    """Decode the beginning of a video's sound, one channel: (S,) float32, ``rate`` samples a second from the
    time 0 of its frames on, ``most`` seconds at most; empty where there is none.
    """
    call = [*ffmpeg_reading(video, "-v", "quiet"), "-map", "0:a:0"]
    call += ["-t", str(most), "-ac", "1", "-af", f"aresample={rate}:async=1:first_pts=0", "-f", "f32le", "-"]
    return np.frombuffer(subprocess.run(call, capture_output=True).stdout, np.float32)


class Log:
    """What ffmpeg says while it runs: ``duration`` in seconds, 0 where unknown; ``stamps`` of the frames so
    far; ``changed``, from when on frames are of which other size or colours; all other lines, ``rest``.
    """

    def __init__(self) -> None:
        self.duration, self.stamps, self.rest, self.changed = 0.0, [], [], None

    def read(self, stream) -> None:
        """Read to the end."""
        for raw in stream:
            line = raw.decode(errors="replace")
            if match := _STAMP.search(line):
                self.stamps += [float(match[1])] if match[1] != "NOPTS" else []
            elif match := _DURATION.search(line):
                self.duration = sum(float(part) * unit for part, unit in zip(match.groups(), (3600, 60, 1)))
            elif match := _CHANGED.search(line):
                after = f" after {self.stamps[-1] - self.stamps[0]:.2f} s" if self.stamps else ""
                self.changed = self.changed or f"others of {match[2]} x {match[3]}, {match[1]},{after}"
            else:
                self.rest.append(line)


def decode(
    video: Path, filters: str, codec: str, log: Log, threads: int | None, start: float | None = None
) -> Iterator[np.ndarray]:
    """Decode the film's stream, see ``header_of``, into images, grey (pgm) or colour (ppm).

    Args:
        video: any that ffmpeg reads.
        filters: of ffmpeg.
        codec: pgm or ppm.
        log: takes what ffmpeg says.
        threads, start: see ``extracted``.

    Raises:
        SceneError: where frames change their size or colours, as of a phone that is turned: ffmpeg makes all
            as the first, and counts them anew.
    """

    def refuse_changed() -> None:
        if log.changed:
            advice = "cut it there, into films of their own (ffmpeg -i IN -ss FROM -to UNTIL OUT.mp4)"
            raise mismatch(video, "frames of one size and kind", log.changed, advice)

    limit = ["-threads", str(threads or 0)]  # of decoder and encoder
    stream = _header_and_stream(video)[1]
    shape = ["-map", stream, "-vf", filters, "-filter_threads", limit[1], "-fps_mode", "passthrough"]
    seek = [] if start is None else ["-ss", f"{start:.6f}"]
    call = [*ffmpeg_reading(video, "-nostats", *limit, *seek), *shape, *limit]
    call += ["-f", "image2pipe", "-c:v", codec, "-"]
    with subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        reader = Thread(target=log.read, args=[process.stderr])
        reader.start()
        try:
            while (image := _read_netpbm(process.stdout)) is not None:
                refuse_changed()
                yield image
        except BaseException:  # also where no more are asked for
            process.kill()
            raise
        finally:
            reader.join()
    refuse_changed()


def _read_netpbm(stream) -> np.ndarray | None:
    """Read one binary PGM (H, W) or PPM (H, W, 3); None at the end."""
    kind = stream.readline().strip()
    if kind not in (b"P5", b"P6"):
        return None
    width, height = map(int, stream.readline().split())
    stream.readline()
    shape = (height, width, 3) if kind == b"P6" else (height, width)
    raw = stream.read(math.prod(shape))
    return np.frombuffer(raw, np.uint8).reshape(shape) if len(raw) == math.prod(shape) else None
