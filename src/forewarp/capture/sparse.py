"""What structure from motion found: cameras and points; read from a pycolmap reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from forewarp.scene.camera import Camera, Lens

_KNOWN = {"f", "fx", "fy", "cx", "cy", "k", "k1", "k2", "k3", "p1", "p2"}
_VIEWS, _ERROR = 3, 1.5  # a point that is sure: seen by so many cameras, to so many pixels


@dataclass(frozen=True)
class Sparse:
    """``cameras`` by the picture's name, in the order of time, near and far 0; ``points`` (N, 3) with
    ``colors`` (N, 3) uint8, reprojection ``errors`` (N,) in pixels and how many pictures see each, ``views``
    (N,); ``seen`` (M, 2) which camera sees which point; ``error`` the mean over all observations, pixels; of
    a search of ours, before doubtful points were deleted.
    """

    cameras: dict[str, Camera]
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    views: np.ndarray
    seen: np.ndarray
    error: float

    def distances(self) -> np.ndarray:
        """From each camera to each point that it sees (M,)."""
        centers = np.stack([np.asarray(camera.center) for camera in self.cameras.values()])
        return np.linalg.norm(self.points[self.seen[:, 1]] - centers[self.seen[:, 0]], axis=1)

    def sure(self) -> np.ndarray:
        """Choose the points (K, 3) that are sure enough to begin with; all, if none is."""
        sure = (self.views >= _VIEWS) & (self.errors <= _ERROR)
        return self.points[sure] if sure.any() else self.points

    def moved(self, turn: np.ndarray, center: np.ndarray, scale: float) -> Sparse:
        """Map the world by ``X -> scale * turn @ (X - center)``."""
        cameras = {}
        for name, camera in self.cameras.items():
            pose = camera.camera_to_world.clone()
            pose[:3, :3] = torch.from_numpy(turn) @ pose[:3, :3]
            pose[:3, 3] = torch.from_numpy(scale * turn @ (np.asarray(camera.center) - center))
            cameras[name] = replace(camera, camera_to_world=pose)
        return replace(self, cameras=cameras, points=scale * (self.points - center) @ turn.T)


def read_model(folder: Path, originals: Mapping[str, str] | None = None) -> Sparse:
    """Read a COLMAP model, binary or text.

    Args:
        folder: of the model.
        originals: names of pictures in the model by those that they are to have; None: they stay.

    Raises:
        ValueError: where there is none, or one that cannot be read, or that has other pictures.
    """
    import pycolmap

    kinds = [
        all((folder / f"{n}.{s}").is_file() for n in ("cameras", "images", "points3D"))
        for s in ("bin", "txt")
    ]
    if not any(kinds):
        raise ValueError(
            f"colmap: expected a folder with cameras.bin, images.bin and points3D.bin (or .txt), but got "
            f"{folder}; it is often called sparse/0"
        )
    try:
        found = pycolmap.Reconstruction(folder)
    except (RuntimeError, ValueError, IndexError, OverflowError, MemoryError) as error:
        text = (str(error).strip().splitlines() or ["a file that cannot be read"])[-1]
        raise ValueError(f"{folder}: expected a COLMAP model, but got {text}; export it again") from error
    if originals is None:
        return sparse_of(found)
    ours = {original: name for name, original in originals.items()}
    unknown = {image.name for image in found.images.values() if image.has_pose} - ours.keys()
    if unknown:
        raise ValueError(
            f"images: expected a picture {min(unknown)}, as the model has, but got none; set images="
        )
    for image in found.images.values():
        image.name = ours.get(image.name, image.name)
    return sparse_of(found)


def sparse_of(found) -> Sparse:
    """Take cameras and points out of a ``pycolmap.Reconstruction``, whose pictures' names sort by time.

    Raises:
        ValueError: for a camera model that pinhole cameras with Brown's distortion do not cover.
    """
    images = sorted(
        (image for image in found.images.values() if image.has_pose), key=lambda image: image.name
    )
    cameras = {image.name: _camera(image) for image in images}
    rows = {number: row for row, number in enumerate(found.points3D)}
    points = list(found.points3D.values())
    index = {image.image_id: row for row, image in enumerate(images)}
    seen = [
        (index[element.image_id], rows[number])
        for number, point in found.points3D.items()
        for element in point.track.elements
        if element.image_id in index
    ]
    return Sparse(
        cameras,
        np.array([p.xyz for p in points]).reshape(-1, 3),
        np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3),
        np.array([p.error for p in points]),
        np.array([p.track.length() for p in points]),
        np.unique(np.array(seen, dtype=np.int64).reshape(-1, 2), axis=0),
        float(found.compute_mean_reprojection_error()) if points else float("nan"),
    )


def _camera(image) -> Camera:
    own = image.camera
    values = dict(zip((name.strip() for name in own.params_info.split(",")), map(float, own.params)))
    beyond = [name for name, value in values.items() if name not in _KNOWN and value != 0]
    if beyond or "FISHEYE" in own.model_name or not {"f", "fx"} & values.keys():
        raise ValueError(
            f"{image.name}: expected a camera model with k1 k2 k3 p1 p2, as OPENCV, but got "
            f"{own.model_name}; undistort the pictures (colmap image_undistorter)"
        )
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    k = (values.get("k1", values.get("k", 0.0)), values.get("k2", 0.0), values.get("k3", 0.0))
    p = (values.get("p1", 0.0), values.get("p2", 0.0))
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    lens = Lens(k, p) if any(k + p) else None
    size = own.width, own.height
    return Camera(*size, fx, fy, values["cx"], values["cy"], torch.from_numpy(pose), 0.0, 0.0, lens=lens)
