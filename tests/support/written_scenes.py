"""Tiny written scenes of every format, the place of the real ones, and changes of JSON files."""

import json
import math
import os
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
import torch

from forewarp.data import dnerf, hypernerf, multicam, nhr, posed_video
from forewarp.data.files import SceneError
from forewarp.drawing import images
from forewarp.scene.camera import Camera, Lens, look_at
from forewarp.scene.frame import Truth

_REAL = Path(os.environ.get("FOREWARP_DATA", Path(__file__).parents[3] / "shared" / "data"))
GONE = object()
UP = torch.tensor([0.0, 0.0, 1.0])
LENS = Lens((0.105, -0.088, 0.01), (-0.0537, 0.0037))


def real(folder: str) -> Path:
    """The root of real scenes, or a skip."""
    if not (_REAL / folder).is_dir():
        pytest.skip(f"no real data: {_REAL / folder} is absent; set FOREWARP_DATA")
    return _REAL / folder


def refused(match):
    """What a user gave is refused in a line like this."""
    return pytest.raises(SceneError, match=match)


def say_linear(path):
    """Let a PNG say that its colours are linear."""
    content, chunk = path.read_bytes(), b"gAMA" + (100000).to_bytes(4, "big")
    chunk = (4).to_bytes(4, "big") + chunk + crc32(chunk).to_bytes(4, "big")
    path.write_bytes(content[:33] + chunk + content[33:])  # behind the header


def edit(path, change):
    """Change a file by a function of its content or by places, ``{"frames.1.time": 3}``; ``GONE`` removes."""
    content = json.loads(path.read_text())
    if callable(change):
        change(content)
    else:
        for place, value in change.items():
            *way, last = (int(key) if key.isdecimal() else key for key in place.split("."))
            holder = reduce(getitem, way, content)
            if value is GONE:
                del holder[last]
            else:
                holder[last] = value
    path.write_text(json.dumps(content))


def noise(rng, camera, channels=3):
    """A random image of a camera's size."""
    return rng.integers(0, 256, (camera.height, camera.width, channels), dtype=np.uint8)


def two_points(*times) -> Truth:
    """Where two points are at three times."""
    return Truth(torch.arange(18.0).reshape(2, 3, 3), torch.tensor(times, dtype=torch.float64))


def around(count=8) -> list[torch.Tensor]:
    """Poses on a circle of radius 4, which look at the origin."""
    angles = [2 * math.pi * i / count for i in range(count)]
    places = [torch.tensor([4 * math.cos(a), 4 * math.sin(a), 1.5], dtype=torch.float64) for a in angles]
    return [look_at(place, torch.zeros(3, dtype=torch.float64), UP).double() for place in places]


# D-NeRF and Lego Complete ----------------------------------------------------------------------------------

ANGLE = 0.6911112
FEW = {"space": 4, "time": 3, "canonical": 2}
TIMES = {"space": [0.0, 0.5, 0.5, 1.0], "time": [0.1, 0.3, 0.6], "canonical": [0.0, 0.0]}
LEGO_TRUTH = two_points(0.0, 0.5, 1.0)


