"""``format=glb``: particles with all of their motion, in one small file."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from forewarp.export.tracks import Progress, Source, no_progress
from forewarp.fields.moving import MovingGaussians
from forewarp.glb.writer import COMPACT, Setting, rows_in_file, write
from forewarp.methods.method import HasBounds, HasLayers, HasMovingGaussians
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
    gaussians, cameras = source.method.moving().to("cpu"), list(source.cameras)
    shown = seen_in_images(gaussians, source, progress) if quality == COMPACT else None
    rows = rows_in_file(gaussians, shown, moving_in_images(source))
    progress(len(cameras), len(cameras))
    if not len(rows.order):
        raise ValueError("run: expected particles that can be seen, but got none; train it longer")
    numbers = sorted({0, *spread(len(cameras), _CAMERAS)})
    setting = Setting(
        [cameras[number] for number in numbers],
        source.rotation_to("y"),
        focus_point(cameras),
        float(seconds),
        source.background,
        [source.image_times[number] for number in numbers] if source.image_times else [],
    )
    left_out = len(gaussians.means) - len(rows.order)
    facts = {"particles": len(rows.order), "moving": rows.in_motion, "left out": left_out}
    facts |= {"quality": quality, "seconds": seconds, "colors": "sRGB, as in the images"}
    return write(gaussians, setting, quality, rows), facts


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
