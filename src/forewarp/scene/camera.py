"""Cameras, pinhole ones with or without a distorting lens; their rays; and new poses, as of videos.

Axes are OpenCV's: x right, y down, z forward. Pixel centres lie at +0.5. Distances are along the unit ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from forewarp.ops.lens import distort, undistort, unfolded
from forewarp.scene.brief import brief

# In the plane at distance 1: outside every image, but small enough for 64-bit integers in pixels.
_OUTSIDE, _ON_AXIS = 1e9, 1e-9

Vector = Tensor | np.ndarray | Sequence[float]


def _numbers(given) -> Tensor:
    """Make a tensor of what a user gives as a tensor, kept if of floats; an array, or a list: float64.

    Raises:
        TypeError, ValueError: for what is not numbers.
    """
    made = given if isinstance(given, Tensor) else torch.from_numpy(np.array(given, np.float64))
    return made if made.is_floating_point() else made.double()


def tensor_of(key: str, given, *shape: int | None) -> Tensor:
    """Make a float64 tensor of what a user gives as a tensor, an array, or a list.

    Args:
        key: what it is, for the error.
        given: numbers.
        shape: that it must have; None: any length.

    Raises:
        ValueError: for another shape, or what is not finite numbers.

    >>> tensor_of("points", [[1, 2, 3]], None, 3).shape
    torch.Size([1, 3])
    """
    try:
        made = _numbers(given)
    except (TypeError, ValueError):
        made = None
    fits = made is not None and [n if n is None else k for n, k in zip(shape, made.shape)] == [*shape]
    if not fits or made.ndim != len(shape) or not bool(made.isfinite().all()):
        form = f"({', '.join('N' if n is None else str(n) for n in shape)}{',' * (len(shape) == 1)})"
        got = f"{type(given).__name__} {given!r}" if made is None else f"{tuple(made.shape)}"
        raise ValueError(f"{key}: expected finite numbers {form}, but got {got}")
    return made.double()


@dataclass(frozen=True)
class Lens:
    """Radial distortion ``k`` (k1, k2, k3) and tangential distortion ``p`` (p1, p2), as in ``ops.lens``.

    Independent of the image size.

    Raises:
        ValueError: for other numbers of coefficients, or coefficients that are not finite.
    """

    k: tuple[float, float, float] = (0.0, 0.0, 0.0)
    p: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, count in (("k", 3), ("p", 2)):
            values = tuple(float(v) for v in getattr(self, name))
            if len(values) != count or not all(math.isfinite(v) for v in values):
                raise ValueError(f"lens.{name}: expected {count} finite numbers, but got {values}")
            object.__setattr__(self, name, values)

    def bend(self, points: Tensor) -> Tensor:
        """Distort points (..., 2) of the plane at distance 1; keeps the dtype.

        Beyond the lens's fold points are invisible, though the polynomial would map them back into the
        image; such points, and points mapped still farther, are put far outside in their own direction.
        """
        # Float64, as the sixth power of points beside the camera exceeds the range of float32.
        plane = points.double()
        bent = distort(plane, self.k, self.p)
        seen = unfolded(plane, self.k, self.p) & (bent.detach().norm(dim=-1) < _OUTSIDE)
        away = plane * (_OUTSIDE / plane.detach().norm(dim=-1, keepdim=True).clamp(min=_ON_AXIS))
        return torch.where(seen[..., None], bent, away).to(points.dtype)

    def straighten(self, points: Tensor) -> Tensor:
        """Invert ``bend`` for points (..., 2) inside a image, float64."""
        return undistort(points, self.k, self.p)


@dataclass(frozen=True)
class Rays:
    """R rays: ``origins`` (R, 3) and unit ``directions`` (R, 3) in world units; ``near`` and ``far``
    are distances along the unit direction, shared by all.
    """

    origins: Tensor
    directions: Tensor
    near: float
    far: float

    __repr__ = brief

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, rows) -> Rays:
        return Rays(self.origins[rows], self.directions[rows], self.near, self.far)

    def to(self, device) -> Rays:
        """Move the rays to another device."""
        return Rays(self.origins.to(device), self.directions.to(device), self.near, self.far)


def joined(parts: Sequence[Rays]) -> Rays:
    """Concatenate rays; take the least near and the greatest far."""
    origins, directions = torch.cat([p.origins for p in parts]), torch.cat([p.directions for p in parts])
    return Rays(origins, directions, min(p.near for p in parts), max(p.far for p in parts))


@dataclass(frozen=True)
class Camera:
    """``width`` x ``height`` pixels, focal lengths ``fx fy`` and principal point ``cx cy`` in pixels,
    ``camera_to_world`` (4, 4) float64 tensor (arrays and lists become one), ``near`` and ``far`` along the
    unit ray in world units.

    The plane's point (x, y), bent by the ``lens``, lies at pixel ``u = fx x + skew y + cx, v = fy y + cy``.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_world: Tensor
    near: float
    far: float
    skew: float = 0.0
    lens: Lens | None = None

    def __post_init__(self) -> None:
        pose = tensor_of("camera_to_world", self.camera_to_world, 4, 4)
        object.__setattr__(self, "camera_to_world", pose)

    def __repr__(self) -> str:
        """Say in a line how large it is and where it stands."""
        place = ", ".join(f"{x:.4g}" for x in self.center.tolist())
        lens = ", with a lens" if self.lens is not None else ""
        return f"Camera({self.width} x {self.height}, fx={self.fx:.4g}, fy={self.fy:.4g}, at [{place}]{lens})"

    @property
    def center(self) -> Tensor:
        """Camera centre (3,), float64, world units."""
        return self.camera_to_world[:3, 3]

    @property
    def inner(self) -> tuple[int | float | Lens | None, ...]:
        """What makes an image but pose and range, for ``at_origin``: it can be compared and hashed."""
        return self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.skew, self.lens

    @staticmethod
    def at_origin(width, height, fx, fy, cx, cy, skew, lens) -> Camera:
        """Make a camera of this ``inner`` whose axes are the world's, of the range 0 to 1."""
        pose = torch.eye(4, dtype=torch.float64)
        return Camera(width, height, fx, fy, cx, cy, pose, 0.0, 1.0, skew, lens)

    def rays(self, pixels: Vector | None = None, dtype: torch.dtype = torch.float32) -> Rays:
        """Make rays through pixel centres.

        Args:
            pixels: flat indices (R,) into the row-major image, or None for all H*W.
            dtype: dtype of the result.
        """
        pixels = torch.arange(self.width * self.height) if pixels is None else torch.as_tensor(pixels)
        u = (pixels % self.width).double() + 0.5
        v = torch.div(pixels, self.width, rounding_mode="floor").double() + 0.5
        directions = self.directions(u, v)
        return Rays(self.center.expand_as(directions).to(dtype), directions.to(dtype), self.near, self.far)

    def directions(self, u: Vector, v: Vector) -> Tensor:
        """Make unit world directions (..., 3) float64 through pixel coordinates ``u v`` (...,), measured from
        the image's top-left corner; lens and skew are undone.
        """
        return self.turned(self.straight(u, v))

    def straight(self, u: Vector, v: Vector) -> Tensor:
        """Return the points (..., 3) float64 of the camera's axes, at depth 1, that pixel coordinates
        ``u v`` (...,) show; the same for all poses.
        """
        y = (_numbers(v).double() - self.cy) / self.fy
        x = (_numbers(u).double() - self.cx - self.skew * y) / self.fx
        if self.lens is not None:
            x, y = self.lens.straighten(torch.stack([x, y], -1)).unbind(-1)
        return torch.stack([x, y, torch.ones_like(x)], -1)

    def turned(self, points: Tensor) -> Tensor:
        """Return the unit world directions (..., 3) towards points (..., 3) float64 of the camera's axes."""
        return torch.nn.functional.normalize(points @ self.camera_to_world[:3, :3].T, dim=-1)

    def project(self, points: Vector) -> tuple[Tensor, Tensor]:
        """Project world points (..., 3): pixel coordinates (..., 2) from the top-left corner, and depth along
        the optical axis (...,); a point is visible only if this depth is positive.

        Tensors, arrays and lists will do; a tensor's type is kept.
        """
        points = _numbers(points)
        pose = self.camera_to_world.to(points)
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        z = local[..., 2]
        scale, shift = points.new_tensor([self.fx, self.fy]), points.new_tensor([self.cx, self.cy])
        # A point beside the camera projects very far off; the bound is relative, so any unit of length works.
        least = torch.finfo(z.dtype).eps * local.detach().abs().amax(-1)
        safe = torch.where(z.abs() > least, z, torch.where(least > 0, least, 1.0))
        plane = local[..., :2] / safe[..., None]
        plane = plane if self.lens is None else self.lens.bend(plane)
        pixel = plane * scale + shift
        if self.skew:
            pixel = pixel + self.skew * torch.stack([plane[..., 1], torch.zeros_like(z)], -1)
        return pixel, z

    def resized(self, width: int, height: int) -> Camera:
        """Change the image size, keeping the view."""
        sx, sy = width / self.width, height / self.height
        pixels = {"fx": self.fx * sx, "fy": self.fy * sy, "cx": self.cx * sx, "cy": self.cy * sy}
        return replace(self, width=width, height=height, **pixels, skew=self.skew * sx)

    def smaller(self, scale: int) -> Camera:
        """Change to an image whose sides are ``scale`` times smaller; sizes are rounded, all else exact.

        The skew shrinks too. Public loaders leave it as it is, which slants the image wherever it is not 0.
        """
        pixels = {key: getattr(self, key) / scale for key in ("fx", "fy", "cx", "cy", "skew")}
        return replace(self, width=round(self.width / scale), height=round(self.height / scale), **pixels)


