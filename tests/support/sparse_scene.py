"""What structure from motion would find of an arc around random points."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from forewarp.capture.poses import Reconstruction
from forewarp.scene.camera import Camera, look_at


def cameras_on_arc(count=12, radius=4.0, degrees=70.0, height=1.2, focal=300.0, roll=0.0, lens=None):
    """Cameras of 320 x 240 pixels by name, which look at the origin, z upwards."""
    rng, made = np.random.default_rng(1), {}
    for i in range(count):
        angle = math.radians(degrees * (i / (count - 1) - 0.5))
        center = torch.tensor(
            [radius * math.sin(angle), -radius * math.cos(angle), height], dtype=torch.float64
        )
        up = torch.tensor([roll * rng.normal(), roll * rng.normal(), 1.0])
        pose = look_at(center, torch.zeros(3), up)
        made[f"frame_{i + 1:06d}.jpg"] = Camera(320, 240, focal, focal, 160, 120, pose, 0.0, 0.0, lens=lens)
    return made


def sparse_arc(points=400, outliers=0, error=0.5, **options) -> Reconstruction:
    """Points in the cube from -1 to 1, which all cameras see, then outliers thousands away."""
    rng, cameras = np.random.default_rng(0), cameras_on_arc(**options)
    places = np.concatenate([rng.uniform(-1, 1, (points, 3)), 3000 * rng.normal(size=(outliers, 3))])
    grid = np.meshgrid(np.arange(len(cameras)), np.arange(len(places)), indexing="ij")
    seen = np.stack(grid, -1).reshape(-1, 2)
    return Reconstruction(
        cameras,
        places,
        rng.integers(0, 256, places.shape).astype(np.uint8),
        np.full(len(places), error),
        np.full(len(places), len(cameras)),
        seen,
        error,
    )


def write_model(folder, cameras, points, model="OPENCV", lens=(0.0, 0.0, 0.0, 0.0)):
    """Write a COLMAP model as text, by hand: each point is seen by all cameras."""
    folder.mkdir(parents=True)
    one = next(iter(cameras.values()))
    numbers = {
        "OPENCV": (one.fx, one.fy, one.cx, one.cy, *lens),
        "SIMPLE_RADIAL": (one.fx, one.cx, one.cy, lens[0]),
        "OPENCV_FISHEYE": (one.fx, one.fy, one.cx, one.cy, *lens),
    }[model]
    (folder / "cameras.txt").write_text(f"1 {model} {one.width} {one.height} {' '.join(map(str, numbers))}\n")
    lines = []
    for number, (name, camera) in enumerate(cameras.items(), 1):
        pose = np.linalg.inv(np.asarray(camera.camera_to_world))
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        pixels = np.asarray(camera.project(torch.from_numpy(points))[0])
        place = " ".join(map(str, (w, x, y, z, *pose[:3, 3])))
        lines.append(f"{number} {place} 1 {name}")
        lines.append(" ".join(f"{u} {v} {row}" for row, (u, v) in enumerate(pixels, 1)))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    tracks = {row: " ".join(f"{n} {row}" for n in range(1, len(cameras) + 1)) for row in range(len(points))}
    rows = (f"{i + 1} {x} {y} {z} 200 100 50 0.25 {tracks[i]}" for i, (x, y, z) in enumerate(points))
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
