"""Step one of a capture: the images, their times and masks, from a video or a folder.

Frames of a video come upright, as its rotation flag says, none dropped and none repeated.
"""

from __future__ import annotations

import math
import re
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn.functional import adaptive_max_pool2d, interpolate

from forewarp.data.files import (
    SIDE,
    SUFFIXES,
    UNREAD,
    beside_images,
    composed,
    images_alone,
    mismatch,
    way_from,
    way_from_file,
)
from forewarp.data.images import (
    bright,
    by,
    common_header,
    copies,
    exif_turned,
    mixed_linear,
    read_image,
    write_image,
)
from forewarp.data.names import in_order, read_names
from forewarp.data.video import Log, converted, decode, deinterlacing, doubts_of, extracted
from forewarp.drawing.images import at_most
from forewarp.files import read_json, write_json

Progress = Callable[[int, int], None]
Step = Callable[[str], object]  # title of a step -> a context manager that gives a ``Progress``

TAKEN = "pictures.json"  # what was taken; written last
_MIN_IMAGES, SHORT, _ENOUGH, MOST = 3, 150, 120, 300  # frames: fewest, of a short film, of a slow one, most
_STEP = 8.0  # pixels of 640, by which what is fast may move from one frame that is taken to the next
_FAST, _FLOW = 0.9, 160  # quantile of an image's motion that counts; pixels of the longer side to measure it
_LEAST_SIDE = 32  # pixels that OpenCV's flow needs; of fewer it crashes
_SAME = 0.3  # mean difference of two images, of 255, below which one repeats the other
_MEASURED = 640  # pixels of the longer side at which sharpness is measured
_COARSE = 160  # pixels of the longer side at which blur is told from what a codec adds
_FLAT = 1e-9  # mean square of a second difference below which an image has no edges
_BLACK, _LIT = 24, 60  # of 255: in a bar at most, black of limited range and noise; beside it at least
_EVEN, _LEAST_BAR = 2, 0.02  # pixels of 640 by which bars at both sides may differ; least share of the side
_WHOLE = 0.9  # share of its duration after which a video counts as whole
NO_MASKS = (
    "expected masks in which what moves is bright, but got none above 127 of 255, nor labels beside 0; write "
    "it as 255 and all else as 0, or leave out masks="
)
_ASKED = "frames= says so"  # why so many frames are taken
_DAMAGE = re.compile("partial file|ended prematurely|corrupt")


@dataclass(frozen=True)
class Source:
    """What to capture: a ``video``, or a folder of ``images``, with ``colmap`` poses that are known; a folder
    of ``masks`` of what moves; and ``size``, the most pixels of the longer side, None: as they are. With
    poses that are known images are left as stored. ``name_pattern`` reads the images' names: see
    ``names.read_names``.
    """

    video: Path | None = None
    images: Path | None = None
    colmap: Path | None = None
    masks: Path | None = None
    size: int | None = 1600
    name_pattern: str | None = None

    @property
    def path(self) -> Path:
        """The video or the folder."""
        return self.video or self.images


@dataclass(frozen=True)
class Frames:
    """The images of a capture.

    Attributes:
        folder: of the images, whose names are ours and sort by time.
        masks: a folder in which black is what moves; None: there are none.
        times: seconds or numbers, by name.
        rows: which of those found each image is. Of a rig this and what follows, up to ``originals``, is left
            out.
        found: how many there were to choose from.
        edges: median width of the images' edges, in pixels of an image 640 wide.
        sizes: (width, height), by name; all alike, unless poses are known.
        originals: the user's names by ours; empty for a video.
        assumed: a line about where times come from; None where that is plain.
        why: of a video, why so many frames were taken.
        masks_from: who says what moves.
        cameras: of a rig, the camera that took each image, by the image's name.
        moments: of a rig, the number of the instant of each image, by name.
    """

    folder: Path
    masks: Path | None
    times: dict[str, float]
    rows: Sequence[int] = ()
    found: int = 0
    edges: float = 0.0
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    originals: Mapping[str, str] = field(default_factory=dict)
    assumed: str | None = None
    why: str | None = None
    masks_from: str = "the masks given"
    cameras: Mapping[str, str] = field(default_factory=dict)
    moments: Mapping[str, int] = field(default_factory=dict)


