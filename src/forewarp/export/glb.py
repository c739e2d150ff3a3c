"""``format=glb``: particles with all of their motion, in one small file."""

from __future__ import annotations

from pathlib import Path

from forewarp.export.tracks import Progress, Source
from forewarp.glb.writer import Setting, rows_in_file, write
from forewarp.methods.method import HasBounds, HasMovingGaussians
from forewarp.scene.camera import focus_point
from forewarp.scene.frame import spread

_CAMERAS = 12  # of training, beside the first one


def export_glb(source: Source, folder: Path, progress: Progress, *, quality: str, seconds: float) -> dict:
    """Write ``scene.glb``.

    Args:
        source: the scene.
        folder: to write into.
        progress: called once.
        quality, seconds: see ``packed_scene``.

    Returns:
        the facts for ``about.json``.

    Raises:
        ValueError: see ``packed_scene``.
    """
    content, facts = packed_scene(source, "glb", quality=quality, seconds=seconds)
    (folder / "scene.glb").write_bytes(content)
    progress(1, 1)
    axes = "y up, by the turn of its first node; what is below it is in the data's world"
    return facts | {"axes in the file": axes}


def packed_scene(source: Source, kind: str, *, quality: str, seconds: float) -> tuple[bytes, dict]:
    """Return the content of ``scene.glb``, and facts about it.

    Args:
        source: the scene.
        kind: the format that needs it.
        quality: ``compact`` or ``lossless``.
        seconds: how long a player takes from time 0 to time 1.

    Raises:
        ValueError: for a method without particles, naming the formats that it has.
    """
    if not isinstance(source.method, HasMovingGaussians):
        others = ["mesh"] if isinstance(source.method, HasBounds) else []
        others += ["gltf", "ply", "npz"] if source.follows else []
        instead = f"; use format={' or '.join(others)}" if others else ""
        raise ValueError(
            f"format={kind}: expected a method made of particles, but got {source.model}{instead}"
        )
    cameras = list(source.cameras)
    shown = [cameras[0], *(cameras[i] for i in spread(len(cameras), _CAMERAS))]
    focus = focus_point(cameras)
    setting = Setting(shown, source.rotation_to("y"), focus, float(seconds), source.background)
    gaussians = source.method.moving()
    order, moving = rows_in_file(gaussians)
    facts = {"particles": len(order), "moving": moving, "quality": quality, "seconds": seconds}
    return write(gaussians, setting, quality), facts | {"colors": "sRGB, as in the images"}
