"""Step one of a capture: the pictures, their times and masks, in the work folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from forewarp.capture.sharpness import edge_width, sharpest
from forewarp.capture.video import extracted, measure
from forewarp.data.cameras import SUFFIXES, in_order
from forewarp.data.images import common_header, read_image, write_jpeg, write_png
from forewarp.files import read_json, write_json

_DONE = "pictures.json"  # written last
_MOVING = 127  # a mask above it is what moves
_LEAST, _ENOUGH = 3, 120  # pictures

Told = Callable[[str], object]  # title of a step -> a context manager that gives a ``Progress``


@dataclass(frozen=True)
class Pictures:
    """``folder`` of the pictures, whose names are ours and sort in the order of time; ``times`` by their
    names, seconds or numbers; ``masks`` a folder in which black is what moves, or None; ``found`` how many
    there were to choose from; ``edges`` the median width of the pictures' edges in pixels of a picture 640
    wide; ``size`` (width, height) of all; ``originals`` the user's names by ours, empty for a video's frames.
    """

    folder: Path
    times: dict[str, float]
    masks: Path | None
    found: int
    edges: float
    size: tuple[int, int]
    originals: Mapping[str, str]


def take(
    place: Path,
    source: Path,
    *,
    video: bool,
    masks: Path | None,
    count: int | None,
    size: int | None,
    told: Told,
    upright: bool = True,
    threads: int | None = None,
) -> Pictures:
    """Take pictures out of a video or a folder, unless an earlier call has done so.

    Args:
        place: the work folder.
        source: a video, or a folder of pictures.
        video: which of both.
        masks: a folder; see ``_write_masks``.
        count: of frames to choose from a video; None: ``_ENOUGH``, and at most every second one, so that
            blurred ones can be left out. Pictures of a folder are all taken.
        size: most pixels of the longer side; None: as they are.
        told: shows progress.
        upright: turn a folder's pictures as their EXIF orientation says.
        threads: of ffmpeg; None: as many as it likes.

    Raises:
        ValueError: where they cannot be read or are too few.
    """
    folder, dark = place / "pictures", place / "masks"
    done = read_json(place / _DONE)
    if done is None:
        for left in (folder, dark):
            shutil.rmtree(left, ignore_errors=True)
        if video:
            done = _from_video(folder, source, count, size, told, threads)
        else:
            done = _from_folder(folder, source, size, upright, told)
        if masks is not None:
            _write_masks(dark, masks, done)
        write_json(place / _DONE, done)
    facts = done["found"], done["edges"], tuple(done["size"]), done["originals"]
    return Pictures(folder, done["times"], dark if masks else None, *facts)


def _from_video(
    folder: Path, video: Path, count: int | None, size: int | None, told: Told, threads: int | None
) -> dict:
    """Write the sharpest frames, named after their numbers in the video, from 1."""
    with told("looking at frames") as progress:
        footage = measure(video, progress, threads)
    if len(footage.stamps) < _LEAST:
        got = f"{len(footage.stamps)} frames"
        raise ValueError(f"{video}: expected a video of many frames, but got {got}; film longer")
    if count is None:
        count = max(_LEAST, min(_ENOUGH, len(footage.stamps) // 2))
    chosen = sharpest(footage.stamps, footage.sharp, count)
    times = {}
    with told("taking frames") as progress:
        for index, pixels in zip(chosen, extracted(video, chosen, size, threads)):
            name = f"frame_{index + 1:06d}.jpg"
            write_jpeg(folder / name, pixels)
            times[name] = float(footage.stamps[index])
            progress(len(times), len(chosen))
    if len(times) < len(chosen):
        raise ValueError(f"{video}: expected {len(chosen)} frames, but got {len(times)}; convert the video")
    edges = float(np.median(footage.widths[chosen]))
    found = {"times": times, "found": len(footage.stamps), "edges": _finite(edges), "rows": chosen}
    return {**found, "size": pixels.shape[1::-1], "originals": {}}


def _from_folder(folder: Path, source: Path, size: int | None, upright: bool, told: Told) -> dict:
    """Copy pictures of one size; times are even, in the order of the names.

    The copies have names of ours: COLMAP's list of pairs has no place for a space, and what comes later sorts
    plainly. Alpha is kept where all pictures have it.
    """
    paths = _images_in(source)
    if len(paths) < _LEAST:
        got = f"{len(paths)} PNG or JPEG files" if paths else "none"
        raise ValueError(f"{source}: expected a folder of many pictures, PNG or JPEG, but got {got}")
    has_alpha = common_header(paths).has_alpha
    widths, originals, first = [], {}, None
    with told("reading pictures") as progress:
        for done, path in enumerate(paths, 1):
            pixels = read_image(path, upright=upright).numpy()
            first = pixels.shape if first is None else first
            _check_like(path, pixels, first, has_alpha)
            pixels = _fitted(pixels if has_alpha else pixels[..., :3], size)
            is_png = path.suffix.lower() == ".png"
            name = f"picture_{done:06d}{'.png' if is_png or has_alpha else '.jpg'}"
            (write_png if name.endswith(".png") else write_jpeg)(folder / name, pixels)
            originals[name] = path.name
            widths.append(edge_width(pixels[..., :3].mean(-1)))
            progress(done, len(paths))
    times = {name: float(number) for number, name in enumerate(originals)}
    rows, edges = list(range(len(paths))), _finite(float(np.median(widths)))
    found = {"times": times, "found": len(paths), "edges": edges, "rows": rows}
    return {**found, "size": pixels.shape[1::-1], "originals": originals}


def _images_in(folder: Path) -> list[Path]:
    """List pictures in order; other systems leave files with a leading dot beside them, which are none."""
    return in_order(p for p in folder.iterdir() if p.suffix in SUFFIXES and not p.name.startswith("."))


def _check_like(path: Path, pixels: np.ndarray, first: tuple[int, ...], has_alpha: bool) -> None:
    """Refuse a picture that is turned otherwise than the first, or cut out where others are not."""
    (height, width), (rows, columns) = pixels.shape[:2], first[:2]
    if (height, width) != (rows, columns):
        raise ValueError(
            f"{path}: expected {columns} x {rows} pixels as the first, but got {width} x {height}, as its "
            "EXIF orientation says; leave it out"
        )
    if not has_alpha and (pixels[..., 3] < 255).any():
        raise ValueError(
            f"{path}: expected alpha in all pictures or in none, but got one of few that have it; remove it"
        )


def _finite(width: float) -> float:
    return min(width, 1e6)  # JSON has no infinity


def _fitted(pixels: np.ndarray, size: int | None) -> np.ndarray:
    """Make a picture (H, W, 3 or 4) so small that no side has more than ``size`` pixels."""
    longer = max(pixels.shape[:2])
    if size is None or longer <= size:
        return pixels
    return shrunk(pixels, *(max(1, round(n * size / longer)) for n in pixels.shape[:2]))


def shrunk(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Make a picture smaller by the mean over areas; where it has straight alpha, colours count by it.

    >>> cut_out = np.array([[[90, 0, 0, 255], [0, 9, 9, 0]]], dtype=np.uint8)
    >>> shrunk(cut_out, 1, 1).tolist()
    [[[90, 0, 0, 128]]]
    """
    import torch

    planes = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)[None].float()
    has_alpha = planes.shape[1] == 4
    if has_alpha:
        planes[:, :3] *= planes[:, 3:] / 255
    small = torch.nn.functional.interpolate(planes, (height, width), mode="area")
    if has_alpha:
        small[:, :3] *= 255 / small[:, 3:].clamp(min=1e-3)
    return small[0].permute(1, 2, 0).round().clamp(0, 255).byte().numpy()


