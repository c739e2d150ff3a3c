"""Draw the trajectories of points on the moving surface over an image, as the paper's figure does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from forewarp.drawing.images import draw_discs, hidden, hues, sample_lines
from forewarp.evaluation.images import within
from forewarp.methods.method import HasMatter, HasTrajectories
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud, far_apart
from forewarp.scene.view import Moment, Rendering, View
from forewarp.training.module import DynamicSceneModule

_VIEWS, _VIEW_SIZE = 24, 80  # number and pixels of the views that find the surface
_STEPS = 60  # vertices of a path through all time
_STILL = 0.15  # a moving point travels at least this share of the farthest travel


class Trajectories:
    """Draw a fading tail behind points of the moving surface; occluded parts of a tail are hidden.

    Args:
        module: the fitted scene.
        cameras: the training cameras, which find the surface.
        count: most points to draw.
        tail: duration of a tail, as a share of the whole time.
        width: line width, as a share of the image's longer side.
        points: canonical points (N, 3) to draw; None: chosen by ``moving_points``.
    """

    def __init__(
        self,
        module: DynamicSceneModule,
        cameras: Sequence[Camera],
        *,
        count: int = 300,
        tail: float = 0.5,
        width: float = 0.004,
        points: Tensor | None = None,
    ) -> None:
        if not (isinstance(module.method, HasTrajectories) and isinstance(module.method, HasMatter)):
            got = f"{type(module.method).__name__}; use path=fixed"
            raise ValueError(f"path: expected a method that knows trajectories, but got {got}")
        self.method, self.tail, self.width = module.method, tail, width
        # The depth of a rendered surface is uncertain by about the size of its matter.
        self.slack = 1.5 * module.method.matter().size
        self.points = moving_points(module, cameras, count) if points is None else points
        self._paths: Tensor | None = None
        self.colors = hues(0.85 * _order(self.points))

    @torch.no_grad()
    def __call__(self, image: Tensor, drawn: Rendering, camera: Camera, time: float) -> Tensor:
        """Draw the tails over ``image`` (H, W, 3) of ``camera`` at ``time``; ``drawn`` is its rendering."""
        if not len(self.points):
            return image
        paths, times = self._tails(time)
        pixels, z = camera.project(paths)
        distance = (paths - camera.center.to(paths)).norm(dim=-1)
        strength = (1 - (time - times) / self.tail).clamp(0, 1).expand_as(distance)
        vertices = torch.cat([pixels, distance[..., None], strength[..., None]], -1)
        is_before_camera = (z > 0).all(1)
        vertices, colors = vertices[is_before_camera], self.colors[is_before_camera]
        surface = torch.where(drawn.opacity > 0.5, drawn.depth, float("inf")).reshape(image.shape[:2])
        tails, line = sample_lines(vertices)
        radius = max(0.35, 0.5 * self.width * max(image.shape[:2]))
        heads = vertices[:, -1], colors, 1.8 * radius
        for marks, color, width in ((tails, colors[line], radius), heads):
            at, distance, strength = marks[:, :2], marks[:, 2], marks[:, 3]
            alpha = strength * ~hidden(at, distance, surface, self.slack)
            image = draw_discs(image, at, color, alpha, width)
        return image

    def forget(self) -> None:
        """Forget where the points were, as the method has changed."""
        self._paths = None

    def _tails(self, time: float) -> tuple[Tensor, Tensor]:
        """Return the points' tails (N, T, 3) at a time, and when they were there (T,), the time itself last.

        Cost: at the first call the method follows the points through all time; then linear interpolation.
        """
        every = torch.linspace(0, 1, _STEPS + 1, device=self.points.device)
        if self._paths is None:
            self._paths = self.method.trajectories(self.points, every)
        begin = max(0.0, time - self.tail)
        between = every[(every > begin) & (every < time)]
        times = torch.cat([between.new_tensor([begin]), between, between.new_tensor([time])])
        at = times * _STEPS
        low = at.floor().long().clamp(max=_STEPS - 1)
        return torch.lerp(self._paths[:, low], self._paths[:, low + 1], (at - low)[:, None]), times


@torch.no_grad()
def surface(module: DynamicSceneModule, cameras: Sequence[Camera]) -> Cloud:
    """Return the matter seen by a few cameras at the canonical time."""
    matter = module.method.matter()
    return matter[seen_by(module, cameras, matter.points, matter.size)]


@torch.no_grad()
def seen_by(module: DynamicSceneModule, cameras: Sequence[Camera], points: Tensor, size: float) -> Tensor:
    """Tell which canonical points (N, 3) lie in a cube, ``size`` world units wide, in which a few cameras see
    the surface: (N,) bool.
    """
    canonical = module.method.at(Moment(module.curriculum.canonical_time))
    black, hits = torch.zeros(3, device=module.device), []
    for camera in cameras[:: max(1, len(cameras) // _VIEWS)][:_VIEWS]:
        view = View(within(camera, _VIEW_SIZE))
        drawn, rays = canonical.render(view, black), view.rays().to(module.device)
        hit = drawn.opacity > 0.5
        hits.append(rays.origins[hit] + drawn.depth[hit, None] * rays.directions[hit])

    def cubes(points: Tensor) -> Tensor:
        """Number the cube that holds each point."""
        x, y, z = (points / size).floor().long().clamp(-(1 << 20), (1 << 20) - 1).unbind(-1)
        return (x << 42) + (y << 21) + z

    # At a silhouette the mean depth lies in empty space; points of matter do not.
    return torch.isin(cubes(points), cubes(torch.cat(hits)))


@torch.no_grad()
def moving_points(module: DynamicSceneModule, cameras: Sequence[Camera], count: int) -> Tensor:
    """Choose at most ``count`` canonical points (N, 3), spread evenly over the moving surface."""
    points = surface(module, cameras).points
    if not len(points):
        return points
    paths = module.method.trajectories(points, torch.linspace(0, 1, 33, device=points.device))
    reach = (paths - points[:, None]).norm(dim=-1).amax(1)
    least = max(_STILL * float(reach.max()), module.method.matter().size)
    points = points[reach > least]
    return points[far_apart(points, count)]


def _order(points: Tensor) -> Tensor:
    """Rank points (N, 3) along their principal axis: (N,), evenly from 0 to 1."""
    if len(points) < 2:
        return points.new_zeros(len(points))
    along = torch.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    return (points @ along).argsort().argsort() / (len(points) - 1)
