"""Write what was found as a scene: the pictures and smaller copies, cameras, times, points, limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from forewarp.capture.pictures import shrunk
from forewarp.capture.place import Limits
from forewarp.capture.sparse import Sparse
from forewarp.data.images import common_header, read_image, write_jpeg, write_png
from forewarp.data.posed_video import SCALES, PosedShot, write_scene

_LEAST_SIDE = 96  # pixels: smaller copies are of no use


def write(
    folder: Path, pictures: Path, sparse: Sparse, times: Mapping[str, float], limits: Limits, progress
) -> list[int]:
    """Write the scene of all registered pictures.

    Args:
        folder: to fill.
        pictures: folder of the pictures, whose names are those of the cameras.
        sparse: cameras and points, placed.
        times: seconds or numbers by the picture's name; the first registered one becomes 0, the last 1.
        limits: near, far and box.
        progress: called with pictures done and all.

    Returns:
        how many times smaller the copies are.
    """
    names = sorted(sparse.cameras, key=lambda name: times[name])
    first, last = times[names[0]], times[names[-1]]
    camera = sparse.cameras[names[0]]
    has_alpha = common_header([pictures / name for name in names]).has_alpha
    scales = [s for s in SCALES[1:] if min(camera.width, camera.height) // s >= _LEAST_SIDE]

    def shots() -> Iterator[PosedShot]:
        for done, name in enumerate(names):
            pixels = read_image(pictures / name).numpy()
            pixels = pixels if has_alpha else pixels[..., :3]
            for scale in scales:
                _write_smaller(folder / f"images_{scale}" / name, pixels, scale)
            time = (times[name] - first) / (last - first)
            yield PosedShot(name, sparse.cameras[name], pixels, time)
            progress(done + 1, len(names))

    options = {"near": limits.near, "far": limits.far, "aabb": limits.box, "points": sparse.sure()}
    write_scene(folder, shots(), **options)
    return scales


def _write_smaller(path: Path, pixels: np.ndarray, scale: int) -> None:
    """Write the mean of each block of ``scale`` x ``scale`` pixels; leave out what is left at the ends."""
    height, width = (n // scale for n in pixels.shape[:2])
    small = shrunk(pixels[: height * scale, : width * scale], height, width)
    (write_png if path.suffix.lower() == ".png" else write_jpeg)(path, small)
