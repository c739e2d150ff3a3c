"""Where a field has matter at any time, so that samples elsewhere need not be evaluated."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from forewarp.ops.grid import dilate
from forewarp.scene.box import Box
from forewarp.scene.frame import Frame, sightings

_EVERY = 4  # possible cell is evaluated by a look
_FADE = 0.8  # of what was found, at each look
_OPAQUE = 0.01  # a cell counts as occupied if a step of one cell through it is at least so opaque,
_AT_ONCE = 1 << 16  # cells evaluated at once
_LEAST = 1e-4  # or more opaque than the mean of all cells and this, while a field is young


class Occupancy(nn.Module):
    """A lattice of side^3 cells over a box: the largest density found in each of them of late, at any time.

    Until it has looked ``patience`` times every possible cell counts as occupied. A look evaluates every
    fourth of these, at a random point of each and at a random time.

    Args:
        box: of the scene; what lies outside is empty.
        side: cells along each axis.
        patience: looks before any cell may count as empty.
    """

    def __init__(self, box: Box, *, side: int, patience: int = 8) -> None:
        super().__init__()
        self.side, self.patience = side, patience
        self.register_buffer("low", torch.tensor(box.low))
        self.register_buffer("cell", torch.tensor(box.size) / side)
        self.register_buffer("density", torch.zeros(side**3))
        self.register_buffer("possible", torch.ones(side**3, dtype=torch.bool))
        self.register_buffer("occupied", torch.ones(side**3, dtype=torch.bool))
        self.register_buffer("looks", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def confine(self, frames: Sequence[Frame], share: float) -> None:
        """Count cells as empty for good that hold something for less than a ``share`` of the time.

        A cell that holds something is covered (by alpha) in every picture, from any side. At other times it
        is as often as the mean of all cells. So cells are left out that less pictures show as covered than
        follows from both, or that most pictures do not see. Cost: about a hundredth of a second a picture.
        """
        cells = torch.arange(self.side**3, device=self.low.device)
        centers = self.low + (self._rows(cells) + 0.5) * self.cell
        masks = [frame.load()[..., 3] > 0 for frame in frames]
        covered, seen = sightings(centers.cpu(), [frame.camera for frame in frames], masks)
        often = covered / seen.clamp(min=1)
        usual = float(often[seen > 0].mean()) if bool((seen > 0).any()) else 0.0
        possible = (2 * seen >= len(frames)) & (often >= usual + share * (1 - usual))
        self.possible.copy_(self._grown(possible.to(self.possible.device)))
        self.occupied.copy_(self.possible)

    @torch.no_grad()
    def look(
        self, density: Callable[[Tensor, float], Tensor], times: Sequence[float], generator: torch.Generator
    ) -> None:
        """Look at some cells.

        Args:
            density: world points (P, 3) and a time -> density (P,), per world unit.
            times: one is drawn.
            generator: draws cells, points and time.
        """
        first = int(torch.randint(_EVERY, (), generator=generator))
        cells = self.possible.nonzero()[first::_EVERY, 0]
        inside = torch.rand(len(cells), 3, generator=generator).to(self.low)
        time = times[int(torch.randint(len(times), (), generator=generator))]
        found = density(self.low + (self._rows(cells) + inside) * self.cell, time)
        self.density[cells] = torch.maximum(_FADE * self.density[cells], found)
        self.looks += 1
        if int(self.looks) >= self.patience:
            self._judge()

    @torch.no_grad()
    def settle(self, density: Callable[[Tensor, float], Tensor], times: Sequence[float]) -> None:
        """Look at the middle of every occupied cell at all of these times, and rely on what is found.

        Args:
            density, times: as of ``look``.
        """
        cells = self.occupied.nonzero()[:, 0]
        middles = self.low + (self._rows(cells) + 0.5) * self.cell
        self.density.zero_()
        for time in times:
            for some, rows in zip(middles.split(_AT_ONCE), cells.split(_AT_ONCE)):
                self.density[rows] = torch.maximum(self.density[rows], density(some, time))
        self.looks.fill_(self.patience)
        self._judge()

    def bounds(self, alpha: float) -> Box | None:
        """Bound the cells more opaque than ``alpha`` across one cell and those beside them; None: none."""
        rows = self._rows((self._opacity() > alpha).nonzero()[:, 0])
        if not len(rows):
            return None
        low, high = rows.amin(0) - 1, rows.amax(0) + 2
        return Box(*(self.low + corner.clamp(0, self.side) * self.cell for corner in (low, high)))

    @property
    def cells(self) -> Tensor:
        """The cells (side, side, side) bool that may hold matter."""
        return self.occupied.reshape(self.side, self.side, self.side)

    def _rows(self, cells: Tensor) -> Tensor:
        """Return the places (P, 3) of cells (P,) along the axes."""
        return torch.stack([cells // self.side**2, cells // self.side % self.side, cells % self.side], -1)

    def _opacity(self) -> Tensor:
        return -torch.expm1(-self.density * float(self.cell.min()))

    def _judge(self) -> None:
        opaque = self._opacity()
        least = min(_OPAQUE, max(_LEAST, float(opaque[self.possible].mean())))
        self.occupied.copy_(self._grown(opaque > least) & self.possible)

    def _grown(self, occupied: Tensor) -> Tensor:
        """Add the cells beside occupied ones: what moves, moves into them."""
        return dilate(occupied.reshape([self.side] * 3)).flatten()

    def forward(self, points: Tensor) -> Tensor:
        """Tell which of the world points (..., 3) lie in an occupied cell: bool (...,)."""
        rows = ((points - self.low) / self.cell).floor().long()
        inside = ((rows >= 0) & (rows < self.side)).all(-1)
        x, y, z = rows.clamp(0, self.side - 1).unbind(-1)
        return inside & self.occupied[(x * self.side + y) * self.side + z]
