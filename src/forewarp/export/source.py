"""What every export begins with: a fitted scene and some times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.evaluation.trajectories import seen_by, surface
from forewarp.methods.method import HasEllipsoids, HasMatter, HasTrajectories, Method
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import far_apart
from forewarp.scene.paths import mean_up
from forewarp.training.module import DynamicSceneModule

Progress = Callable[[int, int], None]  # how many are done, of how many

UP = {"y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_SOLID = 0.1  # opacity at some time of a particle that is a point of the surface


@dataclass(frozen=True)
class Source:
    """A fitted ``module`` named ``model`` in its config, the ``cameras`` it was trained with, ``times`` in
    [0, 1], and the ``background`` (3,) in [0, 1] of its exact pictures.
    """

    module: DynamicSceneModule
    model: str
    cameras: Sequence[Camera]
    times: Sequence[float]
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def method(self) -> Method:
        """The fitted method."""
        return self.module.method

    @property
    def has_ellipsoids(self) -> bool:
        """Whether the scene is a cloud of soft ellipsoids."""
        return isinstance(self.method, HasEllipsoids)

    def turn_to(self, up: str) -> Tensor:
        """Return the rotation (3, 3) float64 that takes the upward direction of the pictures to an axis.

        Args:
            up: ``y``, ``-y`` or ``z``; ``world``: nothing is turned.
        """
        from scipy.spatial.transform import Rotation

        if up == "world":
            return torch.eye(3, dtype=torch.float64)
        before = mean_up(list(self.cameras)).numpy()
        return torch.from_numpy(Rotation.align_vectors([UP[up]], [before])[0].as_matrix())

    def refuse_without_tracks(self, kind: str) -> None:
        """Refuse a method of which ``tracks_of`` knows nothing.

        Raises:
            ValueError: naming the format ``kind``.
        """
        follows = isinstance(self.method, HasTrajectories) and isinstance(self.method, HasMatter)
        if not self.has_ellipsoids and not follows:
            raise ValueError(
                f"format={kind}: expected a method whose points can be followed, as particles, forward or "
                f"backward, but got {self.model}"
            )


@dataclass(frozen=True)
class Tracks:
    """N points that move, on the CPU.

    Attributes:
        points: (N, 3), at the canonical time, world units.
        times: (T,).
        positions: (T, N, 3), world units.
        colors: (T, N, 3), in [0, 1], as in the pictures; of one row, if they do not change.
        opacity: (T, N), in [0, 1]; of one row, if it does not change.
        size: world units that a point is about across.
    """

    points: Tensor
    times: Tensor
    positions: Tensor
    colors: Tensor
    opacity: Tensor
    size: float

    def __len__(self) -> int:
        return len(self.points)


@torch.no_grad()
def tracks_of(source: Source, count: int, progress: Progress = lambda done, of: None) -> Tracks:
    """Follow points of the surface: of particles their centers, of voxels their middles.

    Args:
        source: the scene and its times.
        count: most points, spread evenly over the surface.
        progress: told after each time.

    Raises:
        ValueError: if no camera sees any.
    """
    times = torch.tensor(source.times, dtype=torch.float32)
    follow = _particles if source.has_ellipsoids else _matter
    points, size, at = follow(source, count)
    found = []
    for done, time in enumerate(source.times, 1):
        found.append([part.float().cpu() for part in at(float(time))])
        progress(done, len(times))
    positions, colors, opacity = (torch.stack(parts) for parts in zip(*found))
    colors, opacity = (part[:1] if bool((part == part[:1]).all()) else part for part in (colors, opacity))
    return Tracks(points.float().cpu(), times, positions, colors, opacity, size)


def _particles(source: Source, count: int):
    method = source.method
    clouds = (method.ellipsoids(float(time)) for time in source.times)
    opacity = torch.stack([cloud.opacity for cloud in clouds]).amax(0)
    cloud = method.ellipsoids(source.module.curriculum.canonical_time)
    size = method.matter().size
    seen = (opacity > _SOLID) & seen_by(source.module, source.cameras, cloud.centers, size)
    rows = seen.nonzero()[:, 0]
    if not len(rows):
        raise ValueError("run: expected particles that a camera sees, but got none; train it longer")
    rows = rows[far_apart(cloud.centers[rows], count)]

    def at(time: float):
        now = method.ellipsoids(time)[rows]
        return now.centers, now.colors, now.opacity

    return cloud.centers[rows], size, at


def _matter(source: Source, count: int):
    cloud = surface(source.module, source.cameras)
    if not len(cloud):
        raise ValueError("run: expected matter that a camera sees, but got none; train it longer")
    cloud = cloud[far_apart(cloud.points, count)]

    def at(time: float):
        moved = source.method.trajectories(cloud.points, cloud.points.new_tensor([time]))[:, 0]
        return moved, cloud.colors, cloud.opacity

    return cloud.points, cloud.size, at
