"""New camera poses: random views for regularisation, paths for videos."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from forewarp.scene.camera import Camera, Rays, look_at


def focus_point(cameras: list[Camera]) -> Tensor:
    """Find the point nearest to all optical axes, least squares (3,), float64.

    For a single axis, or parallel ones, take the point midway between near and far.
    """
    centers = torch.stack([c.center.double() for c in cameras])
    axes = torch.stack([c.camera_to_world[:3, 2].double() for c in cameras])
    midway = torch.tensor([[0.5 * (c.near + c.far)] for c in cameras], dtype=torch.float64)
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    ahead = (centers + midway * axes).mean(0)
    offset = (across @ (centers - ahead)[..., None]).sum(0)
    return ahead + (torch.linalg.pinv(across.sum(0), rtol=1e-8) @ offset)[:, 0]


def mean_up(cameras: list[Camera]) -> Tensor:
    """Average the upward directions of the images (3,), float64, unit length; z if they cancel."""
    up = -torch.stack([c.camera_to_world[:3, 1].double() for c in cameras]).mean(0)
    return up / up.norm() if up.norm() > 0.1 else torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def _moved(camera: Camera, center: Tensor, focus: Tensor, up: Tensor) -> Camera:
    """Move a camera to ``center``, facing ``focus``; keep the camera if the two coincide."""
    is_apart = float((center - focus).norm()) >= 1e-6 * camera.far
    return replace(camera, camera_to_world=look_at(center, focus, up)) if is_apart else camera


class RandomPatches:
    """Rays of small patches seen from random poses on the training cameras' sphere (RegNeRF).

    A pose lies between two random training cameras, at their distance from the focus, and faces the focus.

    Args:
        cameras: the training cameras.
        patches: patches per draw.
        size: pixels per side, at most those of the smallest image.
    """

    def __init__(self, cameras: list[Camera], *, patches: int = 16, size: int = 8) -> None:
        self.cameras, self.patches = cameras, patches
        self.size = min([size, *(min(c.width, c.height) for c in cameras)])
        self.focus, self.up = focus_point(cameras), mean_up(cameras)

    def draw(self, generator: torch.Generator) -> Rays:
        """Draw rays (patches * size * size), patch by patch, all from one pose."""
        i, j = torch.randint(len(self.cameras), (2,), generator=generator).tolist()
        share = torch.rand((), generator=generator, dtype=torch.float64)
        a, b = (self.cameras[k].center.double() - self.focus for k in (i, j))
        mixed = torch.nn.functional.normalize(a * share + b * (1 - share), dim=0)
        radius = a.norm() * share + b.norm() * (1 - share)
        camera = _moved(self.cameras[i], self.focus + mixed * radius, self.focus, self.up)
        span = torch.tensor([camera.height - self.size + 1, camera.width - self.size + 1])
        corner = (torch.rand(self.patches, 2, generator=generator) * span).long()
        side = torch.arange(self.size)
        at = corner[:, None, None] + torch.stack(torch.meshgrid(side, side, indexing="ij"), -1)
        return camera.rays((at[..., 0] * camera.width + at[..., 1]).reshape(-1))


def orbit(camera: Camera, focus: Tensor, up: Tensor, turns: Tensor) -> list[Camera]:
    """Make cameras that circle ``focus`` about ``up`` at the height and distance of ``camera``.

    A camera at the focus keeps its pose.

    Args:
        camera: gives the first pose and the lens.
        focus, up: (3,).
        turns: (N,) fractions of a full turn from the start.
    """
    offset = camera.center.double() - focus
    height = (offset @ up) * up
    a, b = offset - height, torch.linalg.cross(up, offset - height)
    angles = [2 * math.pi * turn for turn in turns.tolist()]
    centers = [focus + height + math.cos(angle) * a + math.sin(angle) * b for angle in angles]
    return [_moved(camera, center, focus, up) for center in centers]


def swing(camera: Camera, cameras: list[Camera], focus: Tensor, up: Tensor, shares: Tensor) -> list[Camera]:
    """Make cameras that go to and fro about ``up``, as far as ``cameras`` stand to both sides of ``camera``.

    The outermost twentieth of them on either side does not count.

    Args:
        camera: gives the first pose and the lens.
        cameras: that have seen the scene.
        focus, up: (3,).
        shares: (N,) of the way in [0, 1]: to one side, to the other, and back.
    """
    first = camera.center.double() - focus
    across = torch.linalg.cross(up, first)
    places = torch.stack([c.center.double() - focus for c in cameras])
    turns = torch.atan2(places @ across, places @ first - (places @ up) * (first @ up)) / (2 * math.pi)
    low, high = torch.quantile(turns, torch.tensor([0.05, 0.95], dtype=turns.dtype)).tolist()
    wave = torch.sin(2 * math.pi * shares)
    return orbit(camera, focus, up, torch.where(wave > 0, max(high, 0.0) * wave, max(-low, 0.0) * wave))