def _write_masks(dark: Path, masks: Path, done: dict) -> None:
    """Write a mask for each picture, in which black is what moves and white is matched.

    There are as many as frames in the video, or pictures in the folder, in order; else a mask has the name of
    its picture. A folder's pictures have names of the user's: there the name comes first.
    """
    import torch

    paths, originals = _images_in(masks), done["originals"]
    by_name = {path.stem: path for path in paths}
    names = list(done["times"])
    stems = [Path(originals.get(name, name)).stem for name in names]
    named, counted = all(stem in by_name for stem in stems), len(paths) == done["found"]
    if not named and not counted:
        raise ValueError(
            f"{masks}: expected {done['found']} masks, one for each frame or picture, or masks with the "
            f"names of the pictures ({stems[0]}.png), but got {len(paths)}"
        )
    in_turn = counted and not (named and originals)  # frames may be counted from 0 or from 1
    chosen = [paths[row] for row in done["rows"]] if in_turn else [by_name[stem] for stem in stems]
    (width, height), brightest = done["size"], 0
    for name, path in zip(names, chosen):
        values = read_image(path)[..., 0]
        brightest = max(brightest, int(values.max()))
        # A pixel is kept out as soon as a part of it moves.
        moving = (values > _MOVING).float()[None, None]
        moving = torch.nn.functional.adaptive_max_pool2d(moving, (height, width))[0, 0] > 0
        write_png(dark / f"{name}.png", (255 * ~moving).byte().numpy())
    if brightest <= _MOVING:
        raise ValueError(
            f"{masks}: expected masks in which what moves is brighter than {_MOVING} of 255, but got at most "
            f"{brightest}; write it as 255, or leave out masks="
        )
