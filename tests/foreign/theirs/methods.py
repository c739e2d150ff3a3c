"""A method: coloured mist around a few points, each with a velocity of its own."""

import torch
from torch import nn

from forewarp.methods.method import Method, Snapshot, Step
from forewarp.scene.cloud import Cloud
from forewarp.scene.view import Rendering


class Mist(Method):
    """``count`` points in the box, or, where the stage before left matter, some of that."""

    moves = True

    def __init__(self, start, *, count=8):
        super().__init__()
        low, size = (torch.tensor(getattr(start.scene.box, key)) for key in ("low", "size"))
        place, before = low + size * torch.rand(count, 3), start.handover and start.handover.cloud
        if before is not None and len(before) and not start.blank:
            place = before.points[torch.randint(len(before), (count,))]
        self.canonical_time, self.size_of_all = start.scene.canonical_time, float(size.mean()) / 8
        self.register_buffer("began", place.clone())
        self.place, self.velocity = nn.Parameter(place), nn.Parameter(torch.zeros(count, 3))
        self.paint = nn.Parameter(torch.zeros(count, 4))

    def at(self, moment):
        return Now(moment, self)

    def look(self, batch, factors, generator):
        seen = batch.observations[0]
        drawn = self.at(seen.moment).render(seen.view, seen.background)
        error = (drawn.rgb - seen.rgb).square().mean()
        return Step({"photo": lambda: error}, error.detach())

    def trajectories(self, points, times):
        near = torch.cdist(points, self.place).argmin(-1)
        return points[:, None] + (times - self.canonical_time)[:, None] * self.velocity[near, None]

    def matter(self):
        color, opacity = torch.sigmoid(self.paint.data).split([3, 1], -1)
        return Cloud(self.place.data, color, opacity[:, 0], self.size_of_all)


class Now(Snapshot):
    """The mist of a moment; nothing hides anything."""

    def __init__(self, moment, mist):
        self.moment, self.mist = moment, mist

    def render(self, view, background, rendering=None):
        mist, rays = self.mist, view.rays().to(self.mist.device)
        away = mist.place + (self.moment.time - mist.canonical_time) * mist.velocity - rays.origins[0]
        along = rays.directions @ away.T  # (R, N)
        beside = (away.square().sum(-1) - along.square()).clamp(min=0)
        color, opacity = torch.sigmoid(mist.paint).split([3, 1], -1)
        thick = opacity[:, 0] * torch.exp(-beside / mist.size_of_all**2) * (along > 0)
        whole = thick.sum(-1, keepdim=True)
        share, hit = thick / whole.clamp(min=1e-8), 1 - torch.exp(-whole)
        rgb = hit * (share @ color) + (1 - hit) * background
        return Rendering(rgb, (hit * share * along).sum(-1), hit[:, 0])
