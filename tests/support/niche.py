"""A niche in a wall that a red block fills at once, seen by two cameras that stand still."""

import torch

from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import View

TIMES = (0.0, 1 / 3, 2 / 3, 1.0)  # the block is there in the last two
HALF, DEEP = 0.6, 0.8  # of the niche, which opens in the plane y = 0
SIZE, FINER = 12, 3  # pixels; rays along each side of a pixel


def niche_scene():
    """Two pictures a time. A warp of the points of one template would have to tear at all five sides."""
    train = tuple(_frame(number, time, side) for number, time in enumerate(TIMES) for side in (-1, 1))
    return Scene("niche", train, (), train[:1], Box((-2, -1, -2), (2, 1, 2)), TIMES[0], has_alpha=False)


def _frame(number, time, side):
    picture = _picture(_camera(side), filled=time > 0.5)
    return Frame(f"r_{number}_{side}", time, _camera(side), lambda: picture, camera_id=(side + 1) // 2)


def _camera(side):
    pose = look_at(torch.tensor([0.6 * side, -3.0, 0.3]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(SIZE, SIZE, 1.5 * SIZE, 1.5 * SIZE, SIZE / 2, SIZE / 2, pose, 1.5, 5.0)


def _picture(camera, filled):
    rays = View(camera.resized(SIZE * FINER, SIZE * FINER)).rays()
    start, way = rays.origins, rays.directions
    wall = start - (start[:, 1:2] / way[:, 1:2]) * way
    low, high = torch.tensor([-HALF, 0.0, -HALF]), torch.tensor([HALF, DEEP, HALF])
    out = torch.maximum((low - start) / way, (high - start) / way).amin(1, keepdim=True)
    inside = torch.tensor([0.85, 0.15, 0.15]).expand_as(start)
    if not filled:
        inside = _checked(3 * (start + out * way) + 0.01, [0.3, 0.75, 0.4], [0.15, 0.3, 0.2])
    around = _checked(2.5 * wall[:, ::2], [0.9, 0.8, 0.3], [0.2, 0.35, 0.7])
    rgb = torch.where((wall[:, ::2].abs() < HALF).all(1, keepdim=True), inside, around)
    rgb = rgb.reshape(SIZE, FINER, SIZE, FINER, 3).mean((1, 3))
    return torch.cat([(255 * rgb).round().byte(), torch.full((SIZE, SIZE, 1), 255, dtype=torch.uint8)], -1)


def _checked(places, one, other):
    odd = places.floor().sum(1, keepdim=True) % 2
    return odd * torch.tensor(one) + (1 - odd) * torch.tensor(other)
