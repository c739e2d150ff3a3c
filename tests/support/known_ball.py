"""The ball of ``tiny_scene`` as a method that needs no training: a solid grid with exact motion."""

import torch

from forewarp.methods.method import Start
from forewarp.methods.voxel.model import VoxelMethod, VoxelSnapshot
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective
from forewarp.training.schedule import Curriculum
from tests.support.tiny_scene import RADIANCE, RADIUS, TRAVEL, ball_center, ball_scene, stage


class KnownBall(VoxelMethod):
    """The moving ball and a static block; ``asked`` records the times passed to ``at``."""

    moves = True

    def __init__(self, count=30**3):
        start = Start(ball_scene(size=8), "fine", {"num_voxels": [[0, count]]}, blank=True)
        super().__init__(start, radiance=RADIANCE)
        lattice = self.radiance.lattice
        self.points = lattice.to_world(self.radiance.voxels)
        self.asked = []

    def at(self, moment):
        """Move the ball by filling the grid anew."""
        self.asked.append(moment.time)
        self.fill(moment.time)
        grid = self.radiance()
        canonical = self.fill(0.0).radiance()
        return VoxelSnapshot(moment, {"upsampled": grid}, canonical, self.renderer)

    def fill(self, time):
        ball = (self.points - ball_center(time)).norm(dim=-1) < RADIUS
        self.radiance.density.data = torch.where(ball | self.is_still(self.points), 20.0, -10.0)[:, None]
        return self

    def is_still(self, points, half=0.15):
        """Return whether points belong to the static block."""
        return (points - torch.tensor([-0.3, -0.6, -0.5])).abs().amax(-1) < half

    def trajectories(self, points, times):
        moved = points[:, None] + times[:, None] * torch.tensor(TRAVEL)
        return torch.where(self.is_still(points, 0.27)[:, None, None], points[:, None], moved)


def known_ball():
    """Make a module of it."""
    return DynamicSceneModule(
        KnownBall().fill(0.0),
        objective=Objective({}),
        settings=stage().settings,
        curriculum=Curriculum([0.0, 1.0], 0.0),
    )
