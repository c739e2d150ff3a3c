"""A dataset: a reader of a scene that is made in memory, and its data module."""

from functools import partial

import torch

from forewarp.data.module import SceneDataModule
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame, Scene


def read_scene(scene, *, frames=6, size=16):
    """A grey disc that rises, seen by cameras on a circle; one validation and two test frames."""
    train = tuple(_frame(f"r_{i}", i / frames, i / (frames - 1), size) for i in range(frames))
    seen = [_frame(f"t_{i}", turn, time, size) for i, (turn, time) in enumerate([(0.1, 0.0), (0.6, 0.5)])]
    box = Box((-1, -1, -1), (1, 1, 1))
    protocol = {"dataset": "theirs", "downscale": 1}
    return Scene(scene, train, tuple(seen[1:]), tuple(seen), box, 0.0, has_alpha=True, protocol=protocol)


def _frame(name, turn, time, size):
    angle = torch.tensor(2 * torch.pi * turn)
    pose = look_at(
        torch.stack([3 * angle.cos(), 3 * angle.sin(), torch.tensor(1.0)]),
        torch.zeros(3),
        torch.tensor([0.0, 0.0, 1.0]),
    )
    camera = Camera(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2, pose, 1.0, 5.5)
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    disc = (rows - size * (0.6 - 0.2 * time)) ** 2 + (columns - size / 2) ** 2 < (size / 5) ** 2
    image = disc[..., None] * torch.tensor([128, 128, 128, 255], dtype=torch.uint8)
    return Frame(name, time, camera, lambda: image)


class DiscDataModule(SceneDataModule):
    """The disc; arguments as in ``read_scene`` and ``SceneDataModule``."""

    def __init__(self, scene, *, frames=6, size=16, **common):
        super().__init__(partial(read_scene, scene, frames=frames, size=size), **common)