def take(
    work: Path, source: Source, step: Step, count: int | None, threads: int | None, why: str = _ASKED
) -> Frames:
    """Take the images out of a video or a folder, unless an earlier call has done so.

    Args:
        work: the work folder.
        source: what to capture. With poses that are known images are neither turned nor made smaller.
        step: shows progress.
        count: of frames to choose from a video; None: see ``frames_for``. Images of a folder are all taken.
        threads: of ffmpeg; None: as many as it likes.
        why: so many frames, where ``count`` is given.

    Raises:
        ValueError: where they cannot be read or are too few.
    """
    folder, dark = work / "pictures", work / "masks"
    done = read_json(work / TAKEN)
    if done is None:
        for left in (folder, dark):
            shutil.rmtree(left, ignore_errors=True)
        if source.video is not None:
            done = _from_video(folder, source, count, step, threads)
            done["why"] = done["why"] or why
        else:
            done = _from_folder(folder, source, step)
        of_images = (done[key] for key in ("sizes", "rows", "found", "originals"))
        if source.masks is not None and not write_masks(dark, source.masks, *of_images):
            raise ValueError(f"{source.masks}: {NO_MASKS}")
        write_json(work / TAKEN, done)
    sizes = {name: tuple(size) for name, size in done["sizes"].items()}
    return Frames(folder, dark if source.masks else None, **done | {"sizes": sizes})


def _from_video(folder: Path, source: Source, count: int | None, step: Step, threads: int | None) -> dict:
    """Write the sharpest frames without black bars, named after their numbers in the video, from 1."""
    video = source.video
    with step("looking at frames") as progress:
        stamps, sharpnesses, widths, speeds, are_new, brightest = measure(video, progress, threads)
    kept = np.flatnonzero(are_new) if are_new.sum() >= _MIN_IMAGES else np.arange(len(stamps))
    count, why = frames_for(speeds[kept]) if count is None else (count, None)
    if why and len(kept) < len(stamps):
        why += f"; {len(stamps) - len(kept)} repeat the one before"
    chosen, times = kept[sharpest(stamps[kept], sharpnesses[kept], count)].tolist(), {}
    bars, stay = bars_of(brightest), source.masks is not None
    assumed = [_told(bars, "stay, as masks= are of whole frames" if stay else "are cut off")]
    assumed += doubts_of(video)
    bars, changed = (0.0, 0.0) if stay else bars, converted(video)
    with step("taking frames" + (f" ({'; '.join(changed)})" if changed else "")) as progress:
        for index, pixels in zip(chosen, extracted(video, chosen, source.size, threads, bars)):
            name = f"frame_{index + 1:06d}.jpg"
            write_image(folder / name, pixels)
            times[name] = float(stamps[index])
            progress(len(times), len(chosen))
    if len(times) < len(chosen):
        raise mismatch(video, f"{len(chosen)} frames", len(times), "convert the video")
    sizes, told = dict.fromkeys(times, pixels.shape[1::-1]), "; ".join(filter(None, assumed)) or None
    return _record(times, chosen, len(stamps), widths[chosen], sizes, {}, why=why, assumed=told)


