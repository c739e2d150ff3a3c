"""Write a rig of cameras in the layout of DyNeRF: a video for each camera and their poses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.data.files import mismatch, remove
from forewarp.data.images import by, check_pixels
from forewarp.data.multicam import FILE, write_poses
from forewarp.drawing.images import write_video
from forewarp.scene.camera import Camera


def write_scene(
    folder: str | Path,
    cameras: Sequence[Camera],
    films: Iterable[Iterable[Tensor | np.ndarray]],
    *,
    near: float,
    far: float,
    fps: float = 30.0,
) -> None:
    """Write a scene that ``multicam.read_scene`` reads; poses are removed first and written last.

    Args:
        folder: of the scene; films of an earlier one are removed.
        cameras: which ``multicam.write_poses`` takes, with even sides.
        films: of each camera its images uint8 (H, W, 3), moment by moment; consumed one by one, and
            compressed with some loss.
        near, far: see ``multicam.write_poses``.
        fps: frames a second.
    """
    folder = Path(folder)
    remove(folder, FILE, "cam*.mp4")
    for k, (camera, film) in enumerate(zip(cameras, films, strict=True)):
        name, shape = f"cam{k:02d}.mp4", (camera.height, camera.width, 3)
        if camera.width % 2 or camera.height % 2:
            raise mismatch(name, "even sides", by((camera.width, camera.height)), "crop the images")
        images = (torch.from_numpy(check_pixels(name, image, shape)).float() / 255 for image in film)
        write_video(folder / name, images, fps=fps)
    write_poses(folder, cameras, near=near, far=far)
