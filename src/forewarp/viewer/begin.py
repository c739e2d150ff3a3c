"""Where pages begin, and how they are sent splats, in what viser takes."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterator

import numpy as np
from torch import Tensor

from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Ellipsoids


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Drop what viser prints of its server: commands say in their own words what there is to know."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def vertical_fov(camera: Camera) -> float:
    """Return the angle that a camera's image spans from top to bottom, radians."""
    return 2 * math.atan(0.5 * camera.height / camera.fy)


def fitted_fov(camera: Camera, width: float, height: float) -> float:
    """Return the angle from top to bottom, radians, by which a canvas shows a camera's whole image.

    A canvas narrower than the image, as a phone's, shows more above and below it.
    """
    across = 0.5 * camera.width / camera.fx
    return 2 * math.atan(max(0.5 * camera.height / camera.fy, across * height / width))


def begin_at(server, pose: Tensor, fov: float, focus: Tensor, up: Tensor, away: float) -> None:
    """Let the pages of viser's ``server`` begin at a camera, with the scene upright.

    Args:
        server: viser's.
        pose: ``camera_to_world`` (4, 4).
        fov: vertical, radians.
        focus: (3,); the page turns about the point ahead of the camera that is as far away.
        up: upward direction (3,).
        away: world units to that point if ``focus`` lies behind the camera.
    """
    center, ahead = pose[:3, 3], pose[:3, 2]
    along = float((focus - center) @ ahead)
    target = center + ahead * (along if along > 0 else away)
    server.scene.set_up_direction(tuple(up.tolist()))
    server.initial_camera.position = tuple(center.tolist())
    server.initial_camera.look_at = tuple(target.tolist())
    server.initial_camera.fov = fov


def splat_arrays(cloud: Ellipsoids, unit: float) -> list[np.ndarray]:
    """Return what viser's ``add_gaussian_splats(..., scale=unit)`` takes: centers, covariances, colours,
    opacity. In half precision, which it sends, squares of small lengths vanish: ``unit`` is to be about a
    hundredth of the scene, world units.
    """
    parts = cloud.centers / unit, cloud.covariances / unit**2, cloud.colors, cloud.opacity[:, None]
    return [part.cpu().numpy() for part in parts]
