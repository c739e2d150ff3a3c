"""How the grids of a stage follow its schedule: which voxels are active, how fine each lattice is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.methods.voxel.stage import VoxelStage
from forewarp.methods.voxel.structure import refresh, resample


@dataclass
class _Followed:
    """A grid, the key of its schedule, the count it has now and the step at which it got it."""

    grid: VoxelGrid
    key: str
    voxels: float
    step: int = 0


class Lattices:
    """The canonical grid, and the static background's where there is one.

    Args:
        radiance: the canonical grid.
        background: the static one, or None.
        settings: the stage's numbers.
    """

    def __init__(self, radiance: VoxelGrid, background: VoxelGrid | None, settings: VoxelStage) -> None:
        self.settings = settings
        grids = {"num_voxels": radiance, "background_num_voxels": background}
        self.followed = [
            _Followed(grid, key, settings.at(key, 0.0)) for key, grid in grids.items() if grid is not None
        ]
        # Where voxels were active at the start; only on that lattice does it mean anything.
        self.home: Tensor = radiance.index >= 0

    def follow(self, fraction: float, step: int, optimizer: torch.optim.Optimizer) -> None:
        """Change what is due at a fraction of the stage; the optimiser's moments follow."""
        for followed in self.followed:
            self._follow(followed, fraction, step, optimizer)

    def _follow(
        self, followed: _Followed, fraction: float, step: int, optimizer: torch.optim.Optimizer
    ) -> None:
        settings, grid = self.settings, followed.grid
        only_seen = settings.see_steps > 0 and step - followed.step >= settings.see_steps
        common = {"keep_alpha": settings.keep_alpha, "optimizer": optimizer, "only_seen": only_seen}
        voxels = settings.at(followed.key, fraction)
        due = settings.refresh_every and step and step % settings.refresh_every == 0
        if voxels != followed.voxels:
            resample(grid, grid.lattice.box, voxels, **common)
            followed.voxels, followed.step = voxels, step
        elif due and fraction >= settings.refresh_from:
            confined = followed.key == "num_voxels" and fraction < settings.confine
            confined = confined and self.home.shape == grid.lattice.shape
            allowed = self.home.to(grid.index.device) if confined else None
            refresh(grid, birth_alpha=settings.birth_alpha, allowed=allowed, **common)

    def state_dict(self) -> dict:
        """All that is needed to go on."""
        return {"home": self.home, "followed": {f.key: [f.voxels, f.step] for f in self.followed}}

    def load_state_dict(self, state: dict) -> None:
        """Go on where ``state_dict`` was taken."""
        self.home = state["home"]
        for followed in self.followed:
            followed.voxels, followed.step = state["followed"][followed.key]
