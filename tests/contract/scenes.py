"""Five small scenes, one in the format of each dataset: a coloured ball that slides along x."""

import math
from functools import partial

import numpy as np
import torch

from forewarp.data import dnerf, hypernerf, multicam, nhr
from forewarp.data.images import write_image
from forewarp.data.module import SceneDataModule
from forewarp.scene.camera import Camera, Lens, look_at

RADIUS, SIZE, TIMES, FOCAL = 0.5, 20, 6, 24.0
BOX = (-1.4, -1.2, -1.1, 1.4, 1.2, 1.1)
WALL = (90, 100, 130)  # behind the ball, where a format has no alpha
LENS = Lens((0.1, -0.08, 0.01), (-0.02, 0.004))


def ball_center(time):
    """Where the ball is at a time (3,)."""
    return torch.tensor([-0.4 + 0.8 * time, 0.1, 0.0])


def camera_at(turn, size=(SIZE, SIZE), lens=None):
    """A camera of (width, height) pixels on a slanted circle about the origin."""
    angle = 2 * math.pi * turn
    center = torch.tensor([3.8 * math.cos(angle), 3.8 * math.sin(angle), 0.9 + 0.6 * math.sin(2 * angle)])
    pose = look_at(center, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    width, height = size
    return Camera(width, height, FOCAL, FOCAL, width / 2, height / 2, pose, 2.0, 6.0, lens=lens)


def photograph(camera, time):
    """Render the ball: straight RGBA (H, W, 4) uint8, and ray depth (H, W), 0 on the background."""
    rays = camera.rays()
    offset = rays.origins - ball_center(time)
    along = (offset * rays.directions).sum(-1)
    inside = along**2 - (offset**2).sum(-1) + RADIUS**2
    hit = (inside > 0)[:, None]
    distance = -along - inside.clamp(min=0).sqrt()
    color = 0.5 + 0.4 * (offset + distance[:, None] * rays.directions) / RADIUS
    rgba = torch.cat([color, torch.ones(len(rays), 1)], -1) * hit * 255
    shape = camera.height, camera.width
    depth = (distance * hit[:, 0]).reshape(shape).float().numpy()
    return rgba.round().to(torch.uint8).reshape(*shape, 4).numpy(), depth


def before_wall(rgba):
    """Composite an RGBA image over the wall (H, W, 3), for formats without alpha."""
    return np.where(rgba[..., 3:] > 0, rgba[..., :3], np.array(WALL, np.uint8))


def shots(count, offset, ability="all"):
    """Yield views of the ball, one for each time."""
    for i in range(count):
        camera, time = camera_at(0.381966 * i + offset), i / (count - 1)
        rgba, depth = photograph(camera, time)
        yield dnerf.Shot(f"r_{i}", time, camera.camera_to_world, rgba, depth, ability)


def write_dnerf(folder, write=dnerf.write_scene, ability="all"):
    splits = {"train": shots(TIMES, 0.0), "val": shots(2, 0.1), "test": shots(2, 0.2, ability)}
    write(folder, splits, camera_angle_x=2 * math.atan(SIZE / 2 / FOCAL))


def write_hypernerf(folder):
    def pairs():
        for t in range(TIMES):
            for k, side in enumerate(("left", "right")):
                camera = camera_at(0.03 * t + 0.02 * k, (SIZE, 16), LENS if k else None)
                rgb = before_wall(photograph(camera, t / (TIMES - 1))[0])
                yield hypernerf.RigShot(f"{side}1_{t}", t, k, "train" if k == t % 2 else "val", camera, rgb)

    world = {"center": (0, 0, 0), "scale": 1.0, "near": 2.0, "far": 6.0}
    hypernerf.write_scene(folder, pairs(), **world, points=np.full((4, 3), 0.9, np.float32), scales=(1,))


def write_nhr(folder):
    cameras = [camera_at(k / 4 + 0.05, ((SIZE, 16), (16, SIZE))[k % 2]) for k in range(4)]
    around = torch.nn.functional.normalize(
        torch.randn(64, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )

    def moments():
        for t in range(TIMES):
            time = t / (TIMES - 1)
            pictures = [photograph(camera, time)[0] for camera in cameras]
            points = torch.cat([ball_center(time) + RADIUS * around, 128 + 100 * around], -1).numpy()
            yield nhr.DomeFrame([before_wall(p) for p in pictures], [p[..., 3] for p in pictures], points)

    nhr.write_scene(folder, cameras, moments())


def write_multicam(folder):
    cameras = [camera_at(k / 4 + 0.05, (SIZE, 16)) for k in range(4)]
    for k, camera in enumerate(cameras):
        for t in range(TIMES):
            rgb = before_wall(photograph(camera, t / (TIMES - 1))[0])
            write_image(folder / f"cam{k:02d}" / f"{t:04d}.png", rgb)
    multicam.write_poses(folder, cameras, near=2.0, far=6.0)


write_lego_complete = partial(write_dnerf, ability="time")

# name -> what writes a scene into a folder, and what reads it again from root and name.
DATASETS = {
    "dnerf": (write_dnerf, dnerf.read_scene),
    "hypernerf": (write_hypernerf, partial(hypernerf.read_scene, scale=1, box=BOX)),
    "nhr": (write_nhr, partial(nhr.read_scene, half_resolution=False, test_cameras=[0])),
    "lego_complete": (write_lego_complete, dnerf.read_lego_complete),
    "multicam": (write_multicam, partial(multicam.read_scene, scale=1, box=BOX, normalise=False)),
}


def data_of(dataset, root):
    """A data module over a scene that was written into ``root/dataset``; of a rig, of 3 views a step."""
    views = 3 if dataset in ("nhr", "multicam") else 1
    read = partial(DATASETS[dataset][1], root, dataset)
    return SceneDataModule(read, rays=192, views_per_step=views, place=root / dataset)
