"""What capture is tried on: a scene filmed as by hand, what structure from motion would find, and how near
found cameras come to true ones.
"""

import math
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from forewarp.capture.poses import Reconstruction
from forewarp.scene.camera import Camera, Lens, look_at
from forewarp.synth.raycast import render_all
from forewarp.synth.walks import Walk, cameras_of
from forewarp.synth.world import World
from tests.support.films import write_film


def quiet(done, total):
    """Hear progress and say nothing."""
    assert 0 <= done <= total


def step(title):
    """Give what hears of a step."""
    return nullcontext(quiet)


@dataclass(frozen=True)
class WorldWalk(Walk):
    """A walk through a world: its motion, and whether it has a room."""

    motion: str = ""
    has_room: bool = False


PHONE = Lens((0.05, -0.04, 0.0), (0.001, -0.0015))
WALKS = {
    "room": WorldWalk((-125.0, -55.0), 3.0, 20.0, (0.0, 0.0, -0.08), 62.0, PHONE, "lift_tilt", True),
    "corner": WorldWalk((22.0, 68.0), 3.6, 22.0, (-0.1, -0.1, -0.1), 56.0, PHONE, "room"),
}


def pictures_of(walk: WorldWalk, times, cameras, *, samples: int = 2, workers=None, progress=None):
    """Yield uint8 pictures (H, W, 3), one for each camera; what is behind everything is white."""
    world = World(walk.motion, has_room=walk.has_room)
    views = [(world, float(time), camera) for time, camera in zip(times, cameras)]
    for rgba, _ in render_all(views, samples, workers, progress, shadow_rays=1):
        yield rgba[..., :3]


def hand_film(file, count=20, size=(240, 180)):
    """Write a hand-held film of the room; return its file and its true cameras."""
    walk, times = WALKS["room"], np.linspace(0, 1, count)
    cameras = cameras_of(walk, times, 4.0, size=size)
    images = np.stack(list(pictures_of(walk, times, cameras, samples=1, workers=1)))
    return write_film(file, images, stamps="N*(N+30)*3"), cameras


def smeared(picture: np.ndarray, length: int) -> np.ndarray:
    """The mean of ``length`` copies of (H, W, 3), each a pixel further right: a shaken frame."""
    shifts = range(-(length // 2), length - length // 2)
    moved = [np.roll(picture, shift, 1).astype(np.float32) for shift in shifts]
    return np.mean(moved, 0).round().astype(np.uint8)


def cameras_on_arc(count=12, radius=4.0, degrees=70.0, height=1.2, focal=300.0, roll=0.0, lens=None):
    """Cameras of 320 x 240 pixels by name, which look at the origin, z upwards."""
    rng, made = np.random.default_rng(1), {}
    for i in range(count):
        angle = math.radians(degrees * (i / (count - 1) - 0.5))
        place = [radius * math.sin(angle), -radius * math.cos(angle), height]
        center = torch.tensor(place, dtype=torch.float64)
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
    colors = rng.integers(0, 256, places.shape).astype(np.uint8)
    errors, lengths = np.full(len(places), error), np.full(len(places), len(cameras))
    return Reconstruction(cameras, places, colors, errors, lengths, seen, error)


def write_model(folder, cameras, points, model="OPENCV", lens=(0.0, 0.0, 0.0, 0.0)):
    """Write a COLMAP model as text, by hand: each point is seen by all cameras."""
    folder.mkdir(parents=True)
    one = next(iter(cameras.values()))
    if model.startswith("OPENCV"):
        numbers = one.fx, one.fy, one.cx, one.cy, *lens
    else:
        numbers = one.fx, one.cx, one.cy, lens[0]
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


@dataclass(frozen=True)
class Similarity:
    """``X -> scale * turn @ X + shift``."""

    scale: float
    turn: np.ndarray
    shift: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Move points (..., 3)."""
        return self.scale * points @ self.turn.T + self.shift


def _axes(cameras) -> np.ndarray:
    return np.stack([np.asarray(camera.camera_to_world)[:3, :3] for camera in cameras])


def _centers(cameras) -> np.ndarray:
    return np.stack([np.asarray(camera.center) for camera in cameras])


def fitted(found, true) -> Similarity:
    """Fit the similarity that takes found cameras to true ones.

    The turn is the mean of what takes found axes to true ones: centres on a path that is nearly a line would
    leave the turn about that line open. Scale and shift fit the centres, least squares.
    """
    total = np.einsum("nij,nkj->ik", _axes(true), _axes(found))
    u, _, v = np.linalg.svd(total)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    source, target = _centers(found) @ turn.T, _centers(true)
    a, b = source - source.mean(0), target - target.mean(0)
    scale = float((a * b).sum() / (a * a).sum())
    return Similarity(scale, turn, target.mean(0) - scale * source.mean(0))


def pose_errors(found, true) -> tuple[Similarity, np.ndarray, np.ndarray]:
    """Compare cameras in pairs.

    Returns:
        the similarity from found to true; degrees (N,) between their axes; distances (N,) between their
        centres, as a share of the length of the true path.
    """
    similarity, centers = fitted(found, true), _centers(true)
    path = np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()
    away = np.linalg.norm(similarity(_centers(found)) - centers, axis=1) / path
    turns = np.einsum("nji,njk->nik", _axes(true), similarity.turn @ _axes(found))
    cosine = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    return similarity, np.degrees(np.arccos(np.clip(cosine, -1, 1))), away
