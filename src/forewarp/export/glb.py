"""``format=glb``: particles with all of their motion, in one small file."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from forewarp.export.tracks import Progress, Source, no_progress
from forewarp.fields.moving import MovingGaussians
from forewarp.fields.windows import Window
from forewarp.glb.writer import COMPACT, Rows, Setting, rows_in_file, write
from forewarp.methods.method import HasCommon, HasLayers, HasMovingGaussians
from forewarp.ops.backend import has_kernels
from forewarp.scene.camera import focus_point
from forewarp.scene.frame import Frame, spread
from forewarp.scene.view import Moment

_CAMERAS, _OF_FILM = 12, 64  # of training, beside the first one; of a film, along which players ride
# Pixels, and share of an image: who makes up less than the smaller of these of any image is not missed.
_LEAST_PIXELS, _LEAST_SHARE = 0.25, 1.5e-6


def export_glb(
    source: Source, folder: Path, progress: Progress, *, quality: str, seconds: float | None
) -> dict:
    """Write ``scene.glb``.

    Args:
        source: the scene.
        folder: to write into.
        progress: called after each image that is looked at.
        quality, seconds: see ``packed_scene``.

    Returns:
        the facts for ``about.json``.

    Raises:
        ValueError: see ``packed_scene``.
    """
    content, facts = packed_scene(source, "glb", progress, quality=quality, seconds=seconds)
    (folder / "scene.glb").write_bytes(content)
    axes = "y up, by the turn of its first node; what is below it is in the data's world"
    return facts | {"axes in the file": axes}


def packed_scene(
    source: Source, kind: str, progress: Progress = no_progress, *, quality: str, seconds: float | None
) -> tuple[bytes, dict]:
    """Return the content of ``scene.glb``, and facts about it.

    Args:
        source: the scene.
        kind: the format that needs it.
        progress: called after each image that is looked at.
        quality: ``compact`` or ``lossless``.
        seconds: how long a player takes from time 0 to time 1; None: see ``Source.lasts``.

    Raises:
        ValueError: for a method without particles, naming the formats that it has; where nothing is seen.
    """
    if not isinstance(source.method, HasMovingGaussians):
        raise source.without_particles(kind)
    windows = [source, *source.later]
    shared = shared_in(windows)
    count, images, parts = sum(len(window.cameras) for window in windows), itertools.count(1), []

    def tell() -> None:
        progress(next(images), count)

    for window, last in zip(windows, shared):
        gaussians = window.method.moving().to("cpu")
        shown = seen_in_images(gaussians, window, tell) if quality == COMPACT else None
        parts.append((gaussians, shown, moving_in_images(window), last))
    rows = rows_of_windows(parts)
    progress(count, count)
    written = sum(len(part.order) for part in rows)
    if not written:
        raise ValueError("run: expected particles that can be seen, but got none; train it longer")
    worlds = [window.world.without(source.shift) for window in windows]
    places = zip(windows, worlds)
    cameras = [world.camera_to_data(camera) for window, world in places for camera in window.cameras]
    ends = [(window.image_times, *window.span) for window in windows]
    times = [first + time * (last - first) for taken, first, last in ends for time in taken]
    numbers = sorted({0, *spread(len(cameras), _OF_FILM if source.is_film else _CAMERAS)})
    seconds = source.lasts if seconds is None else seconds
    shown, taken = [cameras[n] for n in numbers], [times[n] for n in numbers] if times else []
    rotation, focus = source.rotation_to("y"), focus_point(cameras)
    setting = Setting(
        shown, rotation, focus, float(seconds), source.background, taken, source.shift, _trust(windows)
    )
    many = int(shared[0][rows[0].order].sum())
    left_out = sum(len(gaussians.means) for gaussians, *_ in parts) - written - many * len(source.later)
    facts = {"particles": written, "moving": sum(part.in_motion for part in rows), "left out": left_out}
    facts |= {"windows": len(windows), "shared": many} if source.later else {}
    facts |= {"quality": quality, "seconds": seconds, "colors": "sRGB, as in the images"}
    film = [
        (Window(gaussians.in_data(world), window.span, window.begin), part)
        for window, world, (gaussians, *_), part in zip(windows, worlds, parts, rows)
    ]
    return write(film, setting, quality, many), facts


def _trust(windows: Sequence[Source]) -> float | None:
    """Return the angle up to which images of all windows are good, degrees; None if one was not measured."""
    angles = [window.trust for window in windows]
    return None if None in angles else min(angles)


def shared_in(windows: Sequence[Source]) -> list[Tensor]:
    """Return which particles (N,) of each window stand still in all of them, the same ones in the same order;
    none of a single window.

    Raises:
        ValueError: where they are not the same: what stands still was trained again after some windows.
    """
    ids = [window.method.common() if isinstance(window.method, HasCommon) else None for window in windows]
    if len(windows) < 2 or any(part is None for part in ids):
        return [torch.zeros(len(window.method.moving().means), dtype=torch.bool) for window in windows]
    in_all = ids[0]
    for part in ids:
        in_all = in_all[(in_all >= 0) & torch.isin(in_all, part)]
    shares = [torch.isin(part, in_all) for part in ids]
    first, *others = (window.method.moving().means.cpu()[share] for window, share in zip(windows, shares))
    for number, means in enumerate(others, 2):
        if not torch.equal(first, means):
            raise ValueError(
                f"run: expected windows that begin from the same run, but window {number} began from another "
                "than the first (what stands still was trained again since); train the older windows again"
            )
    return shares


def rows_of_windows(parts: Sequence[tuple]) -> list[Rows]:
    """Choose the rows of each window that are written: of the first one with those that all share, at the
    end; of the others without them.

    Args:
        parts: of each window its Gaussians, and which of them are shown, in motion, and shared.
    """
    shares = [part[3] for part in parts]
    if parts[0][1] is not None:  # what one window shows of those shared is written
        shown = torch.stack([part[1][share] for part, share in zip(parts, shares)]).any(0)
        for part, share in zip(parts, shares):
            part[1][share] = shown
    first, *others = (rows_in_file(*part) for part in parts)
    kept = [~share.numpy()[rows.order] for rows, share in zip(others, shares[1:])]
    return [first, *(rows._replace(order=rows.order[keep]) for rows, keep in zip(others, kept))]


def moving_in_images(source: Source) -> Tensor | None:
    """Return which particles (N,) training images show in motion; None: whoever follows nodes."""
    if not source.image_times or not isinstance(source.method, HasLayers):
        return None
    # Motion is told from cameras and times alone; no image is loaded.
    frames = [Frame("", *pair, load=None) for pair in zip(source.image_times, source.cameras)]
    return source.method.in_motion(frames).cpu()


def seen_in_images(gaussians: MovingGaussians, source: Source, tell: Callable[[], None]) -> Tensor | None:
    """Return which particles (N,) make up some of any training image, a quarter of a pixel where it is large;
    None without kernels. Call ``tell`` after each image.

    Cost: each training image is rendered, with gradients.
    """
    if not has_kernels(gaussians.device):
        return None
    most = torch.zeros(len(gaussians.means))
    views = sorted(zip(source.image_times, source.cameras), key=lambda view: view[0])
    for time, camera in views:
        least = min(_LEAST_PIXELS, _LEAST_SHARE * camera.width * camera.height)
        most = torch.maximum(most, gaussians.at(Moment(time)).pixels(camera) / least)
        tell()
    return most >= 1 if views else None
