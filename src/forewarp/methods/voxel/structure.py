"""The numbers of a voxel method's stage, and how they change its grids: active voxels and lattices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forewarp.fields.grids import EMPTY, VoxelGrid
from forewarp.methods.method import steps_of
from forewarp.methods.rows import renew_parameters
from forewarp.ops.grid import dilate, trilinear
from forewarp.scene.box import Box, Lattice

EFFECTS = ("motion", "view_dependence", "upsampler", "inpainter", "background")


@dataclass(frozen=True)
class VoxelStage:
    """The numbers of a stage. Fractions are fractions of the stage; opacities are over one voxel.

    Args:
        num_voxels: ``[[fraction, count], ...]``: about ``count`` voxels in the box from ``fraction`` on.
        background_num_voxels: as ``num_voxels``, for the static background's grid over the scene's box.
        effects: effects of the model to use in this stage, some of ``motion, view_dependence, upsampler,
            inpainter, background``.
        upsample: interpolate by this factor instead of the model's up-sampler; None: use the model's.
        carry: continue with the grids of the stage before, if it was a voxel method; False: use its box only.
        start: voxels that are active at first: ``box`` (all), ``hull`` (the visual hull; needs alpha), or
            ``auto`` (the hull if the images have alpha, else the box).
        hull_grow: dilate the hull's silhouettes by this share of the image's width, as the scene moves.
        hull_misses: number of views that may disagree about a voxel of the hull.
        hull_frames: make the hull from this many frames nearest to the canonical time, and all frames of the
            same times. With many frames, objects that move fast are carved away.
        refresh_every: steps between updates of the active voxels; 0: never.
        refresh_from: fraction from which they are updated.
        keep_alpha: opacity above which a voxel stays active.
        birth_alpha: opacity of new voxels, below ``keep_alpha``.
        confine: fraction up to which new voxels appear only where voxels were active at the start, so that
            new matter cannot stand in for motion; 0: anywhere.
        see_steps: once a lattice is this many steps old, also deactivate voxels that no view has seen; 0:
            never.
        box_alpha: opacity of the matter that the next stage's box must hold.
        start_alpha: opacity of the first active voxels.
        color_threshold: the renderer's threshold in this stage; None: unchanged.
        bases: ``[[fraction, K], ...]``: use K trajectory bases from ``fraction`` on; empty: all.
        patches: number of patches that the depth term renders.
        name: name of the stage, for errors.

    Raises:
        ValueError: naming the key that is out of range.
    """

    num_voxels: Sequence[Sequence[float]]
    background_num_voxels: Sequence[Sequence[float]] = ((0.0, 262144),)
    effects: Sequence[str] = EFFECTS
    upsample: float | None = None
    carry: bool = True
    start: str = "box"
    hull_grow: float = 0.01
    hull_misses: int = 0
    hull_frames: int = 5
    refresh_every: int = 0
    refresh_from: float = 0.0
    keep_alpha: float = 1e-3
    birth_alpha: float = 5e-4
    confine: float = 0.0
    see_steps: int = 0
    box_alpha: float = 1e-2
    start_alpha: float = 0.05
    color_threshold: float | None = None
    bases: Sequence[Sequence[float]] = ()
    patches: int = 16
    name: str = "fine"

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        for key in ("num_voxels", "background_num_voxels", "bases"):
            if key != "bases" or self.bases:
                steps_of(f"{where}.{key}", getattr(self, key))
        if not set(self.effects) <= set(EFFECTS):
            raise ValueError(
                f"{where}.effects: expected some of {', '.join(EFFECTS)}, but got {list(self.effects)}"
            )
        if self.start not in ("auto", "box", "hull"):
            raise ValueError(f"{where}.start: expected auto, box or hull, but got '{self.start}'")
        if not 0 <= self.confine <= 1:
            raise ValueError(f"{where}.confine: expected a fraction in [0, 1], but got {self.confine}")
        for key in ("box_alpha", "start_alpha"):
            if not 0 < getattr(self, key) < 1:
                raise ValueError(f"{where}.{key}: expected a number in (0, 1), but got {getattr(self, key)}")
        if not 0 < self.birth_alpha < self.keep_alpha < 1:
            raise ValueError(
                f"{where}: expected 0 < birth_alpha < keep_alpha < 1, or fog spreads, "
                f"but got {self.birth_alpha}, {self.keep_alpha}"
            )

    def at(self, key: str, fraction: float) -> float | None:
        """Return the value of the schedule ``key`` at a fraction; None if it is empty."""
        value = None
        for begin, number in getattr(self, key):
            if fraction >= begin or value is None:
                value = number
        return value


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
