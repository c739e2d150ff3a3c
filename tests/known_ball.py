"""The ball of ``tiny_scene`` as a method that needs no training: a solid grid that truly slides."""

import torch

from forewarp.fields.radiance import DirectRadiance
from forewarp.renderer import Renderer
from forewarp.scene.box import Lattice
from forewarp.scene.state import State
from forewarp.training.module import DynamicSceneModule
from tiny_scene import BOX, RADIUS, TRAVEL, ball_center


class KnownBall(torch.nn.Module):
    """Beside the ball a block stands still; ``asked`` are the times of ``at``."""

    view, canonical_time = None, 0.0

    def __init__(self, count=30**3):
        super().__init__()
        lattice = Lattice.of_count(BOX, count)
        everywhere = torch.ones(lattice.shape, dtype=torch.bool)
        numbers = {"alpha_init": 1e-2, "unit": lattice.pitch, "skip_alpha": 1e-4}
        self.radiance = DirectRadiance(lattice, everywhere, features=3, **numbers)
        self.points = lattice.to_world(self.radiance.voxels)
        self.asked = []

    def at(self, time):
        """Moves the ball, exactly, by filling the grid anew."""
        self.asked.append(time)
        self.fill(time)
        grid = self.radiance()
        canonical = self.fill(0.0).radiance()
        return State(time, {"upsampled": grid}, canonical)

    def fill(self, time):
        ball = (self.points - ball_center(time)).norm(dim=-1) < RADIUS
        self.radiance.density.data = torch.where(ball | self.is_still(self.points), 20.0, -10.0)[:, None]
        return self

    def is_still(self, points, half=0.15):
        """Whether points belong to the block."""
        return (points - torch.tensor([-0.3, -0.6, -0.5])).abs().amax(-1) < half

    def trajectories(self, points, times):
        moved = points[:, None] + times[:, None] * torch.tensor(TRAVEL)
        return torch.where(self.is_still(points, 0.27)[:, None, None], points[:, None], moved)


class _Settings:
    def at(self, key, fraction):
        return None


def known_ball():
    """A module over it."""
    return DynamicSceneModule(
        KnownBall().fill(0.0),
        renderer=Renderer(),
        objective=None,
        settings=_Settings(),
        curriculum=None,
        cameras=[],
    )
