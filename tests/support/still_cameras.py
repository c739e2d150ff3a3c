"""Scenes of a few images by cameras that stand still: a square that slides, a niche that a block fills."""

from functools import partial

import torch

from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame, Scene

TIMES = (0.0, 0.5, 1.0)  # of the square
NICHE_TIMES = (0.0, 1 / 3, 2 / 3, 1.0)  # the block is there in the last two
HALF, DEEP = 0.6, 0.8  # of the niche, which opens in the plane y = 0
FINER = 3  # rays along each side of a pixel of the niche


def camera(size=12, x=0.0, z=0.4, near=2.0, far=4.0):
    """A square camera at y = -3 that looks at the origin."""
    pose = look_at(torch.tensor([x, -3.0, z]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(size, size, 1.5 * size, 1.5 * size, size / 2, size / 2, pose, near, far)


def picture(time, size=12):
    """A dark square that slides to the right before white."""
    image = torch.zeros(size, size, 4, dtype=torch.uint8)
    begin = round(1 + time * (size - 6))
    image[4:8, begin : begin + 4] = torch.tensor([40, 80, 160, 255], dtype=torch.uint8)
    return image


def moving_scene(still=None):
    """The square, three times, by one camera."""
    train = [Frame(f"r_{i}", t, camera(), partial(picture, t), camera_id=0) for i, t in enumerate(TIMES)]
    box = Box((-1, -1, -1), (1, 1, 1))
    return Scene("square", tuple(train), (), (train[0],), box, 0.0, has_alpha=True, still=still)


def over_white(images):
    """Pictures (..., 4) uint8 before white, (..., 3) double in [0, 1]."""
    images = images.double() / 255
    return images[..., :3] * images[..., 3:] + 1 - images[..., 3:]


def static_ceiling(images=None):
    """The train PSNR that no static model exceeds whose cameras see ``images`` (T, ..., 4) at T times."""
    images = torch.stack([picture(time) for time in TIMES]) if images is None else images
    return float(-10 * torch.log10(over_white(images).var(0, unbiased=False).mean()))


def niche_scene():
    """A niche in a wall that a red block fills at once, seen by two cameras: two pictures a time.

    A warp of the points of one template would have to tear at all five sides.
    """
    train = []
    for number, time in enumerate(NICHE_TIMES):
        for k, x in enumerate((-0.6, 0.6)):
            view = camera(x=x, z=0.3, near=1.5, far=5.0)
            load = partial(torch.clone, _niche(view, is_filled=time > 0.5))
            train.append(Frame(f"r_{number}_{k}", time, view, load, camera_id=k))
    box = Box((-2, -1, -2), (2, 1, 2))
    return Scene("niche", tuple(train), (), tuple(train[:1]), box, NICHE_TIMES[0], has_alpha=False)


def _niche(view, is_filled):
    rays = view.resized(view.width * FINER, view.height * FINER).rays()
    start, way = rays.origins, rays.directions
    wall = start - (start[:, 1:2] / way[:, 1:2]) * way
    low, high = torch.tensor([-HALF, 0.0, -HALF]), torch.tensor([HALF, DEEP, HALF])
    out = torch.maximum((low - start) / way, (high - start) / way).amin(1, keepdim=True)
    inside = torch.tensor([0.85, 0.15, 0.15]).expand_as(start)
    if not is_filled:
        inside = _checked(3 * (start + out * way) + 0.01, [0.3, 0.75, 0.4], [0.15, 0.3, 0.2])
    around = _checked(2.5 * wall[:, ::2], [0.9, 0.8, 0.3], [0.2, 0.35, 0.7])
    rgb = torch.where((wall[:, ::2].abs() < HALF).all(1, keepdim=True), inside, around)
    rgb = rgb.reshape(view.height, FINER, view.width, FINER, 3).mean((1, 3))
    rgb = (255 * rgb).round().byte()
    return torch.cat([rgb, torch.full_like(rgb[..., :1], 255)], -1)


def _checked(places, odd_color, even_color):
    odd = places.floor().sum(1, keepdim=True) % 2
    return odd * torch.tensor(odd_color) + (1 - odd) * torch.tensor(even_color)
