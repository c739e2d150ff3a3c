"""What the stability tests share: volumes, rays, and the check that nothing broke."""

import math

import torch

from forewarp.fields.grids import Activation, RadianceGrid
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Rays

SHAPE = (3, 4, 5)
LATTICE = Lattice(Box((-1.0, -1.0, -1.0), (1.0, 2.0, 3.0)), SHAPE)


def check_finite(out, *inputs):
    """Assert that outputs and the gradients of their squares are finite; returns the gradients."""
    outputs = [o for o in (out if isinstance(out, tuple | list) else [out]) if o.is_floating_point()]
    for value in outputs:
        assert value.isfinite().all()
    loss = sum((o.square().sum() for o in outputs if o.requires_grad), 0 * sum(i.sum() for i in inputs))
    gradients = torch.autograd.grad(loss, inputs, allow_unused=True, materialize_grads=True)
    for gradient in gradients:
        assert gradient.isfinite().all()
    return gradients


def voxels(shape=SHAPE, device="cpu"):
    """Every voxel's coordinate (X*Y*Z, 3), float32."""
    return torch.cartesian_prod(*(torch.arange(float(n), device=device) for n in shape))


def grid(raw, *, lattice=LATTICE, index=None, density_scale=1.0, device="cpu"):
    """A radiance grid of constant raw density and grey features; ``index`` None: all voxels are present."""
    if index is None:
        index = torch.arange(lattice.count, dtype=torch.int32, device=device).reshape(lattice.shape)
    values = torch.zeros(int((index >= 0).sum()), 4, device=device)
    values[:, 0] = raw
    return RadianceGrid(lattice, index.to(device), values.requires_grad_(), Activation(-4.6, density_scale))


def index_with(present, device="cpu"):
    """The index of a mask (X, Y, Z)."""
    flat = present.flatten()
    return torch.where(flat, flat.cumsum(0) - 1, -1).to(torch.int32).reshape(present.shape).to(device)


def rays(origins, directions, near=0.0, far=20.0, device="cpu"):
    """Rays of unit directions."""
    directions = torch.nn.functional.normalize(torch.tensor(directions, device=device), dim=-1)
    return Rays(torch.tensor(origins, device=device), directions, near, far)


def raw_of(sigma):
    """The raw density of a density at unit 1 and shift -4.6."""
    return 4.6 + (sigma if sigma > 30 else math.log(math.expm1(sigma)) if sigma > 0 else -math.inf)