def dnerf_shots(count, seed=0, size=(6, 8), ability="all", depth=False, times=None):
    """Random images (H, W) from random places on the sphere of radius 4, looking at the origin."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        center = torch.from_numpy(rng.normal(size=3))
        pose = look_at(4.0311 * center / center.norm(), torch.zeros(3), UP)
        rgba = rng.integers(0, 256, (*size, 4), dtype=np.uint8)
        stored = rng.uniform(2, 6, size).astype(np.float32) if depth else None
        time = i / max(count - 1, 1) if times is None else times[i]
        yield dnerf.Shot(f"r_{i}", time, pose, rgba, stored, ability)


def write_dnerf(folder: Path, size=(6, 8), **changes) -> Path:
    """A stock scene with 4 training, 2 validation and 3 test frames of 8 x 6 pixels."""
    splits = {"train": dnerf_shots(4, 0, size), "val": dnerf_shots(2, 1, size)}
    splits["test"] = dnerf_shots(3, 2, size)
    dnerf.write_scene(folder, splits | changes, camera_angle_x=ANGLE)
    return folder


def lego_views():
    """Shots of each ability at its times, with depth."""
    for seed, (ability, count) in enumerate(FEW.items()):
        yield from dnerf_shots(count, 10 + seed, ability=ability, depth=True, times=TIMES[ability])


def write_lego(folder: Path, **changes) -> Path:
    """A Lego Complete scene: 3 training images, 9 test views of three kinds with depth, trajectories."""
    splits = {"train": dnerf_shots(3), "test": lego_views()} | changes
    dnerf.write_scene(folder, splits, camera_angle_x=ANGLE, trajectories=LEGO_TRUTH)
    return folder


# HyperNeRF: two phones with lenses before a world of its own scale -----------------------------------------

CENTER, SCALE, NEAR, FAR = (2.5, -1.0, 0.75), 0.2, 0.3, 1.4
RIG_TRUTH = two_points(0.5, 0.0, 1.0)


def phone(index, size=(12, 8), skew=0.0):
    """One of the cameras (width, height) around CENTER, in the unscaled world; every other one has a lens."""
    angle, middle = 0.3 * index, torch.tensor(CENTER, dtype=torch.float64)
    offset = torch.tensor([4 * np.cos(angle), 4 * np.sin(angle), 1.0], dtype=torch.float64)
    width, height = size
    inner = (1.1 * width, 1.026 * 1.1 * width, 0.52 * width, 0.47 * height)
    lens = LENS if index % 2 else None
    return Camera(*size, *inner, look_at(middle + offset, middle, UP), NEAR, FAR, skew, lens)


def rig(times=5, **options):
    """Left and right at each time; one is trained on, the other held out, in turns."""
    rng = np.random.default_rng(0)
    for t in range(times):
        for k, side in enumerate(("left", "right")):
            camera, split = phone(2 * t + k, **options), "train" if k == t % 2 else "val"
            yield hypernerf.RigShot(f"{side}1_{t:06d}", t, k, split, camera, noise(rng, camera))


def hand(count=11):
    """One phone that moves; nothing is held out by name."""
    rng = np.random.default_rng(1)
    for t in range(count):
        camera = phone(2 * t + 1)
        yield hypernerf.RigShot(f"{t + 1:06d}", t, 0, "train", camera, noise(rng, camera))


def film(times=4, size=(12, 8), unit=1.0):
    """A phone that measures depth, with a hole and a doubtful pixel, and one beside it, that is held out."""
    rng = np.random.default_rng(2)
    for t in range(times):
        camera, beside = phone(2 * t, size), phone(2 * t + 1, size)
        depth, trust = unit * rng.uniform(3.5, 4.5, size[::-1]), np.ones(size[::-1])
        depth[:2, :2], trust[4:6, 4:6] = 0, 0.5
        points = np.array([[2.0 * t, 4.0, 1], [6, 2, t % 2]])
        about = f"0_{t:05d}", t, 0, "train", camera, noise(rng, camera), depth, trust
        yield hypernerf.RigShot(*about, keypoints=points)
        seen = np.arange(size[0])[None] < np.full(size[::-1], size[0] // 2)
        yield hypernerf.RigShot(f"1_{t:05d}", t, 1, "val", beside, noise(rng, beside), covisible=seen)


def write_rig(folder: Path, shots=None, **changes) -> Path:
    """A rig of five times; what it stores differs from the normalised world."""
    options = {"center": CENTER, "scale": SCALE, "near": NEAR, "far": FAR} | changes
    hypernerf.write_scene(folder, rig() if shots is None else shots, **options)
    return folder


# NHR: a dome of cameras of two sizes around a few coloured balls -------------------------------------------

BALLS = np.array([[0.3, -0.2, 0.9], [-0.25, 0.15, 1.3], [0.05, 0.3, 0.6]])
COLORS = np.array([[230, 40, 40], [40, 220, 60], [50, 70, 230]])
STEP = np.array([0.1, 0.05, 0.0])  # that the balls go from frame to frame
STUDIO = (20, 160, 40)


def dome(views=4, sizes=((60, 48), (48, 60))):
    """Cameras on a circle; no two lenses are equal."""
    cameras = []
    for k in range(views):
        angle, (w, h) = 2 * math.pi * k / views + 0.1, sizes[k % len(sizes)]
        center = torch.tensor([3 * math.cos(angle), 3 * math.sin(angle), 1.0 + 0.3 * (k % 3)])
        pose = look_at(center, torch.tensor([0.1, 0.05, 0.9]), UP)
        cameras.append(Camera(w, h, 70.0 + k, 71.5, w / 2 + 1.3, h / 2 - 0.8, pose, 1.0, 6.0, skew=0.7))
    return cameras


def place(camera, point):
    """Where a point is seen (2,), written out anew: X = R x + T, u = fx x + s y + cx, v = fy y + cy."""
    pose = camera.camera_to_world.numpy()
    x, y, z = pose[:3, :3].T @ (point - pose[:3, 3])
    return np.array([camera.fx * x / z + camera.skew * y / z + camera.cx, camera.fy * y / z + camera.cy])


def dome_frames(cameras, count=3):
    """What the cameras see while the balls move: discs of 4 pixels' radius in front of the studio."""
    for f in range(count):
        images, masks, balls = [], [], BALLS + f * STEP
        for camera in cameras:
            image = np.full((camera.height, camera.width, 3), STUDIO, np.uint8)
            mask = np.zeros((camera.height, camera.width), np.uint8)
            row, column = np.mgrid[: camera.height, : camera.width] + 0.5
            for ball, color in zip(balls, COLORS):
                u, v = place(camera, ball)
                inside = (column - u) ** 2 + (row - v) ** 2 < 16
                image[inside], mask[inside] = color, 255
            images.append(image)
            masks.append(mask)
        yield nhr.DomeFrame(images, masks, np.concatenate([balls, COLORS], 1).astype(np.float32))


