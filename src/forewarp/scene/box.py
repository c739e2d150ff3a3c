"""An axis-aligned box in world units, and the regular lattice of voxel centres in a box."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.scene.brief import brief


@dataclass(frozen=True)
class Box:
    """An axis-aligned box: ``low`` and ``high`` are tuples of three floats in world units.

    Raises:
        ValueError: if a side has no extent or a corner is not finite.

    >>> Box((-1, -1, -1), (1, 2, 1)).size
    (2.0, 3.0, 2.0)
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    __repr__ = brief

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
        is_complete = len(self.low) == len(self.high) == 3 and all(map(math.isfinite, self.low + self.high))
        if not is_complete or any(h <= l for l, h in zip(self.low, self.high)):
            got = f"low={self.low}, high={self.high}"
            raise ValueError(f"a box: expected finite low < high on three axes, but got {got}")

    @property
    def size(self) -> tuple[float, float, float]:
        """Extent per axis, world units."""
        return tuple(h - l for l, h in zip(self.low, self.high))

    @property
    def center(self) -> tuple[float, float, float]:
        """Midpoint, world units."""
        return tuple(0.5 * (h + l) for l, h in zip(self.low, self.high))

    @property
    def diagonal(self) -> float:
        """Length of the diagonal, world units."""
        return math.sqrt(sum(s * s for s in self.size))

    def scaled(self, factor: float) -> Box:
        """Scale the box about its centre."""
        center, half = self.center, [0.5 * factor * s for s in self.size]
        return Box(tuple(c - h for c, h in zip(center, half)), tuple(c + h for c, h in zip(center, half)))

    def padded(self, by: float) -> Box:
        """Add ``by`` world units on every side."""
        return Box(tuple(v - by for v in self.low), tuple(v + by for v in self.high))

    def holds(self, point: Tensor) -> bool:
        """Return whether a point (3,) lies within the box."""
        return all(low <= value <= high for low, value, high in zip(self.low, point.tolist(), self.high))

    def meets(self, other: Box) -> bool:
        """Return whether two boxes share more than a face."""
        return all(max(a, b) < min(c, d) for a, b, c, d in zip(self.low, other.low, self.high, other.high))

    def intersection(self, other: Box) -> Box:
        """Intersect two boxes that meet."""
        return Box(tuple(map(max, self.low, other.low)), tuple(map(min, self.high, other.high)))


@dataclass(frozen=True)
class Lattice:
    """``shape`` points on a regular grid over ``box``, the outermost on its faces (align-corners).

    A point's *lattice coordinate* runs from 0 to ``n - 1`` per axis; the operators in ``ops`` use it.
    """

    box: Box
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        if len(self.shape) != 3 or min(self.shape) < 2:
            got = f"shape={self.shape}"
            raise ValueError(f"a lattice: expected three axes of at least 2 points, but got {got}")

    @classmethod
    def of_count(cls, box: Box, count: float, least: int = 4) -> Lattice:
        """Make a lattice of about ``count`` cubic voxels over a box; axes too flat get ``least`` voxels.

        >>> Lattice.of_count(Box((0, 0, 0), (1, 2, 1)), 2000).shape
        (10, 20, 10)
        >>> Lattice.of_count(Box((0, 0, 0), (1, 1, 1e-9)), 4e4).shape
        (100, 100, 4)
        """
        flat: list[float] = []
        while len(flat) < 3:
            # Take flat axes off first, or a planar scene gets a thousand times as many voxels.
            free = sorted(box.size)[len(flat) :]
            side = (math.prod(free) / (float(count) / least ** len(flat))) ** (1 / len(free))
            if round(free[0] / side) >= least:
                break
            flat.append(free[0])
        return cls(box, tuple(least if s in flat else max(least, int(round(s / side))) for s in box.size))

    @property
    def count(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Distance between neighbours per axis, world units."""
        return tuple(s / (n - 1) for s, n in zip(self.box.size, self.shape))

    @property
    def voxel_size(self) -> float:
        """Geometric mean of the spacing, world units."""
        return math.prod(self.spacing) ** (1 / 3)

    def to_lattice(self, points: Tensor) -> Tensor:
        """Convert world (..., 3) to lattice coordinates (..., 3)."""
        return (points - points.new_tensor(self.box.low)) / points.new_tensor(self.spacing)

    def to_world(self, coordinates: Tensor) -> Tensor:
        """Convert lattice coordinates (..., 3) to world (..., 3)."""
        dtype = coordinates.dtype if coordinates.is_floating_point() else torch.get_default_dtype()
        c = coordinates.to(dtype)
        return c * c.new_tensor(self.spacing) + c.new_tensor(self.box.low)

    def holds(self, coordinates: Tensor) -> Tensor:
        """Return whether lattice coordinates (..., 3) lie within the box: bool (...,)."""
        last = coordinates.new_tensor(self.shape) - 1
        return ((coordinates >= 0) & (coordinates <= last)).all(-1)

    def normalised(self, coordinates: Tensor) -> Tensor:
        """Scale lattice coordinates (..., 3) to [-1, 1] per axis, for positional encoding."""
        last = torch.tensor([n - 1 for n in self.shape], device=coordinates.device)
        return 2.0 * coordinates / last - 1.0  # divided last: keeps float64 exact

    def all_voxels(self, device: torch.device | str = "cpu") -> Tensor:
        """List every voxel's integer coordinates (X*Y*Z, 3), last axis fastest."""
        axes = [torch.arange(n, device=device) for n in self.shape]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
