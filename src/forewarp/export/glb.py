"""``format=glb``: particles with all of their motion, in one small file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from forewarp.export.tracks import Progress, Source, no_progress
from forewarp.fields.moving import MovingGaussians
from forewarp.glb.writer import COMPACT, Later, Rows, Setting, rows_in_file, write
from forewarp.methods.method import HasBounds, HasCommon, HasLayers, HasMovingGaussians
from forewarp.ops.backend import has_kernels
from forewarp.scene.camera import focus_point
from forewarp.scene.frame import Frame, spread
from forewarp.scene.view import Moment

_CAMERAS = 12  # of training, beside the first one
# Pixels, and share of an image: who makes up less than the smaller of these of any image is not missed.
_LEAST_PIXELS, _LEAST_SHARE = 0.25, 1.5e-6


def export_glb(source: Source, folder: Path, progress: Progress, *, quality: str, seconds: float) -> dict:
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
    source: Source, kind: str, progress: Progress = no_progress, *, quality: str, seconds: float
) -> tuple[bytes, dict]:
    """Return the content of ``scene.glb``, and facts about it.

    Args:
        source: the scene.
        kind: the format that needs it.
        progress: called after each image that is looked at.
        quality: ``compact`` or ``lossless``.
        seconds: how long a player takes from time 0 to time 1.

    Raises:
        ValueError: for a method without particles, naming the formats that it has; where nothing is seen.
    """
    if not isinstance(source.method, HasMovingGaussians):
        others = ["mesh"] if isinstance(source.method, HasBounds) else []
        others += ["gltf", "ply", "npz"] if source.follows else []
        instead = f"; use format={' or '.join(others)}" if others else ""
        raise ValueError(
            f"format={kind}: expected a method made of particles, but got {source.model}{instead}"
        )
    windows = [source, *source.later]
    shared = shared_in(windows)
    count, parts = sum(len(window.cameras) for window in windows), []
    for window, last in zip(windows, shared):
        gaussians = window.method.moving().to("cpu")
        done = sum(len(before.cameras) for before in windows[: len(parts)])
        tell = partial(_told, progress, done, count)
        shown = seen_in_images(gaussians, window, tell) if quality == COMPACT else None
        parts.append((gaussians, shown, moving_in_images(window), last))
    rows = rows_of_windows(parts)
    progress(count, count)
    if not sum(len(part.order) for part in rows):
        raise ValueError("run: expected particles that can be seen, but got none; train it longer")
    later = [
        Later(gaussians, part, window.span, window.begin)
        for window, (gaussians, *_), part in zip(source.later, parts[1:], rows[1:])
    ]
    cameras = [camera for window in windows for camera in window.cameras]
    times = [film_time(window, time) for window in windows for time in window.image_times]
    numbers = sorted({0, *spread(len(cameras), _CAMERAS)})
    setting = Setting(
        [cameras[number] for number in numbers],
        source.rotation_to("y"),
        focus_point(cameras),
        float(seconds),
        source.background,
        [times[number] for number in numbers] if times else [],
    )
    written = sum(len(part.order) for part in rows)
    many = 0 if not later else int(shared[0][rows[0].order].sum())
    left_out = sum(len(gaussians.means) for gaussians, *_ in parts) - written - many * len(later)
    facts = {"particles": written, "moving": sum(part.in_motion for part in rows), "left out": left_out}
    facts |= {"windows": len(windows), "shared": many} if later else {}
    facts |= {"quality": quality, "seconds": seconds, "colors": "sRGB, as in the images"}
    options = {"span": source.span, "shared": many, "later": later}
    return write(parts[0][0], setting, quality, rows[0], **options), facts


def film_time(window: Source, time: float) -> float:
    """Return the time of the film at a time of a window."""
    first, last = window.span
    return first + time * (last - first)


def _told(progress: Progress, before: int, count: int, done: int, _: int) -> None:
    progress(before + done, count)


def shared_in(windows: Sequence[Source]) -> list[Tensor | None]:
    """Return which particles (N,) of each window stand still in all of them, the same ones in the same order;
    None of a single window.

    Raises:
        ValueError: where they are not the same: what stands still was trained again after some windows.
    """
    ids = [window.method.common() if isinstance(window.method, HasCommon) else None for window in windows]
    if len(windows) < 2:
        return [None]
    if any(part is None for part in ids):
        return [torch.zeros(len(window.method.moving().means), dtype=torch.bool) for window in windows]
    in_all = ids[0][ids[0] >= 0]
    for part in ids[1:]:
        in_all = in_all[torch.isin(in_all, part)]
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
    if len(parts) == 1:
        return [rows_in_file(*parts[0][:3])]
    shares = [part[3] for part in parts]
    if parts[0][1] is not None:  # what one window shows of those shared is written
        shown = torch.stack([part[1][share] for part, share in zip(parts, shares)]).any(0)
        for part, share in zip(parts, shares):
            part[1][share] = shown
    chosen = [rows_in_file(*part) for part in parts]
    for number, share in enumerate(shares[1:], 1):
        chosen[number] = chosen[number]._replace(
            order=chosen[number].order[~share.numpy()[chosen[number].order]]
        )
    return chosen


def moving_in_images(source: Source) -> Tensor | None:
    """Return which particles (N,) training images show in motion; None: whoever follows nodes."""
    if not source.image_times or not isinstance(source.method, HasLayers):
        return None
    pairs = zip(source.cameras, source.image_times)
    frames = [Frame("", time, camera, _not_loaded) for camera, time in pairs]
    return source.method.in_motion(frames).cpu()


def _not_loaded() -> Tensor:
    raise NotImplementedError  # motion is told from cameras and times alone


def seen_in_images(gaussians: MovingGaussians, source: Source, progress: Progress) -> Tensor | None:
    """Return which particles (N,) make up some of any training image, a quarter of a pixel where it is large;
    None without kernels.

    Cost: each training image is rendered, with gradients.
    """
    if not has_kernels(gaussians.device):
        return None
    most = torch.zeros(len(gaussians.means))
    views = sorted(zip(source.image_times, source.cameras), key=lambda view: view[0])
    for done, (time, camera) in enumerate(views, 1):
        least = min(_LEAST_PIXELS, _LEAST_SHARE * camera.width * camera.height)
        most = torch.maximum(most, gaussians.at(Moment(time)).pixels(camera) / least)
        progress(done, len(views))
    return most >= 1 if views else None
