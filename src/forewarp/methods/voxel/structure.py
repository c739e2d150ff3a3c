"""How voxel grids change during training: which voxels are active, and how fine the lattice is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.fields.radiance_grid import EMPTY
from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.methods.rows import renew_parameters
from forewarp.methods.voxel.stage import VoxelStage
from forewarp.ops.grid import dilate, trilinear
from forewarp.scene.box import Box, Lattice


@dataclass
class _Followed:
    """A grid, the key of its schedule, its present number of voxels and the step at which it got them."""

    grid: VoxelGrid
    key: str
    num_voxels: float
    step: int = 0


class Lattices:
    """Let the canonical grid, and the static background's, follow the schedule of a stage.

    Args:
        radiance: the canonical grid.
        background: the static grid, or None.
        settings: the numbers of the stage.
    """

    def __init__(self, radiance: VoxelGrid, background: VoxelGrid | None, settings: VoxelStage) -> None:
        self.settings = settings
        grids = {"num_voxels": radiance, "background_num_voxels": background}
        self.followed = [
            _Followed(grid, key, settings.at(key, 0.0)) for key, grid in grids.items() if grid is not None
        ]
        # Voxels that were active at the start; meaningful on the first lattice only.
        self.home: Tensor = radiance.index >= 0

    def follow(self, fraction: float, step: int, optimizer: torch.optim.Optimizer) -> None:
        """Resample or refresh the grids that are due at a fraction of the stage."""
        for followed in self.followed:
            self._follow(followed, fraction, step, optimizer)

    def _follow(
        self, followed: _Followed, fraction: float, step: int, optimizer: torch.optim.Optimizer
    ) -> None:
        settings, grid = self.settings, followed.grid
        only_seen = settings.see_steps > 0 and step - followed.step >= settings.see_steps
        common = {"keep_alpha": settings.keep_alpha, "optimizer": optimizer, "only_seen": only_seen}
        num_voxels = settings.at(followed.key, fraction)
        due = settings.refresh_every and step and step % settings.refresh_every == 0
        if num_voxels != followed.num_voxels:
            resample(grid, grid.lattice.box, num_voxels, **common)
            followed.num_voxels, followed.step = num_voxels, step
        elif due and fraction >= settings.refresh_from:
            confined = followed.key == "num_voxels" and fraction < settings.confine
            confined = confined and self.home.shape == grid.lattice.shape
            allowed = self.home.to(grid.index.device) if confined else None
            refresh(grid, birth_alpha=settings.birth_alpha, allowed=allowed, **common)

    def state_dict(self) -> dict:
        """Return all that is needed to continue."""
        return {"home": self.home, "followed": {f.key: [f.num_voxels, f.step] for f in self.followed}}

    def load_state_dict(self, state: dict) -> None:
        """Continue from a ``state_dict``."""
        self.home = state["home"]
        for followed in self.followed:
            followed.num_voxels, followed.step = state["followed"][followed.key]


def seen_rows(radiance: VoxelGrid, optimizer: torch.optim.Optimizer) -> Tensor:
    """Voxels (N,) bool that some view has seen: their colour has had a gradient since the moments began."""
    name = "color" if "color" in radiance.names else radiance.names[0]
    moments = optimizer.state.get(radiance.parameter(name), {}).get("exp_avg_sq")
    if moments is None:
        return torch.ones(len(radiance.voxels), dtype=torch.bool, device=radiance.voxels.device)
    return moments.amax(-1) > 0


def occupied(radiance: VoxelGrid, keep_alpha: float, seen: Tensor | None = None) -> Tensor:
    """Voxels (X, Y, Z) bool with an opacity above ``keep_alpha`` over one voxel that are ``seen`` (N,)."""
    with torch.no_grad():
        grid = radiance()
    solid = grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size) > keep_alpha
    solid = solid if seen is None else solid & seen
    mask = torch.zeros(grid.lattice.shape, dtype=torch.bool, device=solid.device)
    x, y, z = radiance.voxels[solid].unbind(-1)
    mask[x, y, z] = True
    return mask


@torch.no_grad()
def refresh(
    radiance: VoxelGrid,
    optimizer: torch.optim.Optimizer,
    *,
    keep_alpha: float,
    birth_alpha: float,
    only_seen: bool = False,
    allowed: Tensor | None = None,
) -> bool:
    """Activate the occupied voxels and their neighbours, and deactivate all others.

    Leave an empty grid as it is, so that a scene that has not appeared yet can still appear.

    Args:
        radiance: the grid; its active voxels change in place.
        optimizer: its moments follow the rows.
        keep_alpha: opacity over one voxel above which a voxel is occupied.
        birth_alpha: opacity of a new voxel; below ``keep_alpha``, or fog spreads.
        only_seen: also deactivate voxels that no view has seen, inside of solid objects.
        allowed: (X, Y, Z) bool, where voxels may become active; None: anywhere.

    Returns:
        whether the active voxels changed.
    """
    mask = occupied(radiance, keep_alpha, seen_rows(radiance, optimizer) if only_seen else None)
    if not bool(mask.any()):
        return False
    active = dilate(mask, 1) if allowed is None else (dilate(mask, 1) & allowed) | mask
    if bool((active == (radiance.index >= 0)).all()):
        return False
    before = [radiance.parameter(n) for n in radiance.names]
    rows = radiance.activate(active, radiance.births(birth_alpha))
    renew_parameters(optimizer, before, [radiance.parameter(n) for n in radiance.names], rows)
    return True


@torch.no_grad()
def resample(
    radiance: VoxelGrid,
    box: Box,
    num_voxels: float,
    *,
    keep_alpha: float,
    optimizer: torch.optim.Optimizer | None = None,
    only_seen: bool = False,
) -> None:
    """Resample the grid to a lattice of about ``num_voxels`` over ``box``.

    Activate the occupied voxels and their neighbours; if none is occupied, all. The grid's moments in the
    optimiser start at 0.
    """
    source = radiance()
    lattice = Lattice.of_count(box, num_voxels)
    points = source.lattice.to_lattice(lattice.to_world(lattice.all_voxels(source.values.device)))
    raw = source.values[:, :1].detach()
    if only_seen and optimizer is not None:
        raw = torch.where(seen_rows(radiance, optimizer)[:, None], raw, EMPTY)
    raw = trilinear(raw.contiguous(), source.index, points, source.fill[:1])[:, 0]
    last = torch.tensor(source.lattice.shape, device=points.device) - 1
    slack = 1e-3  # in voxels: keep the border of an equal box in spite of rounding
    inside = ((points >= -slack) & (points <= last + slack)).all(-1)
    solid = (source.activation.alpha(raw, source.lattice.voxel_size) > keep_alpha) & inside
    mask = dilate(solid.reshape(lattice.shape), 1)
    if not bool(mask.any()):
        mask = torch.ones_like(mask)
    before = [radiance.parameter(n) for n in radiance.names]
    radiance.resample(lattice, mask, radiance.empties())
    if optimizer is not None:
        renew_parameters(optimizer, before, [radiance.parameter(n) for n in radiance.names], None)


@torch.no_grad()
def box_of_all_times(method, times: list[float], *, alpha: float, pad: float) -> Box | None:
    """Bound all voxels more opaque than ``alpha`` at all ``times``, with a margin of ``pad`` voxels.

    Return None if no voxel is that opaque.
    """
    grid = method.radiance()
    solid = grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size) > alpha
    if not bool(solid.any()):
        return None
    home = grid.lattice.to_world(method.radiance.voxels)[solid]
    low, high = home.amin(0), home.amax(0)
    for time in times if method.moves else ():
        at = method.moved(home, solid, time)
        low, high = torch.minimum(low, at.amin(0)), torch.maximum(high, at.amax(0))
    margin = pad * grid.lattice.voxel_size  # added first, as a flat object has no box of its own
    return Box(tuple((low - margin).tolist()), tuple((high + margin).tolist()))
