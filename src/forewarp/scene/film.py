"""The path of a film's one camera: where it was at a time, and how far beside it images are trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from forewarp.scene.camera import Camera, focus_point
from forewarp.scene.frame import Scene

TRUST_DEGREES = 8.0  # of a film whose run has not measured it
LEAST_DEGREES = 2.0  # that every film holds
# Between images of a path that one camera went: least cosine, and most of the distance to what it looks at.
_STEADY, _STEP = math.cos(0.5), 0.5
_SMOOTHED = 0.08  # standard deviation of a stabilised path's mean, as a share of the film
_MOST_ZOOM, _BEYOND = 1.3, 2.0  # of frames beside the path; depth, in pivots', at which they are still filmed
_ALONG = 0.02  # of a camera's far: what it looks at is at least as far away


@dataclass(frozen=True)
class FilmPath:
    """The ``cameras`` of one film in the order of their ``times`` in [0, 1]. Images from directions up to
    ``degrees`` beside the camera of the same time are trusted, seen from the ``focus`` (3,).
    """

    cameras: tuple[Camera, ...]
    times: tuple[float, ...]
    focus: Tensor
    degrees: float = TRUST_DEGREES

    @classmethod
    def of_scene(cls, scene: Scene, degrees: float | None = None) -> FilmPath | None:
        """Return the path of a scene's training images; see ``of``."""
        if not scene.has_one_camera:
            return None
        return cls.of([f.camera for f in scene.train], [f.time for f in scene.train], degrees)

    @classmethod
    def of(
        cls, cameras: Sequence[Camera], times: Sequence[float], degrees: float | None = None
    ) -> FilmPath | None:
        """Return the path of images; None if no one camera went smoothly from each to the next.

        Args:
            cameras, times: of each image.
            degrees: that are trusted; None: ``TRUST_DEGREES``.
        """
        order = sorted(range(len(times)), key=lambda i: times[i])
        cameras, times = [cameras[i] for i in order], [times[i] for i in order]
        if len(times) < 3 or len(set(times)) < len(times):
            return None
        focus = focus_point(cameras)
        for before, after in zip(cameras, cameras[1:]):
            turn = float(before.camera_to_world[:3, 2] @ after.camera_to_world[:3, 2])
            step = float((after.center - before.center).norm())
            if turn < _STEADY or step > _STEP * float((focus - before.center).norm()):
                return None
        degrees = max(TRUST_DEGREES if degrees is None else degrees, LEAST_DEGREES)
        return cls(tuple(cameras), tuple(times), focus, degrees)

    def at(self, time: float) -> Camera:
        """Return where the camera was at a time, between the two images nearest to it."""
        after = next((k for k, known in enumerate(self.times) if known > time), len(self.times) - 1)
        before = max(after - 1, 0)
        first, last = self.times[before], self.times[after]
        share = min(max((time - first) / (last - first), 0.0), 1.0)
        poses = [self.cameras[k].camera_to_world for k in (before, after)]
        return replace(self.cameras[before], camera_to_world=_mean(poses, [1 - share, share]))

    def stabilised(self, time: float) -> Camera:
        """Return the mean of where the camera was around a time, within the trusted angle."""
        spread = max(_SMOOTHED, 1 / (len(self.times) - 1))
        gaps = torch.tensor(self.times, dtype=torch.float64) - time
        near = torch.exp(-0.5 * (gaps / spread) ** 2)
        # Those of a straight line fitted nearby, so that the ends are not drawn inwards.
        weights = near * ((near * gaps**2).sum() - (near * gaps).sum() * gaps)
        pose = _mean([camera.camera_to_world for camera in self.cameras], weights.tolist())
        return self.within(replace(self.at(time), camera_to_world=pose), time)

    def pivot(self, camera: Camera) -> Tensor:
        """Return the point (3,) on a camera's axis about which a view leans: as far as the focus."""
        ahead = camera.camera_to_world[:3, 2]
        along = float((self.focus - camera.center) @ ahead)
        along = along if along > _ALONG * camera.far else 0.5 * (camera.near + camera.far)
        return camera.center + along * ahead

    def lean(self, camera: Camera, across: float, upward: float) -> Camera:
        """Turn a camera about its pivot by degrees to the right and upwards."""
        return leaned(camera, self.pivot(camera), across, upward)

    def beside(self, camera: Camera, time: float) -> float:
        """Return the degrees between a camera and the film's at a time, seen from the latter's pivot."""
        filmed = self.at(time)
        pivot = self.pivot(filmed)
        start, end = filmed.center - pivot, camera.center - pivot
        cosine = float(start @ end / (start.norm() * end.norm()))
        return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))

    def leant(self, time: float, across: float, upward: float) -> Camera:
        """Return where the film's camera was at a time, leant aside by degrees, however many, which come up
        against the trusted angle.
        """
        pulled = math.hypot(across, upward)
        share = self.degrees * math.tanh(pulled / self.degrees) / pulled if pulled else 0.0
        return self.lean(self.at(time), share * across, share * upward)

    def within(self, camera: Camera, time: float) -> Camera:
        """Bring a camera so near to where the film's was at a time that it is within the trusted angle."""
        away = self.beside(camera, time)
        if away <= self.degrees:
            return camera
        filmed, share = self.at(time), self.degrees / away
        pivot = self.pivot(filmed)
        start, end = filmed.center - pivot, camera.center - pivot
        axis = normalize(torch.linalg.cross(start, end), dim=0)
        length = (1 - share) * start.norm() + share * end.norm()
        pose = _mean([filmed.camera_to_world, camera.camera_to_world], [1 - share, share])
        towards = _rotation(axis, math.radians(self.degrees)) @ normalize(start, dim=0)
        pose[:3, 3] = pivot + length * towards
        return replace(camera, camera_to_world=pose)

    def zoomed(self, views: Sequence[Camera], times: Sequence[float]) -> list[Camera]:
        """Narrow views beside the path, all by one factor, until they show only what was filmed at their
        times, where that takes no more than a third.
        """
        zoom = max(max(self._overshoot(view, time) for view, time in zip(views, times)), 1.0)
        zoom = min(zoom, _MOST_ZOOM)
        return [replace(view, fx=zoom * view.fx, fy=zoom * view.fy) for view in views]

    def _overshoot(self, view: Camera, time: float) -> float:
        """Return how many times farther from its middle than its edge the film's image shows a view's
        corners, at the pivot and behind it.
        """
        filmed = self.at(time)
        along = float((self.pivot(view) - view.center).norm())
        w, h = float(view.width), float(view.height)
        rays = view.directions([0.0, w, 0.0, w, w / 2, w / 2, 0.0, w], [0.0, 0.0, h, h, 0.0, h, h / 2, h / 2])
        depth = along * torch.tensor([1.0, _BEYOND], dtype=torch.float64)[:, None, None]
        places, _ = filmed.project(view.center + depth * rays)
        half = 0.5 * torch.tensor([filmed.width, filmed.height], dtype=torch.float64)
        return float(((places - half).abs() / half).max())


def leaned(camera: Camera, pivot: Tensor, across: float, upward: float) -> Camera:
    """Turn a camera about a pivot (3,) by degrees to the right and upwards."""
    pose = camera.camera_to_world.clone()
    right, down = pose[:3, 0], pose[:3, 1]
    axis = normalize(-across * down - upward * right, dim=0)
    turn = _rotation(axis, math.radians(math.hypot(across, upward)))
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] = pivot + turn @ (camera.center - pivot)
    return replace(camera, camera_to_world=pose)


def _mean(poses: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """Return the weighted mean of poses (4, 4) that are turned by less than half a turn."""
    shares = torch.tensor(weights, dtype=torch.float64) / sum(weights)
    pose = torch.einsum("n,nij->ij", shares, torch.stack(list(poses)))
    ahead = normalize(pose[:3, 2], dim=0)
    right = normalize(torch.linalg.cross(pose[:3, 1], ahead), dim=0)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(ahead, right), ahead], -1)
    return pose


def _rotation(axis: Tensor, angle: float) -> Tensor:
    """Return the rotation (3, 3) by an angle about a unit axis (3,); the axis 0: none."""
    x, y, z = axis.tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(angle * skew)
