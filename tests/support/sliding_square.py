"""A dark square that slides before white, seen by a camera that does not move."""

import torch

from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame, Scene

TIMES = (0.0, 0.5, 1.0)


def camera(size=12):
    pose = look_at(torch.tensor([0.0, -3.0, 0.4]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(size, size, 1.5 * size, 1.5 * size, size / 2, size / 2, pose, 2.0, 4.0)


def picture(time, size=12):
    """A dark square that slides to the right before white."""
    image = torch.zeros(size, size, 4, dtype=torch.uint8)
    begin = round(1 + time * (size - 6))
    image[4:8, begin : begin + 4] = torch.tensor([40, 80, 160, 255], dtype=torch.uint8)
    return image


def frame(name, time):
    return Frame(name, time, camera(), lambda: picture(time), camera_id=0)


def moving_scene(still=None):
    """A static camera, three times."""
    train = tuple(frame(f"r_{i}", time) for i, time in enumerate(TIMES))
    box = Box((-1, -1, -1), (1, 1, 1))
    return Scene("square", train, (), train[:1], box, 0.0, has_alpha=True, still=still)


def over_white(images):
    """Pictures (..., 4) uint8 before white, (..., 3) double in [0, 1]."""
    images = images.double() / 255
    return images[..., :3] * images[..., 3:] + 1 - images[..., 3:]


def static_ceiling(images=None):
    """The train PSNR that no static model exceeds whose cameras see ``images`` (T, ..., 4) at T times."""
    images = torch.stack([picture(time) for time in TIMES]) if images is None else images
    return float(-10 * torch.log10(over_white(images).var(0, unbiased=False).mean()))
