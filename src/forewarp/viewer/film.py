"""A video along a path through key views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.drawing.files import write_video
from forewarp.viewer.look import Look
from forewarp.viewer.visit import Visit

FPS = 25.0  # pictures a second of a video
SHORTEST, LONGEST = 0.1, 600.0  # seconds of a video


def between(keys: Sequence[Look], pictures: int) -> list[Look]:
    """Make ``pictures`` looks along a smooth path through key views, evenly spaced from first to last.

    Places follow a cubic spline, turns a spline of rotations, both through every key; times and angles of
    view go monotonically from key to key. What else is shown is as in the key before.

    Raises:
        ValueError: for fewer than 2 keys or pictures.
    """
    from scipy.interpolate import CubicSpline, PchipInterpolator  # late, as their import takes time
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(keys) < 2 or pictures < 2:
        raise ValueError(
            f"key views: expected at least 2, and 2 pictures of them, but got {len(keys)} key views and "
            f"{pictures} pictures; go to another view or time and add it"
        )
    poses = np.stack([key.pose.double().numpy() for key in keys])
    at, along = np.arange(len(keys)), np.linspace(0, len(keys) - 1, pictures)
    kind = CubicSpline if len(keys) > 2 else PchipInterpolator
    places = kind(at, poses[:, :3, 3])(along)
    turns = RotationSpline(at, Rotation.from_matrix(poses[:, :3, :3]))(along).as_matrix()
    times, angles = (
        PchipInterpolator(at, [getattr(key, name) for key in keys])(along) for name in ("time", "fov")
    )
    looks = []
    for i, place in enumerate(places):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turns[i], place
        before = keys[min(int(along[i] + 1e-9), len(keys) - 1)]
        time = min(1.0, max(0.0, float(times[i])))
        looks.append(
            replace(before, pose=torch.from_numpy(pose), time=time, fov=float(angles[i]), stand=None)
        )
    return looks


def write_film(
    folder: Path, visit: Visit, keys: Sequence[Look], seconds: float, tell: Callable[[int, int], None]
) -> Path:
    """Write a video through key views into ``folder``, as ``path-<number>.mp4`` that is not there yet.

    Its pictures are drawn at the desk, after what pages wait for; not for the thread that serves it.

    Args:
        folder: is made if need be.
        visit: draws the pictures, all as large as it shows them at rest now.
        keys: see ``between``.
        seconds: how long it plays; ``SHORTEST`` to ``LONGEST``, others become the nearest of these.
        tell: called with the pictures done, and of how many.

    Returns:
        the file.

    Raises:
        ValueError: for fewer than 2 keys.
        Superseded: if the page leaves.
        Exception: what went wrong while a picture was drawn. In all cases nothing is left behind.
    """
    seconds = min(LONGEST, max(SHORTEST, seconds))
    looks = between(keys, max(2, round(seconds * FPS)))

    size = visit.full_size()  # of all pictures, also where the window gets another size meanwhile

    def pictures() -> Iterator[Tensor]:
        for number, look in enumerate(looks):
            tell(number, len(looks))
            yield visit.request(look, size=size)

    file = _reserved(folder)
    try:
        return write_video(file, pictures(), fps=FPS)
    except BaseException:
        file.unlink(missing_ok=True)
        raise


def _reserved(folder: Path) -> Path:
    """Make an empty file of a number of its own, as another page may begin a film at the same time."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = count(1)
    while True:
        file = folder / f"path-{next(numbers)}.mp4"
        try:
            file.open("x").close()
        except FileExistsError:
            continue
        return file