def dome_truth(count=3):
    """How the balls move."""
    points = np.stack([BALLS + f * STEP for f in range(count)], 1).astype(np.float32)
    return Truth(torch.from_numpy(points), torch.linspace(0, 1, count, dtype=torch.float64))


def write_dome(folder: Path, cameras=None, count=3, **options) -> Path:
    """Write what the dome sees."""
    cameras = cameras or dome()
    nhr.write_scene(folder, cameras, dome_frames(cameras, count), **options)
    return folder


# A capture with poses, of a world whose unit and origin mean nothing ---------------------------------------

MIDDLE = torch.tensor([30.0, -20.0, 5.0], dtype=torch.float64)


def posed_cameras(count: int, size=(20, 30), lens: Lens | None = LENS) -> list[Camera]:
    """Cameras on a quarter of a circle about ``MIDDLE``; ``size`` is (height, width)."""
    made, (h, w) = [], size
    for i in range(count):
        angle = 1.5 * i / max(count - 1, 1)
        offset = torch.tensor([np.cos(angle), np.sin(angle), 0.3 + 0.1 * (i % 3)], dtype=torch.float64)
        pose = look_at(MIDDLE + 70 * offset / offset.norm(), MIDDLE, UP)
        made.append(Camera(w, h, 1.1 * w, 1.2 * w, 0.52 * w, 0.47 * h, pose, 0.0, 1.0, lens=lens))
    return made


def posed_shots(count=10, channels=3, times=None, suffix=".png", splits=None, views=None):
    """Random images of ``posed_cameras``, or of other ``views``."""
    rng = np.random.default_rng(0)
    for i, camera in enumerate(views or posed_cameras(count)):
        time, split = None if times is None else times[i], splits[i] if splits else ""
        name = f"frame_{i + 1}{suffix}"
        yield posed_video.PosedShot(name, camera, noise(rng, camera, channels), time, split)


def write_video(folder: Path, near=20.0, far=120.0, aabb=None, **options) -> Path:
    """Ten frames of 30 x 20 pixels whose range is known."""
    posed_video.write_scene(folder, posed_shots(**options), near=near, far=far, aabb=aabb)
    return folder


def placed(scene, camera: Camera) -> Camera:
    """A camera of the file in the scene's units, by hand."""
    space, pose = scene.protocol["normalisation"], camera.camera_to_world.clone()
    pose[:3, 3] = (pose[:3, 3] - torch.tensor(space["center"], dtype=torch.float64)) * space["scale"]
    return replace(camera, camera_to_world=pose)


# A rig of fixed cameras with videos -------------------------------------------------------------------------


def fixed_cameras(count=4, size=(32, 48)) -> list[Camera]:
    """Cameras on an arc about ``MIDDLE`` whose middle is theirs; ``size`` is (height, width)."""
    made, (h, w) = [], size
    for i in range(count):
        angle = 0.9 * i / max(count - 1, 1)
        offset = torch.tensor([np.cos(angle), np.sin(angle), 0.2 + 0.1 * (i % 2)], dtype=torch.float64)
        pose = look_at(MIDDLE + 20 * offset / offset.norm(), MIDDLE, UP)
        made.append(Camera(w, h, 1.1 * w, 1.1 * w, w / 2, h / 2, pose, 0.0, 0.0))
    return made


def grey(camera, number, view) -> np.ndarray:
    """An image whose grey tells its number and, in its left half, its camera's."""
    image = np.full((camera.height, camera.width, 3), 20 + 20 * number, np.uint8)
    image[:, : camera.width // 2] = 20 + 20 * view
    return image


def write_multicam(folder: Path, cameras, count=6) -> Path:
    """Films of six frames by each camera."""
    for k, camera in enumerate(cameras):
        film = (torch.from_numpy(grey(camera, n, k)).float() / 255 for n in range(count))
        images.write_video(folder / f"cam{k:02d}.mp4", film, fps=30.0)
    multicam.write_poses(folder, cameras, near=14.0, far=30.0)
    return folder