def bars_of(brightest: np.ndarray) -> tuple[float, float]:
    """Measure the black bars that a film was given to fit another shape, as shares of its width and height.

    Bars are black in all frames, end sharply and are as wide at both sides; a dark background is not.

    Args:
        brightest: (H, W) of 255, the greatest value of each pixel over all frames.

    Returns:
        the share at the left and at the right each, and that above and below.

    >>> frame = np.zeros((40, 50))
    >>> frame[5:35] = 200
    >>> bars_of(frame)
    (0.0, 0.15)
    """
    shares = []
    for axis in (0, 1):
        values = brightest.max(axis)
        lit, share = np.flatnonzero(values > _BLACK), 0.0
        if len(lit):
            ends, inner = (lit[0], len(values) - 1 - lit[-1]), values[lit[0] : lit[-1] + 1]
            sharp = min(inner[:3].max(), inner[-3:].max()) > _LIT
            if sharp and abs(ends[0] - ends[1]) <= _EVEN and min(ends) >= _LEAST_BAR * len(values):
                share = float(max(ends) + 1) / len(values)  # what a codec mixes goes, too
        shares.append(share)
    return tuple(shares)


def _told(bars: tuple[float, float], what: str) -> str | None:
    """Say where bars are, and what happens to them; None where there are none."""
    places = zip(bars, ("at the left and right", "above and below"))
    told = ", ".join(f"{share:.0%} {where}" for share, where in places if share)
    return f"black bars, {told} each, {what}" if told else None


