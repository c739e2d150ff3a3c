"""A painted room with balls, of which images and distances are exact: what neighbouring views show of it."""

import math

import numpy as np
import torch

from forewarp.scene.camera import Camera, look_at
from tests.support.written_scenes import UP

LOW, HIGH = (torch.tensor(end, dtype=torch.float64) for end in ([-3.0, -2.5, 0.0], [3.0, 2.8, 2.9]))
BALLS = [((0.6, 0.4, 0.5), 0.5), ((-0.8, 0.9, 0.4), 0.4), ((1.5, -0.9, 0.8), 0.35), ((-0.2, 1.6, 1.4), 0.3)]


def walk(count=8, size=(64, 48)) -> list[Camera]:
    """Cameras of a walk through the room, which look about."""
    made, (width, height) = [], size
    for s in np.linspace(0, 1, count):
        place = torch.tensor([-2.2 + 0.8 * s, -1.9 + 0.25 * math.sin(5 * s), 1.4 + 0.08 * math.sin(9 * s)])
        aim = torch.tensor([0.6 + 1.2 * math.sin(2.5 * s), 1.0, 0.9 + 0.1 * math.cos(7 * s)])
        pose = look_at(place, aim, UP).double()
        made.append(Camera(*size, 0.85 * width, 0.85 * width, width / 2, height / 2, pose, 0.2, 9.0))
    return made


def shown(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The image (H, W, 3) uint8 of a camera and its depth (H, W) along the axis."""
    rays = camera.rays(dtype=torch.float64)
    start, along = rays.origins, rays.directions
    away = torch.maximum((HIGH - start) / along, (LOW - start) / along).amin(-1)
    for middle, radius in BALLS:
        offset = start - torch.tensor(middle, dtype=torch.float64)
        b = (offset * along).sum(-1)
        inside = b * b - (offset * offset).sum(-1) + radius * radius
        hit = -b - inside.clamp(min=0).sqrt()
        away = torch.where((inside > 0) & (hit > 0.05) & (hit < away), hit, away)
    x, y, z = (start + away[:, None] * along).unbind(-1)
    waves = [
        torch.sin(7 * x + 2 * torch.sin(3 * y)) + torch.sin(5 * z + x),
        torch.sin(6 * y + 4 * z) + torch.cos(9 * x),
        torch.sin(8 * z - 3 * x) + torch.cos(5 * y + x * z),
    ]
    colors = (255 * (0.5 + 0.22 * torch.stack(waves, -1))).byte()
    depth, shape = away * (along @ camera.camera_to_world[:3, 2]), (camera.height, camera.width)
    return colors.reshape(*shape, 3).numpy(), depth.reshape(shape).float().numpy()