def look_at(center: Vector, target: Vector, up: Vector) -> Tensor:
    """Make the pose (4, 4) of a camera at ``center`` that looks at ``target``, with ``up`` upwards.

    All are (3,): tensors, arrays, lists. A camera that looks along ``up`` gets any horizontal axis.

    Raises:
        ValueError: for anything else, and for a target where the camera is.

    >>> look_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1])[:3, 2].tolist()  # which way it looks
    [0.0, 1.0, 0.0]
    """
    center, target, up = (tensor_of(*v, 3) for v in (("center", center), ("target", target), ("up", up)))
    if torch.equal(center, target):
        raise ValueError(f"target: expected another place than the camera's, but got {target.tolist()}")
    forward = torch.nn.functional.normalize(target - center, dim=0)
    right = torch.linalg.cross(forward, up)
    if right.norm() < 1e-6:
        right = torch.linalg.cross(forward, torch.eye(3, dtype=torch.float64)[int(forward.abs().argmin())])
    right = torch.nn.functional.normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
    pose[:3, 3] = center
    return pose


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


def orbit(camera: Camera, focus: Vector, up: Vector, turns: Vector) -> list[Camera]:
    """Make cameras that circle ``focus`` about ``up`` at the height and distance of ``camera``.

    A camera at the focus keeps its pose.

    Args:
        camera: gives the first pose and the lens.
        focus, up: (3,).
        turns: (N,) fractions of a full turn from the start.
    """
    focus, up = tensor_of("focus", focus, 3), torch.nn.functional.normalize(tensor_of("up", up, 3), dim=0)
    offset = camera.center.double() - focus
    height = (offset @ up) * up
    a, b = offset - height, torch.linalg.cross(up, offset - height)
    angles = [2 * math.pi * turn for turn in tensor_of("turns", turns, None).tolist()]
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