def frames_for(speeds: np.ndarray) -> tuple[int, str]:
    """Choose how many frames of a video to take, and say why.

    Every frame of a short video; of a longer one as many as keep what is fast from moving far between two
    frames, and at least 120 of the sharpest, but no more than every second one for that alone.

    Args:
        speeds: (N,) pixels of 640 by which what is fast in a frame has moved since the frame before.

    >>> frames_for(np.full(140, 9.0))
    (140, 'every frame of a short film')
    >>> frames_for(np.full(600, 2.0))
    (150, 'what is fast moves by 2 pixels of 640 a frame')
    >>> frames_for(np.full(600, 0.5))
    (120, 'what is fast moves by 0.5 pixels of 640 a frame; 120 at least')
    >>> frames_for(np.full(600, 30.0))
    (300, 'what is fast moves by 30 pixels of 640 a frame; 300 at most')
    """
    found = len(speeds)
    if found <= SHORT:
        return found, "every frame of a short film"
    asked, least = math.ceil(float(speeds.sum()) / _STEP), min(_ENOUGH, found // 2)
    count = min(found, MOST, max(asked, least))
    bound = "" if count == asked else f"; {count} at {'least' if asked < count else 'most'}"
    return count, f"what is fast moves by {float(speeds.mean()):.2g} pixels of 640 a frame{bound}"


def _from_folder(folder: Path, source: Source, step: Step) -> dict:
    """Copy images; times are the numbers in their names, or even in the order of these.

    Without known poses all have one size and are of one camera. With them, images may lie in subfolders, and
    those of several cameras share a time where folders or names tell so: see ``names.read_names``.

    The copies have names of ours: COLMAP's list of pairs has no place for a space, and what comes later sorts
    plainly. Alpha is kept where all images have it.
    """
    as_stored = source.colmap is not None
    paths, told = images_in(source.images, as_stored)
    if len(paths) < _MIN_IMAGES:
        got = f"{len(paths)} PNG or JPEG files" if paths else "none"
        advice = way_from(source.images)
        raise mismatch(source.images, "a folder of many pictures, PNG or JPEG", got, advice)
    rows = {path: row for row, path in enumerate(paths)}
    names = [path.relative_to(source.images).with_suffix("").as_posix() for path in paths]
    where, numbers = source.images, rows
    assumed = f"{where}: times are even, in the order of the images' names"
    read = read_names(names, str(where), source.name_pattern, one_camera=not as_stored)
    if read is not None and (as_stored or len({*read.frames}) == len(paths)):
        numbers, assumed = dict(zip(paths, read.times)), f"{where}: times: {read.how}"
        paths.sort(key=numbers.get)
    common, headers = common_header(paths, one_size=not as_stored)
    has_alpha, turned = common.has_alpha, [path for path in paths if as_stored and headers[path].is_turned]
    told += mixed_linear(headers, where) + [f"{where}: {line}" for line in copies(paths)]
    told += exif_turned(turned, where)
    widths, originals, sizes, times, first, brightest = [], {}, {}, {}, None, 0
    with step("reading pictures") as progress:
        for done, path in enumerate(paths, 1):
            pixels = read_image(path, upright=not as_stored).numpy()
            first = first or by(pixels.shape[1::-1])
            if (got := by(pixels.shape[1::-1])) != first and not as_stored:
                told = f"{got}, as its EXIF orientation says"
                raise mismatch(path, f"{first} pixels as the first", told, "leave it out")
            if not has_alpha and (pixels[..., 3] < 255).any():
                few = "one of few that have it"
                raise mismatch(path, "alpha in all pictures or in none", few, "remove it")
            pixels = pixels if has_alpha else pixels[..., :3]
            pixels = pixels if as_stored else within(pixels, source.size)
            is_png = has_alpha or path.suffix.lower() == ".png"
            name = f"picture_{done:06d}{'.png' if is_png else '.jpg'}"
            write_image(folder / name, pixels)
            originals[name] = path.relative_to(source.images).as_posix()
            sizes[name], times[name] = pixels.shape[1::-1], float(numbers[path])
            widths.append(edge_width(pixels[..., :3].mean(-1)))
            if not as_stored:
                brightest = np.maximum(brightest, pixels[..., :3].max(-1))
            progress(done, len(paths))
    if not as_stored:
        assumed = "; ".join(filter(None, [_told(bars_of(brightest), "stay: crop the pictures"), assumed]))
    assumed = "; ".join([*told, assumed])
    in_turn = [rows[path] for path in paths]
    return _record(times, in_turn, len(paths), widths, sizes, originals, assumed=assumed)


def _record(times: dict, rows: list[int], found: int, widths, sizes: dict, originals: dict, **told) -> dict:
    """Return what ``Frames`` has, as JSON can hold it: it knows no infinity."""
    edges = min(float(np.median(widths)), 1e6)
    return dict(times=times, rows=rows, found=found, edges=edges, sizes=sizes, originals=originals, **told)


def images_in(folder: Path, deep: bool = False) -> tuple[list[Path], list[str]]:
    """List images in order, and say in a line what is left out, see ``images_alone``.

    Args:
        folder: of images; other systems leave files with a leading dot beside them, which are none.
        deep: list also those in subfolders.

    Raises:
        ValueError: for two images of one name; for those of HEIC, WebP and others that nothing here reads; of
            subfolders, where there are no others.
    """
    return images_alone(_pictures_in(folder, deep), folder)


def _pictures_in(folder: Path, deep: bool) -> list[Path]:
    files = [p for p in folder.glob("**/*" if deep else "*") if not is_hidden(p.relative_to(folder))]
    images = [p for p in files if p.suffix.lower() in SUFFIXES]
    others = sorted(p for p in files if p.suffix.lower() in UNREAD)
    if others and not (deep and images):
        kind, advice = others[0].suffix[1:].upper(), "convert the pictures to JPEG"
        advice = "export JPEG; of Record3D export .r3d, for video=SCAN.r3d" if kind == "EXR" else advice
        advice += ", or set the phone's camera to its most compatible format" if kind[:3] == "HEI" else ""
        raise mismatch(others[0], "PNG or JPEG", kind, advice)
    return in_order(images)


def is_hidden(path: Path) -> bool:
    """Tell whether a name in a path begins with a dot."""
    return any(part.startswith(".") for part in path.parts)


def shrunk(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Make an image smaller by the mean over areas; where it has straight alpha, colours count by it.

    >>> cut_out = np.array([[[90, 0, 0, 255], [0, 9, 9, 0]]], dtype=np.uint8)
    >>> shrunk(cut_out, 1, 1).tolist()
    [[[90, 0, 0, 128]]]
    """
    planes = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)[None].float()
    has_alpha = planes.shape[1] == 4
    if has_alpha:
        planes[:, :3] *= planes[:, 3:] / 255
    small = interpolate(planes, (height, width), mode="area")
    if has_alpha:
        small[:, :3] *= 255 / small[:, 3:].clamp(min=1e-3)
    return small[0].permute(1, 2, 0).round().clamp(0, 255).byte().numpy()


def within(pixels: np.ndarray, size: int | None) -> np.ndarray:
    """Make an image (H, W, C) at most ``size`` pixels wide or high; None: leave it."""
    longer = max(pixels.shape[:2])
    if size is None or longer <= size:
        return pixels
    return shrunk(pixels, *(max(1, round(n * size / longer)) for n in pixels.shape[:2]))


def write_smaller(folder: Path, name: str, pixels: np.ndarray, scale: int) -> None:
    """Write a whole image ``scale`` times smaller, its sides rounded down, into ``images_<scale>``."""
    small = shrunk(pixels, *(n // scale for n in pixels.shape[:2]))
    write_image(folder / f"images_{scale}" / name, small)


def write_masks(
    folder: Path, masks: Path, sizes: Mapping, rows: Sequence[int], found: int, originals: Mapping
) -> bool:
    """Write a mask for each image, in which black is what moves and white is matched; tell whether any does.

    There are as many as frames in the video, or images in the folder, in order; else a mask has the name of
    its image, or, of a video and where one has the number 0, that of its frame from 0. A folder's images have
    names of the user's: there the name comes first. Beside images a mask has their names, as 1_mask.png.

    Args:
        folder: to write to.
        masks: folder of the user's.
        sizes, rows, found, originals: as of ``Frames``.
    """
    there = _pictures_in(masks, deep=True)
    named = {path: image for path, image in beside_images(there, masks)[1].items() if SIDE.search(path.stem)}
    named = named or {path: path for path in images_alone(there, masks)[0]}
    paths = list(named)
    by_name = {composed(at.relative_to(masks).with_suffix("").as_posix()): path for path, at in named.items()}
    stems = [composed(Path(originals.get(name, name)).with_suffix("").as_posix()) for name in sizes]
    are_named, are_counted = all(stem in by_name for stem in stems), len(paths) == found
    numbers = {} if originals else _numbered(by_name)
    from_0 = 0 in numbers and not are_counted
    steps = np.diff(sorted(numbers)) if are_counted else []
    lacks_one = 1 in steps and max(steps) > 1
    are_said = are_named and (originals or len(paths) < found)  # more are of another number of frames
    are_said = all(row in numbers for row in rows) if from_0 else are_said
    if lacks_one or not (are_counted or are_said):
        expected = f"{found} masks, one for each frame or picture, or masks with the names of the pictures"
        got = f"{len(paths)}{f', of numbers {min(numbers)} to {max(numbers)}' if numbers else ''}"
        raise mismatch(masks, f"{expected} ({stems[0]}.png)", got)
    in_turn = are_counted and not (are_named and originals)  # frames may be counted from 0 or from 1
    chosen = [by_name[stem] for stem in stems] if not in_turn and not from_0 else []
    chosen = chosen or [paths[row] if in_turn else numbers[row] for row in rows]
    any_moves = False
    for (name, size), path in zip(sizes.items(), chosen):
        # A pixel is kept out as soon as a part of it moves.
        moving = adaptive_max_pool2d(bright(path).float()[None, None], size[::-1])[0, 0] > 0
        any_moves |= bool(moving.any())
        write_mask(folder / f"{name}.png", moving.numpy())
    return any_moves


def _numbered(by_name: Mapping[str, Path]) -> dict[int, Path]:
    """Return masks by the last number in their names, where most have one form but for that."""
    last = re.compile(r"(\d+)(?=\D*$)")
    forms = {name: last.sub("0", name) for name in by_name if last.search(name)}
    most = Counter(forms.values()).most_common(1)
    return {int(last.search(name)[1]): by_name[name] for name, form in forms.items() if form == most[0][0]}


def write_mask(path: Path, is_dark: np.ndarray) -> None:
    """Write a mask (H, W) that is black where ``is_dark``, as where something moves, and else white."""
    write_image(path, np.where(is_dark, 0, 255).astype(np.uint8))


def read_mask(path: Path) -> np.ndarray:
    """Read where a mask is black: bool (H, W)."""
    return read_image(path)[..., 0].numpy() == 0


def sharpness(grey: np.ndarray) -> float:
    """Measure how much fine detail an image (H, W) has: the mean square of its Laplacian.

    Comparable between images of the same things alone.
    """
    values = grey.astype(np.float32)
    across, down = np.diff(values, 2, axis=1)[1:-1], np.diff(values, 2, axis=0)[:, 1:-1]
    return float(((across + down) ** 2).mean())


def edge_width(grey: np.ndarray) -> float:
    """Estimate how wide the edges of an image (H, W) are, in pixels of one 640 wide.

    Contrast does not count: an edge blurred by a Gaussian of deviation s has a gradient whose mean square is
    2 s^2 times that of its own derivative. This is taken of the image made 160 pixels wide, as what a codec
    adds to a blurred image is finer. So no edge is under 2 wide; sharp films give 1.9 to 2.3, those blurred
    by 3 pixels 2.7, by 6 pixels 3.8. Of both axes the wider counts, as a shaken camera blurs along one.
    Infinite without edges.

    >>> step = 255.0 * (np.arange(640) > 319)[None].repeat(640, 0) * (np.arange(640) > 319)[:, None]
    >>> round(edge_width(step), 1)
    2.0
    >>> blurred = np.cumsum(np.exp(-(np.arange(-320, 320) ** 2) / 200))
    >>> round(edge_width(blurred * blurred[:, None]))
    10
    """
    small = at_most(torch.from_numpy(grey.astype(np.float32))[..., None], _COARSE)[..., 0].numpy()
    widths = []
    for axis in (0, 1):
        first, second = (float((np.diff(small, n, axis=axis) ** 2).mean()) for n in (1, 2))
        widths.append(np.sqrt(first / (2 * second)) if second > _FLAT else np.inf)
    return float(max(widths)) * 640 / _COARSE


def speed(before: np.ndarray, grey: np.ndarray) -> float:
    """Measure how far what is fast has moved from one image (H, W) uint8 to the next, in pixels of one 640
    wide: the ninth decile of the lengths of optical flow (DIS).

    >>> image = np.random.default_rng(0).integers(0, 255, (30, 40)).repeat(4, 0).repeat(4, 1).astype(np.uint8)
    >>> 7 < speed(image, np.roll(image, 2, 1)) < 10
    True
    """
    scale = _FLOW / max(grey.shape)
    size = [max(_LEAST_SIDE, round(scale * length)) for length in grey.shape[::-1]]
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (before, grey)]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(*small, None)
    return float(np.quantile(np.hypot(flow[..., 0], flow[..., 1]), _FAST)) * 640 / _FLOW


def sharpest(stamps: np.ndarray, sharp: np.ndarray, count: int) -> list[int]:
    """Choose the sharpest frame of each of ``count`` windows of equal length in time.

    A window without a frame does not count: where there are gaps, windows are so much shorter that ``count``
    of them have frames, or as many as come nearest to it.

    Args:
        stamps: (N,) seconds, ascending, at any distances.
        sharp: (N,) larger is better.
        count: of windows. All frames, where there are no more.

    Returns:
        indices, ascending.

    >>> sharpest(np.array([0, 1, 2, 3, 9, 10.0]), np.array([1, 5, 2, 3, 1, 2]), 2)
    [1, 5]
    >>> sharpest(np.array([0, 1, 2, 3, 9, 10.0]), np.array([1, 5, 2, 3, 1, 2]), 4)
    [1, 2, 3, 5]
    """
    if len(stamps) <= count:
        return list(range(len(stamps)))
    share = (stamps - stamps[0]) / ((stamps[-1] - stamps[0]) * (1 + 1e-9))

    def windows(number: int) -> list[np.ndarray]:
        """Split all rows by which of so many windows they are in; none is empty."""
        begins = np.flatnonzero(np.diff(np.floor(share * number))) + 1
        return np.split(np.arange(len(share)), begins)

    few = many = count
    while len(windows(many)) < count:
        few, many = many, 2 * many
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (middle, many) if len(windows(middle)) < count else (few, middle)
    chosen = windows(many) if len(windows(many)) <= count else windows(few)
    return [int(rows[np.argmax(sharp[rows])]) for rows in chosen]


def measure(video: Path, progress: Progress, threads: int | None = None) -> tuple[np.ndarray, ...]:
    """Decode a video once and measure its frames.

    Args:
        video: any that ffmpeg reads.
        progress: called with tenths of seconds done and all.
        threads: None: as many as ffmpeg likes.

    Returns:
        (N,) each: seconds from the first frame, ascending; ``sharpness``; ``edge_width``; ``speed``, 0 of the
        first; and whether a frame does not repeat the one before, as films of another rate are converted.
        Then (h, w), the greatest value of each pixel.

    Raises:
        ValueError: where the file is no video, ends too early, or has fewer than three frames.

    **Cost** one decoding, and about 13 ms a frame.
    """
    rows, before, brightest, log = [], None, 0, Log()
    long, short = (f"if(gt({a},{b}),{_MEASURED},-1)" for a, b in (("iw", "ih"), ("ih", "iw")))
    small = f"{deinterlacing(video)}scale=w='min(iw,{long})':h='min(ih,{short})',format=gray"
    for image in decode(video, f"showinfo=checksum=0,{small}", "pgm", log, threads):
        moved = 0.0 if before is None else speed(before, image)
        is_new = before is None or np.abs(image - before.astype(np.float32)).mean() >= _SAME
        rows.append((sharpness(image), edge_width(image), moved, is_new))
        before, brightest = image, np.maximum(brightest, image)
        if len(rows) % 10 == 1 and log.duration and log.stamps:
            seconds = min(log.stamps[-1] - log.stamps[0], log.duration)
            progress(round(10 * seconds), math.ceil(10 * log.duration))
    _refuse(video, log, len(rows))
    progress(len(rows), len(rows))
    stamps = np.array(log.stamps[: len(rows)])
    return stamps - stamps[0], *map(np.array, zip(*rows)), brightest


def _refuse(video: Path, log: Log, count: int) -> None:
    """Refuse what gives no frames, too few, or fewer than the file promises."""
    stamps, text = log.stamps, "".join(log.rest)
    if not count:
        got = f"another file; {way_from_file(video) or 'choose a video, or images='}"
        with video.open("rb") as stream:
            if "moov atom not found" in text and stream.read(8).endswith(b"ftyp"):
                got = "one that was cut off; copy it again"
        got = "sound alone; choose a video" if "matches no streams" in text else got
        raise mismatch(video, "a video", got)
    if count == 1:
        raise mismatch(video, "a video of many frames", "one frame")
    if len(stamps) < count or not np.all(np.diff(stamps[:count]) > 0):
        expected = "a time stamp for each frame, each later than the one before"
        got = f"{len(stamps)} for {count} frames"
        raise mismatch(video, expected, got, "save it anew with a video editor")
    seconds = (stamps[count - 1] - stamps[0]) * count / (count - 1)
    # The header's duration is of all streams: sound that goes on is no damage.
    is_damaged = _DAMAGE.search(text) or ": Audio:" not in text
    if is_damaged and seconds < _WHOLE * log.duration:
        advice = "copy it again, or save the part that plays with a video editor"
        expected = f"{log.duration:.1f} seconds, as its header says"
        raise mismatch(video, expected, f"{seconds:.1f}", advice)
    if count < _MIN_IMAGES:
        raise mismatch(video, "a video of many frames", f"{count} frames", "film longer")
