"""Learned values on the active voxels of a lattice, dense or sparse."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from forewarp.ops.grid import index_of, trilinear
from forewarp.scene.box import Box, Lattice


class VoxelGrid(nn.Module):
    """Parameters (N, C) with one row per active voxel, and buffers with the voxels' positions.

    ``voxels`` (N, 3) are the active voxels' lattice positions, ``index`` (X, Y, Z) their rows or -1. Both
    change during training (``activate``, ``resample``), so loading adopts a checkpoint's lattice and shapes.

    Args:
        lattice: possible voxel positions.
        active: (X, Y, Z) bool, the active voxels.
        channels: number of channels C by parameter name.
    """

    def __init__(self, lattice: Lattice, active: Tensor, channels: dict[str, int]) -> None:
        super().__init__()
        self.lattice = lattice
        self.names = tuple(channels)
        voxels = active.nonzero()
        self.register_buffer("voxels", voxels)
        self.register_buffer("index", index_of(voxels, lattice.shape))
        for name, c in channels.items():
            self.register_parameter(name, nn.Parameter(torch.zeros(len(voxels), c)))

    def extra_repr(self) -> str:
        """Describe shape, share of active voxels and parameters."""
        return f"{self.lattice.shape}, active={len(self.voxels) / self.lattice.count:.1%}, {self.names}"

    def parameter(self, name: str) -> nn.Parameter:
        """Return a parameter (N, C) by name."""
        return getattr(self, name)

    @torch.no_grad()
    def activate(self, active: Tensor, births: dict[str, float]) -> Tensor:
        """Make the voxels in ``active`` (X, Y, Z) the active ones.

        New voxels get ``births[name]``, or the mean of their active neighbours for names not in it.

        Returns:
            (N',) int64, the former row of each voxel, -1 for new ones.
        """
        voxels = active.nonzero().to(self.voxels.device)
        rows = self.index[voxels[:, 0], voxels[:, 1], voxels[:, 2]].long()
        new = (rows < 0).nonzero()[:, 0]
        for name in self.names:
            old = self.parameter(name)
            values = old.data[rows.clamp(min=0)] if len(old) else old.data.new_zeros(len(rows), old.shape[1])
            if name in births:
                values[new] = births[name]
            else:
                values[new] = self._neighbour_mean(old.data, voxels[new])
            self._renew(name, values)
        self._place(self.lattice, voxels)
        return rows

    @torch.no_grad()
    def resample(self, lattice: Lattice, active: Tensor, empty: dict[str, float]) -> None:
        """Interpolate the values to another lattice, trilinearly.

        Absent voxels count as ``empty[name]``; names not in it are averaged over the present voxels.
        """
        voxels = active.nonzero().to(self.voxels.device)
        points = self.lattice.to_lattice(lattice.to_world(voxels))
        ones = torch.ones(len(self.voxels), 1, device=points.device)
        share = trilinear(ones, self.index, points, ones.new_zeros(1)).clamp(min=1e-6)
        for name in self.names:
            p = self.parameter(name)
            fill = p.data.new_full((p.shape[1],), empty.get(name, 0.0))
            values = trilinear(p.data, self.index, points, fill)
            self._renew(name, values if name in empty else values / share)
        self._place(lattice, voxels)

    def _renew(self, name: str, values: Tensor) -> None:
        # A new Parameter, as autograd keeps the shape of the old one while any graph lives.
        setattr(self, name, nn.Parameter(values))

    def _place(self, lattice: Lattice, voxels: Tensor) -> None:
        self.lattice = lattice
        self.voxels = voxels
        self.index = index_of(voxels, lattice.shape)

    def _neighbour_mean(self, values: Tensor, voxels: Tensor) -> Tensor:
        last = torch.tensor(self.lattice.shape, device=voxels.device) - 1
        total = values.new_zeros(len(voxels), values.shape[1])
        count = values.new_zeros(len(voxels), 1)
        for offset in torch.cartesian_prod(*[torch.arange(-1, 2)] * 3).to(voxels.device):
            at = voxels + offset
            inside = ((at >= 0) & (at <= last)).all(-1)
            x, y, z = torch.minimum(at.clamp(min=0), last).unbind(-1)
            row = torch.where(inside, self.index[x, y, z].long(), -1)
            there = (row >= 0)[:, None]
            if len(values):
                total += torch.where(there, values[row.clamp(min=0)], 0.0)
            count += there
        return total / count.clamp(min=1)

    def get_extra_state(self) -> dict:
        """Return the lattice in plain numbers."""
        box = self.lattice.box
        return {"low": list(box.low), "high": list(box.high), "shape": list(self.lattice.shape)}

    def set_extra_state(self, state: dict) -> None:
        """Adopt a checkpoint's lattice."""
        self.lattice = _lattice(state)

    def misfit(self, state: dict, prefix: str) -> str | None:
        """Return the name of a stored entry that contradicts the others, or None.

        Kernels do not check the index: a wrong one would crash the process.
        """
        try:
            lattice = _lattice(state[prefix + "_extra_state"])
        except (KeyError, TypeError, ValueError, OverflowError):
            return "_extra_state"
        voxels, index = (state.get(prefix + name) for name in ("voxels", "index"))
        if not _is(voxels, torch.int64) or voxels.ndim != 2 or voxels.shape[1] != 3:
            return "voxels"
        last = torch.tensor(lattice.shape) - 1
        if not bool(((voxels >= 0) & (voxels <= last)).all()):
            return "voxels"
        if not _is(index, torch.int32) or tuple(index.shape) != lattice.shape:
            return "index"
        if not torch.equal(index, index_of(voxels, lattice.shape)):
            return "index"
        for name in self.names:
            values, own = state.get(prefix + name), self.parameter(name)
            good = torch.is_tensor(values) and values.is_floating_point()
            if not good or tuple(values.shape) != (len(voxels), own.shape[1]):
                return name
        return None

    def _load_from_state_dict(self, state_dict, prefix, *args, **kwargs) -> None:
        for name in ("voxels", "index"):
            if prefix + name in state_dict:
                setattr(self, name, torch.empty_like(state_dict[prefix + name]))
        for name in self.names:
            if prefix + name in state_dict:
                p = self.parameter(name)
                p.data = p.data.new_empty(state_dict[prefix + name].shape)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def grids_in(module: nn.Module) -> dict[str, VoxelGrid]:
    """Return all voxel grids of a module by their names in ``state_dict``."""
    return {name: part for name, part in module.named_modules() if isinstance(part, VoxelGrid)}


def adopted_in(module: nn.Module) -> set[str]:
    """Return the names in ``state_dict`` by which a module's grids adopt a checkpoint's lattices."""
    return {
        f"{place}.{name}"
        for place, grid in grids_in(module).items()
        for name in ("voxels", "index", *grid.names)
    }


def misfit_in(module: nn.Module, state: Mapping[str, Tensor]) -> str | None:
    """Return what in a module's stored grids contradicts their lattices, or None."""
    found = ((place, grid.misfit(state, f"{place}.")) for place, grid in grids_in(module).items())
    return next((f"{place}.{name}" for place, name in found if name is not None), None)


def _lattice(state: dict) -> Lattice:
    return Lattice(Box(tuple(state["low"]), tuple(state["high"])), tuple(state["shape"]))


def _is(value: object, dtype: torch.dtype) -> bool:
    return torch.is_tensor(value) and value.dtype == dtype
