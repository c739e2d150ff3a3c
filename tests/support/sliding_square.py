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


def static_ceiling():
    """The train PSNR that no static model exceeds with a fixed camera."""
    images = torch.stack([picture(time).double() / 255 for time in TIMES])
    rgb = images[..., :3] * images[..., 3:] + 1 - images[..., 3:]
    return float(-10 * torch.log10(rgb.var(0, unbiased=False).mean()))


def appearing_scene():
    """A square that is there only in the second half of six times, beside one that stays, from two sides."""

    def shot(number, time):
        turned = look_at(SIDES[number % 2], torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        from_there = Camera(12, 12, 18.0, 18.0, 6.0, 6.0, turned, 2.0, 4.0)
        return Frame(
            f"r_{number}", time, from_there, lambda: appearing(from_there, time), camera_id=number % 2
        )

    train = tuple(shot(number, number // 2 / 5) for number in range(12))
    box = Box((-1, -1, -1), (1, 1, 1))
    return Scene("appearing", train, (), train[:1], box, 0.0, has_alpha=True)


SIDES = (torch.tensor([0.0, -3.0, 0.4]), torch.tensor([2.1, -2.1, 0.4]))


def appearing(seen_from, time):
    """Two balls, of which one is there only after time 0.5, as a camera sees them."""
    rays, image = seen_from.rays(), torch.zeros(144, 4, dtype=torch.uint8)
    balls = [((-0.45, 0.0, 0.0), (160, 80, 40, 255)), ((0.4, 0.0, 0.0), (40, 80, 160, 255))]
    for center, color in balls[: 1 + (time > 0.5)]:
        towards = torch.tensor(center) - rays.origins
        along = (towards * rays.directions).sum(-1, keepdim=True)
        image[(towards - along * rays.directions).norm(dim=-1) < 0.35] = torch.tensor(
            color, dtype=torch.uint8
        )
    return image.reshape(12, 12, 4)
