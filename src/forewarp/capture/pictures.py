"""Step one of a capture: the pictures, their times and masks, in the work folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from forewarp.capture.sharpness import edge_width, sharpest
from forewarp.capture.video import extracted, measure
from forewarp.data.images import common_header, read_image, write_jpeg, write_png
from forewarp.data.transforms import SUFFIXES, in_order
from forewarp.files import read_json, write_json

_DONE = "pictures.json"  # written last
_MOVING = 127  # a mask above it is what moves

Told = Callable[[str], object]  # title of a step -> a context manager that gives a ``Progress``


@dataclass(frozen=True)
class Pictures:
    """``folder`` of the pictures; ``times`` by their names, seconds or numbers; ``masks`` a folder in which
    black is what moves, or None; ``found`` how many there were to choose from; ``edges`` the median width of
    the pictures' edges in pixels of a picture 640 wide.
    """

    folder: Path
    times: dict[str, float]
    masks: Path | None
    found: int
    edges: float


def take(
    place: Path,
    source: Path,
    *,
    video: bool,
    masks: Path | None,
    count: int,
    size: int | None,
    told: Told,
    threads: int | None = None,
) -> Pictures:
    """Take pictures out of a video or a folder, unless an earlier call has done so.

    Args:
        place: the work folder.
        source: a video, or a folder of pictures.
        video: which of both.
        masks: a folder; see ``_write_masks``.
        count: of frames to choose from a video; those of a folder are all taken.
        size: most pixels of the longer side; None: as they are.
        told: shows progress.
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
            done = _from_folder(folder, source, size, told)
        if masks is not None:
            _write_masks(dark, masks, done, folder)
        write_json(place / _DONE, done)
    return Pictures(folder, done["times"], dark if masks else None, done["found"], done["edges"])


def _from_video(
    folder: Path, video: Path, count: int, size: int | None, told: Told, threads: int | None
) -> dict:
    """Write the sharpest frames, named after their numbers in the video, from 1."""
    with told("looking at frames") as progress:
        footage = measure(video, progress, threads)
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
    return {"times": times, "found": len(footage.stamps), "edges": _finite(edges), "rows": chosen}


def _from_folder(folder: Path, source: Path, size: int | None, told: Told) -> dict:
    """Copy pictures of one size; times are even, in the order of the names."""
    paths = in_order(path for path in source.iterdir() if path.suffix in SUFFIXES)
    if len(paths) < 2:
        got = f"{len(paths)} PNG or JPEG files" if paths else "none"
        raise ValueError(f"{source}: expected a folder of many pictures, PNG or JPEG, but got {got}")
    common_header(paths)
    widths = []
    with told("reading pictures") as progress:
        for done, path in enumerate(paths):
            pixels = _fitted(read_image(path)[..., :3].numpy(), size)
            (write_png if path.suffix.lower() == ".png" else write_jpeg)(folder / path.name, pixels)
            widths.append(edge_width(pixels.mean(-1)))
            progress(done + 1, len(paths))
    times = {path.name: float(number) for number, path in enumerate(paths)}
    rows = list(range(len(paths)))
    return {"times": times, "found": len(paths), "edges": _finite(float(np.median(widths))), "rows": rows}


def _finite(width: float) -> float:
    return min(width, 1e6)  # JSON has no infinity


def _fitted(pixels: np.ndarray, size: int | None) -> np.ndarray:
    """Make a picture (H, W, 3) so small that no side has more than ``size`` pixels."""
    if size is None or max(pixels.shape[:2]) <= size:
        return pixels
    import torch

    height, width = (max(1, round(n * size / max(pixels.shape[:2]))) for n in pixels.shape[:2])
    planes = torch.from_numpy(pixels).permute(2, 0, 1)[None].float()
    small = torch.nn.functional.interpolate(planes, (height, width), mode="area")[0].permute(1, 2, 0)
    return small.round().byte().numpy()


def _write_masks(dark: Path, masks: Path, done: dict, folder: Path) -> None:
    """Write a mask for each picture, in which black is what moves and white is matched.

    A mask has the name of its picture, or there are as many as frames in the video, in order.
    """
    import torch

    paths = in_order(path for path in masks.iterdir() if path.suffix in SUFFIXES)
    by_name = {path.stem: path for path in paths}
    names = list(done["times"])
    if all(Path(name).stem in by_name for name in names):
        chosen = [by_name[Path(name).stem] for name in names]
    elif len(paths) == done["found"]:
        chosen = [paths[row] for row in done["rows"]]
    else:
        raise ValueError(
            f"{masks}: expected {done['found']} masks, one for each frame or picture, or masks with the "
            f"names of the pictures ({names[0]}), but got {len(paths)}"
        )
    for name, path in zip(names, chosen):
        height, width = read_image(folder / name).shape[:2]
        moving = (read_image(path)[..., 0] > _MOVING).float()[None, None]
        # A pixel is kept out as soon as a part of it moves.
        moving = torch.nn.functional.adaptive_max_pool2d(moving, (height, width))[0, 0] > 0
        still = (255 * ~moving).byte().numpy()
        write_png(dark / f"{name}.png", still)
