"""A method as unlike voxels as can be: what the contract must not make awkward."""

from functools import partial

import torch
from torch import Tensor, nn

from forewarp.methods.method import Method, Snapshot, Start, Step
from forewarp.methods.rows import take_rows
from forewarp.scene.batch import Asks, Batch
from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud
from forewarp.scene.view import Moment, Rendering, View


class Splats(Method):
    """Round Gaussians that move along lines; a ray reads each at its nearest point.

    Image, loss and gradients are computed in one pass, without autograd. Stage numbers: ``count`` splats at
    first, at ``most`` so many, density control ``every`` n steps.
    """

    numbers = ("count", "every", "most")
    terms = ("photo", "sparse")
    asks = Asks(kind="pictures", neighbours=1)
    grows = ("position", "velocity", "radius", "color", "opacity", "pull")
    moves = True

    def __init__(self, start: Start, *, radius: float = 0.1) -> None:
        super().__init__()
        numbers = {"count": 80, "every": 20, "most": 1000} | dict(start.numbers)
        self.every, self.most = numbers["every"], numbers["most"]
        self.canonical_time = start.scene.canonical_time
        low, size = torch.tensor(start.scene.box.low), torch.tensor(start.scene.box.size)
        points = low + size * (0.2 + 0.6 * torch.rand(numbers["count"], 3))
        colors = torch.full_like(points, 0.5)
        cloud = None if start.handover is None or start.blank else start.handover.cloud
        if cloud is not None and len(cloud):
            rows = torch.randint(len(cloud), (numbers["count"],))
            points, colors = cloud.points[rows], cloud.colors[rows].clamp(0.02, 0.98)
            radius = max(cloud.size, 0.5 * radius)
        self.position, self.velocity = nn.Parameter(points.clone()), nn.Parameter(torch.zeros_like(points))
        self.radius = nn.Parameter(torch.full((len(points),), radius).log())
        self.color = nn.Parameter(torch.logit(colors))
        self.opacity = nn.Parameter(torch.full((len(points),), -1.0))
        self.register_buffer("pull", torch.zeros(len(points)))  # on positions, since the last density control

    def at(self, moment: Moment) -> Snapshot:
        points = self.position + self.velocity * (moment.time - self.canonical_time)
        return SplatsSnapshot(moment, self, points)

    @torch.no_grad()
    def look(self, batch: Batch, factors, generator: torch.Generator) -> Step:
        gradients = {name: torch.zeros_like(p) for name, p in self.named_parameters()}
        errors, weight = [], factors.get("photo", 0.0) / len(batch.observations)
        for seen in batch.observations:
            drawn, slopes = self.at(seen.moment).trace(seen.view, seen.background)
            residual = drawn.rgb - seen.rgb
            errors.append(residual.square().mean())
            for name, slope in slopes(2 * weight / residual.numel() * residual).items():
                gradients[name] += slope
        solid = torch.sigmoid(self.opacity)
        if "sparse" in factors:
            gradients["opacity"] += factors["sparse"] * solid * (1 - solid) / len(solid)
        self.pull += gradients["position"].norm(dim=-1)
        photo, noted = torch.stack(errors).mean(), {"splats": len(solid)}
        return Step({"photo": lambda: photo, "sparse": solid.mean}, photo, noted, gradients)

    @torch.no_grad()
    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Remove faint splats; split the tenth with the largest gradients into two of half the size."""
        if step and step % self.every == 0:
            alive = (self.opacity > -4).nonzero()[:, 0]
            torn = alive[self.pull[alive].topk(min(len(alive) // 10, self.most - len(alive))).indices]
            if len(alive):  # all that there is must not vanish
                take_rows(self, optimizer, torch.cat([alive, torn]))
                twins = slice(len(alive), None)
                self.radius[twins] -= 0.7
                self.position[twins] += (
                    torch.randn(len(torn), 3).to(self.device) * self.radius[twins, None].exp()
                )
            self.pull.zero_()
        return {}

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {name: [parameter] for name, parameter in self.named_parameters()}

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        return torch.optim.RMSprop(groups, alpha=0.9, momentum=0.5)

    @property
    def size(self) -> tuple[str, int]:
        return "splats", len(self.position)

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Move every point like its nearest splat."""
        nearest = torch.cdist(points, self.position).argmin(-1)
        return points[:, None] + self.velocity[nearest][:, None] * (times - self.canonical_time)[:, None]

    def bounds(self, times: list[float]) -> Box | None:
        points = torch.cat([self.at(Moment(time)).points for time in times])
        low, high = points.amin(0), points.amax(0)
        return Box(tuple((low - 0.05).tolist()), tuple((high + 0.05).tolist()))

    @torch.no_grad()
    def matter(self) -> Cloud:
        size = float(self.radius.exp().mean())
        return Cloud(self.position.data, torch.sigmoid(self.color), torch.sigmoid(self.opacity), size)


class SplatsSnapshot(Snapshot):
    """Splats at their ``points`` (N, 3) of a moment."""

    def __init__(self, moment: Moment, splats: Splats, points: Tensor) -> None:
        self.moment, self.splats, self.points = moment, splats, points

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        return self.trace(view, background)[0]

    def trace(self, view: View, background: Tensor):
        """Render a view; also return a function from gradients of colours (R, 3) to those of parameters."""
        rays, splats = view.rays().to(self.points.device), self.splats
        offset = self.points - rays.origins[0]
        order = offset.norm(dim=-1).argsort()  # all rays of a view begin at one place: one order for all
        offset, directions = offset[order], rays.directions
        along = directions @ offset.T  # (R, N)
        beside = (offset.square().sum(-1) - along.square()).clamp(min=0)
        radius, solid = splats.radius[order].exp(), torch.sigmoid(splats.opacity[order])
        alpha = 0.99 * solid * torch.exp(-0.5 * beside / radius**2) * (along > rays.near)
        through = torch.cumprod(1 - alpha, -1)
        before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], -1)
        weights, color = before * alpha, torch.sigmoid(splats.color[order])
        rgb, opacity = weights @ color + through[:, -1:] * background, weights.sum(-1)
        depth = (weights * along).sum(-1) / opacity.clamp(min=1e-8)
        slopes = partial(
            self._slopes, order, offset, directions, along, beside, alpha, before, weights, color, rgb
        )
        return Rendering(rgb, depth, opacity), slopes

    def _slopes(
        self, order, offset, directions, along, beside, alpha, before, weights, color, rgb, slope
    ) -> dict[str, Tensor]:
        shown = slope @ color.T  # what each colour would change, (R, N)
        behind = (slope * rgb).sum(-1, keepdim=True) - (weights * shown).cumsum(-1)
        pulled = (before * shown - behind / (1 - alpha)) * alpha  # by log alpha
        radius, solid = self.splats.radius[order].exp(), torch.sigmoid(self.splats.opacity[order])
        position = -(pulled.sum(0)[:, None] * offset - (pulled * along).T @ directions) / radius[:, None] ** 2
        found = {
            "position": position,
            "velocity": position * (self.moment.time - self.splats.canonical_time),
            "radius": (pulled * beside).sum(0) / radius**2,
            "color": weights.T @ slope * color * (1 - color),
            "opacity": pulled.sum(0) * (1 - solid),
        }
        back = order.argsort()
        return {name: value[back] for name, value in found.items()}
