"""Point clouds and Gaussians at one time, and the handover from one stage to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations

import torch
from torch import Tensor

from forewarp.ops.gaussians import FLAT, harmonics
from forewarp.scene.box import Box
from forewarp.scene.brief import brief
from forewarp.scene.world import World

_THINNEST = 1e-6  # of a Gaussian's longest axis: a map may have pressed it flat, and logarithms are taken


@dataclass(frozen=True)
class Cloud:
    """Points of the canonical matter: ``points`` (N, 3) world units, ``colors`` (N, 3) in [0, 1], ``opacity``
    (N,) in [0, 1] of a cell about ``size`` world units across.
    """

    points: Tensor
    colors: Tensor
    opacity: Tensor
    size: float

    __repr__ = brief

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows) -> Cloud:
        return Cloud(self.points[rows], self.colors[rows], self.opacity[rows], self.size)


def far_apart(points: Tensor, count: int) -> Tensor:
    """Choose rows (count,) of points (N, 3) that are spread evenly: the farthest from their mean, then
    repeatedly the farthest from those chosen; all rows, if there are no more.

    Cost: N * count distances.
    """
    if len(points) <= count:
        return torch.arange(len(points), device=points.device)
    chosen = [int((points - points.mean(0)).square().sum(-1).argmax())]
    away = (points - points[chosen[0]]).square().sum(-1)
    for _ in range(count - 1):
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (points - points[chosen[-1]]).square().sum(-1))
    return torch.tensor(chosen, device=points.device)


def nearest(points: Tensor, positions: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Find the positions (M, 3) nearest to points (N, 3).

    Returns:
        squared distances and rows (N, count), nearest first; fewer where there are fewer positions.

    Raises:
        ValueError: for points or positions that are not finite.

    Cost: a tree of the positions, on the CPU, and a walk down it for each point.
    """
    from scipy.spatial import KDTree  # late, as its import takes time

    ranks = list(range(1, min(count, len(positions)) + 1))
    if not len(points):
        none = points.new_zeros(0, len(ranks))
        return none, none.long()
    tree = KDTree(positions.detach().double().cpu().numpy())
    distances, rows = tree.query(points.detach().double().cpu().numpy(), ranks)
    return torch.from_numpy(distances).square().to(points), torch.from_numpy(rows).to(points.device)


@dataclass(frozen=True)
class Handover:
    """What a fitted stage passes on to the next stage, whatever their methods.

    Attributes:
        box: bounds of all matter at all training times, world units.
        tight: False if the stage found no matter and kept its own box.
        frames_in_play: training frames in use at the end of the stage.
        cloud: a sample of the canonical matter; None if the method has no ``matter``.
        times: (T,) some training times, and ``paths`` (N, T, 3), the cloud's points at these; None if the
            method has no trajectories.
        notes: numbers for stages of the same method.
    """

    box: Box
    tight: bool
    frames_in_play: int
    cloud: Cloud | None = None
    times: Tensor | None = None
    paths: Tensor | None = None
    notes: Mapping[str, float] = field(default_factory=dict)

    __repr__ = brief


@dataclass(frozen=True)
class Ellipsoids:
    """N Gaussians as other programs draw them, each row the same one at all times.

    Attributes:
        centers: (N, 3), world units.
        roots: (N, 3, 3), world units: covariances are ``root root^t``.
        opacity: (N,), in [0, 1], in the middle.
        harmonics: (N, B, 3), B one of 1, 4, 9, 16: what ``ops.project.harmonics`` of a unit direction, from
            the eye to the centre, is multiplied by. The colour is ``max(0, 1/2 + sum_k Y_k(direction) h_k)``.
    """

    centers: Tensor
    roots: Tensor
    opacity: Tensor
    harmonics: Tensor

    __repr__ = brief

    def __len__(self) -> int:
        return len(self.centers)

    def __getitem__(self, rows) -> Ellipsoids:
        return Ellipsoids(self.centers[rows], self.roots[rows], self.opacity[rows], self.harmonics[rows])

    @property
    def covariances(self) -> Tensor:
        """Covariances (N, 3, 3), square world units."""
        return self.roots @ self.roots.mT

    @property
    def colors(self) -> Tensor:
        """Mean colours over all directions (N, 3), in [0, 1]."""
        return (0.5 + FLAT * self.harmonics[:, 0]).clamp(0, 1)

    def in_data(self, world: World) -> Ellipsoids:
        """Move them from a scene's world to that of its data; places and sizes are float64, unless both are
        the same world.
        """
        if world.is_same:
            return self
        return replace(self, centers=world.to_data(self.centers), roots=self.roots.double() / world.scale)

    def turned(self, rotation: Tensor) -> Ellipsoids:
        """Turn all of them by a rotation (3, 3) about the origin; their colours turn with them."""
        rotation, generator = rotation.double(), torch.Generator().manual_seed(0)
        directions = torch.randn(64, 3, generator=generator, dtype=torch.float64)
        directions = directions / directions.norm(dim=-1, keepdim=True)
        # A colour seen from a direction is seen from the turned direction afterwards.
        before, after = (harmonics(d, self.harmonics.shape[1]) for d in (directions, directions @ rotation.T))
        mixed = torch.linalg.lstsq(after, before).solution.to(self.harmonics)
        colors, rotation = torch.einsum("ab,nbc->nac", mixed, self.harmonics), rotation.to(self.centers)
        return Ellipsoids(self.centers @ rotation.T, rotation @ self.roots, self.opacity, colors)

    @cached_property
    def axes(self) -> tuple[Tensor, Tensor]:
        """Standard deviations (N, 3) > 0 along the principal axes of the covariances, and how these axes are
        turned: unit quaternions (N, 4) w, x, y, z.

        Axes have the order and the signs that are nearest to the columns of the roots (N, 3, 3): those of a
        rotated diagonal matrix stay as they are, and small changes turn them little, unless two are equally
        long. Rotations are proper. What is thinner than a millionth of the longest axis counts as that.

        Cost: a singular value decomposition in float64 each, about 10 microseconds.
        """
        from scipy.spatial.transform import Rotation  # late, as its import takes time

        left, scales, right = torch.linalg.svd(self.roots.double())  # rows of right: axes among the columns
        orders = torch.tensor(list(permutations(range(3))), device=self.roots.device)  # (6, 3)
        columns = torch.arange(3, device=self.roots.device)
        order = orders[right.abs()[:, orders, columns].sum(-1).argmax(-1)]  # (N, 3), the axis of each column
        signs = torch.where(right.gather(1, order[:, None])[:, 0] < 0, -1.0, 1.0)
        axes = left.gather(2, order[:, None].expand(-1, 3, -1)) * signs[:, None]
        axes[:, :, 2] *= torch.linalg.det(axes).sign()[:, None]
        longest = scales[:, :1].clamp(min=torch.finfo(torch.float32).tiny / _THINNEST)
        scales = torch.maximum(scales.gather(1, order), _THINNEST * longest)
        quaternions = Rotation.from_matrix(axes.cpu().numpy()).as_quat()  # x, y, z, w
        return scales.to(self.roots), torch.from_numpy(quaternions).roll(1, -1).to(self.roots)
