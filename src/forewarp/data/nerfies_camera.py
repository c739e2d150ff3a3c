"""The camera files of Nerfies and HyperNeRF captures, ``camera/<id>.json``.

``orientation`` is world-to-camera with OpenCV's axes, ``position`` the camera's centre in the unscaled world;
all else is in pixels of the full-size image. Old files say ``tangential`` for ``tangential_distortion``.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch

from forewarp.data.files import number, read_json
from forewarp.data.views import check_lens, pose_of
from forewarp.files import replace_file
from forewarp.scene.camera import Camera
from forewarp.scene.errors import SceneError
from forewarp.scene.lens import Lens

# Beyond them a camera is a slip, not a camera.
_MOST_PIXELS, _MOST_PIXELS_OFF, _MOST_BENT = 1e5, 1e7, 1e3
_ASPECTS = 1e-2, 1e2


def read_camera(path: Path, near: float, far: float) -> Camera:
    """The camera of a file, in its units: the unscaled world and the full-size image.

    Raises:
        SceneError: for a key that is missing or has a wrong number of values, for no rotation, and for a lens
            that cannot be undone.
    """
    content = read_json(path)
    width, height = numbers(content, "image_size", 2, path, 1, _MOST_PIXELS)
    if width % 1 or height % 1:
        raise SceneError(f"{path}: image_size: expected whole numbers, but got {width:g} x {height:g}")
    focal = number(content.get("focal_length"), f"{path}: focal_length", 1e-3, _MOST_PIXELS_OFF)
    aspect = number(content.get("pixel_aspect_ratio", 1.0), f"{path}: pixel_aspect_ratio", *_ASPECTS)
    skew = number(content.get("skew", 0.0), f"{path}: skew", -_MOST_PIXELS_OFF, _MOST_PIXELS_OFF)
    cx, cy = numbers(content, "principal_point", 2, path, -_MOST_PIXELS_OFF, _MOST_PIXELS_OFF)
    pose = torch.from_numpy(_pose(content, path))
    size = int(width), int(height)
    camera = Camera(*size, focal, focal * aspect, cx, cy, pose, near, far, skew, _lens(content, path))
    check_lens(camera, f"{path}: radial_distortion")
    return camera


def write_camera(path: Path, camera: Camera) -> None:
    """Write a camera for ``read_camera``, every digit of it but near and far, whole or not at all."""
    lens = camera.lens or Lens()
    content = {
        "orientation": camera.camera_to_world[:3, :3].double().T.tolist(),
        "position": camera.center.double().tolist(),
        "focal_length": float(camera.fx),
        "principal_point": [float(camera.cx), float(camera.cy)],
        "skew": float(camera.skew),
        "pixel_aspect_ratio": float(camera.fy / camera.fx),
        "radial_distortion": list(lens.k),
        "tangential_distortion": list(lens.p),
        "image_size": [camera.width, camera.height],
    }
    replace_file(path, json.dumps(content, indent=1).encode())


def reduced(camera: Camera, scale: int) -> Camera:
    """The camera of the image whose sides are ``scale`` times smaller, its size rounded.

    All that is in pixels shrinks exactly, whatever the rounding, and the skew too: public loaders leave it as
    it is, which slants the picture wherever it is not 0.
    """
    size = {"width": round(camera.width / scale), "height": round(camera.height / scale)}
    pixels = {key: getattr(camera, key) / scale for key in ("fx", "fy", "cx", "cy", "skew")}
    return replace(camera, **size, **pixels)


def numbers(
    content: dict, key: str, count: int, path: Path, low: float = -np.inf, high: float = np.inf
) -> list[float]:
    """The ``count`` finite numbers, ``low <= value <= high``, that a file holds under ``key``."""
    values = content.get(key)
    if not isinstance(values, list) or len(values) != count:
        raise SceneError(f"{path}: {key}: expected {count} numbers, but got {short(values)}")
    return [number(value, f"{path}: {key}[{i}]", low, high) for i, value in enumerate(values)]


def _pose(content: dict, path: Path) -> np.ndarray:
    """Camera-to-world (4, 4) float64."""
    rows = content.get("orientation")
    fits = isinstance(rows, list) and [len(r) if isinstance(r, list) else 0 for r in rows] == [3, 3, 3]
    if not fits:
        raise SceneError(f"{path}: orientation: expected 3 x 3 numbers, but got {short(rows)}")
    where = f"{path}: orientation"
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[number(v, where) for v in row] for row in rows]).T
    matrix[:3, 3] = numbers(content, "position", 3, path)
    return pose_of(matrix, where)


def _lens(content: dict, path: Path) -> Lens | None:
    """None where nothing is bent."""
    name = "tangential" if "tangential" in content else "tangential_distortion"
    bent = {"radial_distortion": [0.0] * 3, name: [0.0] * 2} | content
    radial = numbers(bent, "radial_distortion", 3, path, -_MOST_BENT, _MOST_BENT)
    tangential = numbers(bent, name, 2, path, -_MOST_BENT, _MOST_BENT)
    return Lens(tuple(radial), tuple(tangential)) if any(radial + tangential) else None
